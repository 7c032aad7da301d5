// Numbers of twice the precision of float64, as sums of two [Dekker 1971].

#define SPLIT 134217729.0 // 2^27 + 1: halves the digits of a double

typedef struct {
    double high, low; // low is much smaller
} twofold;

// a + b exactly, if |a| >= |b|.
twofold joined(double a, double b)
{
    const double high = a + b;
    return (twofold){high, b - (high - a)};
}

// a + b exactly [Knuth 1998].
twofold sum_of(double a, double b)
{
    const double high = a + b, part = high - a;
    return (twofold){high, (a - (high - part)) + (b - part)};
}

// a b exactly.
twofold product_of(double a, double b)
{
    const double high = a * b, as = SPLIT * a, bs = SPLIT * b;
    const double ah = as - (as - a), bh = bs - (bs - b), al = a - ah, bl = b - bh;
    return (twofold){high, al * bl - (((high - ah * bh) - al * bh) - ah * bl)};
}

twofold plus(twofold a, twofold b)
{
    const twofold high = sum_of(a.high, b.high), low = sum_of(a.low, b.low);
    const twofold sum = joined(high.high, high.low + low.high);
    return joined(sum.high, sum.low + low.low);
}

twofold times(twofold a, twofold b)
{
    const twofold p = product_of(a.high, b.high);
    return joined(p.high, p.low + (a.high * b.low + a.low * b.high));
}

twofold root_of(twofold a)
{
    if (a.high <= 0)
        return (twofold){0, 0};
    const double root = sqrt(a.high);
    const twofold square = product_of(root, root);
    return joined(root, ((a.high - square.high) - square.low + a.low) / (2 * root));
}

twofold dot_of(const twofold *a, const twofold *b)
{
    return plus(plus(times(a[0], b[0]), times(a[1], b[1])), times(a[2], b[2]));
}
