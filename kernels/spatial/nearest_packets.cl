// The nearest triangle of a mesh to each of many points: a work-item follows POINTS points that are
// near each other, one per lane, so that they share the traversal. Host side:
// voxtool/spatial/distance.py. The results are those of nearest_triangles in distance.cl.
//
// Options: RANKED: the nearest triangle is returned in addition to its distance.

#include "spatial/bvh.h"
#include "spatial/names.h"
#include "spatial/nearest_packets.h"

#define LANES double16 // one lane per point: POINTS
#define MASKS long16
#include "spatial/point_triangle.h"

#define STACK ((ARITY - 1) * MAX_LEVELS + 1)
#define SLACK (1 + 0x1p-18f) // exceeds the rounding error of squared distances to boxes

// Triangles whose longest edge, or whose height, is shorter than SHORT are rounded to points or to
// segments. No point of them moves further.
#define SHORT 0x1p-20

// rounded[i] = the numbers of frame_triangles of slot i, in single precision.
//
// The distance from a point within NEAR extents, computed in single precision by rounded_squares,
// exceeds the exact one by less than DOUBT: With coordinates of at most 8 + 1 and roundings of 2^-24,
// the vector from corner a to the point is off by less than 2^-19 in each coordinate, and so are its
// components along e and g, which are perpendicular, in units of length. So are then the distances
// to the lines of the edges, by whose signs the feature is chosen. A feature that is chosen wrongly
// is thus less than 2^-18 from the right one at the place that is nearest to the point. The vector
// from the place that is found, which is always in the triangle, is again off by less than 2^-19 in
// each coordinate. The sum is less than 2^-16; DOUBT is twice that.
#define DOUBT 0x1p-15f

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

float16 clamped_float(float16 t)
{
    return fmin(fmax(t, 0.0f), 1.0f);
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

// Triangle `slot`, in all lanes.
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

// The squared distances of points to a child's box.
float16 squares_to(__global const float *box, float16 x, float16 y, float16 z)
{
    const float16 dx = fmax(fmax(box[0] - x, x - box[3 * ARITY]), 0.0f);
    const float16 dy = fmax(fmax(box[ARITY] - y, y - box[4 * ARITY]), 0.0f);
    const float16 dz = fmax(fmax(box[2 * ARITY] - z, z - box[5 * ARITY]), 0.0f);
    return dx * dx + dy * dy + dz * dz;
}

// distances[i] and slots[i] as of nearest_triangles, for `count` points within NEAR extents in n
// packets.
__kernel void nearest_in_packets(__global const double *points, __global const uint *order,
                                 const uint count, const uint n, __global const float *nodes,
                                 __global const double *leaves, __global const float *rounded,
                                 const uint triangles, const uint first_leaf,
#ifdef RANKED
                                 __global const uint *ranks, __global uint *slots,
#endif
                                 __global double *distances)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    double xs[POINTS], ys[POINTS], zs[POINTS], least_of[POINTS];
    float3 low = INFINITY, high = -INFINITY; // of the packet
    for (uint i = 0; i < POINTS; ++i) {
        const double3 p = vload3(order[min(POINTS * gid + i, count - 1)], points);
        xs[i] = p.x, ys[i] = p.y, zs[i] = p.z;
        low = fmin(low, convert_float3(p));
        high = fmax(high, convert_float3(p));
    }
    const double16 x = vload16(0, xs), y = vload16(0, ys), z = vload16(0, zs);
    const float16 fx = convert_float16(x), fy = convert_float16(y), fz = convert_float16(z);
    double16 least = INFINITY;
#ifdef RANKED
    double16 least_ranked = INFINITY;
    uint16 rank = NAMELESS, slot = NAMELESS;
#endif
    float16 reach = INFINITY, doubtful = INFINITY; // of boxes, and of rounded triangles
    float furthest = INFINITY;                     // reach
    float bounds[STACK];
    uint ids[STACK];
    uint top = 1;
    bounds[0] = 0;
    ids[0] = 0;
    while (top > 0) {
        const uint id = ids[--top];
        if (bounds[top] >= furthest)
            continue;
        if (id > 0) {
            __global const float *box = nodes + (size_t)((id - 1) / ARITY) * (6 * ARITY) + (id - 1) % ARITY;
            if (!any(squares_to(box, fx, fy, fz) < reach))
                continue;
        }
        if (id >= first_leaf) {
            const uint first = (id - first_leaf) * LEAF;
            bool changed = false;
            for (uint own = first; own < min(first + LEAF, triangles); ++own) {
                if (!any(rounded_squares(rounded + FIELDS * (size_t)own, fx, fy, fz) < doubtful))
                    continue;
                const triangle t = triangle_of(leaves, own);
                ways way;
                long16 feature;
                const double16 dd = triangle_ways(&t, x, y, z, &way, &feature);
                const long16 nearer = dd < least;
                least = nearer ? dd : least;
#ifdef RANKED
                if (ranks[own] == NAMELESS)
                    continue;
                const long16 lower = convert_long16(ranks[own] < rank);
                const long16 better = dd < least_ranked | (dd == least_ranked & lower);
                least_ranked = better ? dd : least_ranked;
                rank = convert_int16(better) ? ranks[own] : rank;
                slot = convert_int16(better) ? own : slot;
                changed |= any(better);
#else
                changed |= any(nearer);
#endif
                if (changed) {
#ifdef RANKED
                    const float16 square = convert_float16(least_ranked);
#else
                    const float16 square = convert_float16(least);
#endif
                    reach = square * SLACK + 0x1p-100f;
                    const float16 far = sqrt(square) * SLACK + DOUBT;
                    doubtful = far * far;
                }
            }
            if (changed)
                furthest = largest(reach);
            continue;
        }
        __global const float *boxes = nodes + (size_t)id * (6 * ARITY);
        const float8 dx = fmax(fmax(vload8(0, boxes) - high.x, low.x - vload8(3, boxes)), 0.0f);
        const float8 dy = fmax(fmax(vload8(1, boxes) - high.y, low.y - vload8(4, boxes)), 0.0f);
        const float8 dz = fmax(fmax(vload8(2, boxes) - high.z, low.z - vload8(5, boxes)), 0.0f);
        float found[ARITY];
        vstore8(dx * dx + dy * dy + dz * dz, 0, found);
        const uint base = top;
        for (uint i = 0; i < ARITY; ++i) {
            if (found[i] >= furthest)
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
    vstore16(sqrt(least), 0, least_of);
#ifdef RANKED
    uint slot_of[POINTS];
    vstore16(slot, 0, slot_of);
#endif
    for (uint i = 0; i < POINTS && POINTS * gid + i < count; ++i) {
        const uint own = order[POINTS * gid + i];
        distances[own] = least_of[i];
#ifdef RANKED
        slots[own] = slot_of[i];
#endif
    }
}
