// Counts of the edges, shells and others of a mesh. Host side: voxtool/mesh/counts.py. The order of
// atomic operations does not change the counts.

#include "mesh/counts.h"
#include "union_find.h"

// The positions of the corners of a face, `first` of its vertices if that is given.
uint3 corners_of(__global const uint *faces, __global const uint *first, uint face)
{
    const uint3 v = vload3(face, faces);
    return first ? (uint3)(first[v.x], first[v.y], first[v.z]) : v;
}

bool is_proper(uint3 at) { return at.x != at.y && at.y != at.z && at.z != at.x; }

// True if an area's component is not zero, whatever the rounding errors.
bool is_sure(double left, double right)
{
    return fabs(left - right) > 0x1p-50 * (fabs(left) + fabs(right)) + 0x1p-1000;
}

// counts[i] = the number of sides whose lower end is position i. used[i] becomes 1 at the corners of
// proper faces, and flat[f] is 1 for those that may have no area. roots[f] = f.
__kernel void count_sides(__global const uint *faces, const uint n, __global const uint *first,
                          __global const double *points, volatile __global uint *counts,
                          volatile __global uint *used, __global uint *roots, __global uchar *flat)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    roots[gid] = gid;
    flat[gid] = 0;
    const uint3 at = corners_of(faces, first, gid);
    if (!is_proper(at))
        return;
    const uint corners[4] = {at.x, at.y, at.z, at.x};
    for (int k = 0; k < 3; ++k) {
        atomic_inc(&counts[min(corners[k], corners[k + 1])]);
        used[corners[k]] = 1;
    }
    const double3 a = vload3(at.x, points), p = vload3(at.y, points) - a, q = vload3(at.z, points) - a;
    flat[gid] = !(is_sure(p.x * q.y, p.y * q.x) || is_sure(p.y * q.z, p.z * q.y) ||
                  is_sure(p.z * q.x, p.x * q.z));
}

// List the sides of proper faces at their lower ends: the higher end, the face, and 1 if the side runs
// to its higher end. ends[i] is where the list of position i begins, and becomes where it ends.
__kernel void list_sides(__global const uint *faces, const uint n, __global const uint *first,
                         volatile __global uint *ends, __global ulong *sides)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint3 at = corners_of(faces, first, gid);
    if (!is_proper(at))
        return;
    const uint corners[4] = {at.x, at.y, at.z, at.x};
    for (int k = 0; k < 3; ++k) {
        const uint low = min(corners[k], corners[k + 1]), high = max(corners[k], corners[k + 1]);
        sides[atomic_inc(&ends[low])] = (ulong)high << 32 | gid << 1 | (corners[k] == low);
    }
}

// The corner of a side's face that is not on the edge from `low`.
uint third_corner(__global const uint *faces, __global const uint *first, uint low, ulong side)
{
    const uint3 at = corners_of(faces, first, (uint)side >> 1);
    return at.x + at.y + at.z - low - (uint)(side >> 32);
}

// Count what the sides [begin, end) of an edge tell, and unite its faces.
void count_edge(__global const uint *faces, __global const uint *first, uint low,
                __global const ulong *sides, uint begin, uint end, volatile __global uint *roots,
                uint *found)
{
    const uint many = end - begin;
    uint forward = 0;
    for (uint s = begin; s < end; ++s) {
        forward += sides[s] & 1;
        if (s == begin)
            continue;
        found[UNITED] += unite(roots, (uint)sides[s - 1] >> 1, (uint)sides[s] >> 1);
        const uint third = third_corner(faces, first, low, sides[s]);
        if (third < sides[s] >> 32)
            continue; // counted at another edge, that of the lowest two corners
        uint other = begin;
        while (other < s && third_corner(faces, first, low, sides[other]) != third)
            ++other;
        found[DUPLICATE] += other < s;
    }
    ++found[EDGES];
    found[ODD] += many & 1;
    found[BOUNDARY] += many == 1;
    found[NONMANIFOLD] += many > 2;
    found[INCONSISTENT] += many == 2 && forward != 1;
}

// sums[SUMS i ...] = the counts of the edges whose lower ends work-item i processes. *unsure becomes 1
// if a list is too long.
__kernel void count_edges(__global const uint *faces, __global const uint *first, const uint positions,
                          __global const uint *ends, __global const uint *used,
                          __global ulong *sides, volatile __global uint *roots, __global uint *sums,
                          volatile __global uint *unsure, const uint n)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint found[SUMS] = {0};
    for (uint low = POSITIONS * gid; low < min(POSITIONS * (gid + 1), positions); ++low) {
        found[VERTICES] += used[low];
        const uint begin = low ? ends[low - 1] : 0, end = ends[low];
        if (end - begin > MOST_SIDES) {
            *unsure = 1;
            continue;
        }
        for (uint s = begin + 1; s < end; ++s) {
            const ulong side = sides[s];
            uint place = s;
            for (; place > begin && sides[place - 1] > side; --place)
                sides[place] = sides[place - 1];
            sides[place] = side;
        }
        for (uint s = begin, next = begin; s < end; s = next) {
            for (; next < end && sides[next] >> 32 == sides[s] >> 32; ++next)
                ;
            count_edge(faces, first, low, sides, s, next, roots, found);
        }
    }
    for (uint i = 0; i < SUMS; ++i)
        sums[SUMS * gid + i] = found[i];
}
