// From the flips of rows along x to inside voxels and inside leaves, level by level ([voCCeL], section
// 3.2, fig. 3.6, listings A.2, A.3 and A.7 to A.12). Host side: voxtool/svo/voxelization/fill/propagation.py. Options:
// CODE.
//
// before[i] and after[i] are the neighbours of node i along x at its level, or NOWHERE. flip[i] tells
// how the rows that leave node i change what comes after it: 0, 1, or MIXED if they differ. inside[i]
// is 1 if all within node i changes.

#include "svo/octree/octree.h"
#include "svo/voxelization/fill/filling.h"
#include "svo/voxelization/morton.h"

#define NOWHERE 0xFFFFFFFFu
#define MIXED 2

// The neighbours of the children of the refined nodes of a level (listing A.2, stitch_lvli). The
// level's nodes start at nodes[first], their children at nodes[below].
__kernel void stitch_level(__global const svo_node *nodes, const uint first, const uint below,
                           const uint n, __global uint *before, __global uint *after)
{
    const uint gid = get_global_id(0);
    if (gid >= n || !(nodes[first + gid].child & VALID))
        return;
    uint beside[2] = {before[first + gid], after[first + gid]};
    for (uint i = 0; i < 2; ++i) {
        const uint child = beside[i] == NOWHERE ? 0 : nodes[beside[i]].child;
        beside[i] = child & VALID ? below + (child & LINK) : NOWHERE;
    }
    const uint children = below + (nodes[first + gid].child & LINK);
    for (uint o = 0; o < 8; o += 2) {
        before[children + o] = beside[0] == NOWHERE ? NOWHERE : beside[0] + o + 1;
        after[children + o] = children + o + 1;
        before[children + o + 1] = children + o;
        after[children + o + 1] = beside[1] == NOWHERE ? NOWHERE : beside[1] + o;
    }
}

// Fill the bricks of each string of level-0 nodes along x, as if its rows began outside (A.8).
__kernel void concatenate_bricks(__global const uint *before, __global const uint *after,
                                 const uint first, const uint n, __global const ulong *flips,
                                 __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid >= n || before[first + gid] != NOWHERE)
        return;
    ulong face = 0;
    for (uint node = first + gid; node != NOWHERE; node = after[node]) {
        const ulong filled = fill_brick(flips[node - first], face);
        bricks[node - first] = filled;
        face = exit_face(filled);
    }
}

// Flip a refined level-1 node if the strings that end in it are inside there (A.9).
__kernel void flip_level1(__global const svo_node *nodes, __global const uint *after,
                          const uint first, const uint below, const uint n,
                          __global const ulong *bricks, __global uchar *flip)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint child = nodes[first + gid].child;
    uchar found = 0;
    if (child & VALID && after[below + (child & LINK) + 1] == NOWHERE) {
        ulong every = X0, some = 0;
        for (uint o = 1; o < 8; o += 2) {
            const ulong face = exit_face(bricks[(child & LINK) + o]);
            every &= face;
            some |= face;
        }
        found = some == 0 ? 0 : every == X0 ? 1 : MIXED;
    }
    flip[first + gid] = found;
}

// Flip a node of a higher level, whose children are nodes, by their flips (A.11).
__kernel void flip_level(__global const svo_node *nodes, __global const uint *after,
                         const uint first, const uint below, const uint n, __global uchar *flip)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint child = nodes[first + gid].child, children = below + (child & LINK);
    uchar found = 0;
    if (child & VALID && after[children + 1] == NOWHERE) {
        found = flip[children + 1];
        for (uint o = 3; o < 8; o += 2)
            found = flip[children + o] == found ? found : MIXED;
    }
    flip[first + gid] = found;
}

// Pass the flips of a level on along its strings (A.10). `open` counts nodes after which rows differ,
// and which a leaf follows.
__kernel void concatenate_level(__global const uint *before, __global const uint *after,
                                const uint first, const uint n, __global uchar *flip,
                                __global uchar *inside, volatile __global uint *open)
{
    const uint gid = get_global_id(0);
    if (gid >= n || before[first + gid] != NOWHERE)
        return;
    uchar flipped = 0;
    for (uint node = first + gid; node != NOWHERE; node = after[node]) {
        inside[node] = flipped;
        if (flip[node] != MIXED)
            flip[node] ^= flipped;
        flipped = flip[node] & 1;
        if (flip[node] == MIXED && after[node] != NOWHERE)
            atomic_inc(open);
    }
}

// A node that flips flips all of its children (A.12); bricks follow below. A leaf is marked INSIDE;
// `open` counts leaves that reach beyond the grid. above_codes: codes of refined nodes one level up.
__kernel void propagate_level(__global svo_node *nodes, __global const CODE *above_codes,
                              const uint is_root, const uint first, const uint below, const uint n,
                              const uint side, const int3 shape, const uint is_last,
                              __global uchar *inside, volatile __global uint *open)
{
    const uint gid = get_global_id(0);
    if (gid >= n || !inside[first + gid])
        return;
    const uint child = nodes[first + gid].child;
    if (child & VALID) {
        for (uint o = 0; o < 8 && !is_last; ++o)
            inside[below + (child & LINK) + o] ^= 1;
        return;
    }
    const CODE code = is_root ? 0 : above_codes[gid >> 3] << 3 | (gid & 7);
    const uint x = side * morton_decode(code).x;
    if (x + side <= (uint)shape.x)
        nodes[first + gid].child = INSIDE;
    else if (x < (uint)shape.x)
        atomic_inc(open);
}

// Flips the bricks below a node of level 1, clipped to the grid, if it flips (A.7).
__kernel void propagate_bricks(__global const CODE *codes, __global const uint *parent_index,
                               const uint n, const uint is_root, const uint first, const int3 shape,
                               __global const uchar *inside, __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint own = is_root ? 0 : 8 * parent_index[gid] + (uint)(codes[gid] & 7);
    const ulong change = inside[first + own] ? ALL : 0;
    const int x = 8 * (int)morton_decode(codes[gid]).x;
    for (uint o = 0; o < 8; ++o)
        bricks[8 * gid + o] = (bricks[8 * gid + o] ^ change) & voxels_before(shape.x, x, o & 1);
}
