// The voxels that the outside reaches through voxels that share a face, an edge or a corner: connected components
// of the leaves of an octree and of the free voxels of its bricks. Host side: voxtool/svo/voxelization/fill/flood.py.
// Options: CODE.
//
// Nodes of the graph are numbered: coarse nodes as in the octree, then PARTS for each brick. A root is
// the least number of its component, whatever the order in which components are united.

#include "svo/octree/octree.h"
#include "svo/voxelization/fill/flood.h"
#include "svo/voxelization/morton.h"
#include "svo/voxelization/fill/beside.h"
#include "union_find.h"

// ---- components

// The connected components of the free voxels of each brick: at most PARTS,
// and empty masks after them.
__kernel void split_bricks(__global const ulong *barrier, const uint n, __global ulong *parts)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong left = ~barrier[gid];
    for (uint i = 0; i < PARTS; ++i) {
        ulong part = left & (~left + 1), grown = part; // the lowest voxel
        do {
            part = grown;
            grown = spilled(part, (int3)(0)) & left;
        } while (grown != part);
        parts[(size_t)PARTS * gid + i] = part;
        left &= ~part;
    }
}

__kernel void number_nodes(const uint n, __global uint *roots)
{
    if (get_global_id(0) < n)
        roots[get_global_id(0)] = get_global_id(0);
}

// ---- neighbours

// The node at a cell of a level: a leaf at this level or above, or else the node at this level.
uint node_at(__global const svo_node *nodes, __constant uint *offsets, uint top, uint level, uint3 cell)
{
    uint at = 0, own = 0;
    for (uint above = top; above > level; --above) {
        const uint child = nodes[at].child, shift = above - 1 - level;
        if (!(child & VALID))
            return at;
        own = (child & LINK) | ((cell.x >> shift) & 1) | ((cell.y >> shift) & 1) << 1 |
              ((cell.z >> shift) & 1) << 2;
        at = offsets[top - above + 1] + own;
    }
    return at;
}

// beside[27 i ..] = what lies in each direction from level-1 node i: VALID and the index of a refined
// level-1 node, the number of a leaf, or NOTHING. The region is that of the level-1 cells from low to
// below high.
__kernel void find_beside(__global const svo_node *nodes, __constant uint *offsets, const uint top,
                          __global const CODE *codes, const uint n, const int3 low, const int3 high,
                          __global uint *beside)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 own = convert_int3(morton_decode(codes[gid]));
    const bool within = all(own >= low) && all(own < high);
    for (int i = 0; i < 27; ++i) {
        const int3 cell = own + direction(i);
        uint found = NOTHING;
        if (within && all(cell >= low) && all(cell < high)) {
            found = node_at(nodes, offsets, top, 1, convert_uint3(cell));
            const uint child = nodes[found].child;
            found = child & VALID ? VALID | (child & LINK) / 8 : found;
        }
        beside[27 * (size_t)gid + i] = found;
    }
}

// ---- links

// Unite each leaf of a level with the leaves beside it that are not smaller, within the region.
// `parents` holds the codes of the refined nodes of the level above.
__kernel void link_leaves(__global const svo_node *nodes, __constant uint *offsets, const uint top,
                          const uint level, __global const CODE *parents, const uint n, const int3 low,
                          const int3 high, volatile __global uint *roots)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint own = offsets[top - level] + gid;
    if (nodes[own].child & VALID)
        return;
    const int3 cell = convert_int3(morton_decode(parents[gid >> 3] << 3 | (gid & 7)));
    const int side = 1 << (level - 1);
    if (any(cell * side < low) || any((cell + 1) * side > high))
        return;
    for (int i = 0; i < 27; ++i) {
        const int3 next = cell + direction(i);
        if (any(next * side < low) || any((next + 1) * side > high))
            continue;
        const uint other = node_at(nodes, offsets, top, level, convert_uint3(next));
        if (!(nodes[other].child & VALID))
            unite(roots, own, other);
    }
}

