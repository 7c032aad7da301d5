// The distance from points to a mesh. Host side: voxtool/proximity/distance.py. Options: BOX, the
// precision in which the distance to a box is bounded: float near the mesh, double far away; SIGNED.

#include "spatial/bvh.h"
#include "spatial/hilbert.h"
#include "spatial/names.h"

#pragma OPENCL FP_CONTRACT OFF

#define LANES double4 // one lane a triangle of a leaf: LEAF
#define MASKS long4
#include "spatial/point_triangle.h"

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

// The triangles of a leaf, one a lane.
triangle leaf_triangles(__global const double *leaf)
{
    const triangle t = {vload4(0, leaf),  vload4(1, leaf),  vload4(2, leaf),  vload4(3, leaf),
                        vload4(4, leaf),  vload4(5, leaf),  vload4(6, leaf),  vload4(7, leaf),
                        vload4(8, leaf),  vload4(9, leaf),  vload4(10, leaf), vload4(11, leaf),
                        vload4(12, leaf), vload4(13, leaf), vload4(14, leaf)};
    return t;
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
    const triangle t = leaf_triangles(leaf);
    ways way;
    long4 feature;
    triangle_ways(&t, p.x, p.y, p.z, &way, &feature);
    const double x[LEAF] = {way.x.x, way.x.y, way.x.z, way.x.w};
    const double y[LEAF] = {way.y.x, way.y.y, way.y.z, way.y.w};
    const double z[LEAF] = {way.z.x, way.z.y, way.z.z, way.z.w};
    const long of[LEAF] = {feature.x, feature.y, feature.z, feature.w};
    uint i = 0;
    while (i < LEAF - 1 && names[i] != name)
        ++i;
    const double3 normal = normal_of(name, (uint)of[i], features, normals);
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
            const triangle t = leaf_triangles(leaves + leaf * (FIELDS * LEAF));
            ways way;
            long4 feature;
            const double4 dd = triangle_ways(&t, p.x, p.y, p.z, &way, &feature);
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
