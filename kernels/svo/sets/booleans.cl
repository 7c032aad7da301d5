// Set operations on octrees. Host side: voxtool/svo/sets/booleans.py.
//
// A node of the result is open while operands are refined there. The entries of open node i are
// starts[i] .. starts[i + 1] - 1: an operand, and the index of the first of its eight children. The
// operands that have ended in a leaf are summed up in states[i]: FULL or EMPTY. `exclusive` combines
// by exclusive or, otherwise by or; `complement` is of the result.

#include "svo/octree/octree.h"
#include "svo/sets/booleans.h"

// Children of open nodes: child i has counts[i] refined operands, and is open if there is one;
// states[i] = what its other operands make of it, or, if it is closed, its state in the result.
__kernel void close_children(const uint n, __global const uint *starts,
                             __global const uint *operands, __global const uint *firsts,
                             __global const uchar *states, __global const uint *inverted,
                             const uint exclusive, const uint complement,
                             __global const uint *words, __global uint *counts,
                             __global uint *open, __global uchar *child_states)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint node = gid / 8, end = starts[node + 1];
    uint count = 0, state = states[node];
    for (uint e = starts[node]; e < end; ++e) {
        const uint word = words[firsts[e] + gid % 8];
        if (word & VALID) {
            ++count;
            continue;
        }
        const uint value = ((word & INSIDE) != 0) ^ inverted[operands[e]];
        if (exclusive) {
            state ^= value;
        } else if (value) {
            state = FULL;
            count = 0;
            break;
        }
    }
    counts[gid] = count;
    open[gid] = count != 0;
    child_states[gid] = count ? state : state ^ complement;
}

// The entries of the open children; `places` and `ranks` are the scans of `counts` and
// `open`, `bases` the index of the first node or brick of each operand two levels below the nodes.
__kernel void list_entries(const uint n, __global const uint *starts,
                           __global const uint *operands, __global const uint *firsts,
                           __global const uint *words, __global const uint *places,
                           __global const uint *ranks, __global const uchar *child_states,
                           __global const uint *bases, __global uint *child_starts,
                           __global uint *child_operands, __global uint *child_firsts,
                           __global uchar *open_states, __global uint *slots)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint node = gid / 8, rank = ranks[gid];
    uint place = places[gid];
    if (gid == n - 1)
        child_starts[ranks[n]] = places[n];
    if (rank == ranks[gid + 1])
        return;
    child_starts[rank] = place;
    open_states[rank] = child_states[gid];
    slots[rank] = gid;
    for (uint e = starts[node]; e < starts[node + 1]; ++e) {
        const uint word = words[firsts[e] + gid % 8];
        if (!(word & VALID))
            continue;
        child_operands[place] = operands[e];
        child_firsts[place] = bases[operands[e]] + (word & LINK);
        ++place;
    }
}

// The eight bricks of each open level-1 node, and the node's state in the result.
__kernel void combine_bricks(const uint n, __global const uint *starts,
                             __global const uint *operands, __global const uint *firsts,
                             __global const uchar *states, __global const uint *inverted,
                             const uint exclusive, const uint complement,
                             __global const ulong *bricks, __global ulong *combined,
                             __global uchar *settled, __global uint *refined)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong8 masks = (ulong8)(states[gid] == FULL ? ~0UL : 0UL);
    for (uint e = starts[gid]; e < starts[gid + 1]; ++e) {
        const ulong8 more = vload8(0, bricks + firsts[e]) ^ (inverted[operands[e]] ? ~0UL : 0UL);
        masks = exclusive ? masks ^ more : masks | more;
    }
    if (complement)
        masks = ~masks;
    vstore8(masks, gid, combined);
    const ulong4 any = masks.lo | masks.hi, all = masks.lo & masks.hi;
    const uint empty = (any.x | any.y | any.z | any.w) == 0;
    const uint full = (all.x & all.y & all.z & all.w) == ~0UL;
    settled[gid] = full ? FULL : empty ? EMPTY : REFINED;
    refined[gid] = !full && !empty;
}

// The state in the result of each open node above level 1, from those of its children: the closed
// ones have it in child_states, the open ones in `below`, from where it is copied.
__kernel void settle_nodes(const uint n, __global const uint *ranks, __global const uchar *below,
                           __global uchar *child_states, __global uchar *settled,
                           __global uint *refined)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint found = 0; // a bit for each state
    for (uint i = 8 * gid; i < 8 * gid + 8; ++i) {
        if (ranks[i] != ranks[i + 1])
            child_states[i] = below[ranks[i]];
        found |= 1u << child_states[i];
    }
    const uint state = found == 1u << EMPTY ? EMPTY : found == 1u << FULL ? FULL : REFINED;
    settled[gid] = state;
    refined[gid] = state == REFINED;
}

// Link the refined ones of the open nodes of a level with their children: `kept` is the scan of
// their `refined`, `kept_above` that of the level above, where slots[i] is the place among children.
// The children of level-1 nodes (which have no child_states) own the bricks, which are copied.
__kernel void link_nodes(const uint n, __global const uint *kept, __global const uint *kept_above,
                         __global const uint *slots, const uint offset, const uint child_offset,
                         __global const uchar *child_states, __global const ulong *combined,
                         __global svo_node *nodes, __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid >= n || kept[gid] == kept[gid + 1])
        return;
    const uint first = 8 * kept[gid];
    const uint own = kept_above ? 8 * kept_above[slots[gid] / 8] + slots[gid] % 8 : 0;
    nodes[offset + own].child = VALID | first;
    for (uint j = 0; j < 8; ++j) {
        __global svo_node *child = nodes + child_offset + first + j;
        child->parent = VALID | own;
        if (!child_states) {
            child->child = VALID | (first + j);
            bricks[first + j] = combined[8 * gid + j];
        } else if (child_states[8 * gid + j] != REFINED) {
            child->child = child_states[8 * gid + j] == FULL ? INSIDE : 0;
        }
    }
}
