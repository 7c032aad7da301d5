// Bricks of several octrees united, each voxel with the octree that comes first. Host side:
// voxtool/svo/sets/priority_union.py. Option: VALUE, the type of what is written for an octree.
//
// Entries firsts[i] to firsts[i + 1] - 1 of brick i are masks, and the ranks of their octrees, the
// last one first; behind[i] is the rank of the first octree that fills the brick completely, or NONE.

#include "svo/sets/priority_union.h"

#define ENTRIES                                                                                    \
    __global const uint *firsts, __global const uint *ranks, __global const ulong *masks,          \
        __global const uint *behind

// bricks[i] = the voxels that any octree sets; shared[i] = those that several set.
__kernel void unite_bricks(const uint n, ENTRIES, __global ulong *bricks, __global ulong *shared)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong any = behind[gid] == NONE ? 0 : ~0ul, several = 0;
    for (uint i = firsts[gid]; i < firsts[gid + 1]; ++i) {
        several |= any & masks[i];
        any |= masks[i];
    }
    bricks[gid] = any;
    shared[gid] = several;
}

// Write, for each set voxel of brick i in the order of the bits, from starts[i] on, value_of[rank] of
// the first octree that sets it.
__kernel void paint_bricks(const uint n, ENTRIES, __global const ulong *bricks,
                           __global const uint *starts, __global const VALUE *value_of,
                           __global VALUE *values)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong brick = bricks[gid];
    __global VALUE *own = values + starts[gid];
    if (behind[gid] != NONE) {
        const VALUE value = value_of[behind[gid]];
        for (uint k = 0; k < 64; ++k)
            own[k] = value;
    }
    for (uint i = firsts[gid]; i < firsts[gid + 1]; ++i) {
        if (ranks[i] > behind[gid])
            continue;
        const VALUE value = value_of[ranks[i]];
        for (ulong left = masks[i]; left; left &= left - 1)
            own[popcount(brick & ((left & -left) - 1))] = value;
    }
}
