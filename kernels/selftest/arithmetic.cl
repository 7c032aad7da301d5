// The arithmetic that everything else uses, one value a work-item. Host side: voxtool/selftest/arithmetic.py.
// Options: REAL, float or double.

// results: sum, difference, product, quotient, root, a b + c and a b + b c + c a, n of each.
__kernel void compute(__global const REAL *as, __global const REAL *bs, __global const REAL *cs,
                      const uint n, __global REAL *results)
{
    const uint i = get_global_id(0);
    if (i >= n)
        return;
    const REAL a = as[i], b = bs[i], c = cs[i];
    results[i] = a + b;
    results[n + i] = a - b;
    results[2 * n + i] = a * b;
    results[3 * n + i] = a / b;
    results[4 * n + i] = sqrt(a);
    results[5 * n + i] = a * b + c;
    results[6 * n + i] = a * b + b * c + c * a;
}

// results: products of 64 bits, their upper halves, quotients and remainders, with and without sign; a
// shift, the number of bits and of leading zeros; whole numbers as REAL, and REAL as whole numbers.
__kernel void count(__global const ulong *as, __global const ulong *bs, __global const REAL *xs,
                    const uint n, __global ulong *results, __global REAL *converted)
{
    const uint i = get_global_id(0);
    if (i >= n)
        return;
    const ulong a = as[i], b = bs[i];
    const long c = as_long(a), d = as_long(b);
    results[i] = a * b;
    results[n + i] = mul_hi(a, b);
    results[2 * n + i] = a / b;
    results[3 * n + i] = a % b;
    results[4 * n + i] = as_ulong(mul_hi(c, d));
    results[5 * n + i] = as_ulong(c / d);
    results[6 * n + i] = as_ulong(c % d);
    results[7 * n + i] = as_ulong(c >> (b & 63));
    results[8 * n + i] = popcount(a);
    results[9 * n + i] = clz(a >> (b & 63));
    results[10 * n + i] = as_ulong(convert_long(xs[i]));
    converted[i] = sizeof(REAL) == 4 ? (REAL)convert_int(c >> 32) : (REAL)c;
}
