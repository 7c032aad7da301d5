// The distance from points to a mesh. Host side: voxtool/proximity/distance.py. Options: BOX, the
// precision in which the distance to a box is bounded: float near the mesh, double far away; SIGNED.

#include "proximity/bvh.h"
#include "proximity/curve.h"
#include "proximity/names.h"

#pragma OPENCL FP_CONTRACT OFF

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define BOXES JOIN(BOX, 8) // one lane a child: ARITY
#define to_boxes JOIN(convert_, BOXES)
#define SLACK ((BOX)1 + (sizeof(BOX) == 4 ? (BOX)0x1p-18 : (BOX)0x1p-40)) // beyond its rounding
#define STACK ((ARITY - 1) * MAX_LEVELS + 1)

// codes[i] = the place of point i along the curve; order[i] = i.
__kernel void point_codes(__global const double *points, const uint n, __global uint *codes,
                          __global uint *order)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const double3 p = vload3(gid, points);
    const uint3 cell =
        (uint3)(cell_of(p.x, POINT_BITS), cell_of(p.y, POINT_BITS), cell_of(p.z, POINT_BITS));
    codes[gid] = (uint)hilbert_index(cell, POINT_BITS);
    order[gid] = gid;
}

double4 clamped(double4 t)
{
    t = t > 0.0 ? t : 0.0;
    return t < 1.0 ? t : 1.0;
}

// What of a triangle a point is nearest to; as in leaf_ways, ab is its longest edge.
enum { FACE, AB, BC, CA, A, B, C };

// The ways from the nearest points of a leaf's triangles, and on what these are; returns the squares
// of their lengths.
//
// In the triangle's plane, with e and g as axes, a is (0, 0), b is (1, 0) and c is (foot, 1). As e is
// the longest edge, the angles at a and b are acute. So a point below ab is nearest to ab; one beyond
// ac to ac, or past c to bc; one beyond bc to bc. Slivers are safe: what is measured is always the
// way to a point of the triangle, and an error of the foot point across a thin triangle is less than
// its height.
double4 leaf_ways(__global const double *leaf, double3 p, double4 *wx, double4 *wy, double4 *wz,
                  long4 *feature)
{
    const double4 px = p.x - vload4(0, leaf);
    const double4 py = p.y - vload4(1, leaf);
    const double4 pz = p.z - vload4(2, leaf);
    const double4 ex = vload4(3, leaf), ey = vload4(4, leaf), ez = vload4(5, leaf);
    const double4 gx = vload4(6, leaf), gy = vload4(7, leaf), gz = vload4(8, leaf);
    const double4 foot = vload4(9, leaf), rest = 1.0 - foot;
    const double4 ee = vload4(10, leaf), gg = vload4(11, leaf);
    const double4 pe = px * ex + py * ey + pz * ez;
    const double4 pg = px * gx + py * gy + pz * gz;
    const double4 x = pe / ee, y = pg / gg;
    const double4 ac = (foot * pe + pg) / (foot * foot * ee + gg);
    const double4 bc = clamped((rest * (ee - pe) + pg) / (rest * rest * ee + gg));
    const long4 below = pg <= 0.0;
    const long4 left = x < foot * y, right = x > 1.0 - rest * y;
    const long4 beyond = left | right, on_ac = left & (ac < 1.0);
    double4 u = beyond ? 1.0 - bc * rest : x;
    double4 v = beyond ? bc : y;
    u = on_ac ? clamped(ac) * foot : u;
    v = on_ac ? clamped(ac) : v;
    u = below ? clamped(x) : u;
    v = below ? 0.0 : v;
    const long4 on_ab = x > 0.0 ? (x < 1.0 ? (long4)AB : (long4)B) : (long4)A;
    const long4 on_bc = bc > 0.0 ? (bc < 1.0 ? (long4)BC : (long4)C) : (long4)B;
    const long4 on_ca = ac > 0.0 ? (long4)CA : (long4)A;
    *feature = below ? on_ab : on_ac ? on_ca : beyond ? on_bc : (long4)FACE;
    const double4 dx = *wx = px - u * ex - v * gx;
    const double4 dy = *wy = py - u * ey - v * gy;
    const double4 dz = *wz = pz - u * ez - v * gz;
    return dx * dx + dy * dy + dz * dz;
}

double lesser(double4 x)
{
    const double2 least = x.lo < x.hi ? x.lo : x.hi;
    return least.x < least.y ? least.x : least.y;
}

// Of the triangles of a leaf, the nearest one that has a name: if it is nearer than `least`, or as
// near as that and of a lower name, these become its own, and true is returned.
bool nearest_named(double4 dd, uint4 names, double *least, uint *name)
{
    const double4 named = convert_long4(names) == NAMELESS ? INFINITY : dd;
    const double near = lesser(named);
    if (near > *least)
        return false;
    const uint4 nearest = convert_uint4(named == near) ? names : (uint4)NAMELESS;
    const uint2 lower = min(nearest.lo, nearest.hi);
    const uint lowest = min(lower.x, lower.y);
    const bool better = near < *least || lowest < *name;
    *least = near;
    *name = better ? lowest : *name;
    return better;
}

