// The nearest triangle of a mesh to each point. Host side: voxtool/spatial/distance.py.
//
// Options: BOX: the precision of distance bounds to boxes, float near the mesh and double far away.
// RANKED: the nearest triangle is returned in addition to its distance. GRAINED: see grain.h.

#include "spatial/bvh.h"
#include "spatial/grain.h"
#include "spatial/hilbert.h"
#include "spatial/names.h"

#define LANES double4 // one lane per triangle of a leaf: LEAF
#define MASKS long4
#include "spatial/point_triangle.h"
#include "spatial/traversal.h"

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define BOXES JOIN(BOX, 8) // one lane per child: ARITY
#define to_boxes JOIN(convert_, BOXES)
#define SLACK ((BOX)1 + (sizeof(BOX) == 4 ? (BOX)0x1p-18 : (BOX)0x1p-40)) // exceeds the rounding error
#define TINY 0x1p-900 // smaller squares count as 0

// codes[i] = the Hilbert index of point i; order[i] = i.
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

// The triangles of a leaf, one per lane.
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

// Updates the nearest triangle, its squared distance `least` and its rank with the ranked triangles
// of a leaf. The lowest rank breaks ties. Returns whether the result changed.
bool nearest_ranked(double4 dd, uint4 ranks, double *least, uint *rank)
{
    const double4 ranked = convert_long4(ranks) == NAMELESS ? INFINITY : dd;
    const double near = lesser(ranked);
    if (near > *least)
        return false;
    const uint4 nearest = convert_uint4(ranked == near) ? ranks : (uint4)NAMELESS;
    const uint2 lower = min(nearest.lo, nearest.hi);
    const uint lowest = min(lower.x, lower.y);
    const bool better = near < *least || lowest < *rank;
    *least = near;
    *rank = better ? lowest : *rank;
    return better;
}

// The distance of x to each interval [low, high].
BOXES gap(float8 low, float8 high, BOX x)
{
    const BOXES below = to_boxes(low) - x, above = x - to_boxes(high);
    const BOXES outside = below > above ? below : above;
    return outside > (BOX)0 ? outside : (BOX)0;
}

// distances[i] = the distance of point i to the nearest triangle. If RANKED, slots[i] = the index,
// in leaf order, of the nearest triangle that has a rank; the lowest rank breaks ties; NAMELESS if
// no triangle has a rank.
//
// Nearest boxes are visited first. A box is skipped only if none of its triangles can change the
// result. So the result depends neither on the tree nor on the traversal order.
__kernel void nearest_triangles(__global const double *points, __global const uint *order,
                                const uint n, __global const float *nodes,
                                __global const double *leaves, const uint first_leaf,
#ifdef RANKED
                                __global const uint *ranks, __global uint *slots,
#endif
#ifdef GRAINED
                                const double grain,
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
#ifdef RANKED
    double least_ranked = INFINITY;
    uint rank = NAMELESS, own_leaf = 0;
#endif
    BOX reach = INFINITY;
    while (top > 0) {
        const uint id = ids[--top];
        if (bounds[top] >= reach)
            continue;
        if (id >= first_leaf) {
            const uint leaf = id - first_leaf;
            const triangle t = leaf_triangles(leaves + (size_t)leaf * (FIELDS * LEAF));
            ways way;
            long4 feature;
            const double4 squares = triangle_ways(&t, p.x, p.y, p.z, &way, &feature);
            const double4 dd = GRAINS(squares, grain);
            const double near = lesser(dd);
            const bool nearer = near < least;
            least = nearer ? near : least;
#ifdef RANKED
            const bool found = nearest_ranked(dd, vload4(leaf, ranks), &least_ranked, &rank);
            own_leaf = found ? leaf : own_leaf;
            if (found)
                reach = (BOX)MOST_OF(least_ranked, grain) * SLACK + (BOX)0x1p-100;
#else
            if (nearer)
                reach = (BOX)least * SLACK + (BOX)0x1p-100; // positive even if the distance is 0
#endif
            continue;
        }
        __global const float *boxes = nodes + (size_t)id * (6 * ARITY);
        const BOXES dx = gap(vload8(0, boxes), vload8(3, boxes), x);
        const BOXES dy = gap(vload8(1, boxes), vload8(4, boxes), y);
        const BOXES dz = gap(vload8(2, boxes), vload8(5, boxes), z);
        BOX found[ARITY];
        JOIN(vstore, 8)(dx * dx + dy * dy + dz * dz, 0, found);
        top = push_nearest(id, found, reach, bounds, ids, top);
    }
    distances[own] = DISTANCE(least);
#ifdef RANKED
    uint slot = own_leaf * LEAF;
    while (rank != NAMELESS && ranks[slot] != rank)
        ++slot;
    slots[own] = rank == NAMELESS ? NAMELESS : slot;
#endif
}

// The vector from the nearest point of a slot's triangle to p, and the feature of the triangle that
// contains this point.
double3 way_from(__global const double *leaves, uint slot, double3 p, triangle *t, uint *feature)
{
    ways way;
    long4 features;
    *t = one_triangle(leaves + (size_t)(slot / LEAF) * (FIELDS * LEAF), slot % LEAF);
    triangle_ways(t, p.x, p.y, p.z, &way, &features);
    *feature = (uint)features.x;
    return (double3)(way.x.x, way.y.x, way.z.x);
}

#define LANES_OF(i) (double4)(own[0][(i) * LEAF], own[1][(i) * LEAF], own[2][(i) * LEAF], own[3][(i) * LEAF])

