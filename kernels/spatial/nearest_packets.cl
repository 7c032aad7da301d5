// The nearest triangle of a mesh to each of many points: POINTS points that are near each other, one
// per lane, share a traversal. A work-item follows RUN packets of them, one after the other. Host
// side: voxtool/spatial/distance.py. The results are those of nearest_triangles in distance.cl.
//
// Options: RANKED: the nearest triangle is returned in addition to its distance. GRAINED: see grain.h.

#include "spatial/bvh.h"
#include "spatial/grain.h"
#include "spatial/names.h"
#include "spatial/nearest_packets.h"
#include "spatial/oriented_boxes.h"

#define LANES double16 // one lane per point: POINTS
#define MASKS long16
#define BOX float
#include "spatial/point_triangle.h"
#include "spatial/traversal.h"

#define SLACK (1 + 0x1p-18f) // exceeds the rounding error of squared distances to boxes

// Triangles whose longest edge, or whose height, is shorter than SHORT are rounded to points or to
// segments. No point of them moves further.
#define SHORT 0x1p-20

// rounded[i] = the numbers of frame_triangles of slot i, in single precision.
//
// The distance from a point within NEAR extents, computed in single precision by rounded_squares,
// exceeds the exact one by less than DOUBT. With u = 2^-24 and coordinates below 9:
// - The vector from corner a to the point is off by 17 u a coordinate, so by less than 30 u; it is
//   shorter than 16. Its components along e and g, which are perpendicular, are off by 30 u, by 48 u of the
//   dot product and by 16 u of e, and the place along an edge by 32 u of the quotient: 126 u.
// - The place that is found is off by 126 u along both, less than 180 u. A feature that is chosen
//   wrongly has its nearest place within another 180 u, or else the distance is too short.
// - The vector from the place to the point is off by 40 u a coordinate, so by less than 70 u.
// The sum is 430 u; DOUBT is more than twice that.
#define DOUBT 0x1p-14f

__kernel void round_triangles(__global const double *leaves, const uint n, __global float *rounded)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const size_t leaf = (size_t)(gid / LEAF) * (FIELDS * LEAF) + gid % LEAF;
    double t[FIELDS];
    for (uint i = 0; i < FIELDS; ++i)
        t[i] = leaves[leaf + i * LEAF];
    const double ee = t[3] * t[3] + t[4] * t[4] + t[5] * t[5];
    const double gg = t[6] * t[6] + t[7] * t[7] + t[8] * t[8];
    for (uint i = 3; i < FIELDS; ++i) {
        const bool of_edge = i < 6 || i == 10 || i == 11;
        if (ee < SHORT * SHORT || (gg < SHORT * SHORT && !of_edge))
            t[i] = 0;
    }
    for (uint i = 0; i < FIELDS; ++i)
        rounded[FIELDS * (size_t)gid + i] = (float)t[i];
}

// boxes[i] = the box of node i of a level, which holds `span` of `count` triangles.
__kernel void orient_boxes(__global const double *leaves, const uint count, const uint span,
                           const uint n, __global float *boxes, const uint first)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint begin = gid * span;
    store_oriented(leaves, begin, min(begin + span, count), boxes + ORIENTED * (size_t)(first + gid));
}

float16 clamped_float(float16 t)
{
    t = t > 0.0f ? t : 0.0f;
    return t < 1.0f ? t : 1.0f;
}

// As triangle_ways, the squared distances alone, in single precision.
float16 rounded_squares(__global const float *t, float16 x, float16 y, float16 z)
{
    const float16 px = x - t[0], py = y - t[1], pz = z - t[2];
    const float foot = t[9], rest = 1 - foot;
    const float16 pe = px * t[3] + py * t[4] + pz * t[5], pg = px * t[6] + py * t[7] + pz * t[8];
    const float16 along = pe * t[11], up = pg * t[12];
    const float16 ac = (foot * pe + pg) * t[13];
    const float16 bc = clamped_float((rest * (t[10] - pe) + pg) * t[14]);
    const int16 below = pg <= 0.0f;
    const int16 left = along < foot * up, beyond = left | (along > 1 - rest * up);
    const int16 on_ac = left & (ac < 1.0f);
    const float16 up_ac = clamped_float(ac);
    float16 u = beyond ? 1 - bc * rest : along, v = beyond ? bc : up;
    u = on_ac ? up_ac * foot : u;
    v = on_ac ? up_ac : v;
    u = below ? clamped_float(along) : u;
    v = below ? 0.0f : v;
    const float16 wx = px - u * t[3] - v * t[6], wy = py - u * t[4] - v * t[7];
    const float16 wz = pz - u * t[5] - v * t[8];
    return wx * wx + wy * wy + wz * wz;
}