// Unite each part of brick i with the leaves, and with the parts of other bricks, that it touches.
__kernel void link_parts(__global const uint *beside, const uint n, __global const ulong *parts,
                         const uint first_part, volatile __global uint *roots)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    for (int i = 0; i < 27; ++i) {
        uint octant;
        const int3 d = direction(i);
        const uint other = beside_brick(beside, gid >> 3, gid & 7, d, &octant);
        if (i == 13 || other == NOTHING || (other & VALID && i < 13))
            continue; // bricks find each other from one side
        for (uint p = 0; p < PARTS && parts[(size_t)PARTS * gid + p]; ++p) {
            const ulong reach = spilled(parts[(size_t)PARTS * gid + p], d);
            const uint own = first_part + PARTS * gid + p;
            const uint first = PARTS * (8 * (other & LINK) + octant);
            if (!(other & VALID)) {
                if (reach)
                    unite(roots, own, other);
                continue;
            }
            for (uint q = 0; q < PARTS && parts[first + q]; ++q)
                if (reach & parts[first + q])
                    unite(roots, own, first_part + first + q);
        }
    }
}

// ---- answers

__kernel void find_roots(const uint n, volatile __global uint *roots)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        atomic_min(&roots[gid], root_of(roots, gid));
}

// found[PARTS i + p] = the root of part p of brick chosen[i], or NOTHING if there is no such part.
__kernel void find_roots_of(__global const uint *chosen, const uint n, __global const ulong *parts,
                            const uint first_part, __global const uint *roots, __global uint *found)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const size_t first = (size_t)PARTS * chosen[gid];
    for (uint p = 0; p < PARTS; ++p)
        found[(size_t)PARTS * gid + p] = parts[first + p] ? roots[first_part + first + p] : NOTHING;
}

// outside[i] = the voxels of brick i whose roots are reached.
__kernel void collect_outside(__global const ulong *parts, const uint n, const uint first_part,
                              __global const uint *roots, __global const uchar *reached,
                              __global ulong *outside)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong found = 0;
    for (uint p = 0; p < PARTS && parts[(size_t)PARTS * gid + p]; ++p)
        if (reached[roots[first_part + PARTS * gid + p]])
            found |= parts[(size_t)PARTS * gid + p];
    outside[gid] = found;
}

// states[i] = the state of coarse node i: REFINED, or EMPTY if its root is reached, or FULL.
__kernel void state_nodes(__global const svo_node *nodes, const uint n, __global const uint *roots,
                          __global const uchar *reached, __global uchar *states)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        states[gid] = nodes[gid].child & VALID ? REFINED : reached[roots[gid]] ? EMPTY : FULL;
}

// The voxels of a brick at a cell of bricks that lie in the box from low to below high.
ulong voxels_within(int3 brick, int3 low, int3 high)
{
    const int first[3] = {low.x - 4 * brick.x, low.y - 4 * brick.y, low.z - 4 * brick.z};
    const int end[3] = {high.x - 4 * brick.x, high.y - 4 * brick.y, high.z - 4 * brick.z};
    ulong beyond = 0;
    for (int axis = 0; axis < 3; ++axis)
        for (int i = 0; i < 4; ++i)
            if (i < first[axis] || i >= end[axis])
                beyond |= LOW[axis] << shift_to(axis, i);
    return ~beyond;
}

// Clear the voxels that do not lie in the box, or with `inverted` set those that are clear and lie in it.
__kernel void clip_bricks(__global const CODE *codes, const uint n, const int3 low, const int3 high,
                          const uint inverted, __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 octant = (int3)(gid & 1, gid >> 1 & 1, gid >> 2 & 1);
    const int3 brick = 2 * convert_int3(morton_decode(codes[gid >> 3])) + octant;
    bricks[gid] = (inverted ? ~bricks[gid] : bricks[gid]) & voxels_within(brick, low, high);
}
