// Exact signs of determinants of coordinates: in float64, with a bound of the error, and in integers
// where that leaves the sign open. Coordinates are within 2^57, and differ by at most 2; digits below
// 2^-UNIT are cut off.

#define UNIT 188
#define WORDS 3      // of a difference: 64 bits each, the lowest first, in two's complement
#define TINY 0x1p-900 // products of float64 below it have digits that underflow

// Adds b to a, or subtracts it, both of `words`.
void add_words(ulong *a, const ulong *b, uint words, bool subtract)
{
    ulong carry = subtract;
    for (uint i = 0; i < words; ++i) {
        const ulong term = subtract ? ~b[i] : b[i], sum = a[i] + term;
        a[i] = sum + carry;
        carry = (sum < term) | (a[i] < carry);
    }
}

// Adds a 2^UNIT to a difference, or subtracts it.
void add_coordinate(ulong *to, double a, bool subtract)
{
    const ulong bits = as_ulong(a), digits = (bits & 0xFFFFFFFFFFFFFUL) | 1UL << 52;
    const int shift = (int)(bits >> 52 & 2047) - 1075 + UNIT;
    if (shift < -52)
        return;
    const uint at = shift < 0 ? 0 : shift / 64, by = shift < 0 ? 0 : shift % 64;
    ulong words[WORDS] = {0, 0, 0};
    words[at] = shift < 0 ? digits >> -shift : digits << by;
    if (by > 0 && at + 1 < WORDS)
        words[at + 1] = digits >> (64 - by);
    add_words(to, words, WORDS, subtract != (bits >> 63));
}

// to, of n + m words = a b, of n and of m.
void multiply_words(const ulong *a, uint n, const ulong *b, uint m, ulong *to)
{
    for (uint i = 0; i < n + m; ++i)
        to[i] = 0;
    for (uint i = 0; i < n; ++i) {
        ulong carry = 0;
        for (uint j = 0; j < m; ++j) {
            const ulong low = a[i] * b[j] + carry;
            carry = mul_hi(a[i], b[j]) + (low < carry);
            to[i + j] += low;
            carry += to[i + j] < low;
        }
        to[i + m] = carry;
    }
    if (a[n - 1] >> 63)
        add_words(to + n, b, m, true);
    if (b[m - 1] >> 63)
        add_words(to + m, a, n, true);
}

// to, of 2 WORDS = a d - b c.
void determinant(const ulong *a, const ulong *b, const ulong *c, const ulong *d, ulong *to)
{
    ulong other[2 * WORDS];
    multiply_words(a, WORDS, d, WORDS, to);
    multiply_words(b, WORDS, c, WORDS, other);
    add_words(to, other, 2 * WORDS, true);
}

int sign_of_words(const ulong *a, uint words)
{
    ulong any = 0;
    for (uint i = 0; i < words; ++i)
        any |= a[i];
    return a[words - 1] >> 63 ? -1 : any != 0;
}

// 1 or -1; 0 if a number may be 0, given a bound of its error.
int sure_sign(double value, double error)
{
    return (value > error + TINY) - (value < -error - TINY);
}

// A plane through three points, and what the error of a determinant is in proportion to.
typedef struct {
    double3 a, b, c, normal, size;
} plane;

plane plane_through(double3 a, double3 b, double3 c)
{
    const double3 p = b - a, q = c - a, one = p.yzx * q.zxy, other = p.zxy * q.yzx;
    return (plane){a, b, c, one - other, fabs(one) + fabs(other)};
}

NOINLINE int exact_side(const plane *of, double3 d)
{
    const double points[4][3] = {{of->a.x, of->a.y, of->a.z}, {of->b.x, of->b.y, of->b.z},
                                 {of->c.x, of->c.y, of->c.z}, {d.x, d.y, d.z}};
    ulong from[3][3][WORDS], minor[2 * WORDS], term[3 * WORDS], sum[3 * WORDS] = {0};
    for (uint i = 0; i < 3; ++i)
        for (uint k = 0; k < 3; ++k) {
            from[i][k][0] = from[i][k][1] = from[i][k][2] = 0;
            add_coordinate(from[i][k], points[i + 1][k], false);
            add_coordinate(from[i][k], points[0][k], true);
        }
    for (uint i = 0; i < 3; ++i) {
        const uint j = (i + 1) % 3, k = (i + 2) % 3;
        determinant(from[0][j], from[0][k], from[1][j], from[1][k], minor);
        multiply_words(minor, 2 * WORDS, from[2][i], WORDS, term);
        add_words(sum, term, 3 * WORDS, false);
    }
    return sign_of_words(sum, 3 * WORDS);
}

// The side of a plane on which a point lies: 1 where its normal points to, -1, or 0 on the plane.
int side_of(const plane *of, double3 d)
{
    const double3 way = d - of->a, volume = of->normal * way, size = of->size * fabs(way);
    const double most = size.x + size.y + size.z;
    const int side = sure_sign(volume.x + volume.y + volume.z, 0x1p-49 * most);
    return side != 0 || most == 0 ? side : exact_side(of, d);
}

NOINLINE int exact_turn(double2 a, double2 b, double2 c)
{
    ulong from[4][WORDS] = {{0}}, area[2 * WORDS];
    const double to[4] = {b.x, b.y, c.x, c.y};
    for (uint i = 0; i < 4; ++i) {
        add_coordinate(from[i], to[i], false);
        add_coordinate(from[i], i % 2 ? a.y : a.x, true);
    }
    determinant(from[0], from[1], from[2], from[3], area);
    return sign_of_words(area, 2 * WORDS);
}

// 1 if three points of a plane turn to the left, -1 to the right, 0 if they are collinear.
int turn_of(double2 a, double2 b, double2 c)
{
    const double2 p = b - a, q = c - a;
    const double left = p.x * q.y, right = p.y * q.x, most = fabs(left) + fabs(right);
    const int turn = sure_sign(left - right, 0x1p-50 * most);
    return turn != 0 || most == 0 ? turn : exact_turn(a, b, c);
}