// Triangle `slot`, in every lane.
triangle triangle_of(__global const double *leaves, uint slot)
{
    return one_triangle(leaves + (size_t)(slot / LEAF) * (FIELDS * LEAF), slot % LEAF);
}

float largest(float16 v)
{
    const float8 a = fmax(v.lo, v.hi);
    const float4 b = fmax(a.lo, a.hi);
    const float2 c = fmax(b.lo, b.hi);
    return fmax(c.x, c.y);
}

// The points of a packet, in both precisions, and their box; the nearest triangles found so far, as
// of nearest_triangles; and the squares beyond which no box and no rounded triangle changes them.
typedef struct {
    double16 x, y, z;
    float16 fx, fy, fz;
    float3 low, high;
    double16 least;
#ifdef RANKED
    double16 least_ranked;
    uint16 rank, slot;
#endif
    float16 reach, doubtful;
#ifdef GRAINED
    double grain;
#endif
} packet;

// The packet of points from `start` on; the last of `count` pads the last packet.
packet points_of(__global const double *points, __global const uint *order, uint count, uint start)
{
    double xs[POINTS], ys[POINTS], zs[POINTS];
    packet p;
    p.low = INFINITY, p.high = -INFINITY;
    for (uint i = 0; i < POINTS; ++i) {
        const double3 point = vload3(order[min(start + i, count - 1)], points);
        xs[i] = point.x, ys[i] = point.y, zs[i] = point.z;
        p.low = fmin(p.low, convert_float3(point));
        p.high = fmax(p.high, convert_float3(point));
    }
    p.x = vload16(0, xs), p.y = vload16(0, ys), p.z = vload16(0, zs);
    p.fx = convert_float16(p.x), p.fy = convert_float16(p.y), p.fz = convert_float16(p.z);
    p.least = INFINITY;
#ifdef RANKED
    p.least_ranked = INFINITY;
    p.rank = NAMELESS, p.slot = NAMELESS;
#endif
    p.reach = INFINITY, p.doubtful = INFINITY;
    return p;
}

// Updates the nearest triangles with the triangle of a slot. Returns whether `reach` changed.
bool meet(packet *p, const triangle *t, uint slot, uint rank)
{
    ways way;
    long16 feature;
    const double16 square_of = triangle_ways(t, p->x, p->y, p->z, &way, &feature);
    const double16 dd = GRAINS(square_of, p->grain);
    const long16 nearer = dd < p->least;
    p->least = nearer ? dd : p->least;
#ifdef RANKED
    if (rank == NAMELESS)
        return false;
    const long16 lower = convert_long16(rank < p->rank);
    const long16 better = dd < p->least_ranked | (dd == p->least_ranked & lower);
    p->least_ranked = better ? dd : p->least_ranked;
    p->rank = convert_int16(better) ? rank : p->rank;
    p->slot = convert_int16(better) ? slot : p->slot;
    const float16 square = convert_float16(MOST_OF(p->least_ranked, p->grain));
#else
    const long16 better = nearer;
    const float16 square = convert_float16(MOST_OF(p->least, p->grain));
#endif
    p->reach = square * SLACK + 0x1p-100f; // positive even if the distance is 0
    const float16 distance = sqrt(square) * SLACK + DOUBT;
    p->doubtful = distance * distance;
    return any(better);
}

float8 gap_between(float8 below, float8 above)
{
    const float8 outside = below > above ? below : above;
    return outside > 0.0f ? outside : 0.0f;
}

