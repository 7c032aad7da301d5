// The winding number of the thin faces about a vertex, or of the faces about an edge. Host side:
// voxtool/spatial/fans.py. Options: BOOK for an edge.

#include "spatial/angles.h"
#include "spatial/bvh.h"
#include "spatial/fans.h"
#include "spatial/moments.h"
#include "spatial/winding_number.h"

// The numbers of a bundle of sides of the rim, from q to r: its centre, from which these are
// counted; its squared radius times the squared reach; the sums of r, of its products of two and of
// three coordinates, less those of q; and the moments of the triangles between the centre and the
// sides. Coefficients have the order of moments.h. For an edge (BOOK) the sums run over the corners q,
// each times the sign of its face; the sum of the signs and the squared radius stand in place of the
// moments.
enum { CENTRE = 0, FAR = 3, ONE = 4, TWO = 7, THREE = 13, RIM = 23, NET = 23, RADIUS = 24 };

// Side i of the rim: its start q, or with `way` = 3 LEAF the way from q to r, which for an edge (BOOK) is
// the sign of the face, 0, 0.
double3 side_of(__global const double *rim, uint i, uint way)
{
    __global const double *leaf = rim + (size_t)(i / LEAF) * (6 * LEAF) + way + i % LEAF;
    return (double3)(leaf[0], leaf[LEAF], leaf[2 * LEAF]);
}

