// A triangle on the fixed-point lattice and its exact integer predicates. For triangles of up to 2^20
// units (4096 voxels) with normal n, n . (p - v0) fits 62 bits; for larger triangles, the plan sets
// the option WIDE, and this product is computed in 128 bits. Edge functions always fit 64 bits,
// because coordinates are at most 2^30 in magnitude.

#define VOXEL (1 << FIXED_POINT_BITS) // units of the lattice in a voxel
#define HALF (VOXEL / 2)

typedef struct {
    int3 v[3];
    uint face;
} triangle;

triangle fetch_triangle(__global const int *vertices, __global const int *faces, uint index)
{
    triangle t;
    t.face = index;
    for (int i = 0; i < 3; ++i)
        t.v[i] = vload3(faces[3 * (size_t)index + i], vertices);
    return t;
}

// The corners of a triangle's bounding box.
void find_bounds(const triangle *t, int3 *low, int3 *high)
{
    *low = min(min(t->v[0], t->v[1]), t->v[2]);
    *high = max(max(t->v[0], t->v[1]), t->v[2]);
}

// ---- n . (p - v0), in 64 or 128 bits

#ifdef WIDE
typedef struct { long high; ulong low; } wide; // two's complement

wide wide_product(long a, long b)
{
    const wide w = {mul_hi(a, b), (ulong)a * (ulong)b};
    return w;
}

wide wide_sum(wide a, wide b)
{
    const ulong low = a.low + b.low;
    const wide w = {(long)((ulong)a.high + (ulong)b.high + (low < a.low ? 1ul : 0ul)), low};
    return w;
}

wide wide_negative(wide a)
{
    const wide w = {(long)(~(ulong)a.high + (a.low == 0 ? 1ul : 0ul)), ~a.low + 1ul};
    return w;
}

bool is_negative(wide a) { return a.high < 0; }
bool is_positive(wide a) { return a.high > 0 || (a.high == 0 && a.low != 0); }
// Computed from the magnitude, because the halves of a small negative number would cancel.
float to_float(wide a)
{
    const wide m = is_negative(a) ? wide_negative(a) : a;
    const float magnitude = (float)m.high * 0x1p64f + (float)m.low;
    return is_negative(a) ? -magnitude : magnitude;
}
#else
typedef long wide;
wide wide_product(long a, long b) { return a * b; }
wide wide_sum(wide a, wide b) { return a + b; }
wide wide_negative(wide a) { return -a; }
bool is_negative(wide a) { return a < 0; }
bool is_positive(wide a) { return a > 0; }
#endif

// a . b
wide wide_dot(long ax, long ay, long az, long bx, long by, long bz)
{
    return wide_sum(wide_sum(wide_product(ax, bx), wide_product(ay, by)), wide_product(az, bz));
}

// ax by - bx ay, a component of a cross product: the result fits 63 bits, though its terms may wrap.
long cross_term(int ax, int by, int bx, int ay)
{
    return (long)((ulong)((long)ax * by) - (ulong)((long)bx * ay));
}

// The cross product.
long3 cross_of(int3 a, int3 b)
{
    return (long3)(cross_term(a.y, b.z, b.y, a.z), cross_term(a.z, b.x, b.z, a.x),
                   cross_term(a.x, b.y, b.x, a.y));
}

// ---- edge functions of a triangle's projection to the axes p and q ([voCCeL], eq. 3.2 to 3.4): one
// component an edge. At (i, j) they are p * i + q * j + d; a point is inside if none is negative.

typedef struct { long3 p, q, d; } edge_functions;

// From the corners' coordinates, and the sign of the projected area.
edge_functions edges_of(int3 p, int3 q, int sign)
{
    const long3 p0 = convert_long3(p), q0 = convert_long3(q), p1 = p0.yzx, q1 = q0.yzx;
    edge_functions e;
    e.p = (q0 - q1) * sign; // the inward normals
    e.q = (p1 - p0) * sign;
    e.d = -(e.p * p0 + e.q * q0);
    return e;
}

bool none_negative(long3 values) { return (values.x | values.y | values.z) >= 0; }

// The sign of (x, y, z) . eps for eps.x >> eps.y >> eps.z > 0: it decides every tie.
int shift_sign(long x, long y, long z)
{
    const long first = x != 0 ? x : y != 0 ? y : z;
    return (first > 0) - (first < 0);
}