// The squared distances of the packet's box to a node's children.
float8 squares_apart(const packet *p, __global const float *boxes)
{
    const float8 dx = gap_between(vload8(0, boxes) - p->high.x, p->low.x - vload8(3, boxes));
    const float8 dy = gap_between(vload8(1, boxes) - p->high.y, p->low.y - vload8(4, boxes));
    const float8 dz = gap_between(vload8(2, boxes) - p->high.z, p->low.z - vload8(5, boxes));
    return dx * dx + dy * dy + dz * dz;
}

// The tree over the triangles: boxes of nodes and triangles in both precisions. Nodes from
// first_oriented on have an oriented box.
typedef struct {
    __global const float *nodes, *oriented, *rounded;
    __global const double *leaves;
    uint triangles, first_leaf, first_oriented;
#ifdef RANKED
    __global const uint *ranks;
#endif
} tree;

bool meet_slot(packet *p, const tree *t, uint slot)
{
    const triangle exact = triangle_of(t->leaves, slot);
#ifdef RANKED
    return meet(p, &exact, slot, t->ranks[slot]);
#else
    return meet(p, &exact, slot, 0);
#endif
}

// Finds the nearest triangles. `hint` is the slot of a triangle that may be near; returns one for
// the points that follow.
uint search(packet *p, const tree *t, uint hint)
{
    meet_slot(p, t, hint);
    float furthest = largest(p->reach), bounds[STACK];
    uint ids[STACK];
    uint top = 1;
    bounds[0] = 0;
    ids[0] = 0;
    while (top > 0) {
        const uint id = ids[--top];
        if (bounds[top] >= furthest)
            continue;
        if (id >= t->first_oriented) {
            __global const float *box = t->oriented + ORIENTED * (size_t)(id - t->first_oriented);
            if (!any(squares_to(box, p->fx, p->fy, p->fz) < p->reach))
                continue;
        }
        if (id < t->first_leaf) {
            float found[ARITY];
            vstore8(squares_apart(p, t->nodes + (size_t)id * (6 * ARITY)), 0, found);
            top = push_nearest(id, found, furthest, bounds, ids, top);
            continue;
        }
        const uint first = (id - t->first_leaf) * LEAF;
        bool changed = false;
        for (uint slot = first; slot < min(first + LEAF, t->triangles); ++slot) {
            __global const float *rounded = t->rounded + FIELDS * (size_t)slot;
            if (!any(rounded_squares(rounded, p->fx, p->fy, p->fz) < p->doubtful))
                continue;
            const bool nearer = meet_slot(p, t, slot);
            changed |= nearer;
            hint = nearer ? slot : hint;
        }
        if (changed)
            furthest = largest(p->reach);
    }
    return hint;
}

// distances[i] and slots[i] as of nearest_triangles, for `count` points within NEAR extents in n
// runs of packets.
__kernel void nearest_in_packets(__global const double *points, __global const uint *order,
                                 const uint count, const uint n, __global const float *nodes,
                                 __global const double *leaves, __global const float *rounded,
                                 __global const float *oriented, const uint triangles,
                                 const uint first_leaf, const uint first_oriented,
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
    const tree t = {nodes, oriented, rounded, leaves, triangles, first_leaf, first_oriented,
#ifdef RANKED
                    ranks
#endif
    };
    uint hint = 0;
    for (uint start = gid * (RUN * POINTS); start < min((gid + 1) * (RUN * POINTS), count); start += POINTS) {
        packet p = points_of(points, order, count, start);
#ifdef GRAINED
        p.grain = grain;
#endif
        hint = search(&p, &t, hint);
        double least[POINTS];
        vstore16(DISTANCE(p.least), 0, least);
#ifdef RANKED
        uint slot[POINTS];
        vstore16(p.slot, 0, slot);
#endif
        for (uint i = 0; i < POINTS && start + i < count; ++i) {
            const uint own = order[start + i];
            distances[own] = least[i];
#ifdef RANKED
            slots[own] = slot[i];
#endif
        }
    }
}
