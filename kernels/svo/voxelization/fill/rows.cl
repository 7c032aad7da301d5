// From the flips of rows along x to inside voxels and inside leaves. Host side:
// voxtool/svo/voxelization/fill/rows.py. Options: CODE.
//
// A bundle is 8 x 8 rows along x, as wide as a level-1 node. Its state has one bit a row: set if the
// row is inside. A state interleaves the faces of four bricks.

#include "svo/octree/octree.h"
#include "svo/voxelization/fill/filling.h"
#include "svo/voxelization/fill/rows.h"
#include "svo/voxelization/fill/sums.h"
#include "svo/voxelization/morton.h"

// The rows of quadrant o (brick octant / 2) of a bundle's state, as bits of X0; and back.
ulong face_of(ulong state, uint o) { return (state >> ((o & 1) + 8 * (o >> 1))) & X0; }
ulong rows_of(ulong face, uint o) { return face << ((o & 1) + 8 * (o >> 1)); }

// The rows that the flips of a level-1 node change: the parity along x of its eight bricks.
ulong node_flips(__global const ulong *bricks)
{
    ulong rows = 0;
    for (uint o = 0; o < 4; ++o) {
        ulong v = bricks[2 * o] ^ bricks[2 * o + 1];
        v ^= v >> 8;
        v ^= v >> 1;
        rows |= rows_of(v & X0, o);
    }
    return rows;
}

// The sums of two bricks along x, the first from x on. Bits 0 and 3 of a voxel's index are those of x.
uint2 brick_sums(ulong low, ulong high, int x)
{
    const ulong odd = 0xAAAAAAAAAAAAAAAAul, far = 0xFF00FF00FF00FF00ul;
    const uint first = (uint)popcount(low), second = (uint)popcount(high);
    const uint ones = (uint)popcount((low & odd) | (high & odd) >> 1);
    const uint twos = (uint)popcount((low & far) | (high & far) >> 8);
    const uint voxels = first + second;
    return (uint2)(voxels, 2 * (voxels * (uint)x + 4 * second + ones + 2 * twos));
}

// The bundles that pass through level-1 nodes.
__kernel void list_bundles(__global const CODE *codes, const uint n, const int3 shape,
                           __global uint *bundles)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint3 cell = morton_decode(codes[gid]);
    bundles[gid] = cell.y + cell.z * ((uint)(shape.y + 7) / 8);
}

#define MAX_LEVELS 16

// Traverse the octree along a bundle of rows. `entries` receives the states of rows where they enter
// level-1 nodes. `fills` counts the bundles that are completely inside at a leaf, or becomes MIXED if
// some rows are inside or the leaf reaches beyond the grid. With `states`, they are recorded for leaves
// to be refined instead (child = slot + 1). With `chosen`, only the chosen bundles are traversed. If
// asked for, sums[i] = the sums of sums.h over the voxels of the leaves of the bundle of work-item i.
__kernel void sweep_rows(__global const svo_node *nodes, __constant uint *offsets, const uint top,
                         const int3 shape, const uint n, __global const uint *chosen,
                         __global const ulong *entry, __global const ulong *bricks, __global ulong *entries,
                         volatile __global uint *fills, __global ulong *states, __global uint2 *sums)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint bundle = chosen ? chosen[gid] : gid, bundles_y = (uint)(shape.y + 7) / 8;
    const uint y = bundle % bundles_y, z = bundle / bundles_y;
    ulong state = entry ? entry[bundle] : 0;
    const uint end = (uint)(shape.x + 7) / 8;
    uint path[MAX_LEVELS]; // the nodes that contain cell (x, y, z), by level
    path[top] = 0;
    uint x = 0, level = top;
    uint2 inside = 0;
    while (x < end) {
        // descend to the leaf or level-1 node of the cell, from the last node that contains it
        uint child = nodes[offsets[top - level] + path[level]].child;
        while (level > 1 && (child & VALID)) {
            --level;
            const uint shift = level - 1;
            path[level] = (child & LINK) | ((x >> shift) & 1) | ((y >> shift) & 1) << 1 |
                          ((z >> shift) & 1) << 2;
            child = nodes[offsets[top - level] + path[level]].child;
        }
        uint next;
        if (child & VALID) {
            const uint index = (child & LINK) / 8;
            if (!states)
                entries[index] = state;
            state ^= node_flips(bricks + 8 * index);
            next = x + 1;
        } else {
            const uint side = 1u << (level - 1); // of the leaf, in cells
            const uint leaf = offsets[top - level] + path[level];
            next = (x | (side - 1)) + 1;
            if (sums)
                inside += row_sums((uint)popcount(state), 8 * x, min(8 * (int)next, shape.x));
            if (states) {
                if (child & LINK)
                    states[(child & LINK) - 1 + (y & (side - 1)) + (z & (side - 1)) * side] = state;
            } else if (state == ALL && 8 * next <= (uint)shape.x) {
                atomic_inc(&fills[leaf]);
            } else if (state != 0) {
                atomic_or(&fills[leaf], MIXED);
            }
        }
        level = min(33 - clz(x ^ next), top);
        x = next;
    }
    if (sums)
        sums[gid] = weighed(inside, bundle);
}

// Mark leaves: INSIDE if all bundles through a leaf fill it, otherwise MIXED; count the MIXED ones.
__kernel void mark_leaves(__global svo_node *nodes, __constant uint *offsets, const uint top,
                          const uint n, __global const uint *fills,
                          volatile __global uint *unresolved)
{
    const uint gid = get_global_id(0);
    if (gid >= n || fills[gid] == 0)
        return;
    uint level = top;
    while (gid >= offsets[top - level + 1])
        --level;
    if (fills[gid] == 1u << (2 * (level - 1))) {
        nodes[gid].child = INSIDE;
    } else {
        nodes[gid].child = MIXED;
        atomic_inc(unresolved);
    }
}

// bricks[8 positions[i] ..] |= added[8 i ..], for the eight bricks of level-1 node i.
__kernel void unite_bricks(__global const ulong *added, __global const uint *positions,
                           const uint n, __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        bricks[8 * positions[gid / 8] + gid % 8] |= added[gid];
}

// Turn the flips of each level-1 node into voxels, clipped to the grid. If asked
// for, sums[gid] = their sums.
__kernel void fill_bricks(__global const CODE *codes, const uint n, const int3 shape,
                          __global const ulong *entries, __global ulong *bricks, __global uint2 *sums)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong state = entries[gid];
    const uint3 cell = morton_decode(codes[gid]);
    const int x = 8 * (int)cell.x;
    uint2 inside = 0;
    for (uint o = 0; o < 4; ++o) {
        __global ulong *pair = bricks + 8 * gid + 2 * o;
        const ulong low = fill_brick(pair[0], face_of(state, o));
        const ulong high = fill_brick(pair[1], exit_face(low));
        pair[0] = low & voxels_before(shape.x, x, 0);
        pair[1] = high & voxels_before(shape.x, x, 1);
        if (sums)
            inside += brick_sums(pair[0], pair[1], x);
    }
    if (sums)
        sums[gid] = weighed(inside, cell.y + cell.z * ((uint)(shape.y + 7) / 8));
}
