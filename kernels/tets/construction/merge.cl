// Points at one position. Host side: voxtool/tets/construction/merge.py.

#include "tets/pictures/mixed.h"

// Keys of points by their position, -0 as 0, and their buckets: the highest bits, from `shift` on.
__kernel void key_points(__global const double *points, const uint n, const uint shift,
                         __global uint *buckets, __global ulong *keys)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong3 bits = as_ulong3(vload3(gid, points) + 0.0);
    const ulong key = mixed(mixed(mixed(bits.x) + bits.y) + bits.z);
    buckets[gid] = (uint)(key >> shift);
    keys[gid] = key;
}

bool at_one_place(__global const double *points, const uint a, const uint b)
{
    return all(vload3(a, points) == vload3(b, points));
}

// first[i] = the first of the points at the position of point i. Points of equal keys are in their
// order, and nearly always at one position.
__kernel void first_points(__global const double *points, __global const ulong *keys,
                           __global const uint *items, const uint n, __global uint *first)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint item = items[gid];
    for (uint i = gid; i > 0 && keys[i - 1] == keys[gid]; --i)
        if (at_one_place(points, items[i - 1], item))
            return; // not the first
    for (uint i = gid; i < n && keys[i] == keys[gid]; ++i)
        if (at_one_place(points, items[i], item))
            first[items[i]] = item;
}
