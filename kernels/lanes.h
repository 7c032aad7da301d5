// Vectors of LANES items, 1 or 16, so that a kernel is written once for both. A mask is 0 in a lane
// where it does not hold; elsewhere it is -1, or 1 where LANES is 1.

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#if LANES == 1
#define VECTOR(type) type
#define load(p) (*(p))
#define store(v, p) (*(p) = (v))
#define ANY(x) (x)
#else
#define VECTOR(type) JOIN(type, LANES)
#define load(p) JOIN(vload, LANES)(0, p)
#define store(v, p) JOIN(vstore, LANES)(v, 0, p)
#define ANY(x) any(x)
#endif
#define EACH_LANE(i) for (uint i = 0; i < LANES; ++i)
#define ints VECTOR(int)
#define uints VECTOR(uint)
#define longs VECTOR(long)
#define ulongs VECTOR(ulong)
#define floats VECTOR(float)
#define doubles VECTOR(double)
#define to_ints VECTOR(convert_int)
#define to_uints VECTOR(convert_uint)
#define to_longs VECTOR(convert_long)
#define to_ulongs VECTOR(convert_ulong)
#define to_floats VECTOR(convert_float)
#define to_doubles VECTOR(convert_double)
#define as_ints VECTOR(as_int)
#define as_floats VECTOR(as_float)