// Whether the way from the nearest point of a leaf's triangle leads inside.
bool leads_inside(__global const double *leaf, __global const uint *names, uint name, double3 p,
                  __global const uint *features, __global const double *normals)
{
    double4 wx, wy, wz;
    long4 feature;
    leaf_ways(leaf, p, &wx, &wy, &wz, &feature);
    const double x[LEAF] = {wx.x, wx.y, wx.z, wx.w}, y[LEAF] = {wy.x, wy.y, wy.z, wy.w};
    const double z[LEAF] = {wz.x, wz.y, wz.z, wz.w};
    const long of[LEAF] = {feature.x, feature.y, feature.z, feature.w};
    uint i = 0;
    while (i < LEAF - 1 && names[i] != name)
        ++i;
    const uint turn = name % 3, which = (uint)of[i];
    const uint turned = which == FACE ? FACE
                        : which < A   ? AB + (which - AB + turn) % 3
                                      : A + (which - A + turn) % 3;
    const double3 normal = vload3(features[7 * (size_t)(name / 3) + turned], normals);
    return x[i] * normal.x + y[i] * normal.y + z[i] * normal.z < 0;
}

// How far x lies outside of each [low, high].
BOXES gap(float8 low, float8 high, BOX x)
{
    const BOXES below = to_boxes(low) - x, above = x - to_boxes(high);
    const BOXES outside = below > above ? below : above;
    return outside > (BOX)0 ? outside : (BOX)0;
}

// distances[i] = the distance of point i to the nearest triangle. Nearest boxes first; a box is left
// out only where none of its triangles can change the result, which therefore depends neither on
// the tree nor on the order of the visit. If SIGNED, they are negative inside: where the way from the
// nearest face that has a name, the first in the mesh of equally near ones, leads inside.
__kernel void nearest_triangles(__global const double *points, __global const uint *order,
                                const uint n, __global const float *nodes,
                                __global const double *leaves, const uint first_leaf,
#ifdef SIGNED
                                __global const uint *names, __global const uint *features,
                                __global const double *normals,
#endif
                                __global double *distances)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint own = order[gid];
    const double3 p = vload3(own, points);
    const BOX x = (BOX)p.x, y = (BOX)p.y, z = (BOX)p.z;
    BOX bounds[STACK];
    uint ids[STACK];
    uint top = 1;
    bounds[0] = 0;
    ids[0] = 0;
    double least = INFINITY;
#ifdef SIGNED
    double least_named = INFINITY;
    uint name = NAMELESS;
    size_t own_leaf = 0;
#endif
    BOX reach = INFINITY;
    while (top > 0) {
        const uint id = ids[--top];
        if (bounds[top] >= reach)
            continue;
        if (id >= first_leaf) {
            const size_t leaf = id - first_leaf;
            double4 wx, wy, wz;
            long4 feature;
            const double4 dd = leaf_ways(leaves + leaf * (FIELDS * LEAF), p, &wx, &wy, &wz, &feature);
            const double near = lesser(dd);
            const bool nearer = near < least;
            least = nearer ? near : least;
#ifdef SIGNED
            const bool found = nearest_named(dd, vload4(leaf, names), &least_named, &name);
            own_leaf = found ? leaf : own_leaf;
            if (found)
                reach = (BOX)least_named * SLACK + (BOX)0x1p-100;
#else
            if (nearer)
                reach = (BOX)least * SLACK + (BOX)0x1p-100; // positive, however small it is
#endif
            continue;
        }
        __global const float *boxes = nodes + (size_t)id * (6 * ARITY);
        const BOXES dx = gap(vload8(0, boxes), vload8(3, boxes), x);
        const BOXES dy = gap(vload8(1, boxes), vload8(4, boxes), y);
        const BOXES dz = gap(vload8(2, boxes), vload8(5, boxes), z);
        BOX found[ARITY];
        JOIN(vstore, 8)(dx * dx + dy * dy + dz * dz, 0, found);
        const uint base = top;
        for (uint i = 0; i < ARITY; ++i) {
            if (found[i] >= reach)
                continue;
            uint at = top++;
            for (; at > base && bounds[at - 1] < found[i]; --at) {
                bounds[at] = bounds[at - 1];
                ids[at] = ids[at - 1];
            }
            bounds[at] = found[i];
            ids[at] = ARITY * id + 1 + i;
        }
    }
    double distance = sqrt(least);
#ifdef SIGNED
    if (name != NAMELESS && distance > 0 &&
        leads_inside(leaves + own_leaf * (FIELDS * LEAF), names + own_leaf * LEAF, name, p, features,
                     normals))
        distance = -distance;
#endif
    distances[own] = distance;
}