double3 cross_of(double3 a, double3 b)
{
    return (double3)(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

double product(double3 a, double3 b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

// sums += sign times the coordinates of d and their products of two and of three.
void add_products(double *sums, double sign, double3 d)
{
    const double3 e = sign * d, square = e * d;
    sums[0] += e.x, sums[1] += e.y, sums[2] += e.z;
    sums[3] += square.x, sums[4] += square.y, sums[5] += square.z;
    sums[6] += e.y * d.z, sums[7] += e.x * d.z, sums[8] += e.x * d.y;
    sums[9] += square.x * d.x, sums[10] += square.y * d.y, sums[11] += square.z * d.z;
    sums[12] += square.x * d.y, sums[13] += square.x * d.z, sums[14] += square.y * d.x;
    sums[15] += square.y * d.z, sums[16] += square.z * d.x, sums[17] += square.z * d.y;
    sums[18] += e.x * d.y * d.z;
}

// The numbers of n bundles, each of `size` of the rim's `count` sides; the first is `bundle`.
__kernel void sum_bundles(__global const double *rim, const uint count, const uint size,
                          const uint n, const uint bundle, const double far,
                          __global double *bundles)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint first = gid * size, end = count - first > size ? first + size : count;
    double3 low = INFINITY, high = -INFINITY;
    for (uint i = first; i < end; ++i) {
        const double3 q = side_of(rim, i, 0);
        low = q < low ? q : low;
        high = q > high ? q : high;
#ifndef BOOK
        const double3 r = q + side_of(rim, i, 3 * LEAF);
        low = r < low ? r : low;
        high = r > high ? r : high;
#endif
    }
    const double3 centre = 0.5 * (low + high);
    double sums[19] = {0}, radius = 0;
    moments m;
    clear(&m);
    for (uint i = first; i < end; ++i) {
        const double3 q = side_of(rim, i, 0) - centre, way = side_of(rim, i, 3 * LEAF);
        const double qq = product(q, q);
        radius = qq > radius ? qq : radius;
#ifdef BOOK
        add_products(sums, way.x, q);
        m.one[0] += way.x;
#else
        const double3 r = q + way;
        const double rr = product(r, r);
        radius = rr > radius ? rr : radius;
        add_products(sums, 1, r);
        add_products(sums, -1, q);
        const double3 normal = 0.5 * cross_of(q, way), both = q + r;
        const double start[3] = {q.x, q.y, q.z}, last[3] = {r.x, r.y, r.z};
        const double sum[3] = {both.x, both.y, both.z}, area[3] = {normal.x, normal.y, normal.z};
        double quadric[6] = {0, 0, 0, 0, 0, 0};
        add_two(quadric, 1.0 / 12, start, start);
        add_two(quadric, 1.0 / 12, last, last);
        add_two(quadric, 1.0 / 12, sum, sum);
        for (uint k = 0; k < 3; ++k)
            m.one[k] += area[k];
        add_two(m.two, 1.0 / 3, sum, area);
        add_three(m.three, 1, area, quadric);
#endif
    }
#ifdef BOOK
    m.one[1] = radius;
#else
    make_harmonic(&m);
#endif
    __global double *to = bundles + (size_t)(bundle + gid) * SUMS;
    to[CENTRE] = centre.x, to[CENTRE + 1] = centre.y, to[CENTRE + 2] = centre.z;
    to[FAR] = far * far * radius;
    for (uint k = 0; k < 19; ++k)
        to[ONE + k] = sums[k];
    for (uint k = 0; k < 3; ++k)
        to[RIM + k] = m.one[k];
    for (uint k = 0; k < 6; ++k)
        to[RIM + 3 + k] = m.two[k];
    for (uint k = 0; k < 10; ++k)
        to[RIM + 9 + k] = m.three[k];
}

// v v contracted with a symmetric form of order three.
double3 contracted(__global const double *m, double3 v)
{
    const double xx = v.x * v.x, yy = v.y * v.y, zz = v.z * v.z;
    const double yz = 2 * v.y * v.z, xz = 2 * v.x * v.z, xy = 2 * v.x * v.y;
    return (double3)(m[0] * xx + m[5] * yy + m[7] * zz + m[9] * yz + m[4] * xz + m[3] * xy,
                     m[3] * xx + m[1] * yy + m[8] * zz + m[6] * yz + m[9] * xz + m[5] * xy,
                     m[4] * xx + m[6] * yy + m[2] * zz + m[8] * yz + m[7] * xz + m[9] * xy);
}

// The solid angle of the triangles between the centre and the rim, at the end of the way c.
double rim_angle(__global const double *m, double3 c)
{
    const double s = 1 / product(c, c);
    const double one = c.x * m[0] + c.y * m[1] + c.z * m[2];
    const double two = c.x * (c.x * m[3] + c.y * m[8] + c.z * m[7]) +
                       c.y * (c.y * m[4] + c.z * m[6]) + c.z * c.z * m[5];
    m += 9;
    const double three = c.x * (c.x * (c.x * m[0] + c.y * m[3] + c.z * m[4]) +
                                c.y * (c.y * m[5] + c.z * m[9]) + c.z * c.z * m[7]) +
                         c.y * (c.y * (c.y * m[1] + c.z * m[6]) + c.z * c.z * m[8]) +
                         c.z * c.z * c.z * m[2];
    return s * sqrt(s) * (one + s * (7.5 * s * three - 3.0 * two));
}

// The sum of f(d) over the d of a bundle, from its centre: the solid angle of the triangles between the
// apex, the centre and the ends of d, with a and c the ways to the apex and to the centre.
//
// f(d) = 2 atan(y / x) of y = a x c . d and of x as in solid_angles.h. To the third order that is
// g.d (1 - h.d + (h.d)^2 - (d.d / c.c - (c.d / c.c)^2) / 4) - (g.d)^3 / 12.
double arms_angle(__global const double *bundle, double3 a, double3 c)
{
    __global const double *one = bundle + ONE, *two = bundle + TWO, *three = bundle + THREE;
    const double cc = product(c, c), lengths = sqrt(product(a, a) * cc);
    const double both = lengths + product(a, c);
    const double3 g = cross_of(a, c) / (sqrt(cc) * both);
    const double3 h = 0.5 * (c * ((1 + lengths / both) / cc) + a / both);
    const double3 trace = {three[0] + three[5] + three[7], three[3] + three[1] + three[8],
                           three[4] + three[6] + three[2]};
    const double first = g.x * one[0] + g.y * one[1] + g.z * one[2];
    const double second = g.x * h.x * two[0] + g.y * h.y * two[1] + g.z * h.z * two[2] +
                          (g.y * h.z + g.z * h.y) * two[3] + (g.x * h.z + g.z * h.x) * two[4] +
                          (g.x * h.y + g.y * h.x) * two[5];
    const double3 third = contracted(three, h) - 0.25 / cc * trace +
                          0.25 / (cc * cc) * contracted(three, c) - contracted(three, g) / 12;
    return first - second + product(g, third);
}

// Whether f is smooth: the ray away from the apex is far from the centre.
bool is_smooth(__global const double *bundle, double3 a, double3 c)
{
    const double aa = product(a, a), along = product(a, c);
    const double gap = product(c, c) - (along < 0 ? along * along / aa : 0.0);
    return aa > 0 && gap > bundle[FAR];
}

#ifdef BOOK
// Half of the solid angles of triangles between a, b and four points (qx, qy, qz).
double4 pages_angle(double3 a, double3 b, double3 spine, double4 qx, double4 qy, double4 qz)
{
    const double3 normal = cross_of(a, spine);
    const double as = sqrt(product(a, a)), bs = sqrt(product(b, b)), ab = product(a, b);
    const double4 q = sqrt(qx * qx + qy * qy + qz * qz);
    const double4 aq = a.x * qx + a.y * qy + a.z * qz, bq = b.x * qx + b.y * qy + b.z * qz;
    const double4 y = normal.x * qx + normal.y * qy + normal.z * qz;
    return angle_of(y, as * bs * q + ab * q + bq * as + aq * bs);
}

// Whether the point is outside of the wedge about the spine that contains the bundle.
bool is_beside(__global const double *bundle, double3 a, double3 c, double3 spine)
{
    const double ss = product(spine, spine);
    const double3 ahead = c - a - spine * (product(c - a, spine) / ss);
    const double3 own = -a + spine * (product(a, spine) / ss);
    const double3 across = cross_of(ahead, own);
    return product(ahead, own) < 0 ||
           product(across, across) > product(own, own) * bundle[RADIUS] * (1 + 0x1p-20);
}

// The solid angle of a bundle's faces, or NAN if its parts must be summed. The faces of the tetrahedron
// between a, b, the centre and q are closed.
double bundle_angle(__global const double *bundle, double3 a, double3 b, double3 c, double3 spine)
{
    if (!is_smooth(bundle, a, c) || !is_smooth(bundle, b, c) || !is_beside(bundle, a, c, spine))
        return NAN;
    const double4 angle = pages_angle(a, b, spine, c.x, c.y, c.z);
    return 2 * bundle[NET] * angle.x + arms_angle(bundle, a, c) - arms_angle(bundle, b, c);
}
#else
// The solid angle of a bundle of a fan, or NAN if its parts must be summed.
double bundle_angle(__global const double *bundle, double3 a, double3 b, double3 c, double3 spine)
{
    if (!is_smooth(bundle, a, c))
        return NAN;
    return arms_angle(bundle, a, c) + rim_angle(bundle + RIM, c);
}
#endif

// Half of the solid angle of the faces of leaf i.
double leaf_angle(__global const double *rim, uint i, double3 a, double3 b, double3 p, double3 spine)
{
    __global const double *leaf = rim + (size_t)i * (6 * LEAF);
    const double4 qx = vload4(0, leaf) - p.x, qy = vload4(1, leaf) - p.y, qz = vload4(2, leaf) - p.z;
    const double4 wx = vload4(3, leaf);
#ifdef BOOK
    const double4 angle = wx * pages_angle(a, b, spine, qx, qy, qz);
#else
    const double4 wy = vload4(4, leaf), wz = vload4(5, leaf);
    const double4 rx = qx + wx, ry = qy + wy, rz = qz + wz;
    const double size = sqrt(product(a, a));
    const double4 q = sqrt(qx * qx + qy * qy + qz * qz), r = sqrt(rx * rx + ry * ry + rz * rz);
    const double4 y = a.x * (qy * wz - qz * wy) + a.y * (qz * wx - qx * wz) + a.z * (qx * wy - qy * wx);
    const double4 aq = a.x * qx + a.y * qy + a.z * qz, ar = a.x * rx + a.y * ry + a.z * rz;
    const double4 qr = qx * rx + qy * ry + qz * rz;
    const double4 angle = angle_of(y, size * q * r + aq * r + qr * size + ar * q);
#endif
    return angle.x + angle.y + angle.z + angle.w;
}

// numbers[i] += the winding number of a fan about point i. `rim` holds the `count` sides opposite to
// the apex, or the corners opposite to the edge from the apex along the spine, in leaves of LEAF;
// `bundles` those of each level, from the smallest on, up to one.
__kernel void wind_fan(__global const double *points, __global const uint *order, const uint n,
                       const double4 apex, const double4 spine, __global const double *rim,
                       const uint count, __global const double *bundles, __global double *numbers)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint own = order[gid];
    const double3 p = vload3(own, points), a = apex.xyz - p, b = a + spine.xyz;
    const double beyond = (double)(1ul << FAR_BITS);
    if (!(product(p, p) < beyond * beyond))
        return;
    uint firsts[DEEP], counts[DEEP], top = 0, i = 0;
    firsts[0] = 0;
    counts[0] = (count + BUNDLE - 1) / BUNDLE;
    for (; counts[top] > 1; ++top) {
        firsts[top + 1] = firsts[top] + counts[top];
        counts[top + 1] = (counts[top] + ARITY - 1) / ARITY;
    }
    const uint leaves = (count + LEAF - 1) / LEAF;
    double sum = 0;
    for (uint level = top; i < counts[level];) {
        __global const double *bundle = bundles + (size_t)(firsts[level] + i) * SUMS;
        const double3 c = (double3)(bundle[0], bundle[1], bundle[2]) - p;
        const double angle = bundle_angle(bundle, a, b, c, spine.xyz);
        if (angle == angle) {
            sum += angle;
        } else if (level > 0) {
            --level;
            i *= ARITY;
            continue;
        } else {
            for (uint k = i * (BUNDLE / LEAF); k < min((i + 1) * (BUNDLE / LEAF), leaves); ++k)
                sum += 2 * leaf_angle(rim, k, a, b, p, spine.xyz);
        }
        for (++i; level < top && i % ARITY == 0; i /= ARITY)
            ++level;
    }
    numbers[own] += sum / (4 * PI);
}
