// From the flips of rows along x to inside voxels and inside leaves. Host side:
// voxtool/svo/fill/rows.py. Options: CODE.
//
// A bundle is 8 x 8 rows along x, a level-1 node wide; its state is 64 bits, one a row: inside or
// not. The bits of a brick are numbered in Morton order, so voxels of x = 0 .. 3 lie at offsets
// 0, 1, 8 and 9 from those of X0, and the faces of a bundle's four bricks interleave in its state.

#include "svo/octree.h"
#include "svo/fill/rows.h"
#include "svo/morton.h"

#define X0 0x0055005500550055ul // the voxels of a brick with x = 0
#define ALL 0xFFFFFFFFFFFFFFFFul

// The rows of quadrant o (brick octant / 2) of a bundle's state, as bits of X0; and back.
ulong face_of(ulong state, uint o) { return (state >> ((o & 1) + 8 * (o >> 1))) & X0; }
ulong rows_of(ulong face, uint o) { return face << ((o & 1) + 8 * (o >> 1)); }

// The rows that a level-1 node's flips turn: the parity along x of its eight bricks.
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

// Prefix parity along x of a brick's flips, from the state of its rows on entry.
ulong fill_brick(ulong flips, ulong face)
{
    ulong v = flips ^ face;
    v ^= (v & 0x5555555555555555ul) << 1;               // x = 0 to 1, 2 to 3
    const ulong middle = v & (X0 << 1);                 // x = 1 ...
    return v ^ (middle << 7) ^ (middle << 8);           // ... to 2 and 3
}

// The state of a brick's rows on exit: its voxels of x = 3.
ulong exit_face(ulong brick) { return (brick >> 9) & X0; }

#define MAX_LEVELS 16

// Walk a bundle's rows through the octree along x. Level-1 nodes get their rows' state on entry; for a
// leaf, `fills` counts the bundles that fill it, or is MIXED where a bundle fills it in part or it
// reaches beyond the grid. If bundles are chosen, their states in the leaves that are to be refined
// (child = slot + 1) are recorded instead.
__kernel void sweep_rows(__global const svo_node *nodes, __constant uint *offsets, const uint top,
                         const int3 shape, const uint n, __global const uint *chosen,
                         __global const ulong *entry, __global const ulong *bricks, __global ulong *entries,
                         volatile __global uint *fills, __global ulong *states)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint bundle = chosen ? chosen[gid] : gid, bundles_y = (uint)(shape.y + 7) / 8;
    const uint y = bundle % bundles_y, z = bundle / bundles_y;
    ulong state = entry ? entry[bundle] : 0;
    const uint end = (uint)(shape.x + 7) / 8;
    uint path[MAX_LEVELS]; // the nodes that hold cell (x, y, z), from the root down
    path[top] = 0;
    uint x = 0, level = top;
    while (x < end) {
        // down to the leaf or level-1 node of the cell, from the last node that holds it
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
            if (!chosen)
                entries[index] = state;
            state ^= node_flips(bricks + 8 * index);
            next = x + 1;
        } else {
            const uint side = 1u << (level - 1); // of the leaf, in cells
            const uint leaf = offsets[top - level] + path[level];
            next = (x | (side - 1)) + 1;
            if (chosen) {
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
}

// A leaf that all its bundles fill is inside; one that only some fill must be refined: it gets MIXED,
// and is counted.
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

// bricks[8 positions[i] ..] = flips[8 i ..], the eight bricks of a level-1 node.
__kernel void move_bricks(__global const ulong *flips, __global const uint *positions,
                          const uint n, __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        bricks[8 * positions[gid / 8] + gid % 8] = flips[gid];
}

// The same, but the voxels are added to those that are set.
__kernel void unite_bricks(__global const ulong *added, __global const uint *positions,
                           const uint n, __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        bricks[8 * positions[gid / 8] + gid % 8] |= added[gid];
}

// From flips to voxels: the prefix parity along x of each level-1 node's bricks, cut at the grid.
__kernel void fill_bricks(__global const CODE *codes, const uint n, const int3 shape,
                          __global const ulong *entries, __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong state = entries[gid];
    const int x = 8 * (int)morton_decode(codes[gid]).x;
    for (uint o = 0; o < 4; ++o) {
        __global ulong *pair = bricks + 8 * gid + 2 * o;
        const ulong low = fill_brick(pair[0], face_of(state, o));
        const ulong high = fill_brick(pair[1], exit_face(low));
        ulong kept[2] = {ALL, ALL};
        if (x + 8 > shape.x) // the voxels beyond the high-x side are no part of the grid
            for (int i = 0; i < 8; ++i)
                if (x + i >= shape.x)
                    kept[i >> 2] &= ~(X0 << ((i & 1) + 8 * ((i >> 1) & 1)));
        pair[0] = low & kept[0];
        pair[1] = high & kept[1];
    }
}