// The triangles of four slots, one per lane.
triangle triangles_of(__global const double *leaves, const uint *slots)
{
    __global const double *own[4];
    for (uint i = 0; i < 4; ++i)
        own[i] = leaves + (size_t)(slots[i] / LEAF) * (FIELDS * LEAF) + slots[i] % LEAF;
    const triangle t = {LANES_OF(0),  LANES_OF(1),  LANES_OF(2),  LANES_OF(3),  LANES_OF(4),
                        LANES_OF(5),  LANES_OF(6),  LANES_OF(7),  LANES_OF(8),  LANES_OF(9),
                        LANES_OF(10), LANES_OF(11), LANES_OF(12), LANES_OF(13), LANES_OF(14)};
    return t;
}

// Negates the distances of points inside: the vector from the nearest triangle has a negative dot
// product with the pseudo-normal of the nearest feature [Baerentzen 2005]. A work-item has four of
// `count` points, one per lane.
__kernel void sign_distances(__global const double *points, __global const uint *order,
                             const uint count, const uint n, __global const double *leaves,
                             __global const uint *nearest, __global const uint *names,
                             __global const uint *features, __global const double *normals,
                             __global double *distances)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    double x[4], y[4], z[4];
    uint own[4], slots[4];
    bool named[4];
    for (uint i = 0; i < 4; ++i) {
        own[i] = order[min(4 * gid + i, count - 1)];
        named[i] = nearest[own[i]] != NAMELESS;
        slots[i] = named[i] ? nearest[own[i]] : 0;
        x[i] = points[3 * (size_t)own[i]];
        y[i] = points[3 * (size_t)own[i] + 1];
        z[i] = points[3 * (size_t)own[i] + 2];
    }
    const triangle t = triangles_of(leaves, slots);
    ways way;
    long4 feature;
    triangle_ways(&t, vload4(0, x), vload4(0, y), vload4(0, z), &way, &feature);
    long feature_of[4];
    vstore4(feature, 0, feature_of);
    for (uint i = 0; i < 4; ++i) {
        double3 normal = 0;
        if (named[i])
            normal = normal_of(names[slots[i]], (uint)feature_of[i], features, normals);
        x[i] = normal.x, y[i] = normal.y, z[i] = normal.z;
    }
    double along[4];
    vstore4(way.x * vload4(0, x) + way.y * vload4(0, y) + way.z * vload4(0, z), 0, along);
    for (uint i = 0; i < 4 && 4 * gid + i < count; ++i)
        if (distances[own[i]] > 0 && along[i] < 0)
            distances[own[i]] = -distances[own[i]];
}

// The nearest face of each point, the nearest point on it, and the unit direction from there to the
// point. For a point on the surface, the direction is the face's normal, or 0 if the face has zero
// area.
__kernel void describe_nearest(__global const double *points, const uint n,
                               __global const double *leaves, __global const uint *slots,
                               __global const uint *face_of, __global uint *faces,
                               __global double *nearest, __global double *directions)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const double3 p = vload3(gid, points);
    triangle t;
    uint feature;
    const double3 way = way_from(leaves, slots[gid], p, &t, &feature);
    const double3 a = (double3)(t.ax.x, t.ay.x, t.az.x), e = (double3)(t.ex.x, t.ey.x, t.ez.x);
    const double3 g = (double3)(t.gx.x, t.gy.x, t.gz.x);
    double3 at = p - way;
    at = feature == A ? a : feature == B ? a + e : feature == C ? a + t.foot.x * e + g : at;
    double3 v = way;
    double vv = v.x * v.x + v.y * v.y + v.z * v.z;
    if (!(vv > TINY)) {
        v = (double3)(e.y * g.z - e.z * g.y, e.z * g.x - e.x * g.z, e.x * g.y - e.y * g.x);
        vv = v.x * v.x + v.y * v.y + v.z * v.z;
    }
    const double3 direction = vv > TINY ? v / sqrt(vv) : (double3)0;
    faces[gid] = face_of[slots[gid]];
    vstore3(at, gid, nearest);
    vstore3(direction, gid, directions);
}

// found[i] = 1 if a triangle of another face than faces[i] is within reaches[i] of point i, which lies
// in the mesh's box; otherwise 0.
__kernel void others_within(const uint n, __global const double *points,
                            __global const double *reaches, __global const uint *faces,
                            __global const float *nodes, __global const double *leaves,
                            __global const uint *face_of, const uint first_leaf,
                            __global uchar *found)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const double3 p = vload3(gid, points);
    const BOX x = (BOX)p.x, y = (BOX)p.y, z = (BOX)p.z, reach = (BOX)reaches[gid] * SLACK;
    uint ids[STACK];
    uint top = 1;
    ids[0] = 0;
    found[gid] = 0;
    while (top > 0) {
        const uint id = ids[--top];
        if (id >= first_leaf) {
            const uint leaf = id - first_leaf;
            const triangle t = leaf_triangles(leaves + (size_t)leaf * (FIELDS * LEAF));
            ways way;
            long4 feature;
            const double4 dd = triangle_ways(&t, p.x, p.y, p.z, &way, &feature);
            const long4 other = convert_long4(vload4(leaf, face_of) != faces[gid]);
            if (any(other & (dd <= reaches[gid] * reaches[gid]))) {
                found[gid] = 1;
                return;
            }
            continue;
        }
        __global const float *boxes = nodes + (size_t)id * (6 * ARITY);
        const BOXES dx = gap(vload8(0, boxes), vload8(3, boxes), x);
        const BOXES dy = gap(vload8(1, boxes), vload8(4, boxes), y);
        const BOXES dz = gap(vload8(2, boxes), vload8(5, boxes), z);
        BOX apart[ARITY];
        vstore8(dx * dx + dy * dy + dz * dz, 0, apart);
        for (uint i = 0; i < ARITY; ++i)
            if (apart[i] <= reach * reach)
                ids[top++] = ARITY * id + 1 + i;
    }
}
