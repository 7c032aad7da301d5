// Finds the tiles of samples that the surface may cross, and the cut cells, from an octree. Host
// side: voxtool/svo/surface/cut_cells.py. Options: VOXELS: samples are voxels and tiles are bricks;
// FRACTIONS: the same, with how much of each is inside; SAMPLE: the type of coverages and fractions.

#include "svo/octree/octree.h"
#include "svo/surface/samples.h"

// A level's nodes start at nodes[first].

// coverage[i] = number of occupied voxels in node i of a level, `full` if the node is inside.
// `below` holds the coverages of the next finer level, or `bricks` its bricks if that is level 0.
__kernel void cover_level(__global const svo_node *nodes, const uint first, const uint n,
                          const uint full, __global const ulong *bricks,
                          __global const uint *below, const uint below_bricks,
                          __global uint *coverage)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint child = nodes[first + gid].child;
    uint sum = child & INSIDE ? full : 0;
    if (child & VALID)
        for (uint i = child & LINK; i < (child & LINK) + 8; ++i)
            sum += below_bricks ? (uint)popcount(bricks[i]) : below[i];
    coverage[gid] = sum;
}

// Adds 2^shift tiles, 1 or 8, to a set.
void add_tiles(WORDS, volatile __global uint *set, ulong tile, uint shift)
{
    const uint word = word_of(THESE_WORDS, tile >> 6);
    atomic_or(&set[2 * (size_t)word + (tile >> 5 & 1)], (shift ? 0xFFu : 1u) << (tile & 31));
}

// The codes of a level's refined nodes, from those of the level above; and the tiles in the level's
// inside leaves, 2^shift a leaf. On the last level, also the active tiles, those of its refined
// nodes; a node whose children are bricks has eight tiles.
__kernel void place_nodes(__global const svo_node *nodes, const uint first, const uint n,
                          __global const ulong *above_codes, const uint is_last, const uint shift,
                          __global ulong *codes, WORDS, volatile __global uint *inside,
                          volatile __global uint *active)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint child = nodes[first + gid].child;
    const ulong code = above_codes[gid >> 3] << 3 | (gid & 7);
    if (child & VALID) {
        codes[(child & LINK) >> 3] = code;
        if (is_last)
            add_tiles(THESE_WORDS, active, code << shift, shift);
    }
    if (child & INSIDE)
        add_tiles(THESE_WORDS, inside, code << shift, shift);
}

// The words of tiles at the corners of the cubes of a listed word, in one set. A word of the root
// that is not listed lies in the same leaf; what lies outside the root is empty.
void corner_words(WORDS, __global const ulong *set, uint own, ulong root, ulong *corner)
{
    for (uint j = 0; j < 8; ++j) {
        const ulong code = corner_cell(word_codes[own], j);
        const uint at = word_of(THESE_WORDS, code);
        corner[j] = code < root ? set[at == NOWHERE ? own : at] : 0;
    }
    shift_to_corners(corner);
}

// Finds the tiles with a cube that may be cut: one of the cube's corners lies in an active tile, or
// its corners lie in both inside and empty tiles. Tiles that are not active correspond to the
// NullCubes of [voCCeL], section 4.1. The root has `root` words.
__kernel void find_tiles(__global const ulong *active, __global const ulong *inside, const uint n,
                         WORDS, const ulong root, __global ulong *present, __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong corner[8];
    corner_words(THESE_WORDS, inside, gid, root, corner);
    ulong any = cut_cubes(corner);
    corner_words(THESE_WORDS, active, gid, root, corner);
    for (uint j = 0; j < 8; ++j)
        any |= corner[j];
    present[gid] = any;
    counts[gid] = (uint)popcount(any);
}

// The codes of present tiles. Until it is sampled, each tile counts as completely inside or empty.
__kernel void list_tiles(__global const ulong *word_codes, __global const ulong *present,
                         __global const uint *ranks, __global const ulong *inside, const uint n,
                         __global ulong *codes, __global ulong *masks, __global uint *source)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint slot = ranks[gid];
    for (ulong left = present[gid]; left; left &= left - 1) {
        const uint bit = lowest_bit(left);
        codes[slot] = word_codes[gid] << 6 | bit;
        masks[slot] = inside[gid] >> bit & 1 ? ALL : 0;
        source[slot++] = NOWHERE;
    }
}

#ifdef VOXELS

// The masks of the active tiles are the bricks.
__kernel void sample_tiles(__global const ulong *node_codes, const uint n,
                           __global const ulong *bricks, WORDS,
                           __global const ulong *present, __global const uint *ranks,
                           __global ulong *masks,
                           __global uint *source)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint slot = slot_of(THESE_WORDS, present, ranks, node_codes[gid >> 3] << 3 | (gid & 7));
    masks[slot] = bricks[gid];
    source[slot] = gid;
}

#elif defined(FRACTIONS)

// The fractions of the 64 voxels of each brick: those of `partial` voxels follow each other from
// fractions[firsts[i]] on, the other set ones are full; and the masks of voxels of `threshold` or more.
__kernel void sample_tiles(__global const ulong *node_codes, const uint n,
                           __global const ulong *bricks, __global const ulong *partial,
                           __global const uint *firsts, __global const ushort *fractions,
                           const uint full, const uint threshold, WORDS,
                           __global const ulong *present, __global const uint *ranks,
                           __global SAMPLE *samples,
                           __global ulong *masks, __global uint *source)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong mask = 0;
    uint next = firsts[gid];
    for (uint bit = 0; bit < 64; ++bit) {
        uint found = bricks[gid] >> bit & 1 ? full : 0;
        if (partial[gid] >> bit & 1)
            found = fractions[next++];
        samples[64 * (size_t)gid + bit] = (SAMPLE)found;
        mask |= (ulong)(found >= threshold) << bit;
    }
    const uint slot = slot_of(THESE_WORDS, present, ranks, node_codes[gid >> 3] << 3 | (gid & 7));
    masks[slot] = mask;
    source[slot] = gid;
}

#else

// The coverages of the 64 samples of each active tile; the masks of samples inside, and of samples
// outside that contain occupied voxels; and the number of occupied voxels in the latter.
// full_and_inside: the coverage of a full sample, and the least of a sample inside.
__kernel void sample_tiles(__global const ulong *node_codes, const uint n,
                           __global const svo_node *nodes, const uint first,
                           const uint2 full_and_inside, __global const COVERAGE *coverage,
                           WORDS, __global const ulong *present, __global const uint *ranks,
                           __global SAMPLE *samples, __global ulong *below,
                           __global uint *lost_below, __global ulong *masks,
                           __global uint *source)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong mask = 0, set = 0;
    uint outside = 0;
    for (uint octant = 0; octant < 8; ++octant) {
        const uint child = nodes[first + 8 * gid + octant].child, node = child & LINK;
        __global SAMPLE *sample = samples + 64 * (size_t)gid + 8 * octant;
        if (child & VALID) {
            for (uint i = 0; i < 8; ++i) {
                const COVERAGE found = coverage[node + i]; // at level 0 a brick's mask
                const uint covered = (uint)(sizeof(COVERAGE) == 8 ? popcount(found) : found);
                sample[i] = (SAMPLE)covered;
                mask |= (ulong)(covered >= full_and_inside.y) << (8 * octant + i);
                set |= (ulong)(covered > 0) << (8 * octant + i);
                outside += covered < full_and_inside.y ? covered : 0;
            }
        } else {
            for (uint i = 0; i < 8; ++i)
                sample[i] = (SAMPLE)(child & INSIDE ? full_and_inside.x : 0);
            mask |= (child & INSIDE ? 0xFFul : 0ul) << (8 * octant);
        }
    }
    const uint slot = slot_of(THESE_WORDS, present, ranks, node_codes[gid]);
    masks[slot] = mask;
    below[gid] = set & ~mask;
    lost_below[gid] = outside;
    source[slot] = gid;
}

#endif

#if !defined(VOXELS) && !defined(FRACTIONS)

// The samples of a tile in a mask, and their neighbours by face, edge or corner.
ulong dilate(ulong mask)
{
    for (uint axis = 0; axis < 3; ++axis) {
        const uint one = 1u << axis, two = 8u << axis;
        const ulong low = LAYER(axis);
        mask |= shift_mask(mask, 0, axis) | (mask & (low | low << two)) << one |
                (mask & low << one) << (two - one);
    }
    return mask;
}

// lost[2 i]: number of occupied voxels in samples outside. lost[2 i + 1]: those of them in samples
// with no cut cell around. Each of n work-items sums a share of the tiles from core.x to below
// core.y.
__kernel void count_lost(__global const ulong *codes, const uint2 core, TILES, SAMPLES,
                         __global const ulong *below, __global const uint *lost_below,
                         __global const ulong *cut, const uint n, __global ulong *lost)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong sum = 0, vanished = 0;
    const uint share = (core.y - core.x + n - 1) / n, begin = core.x + gid * share;
    for (uint slot = begin; slot < min(begin + share, core.y); ++slot) {
        if (source[slot] == NOWHERE)
            continue;
        sum += lost_below[source[slot]];
        // samples without a cut cell in the tile
        ulong left = below[source[slot]] & ~dilate(masks[slot]);
        for (; left; left &= left - 1) {
            const uint bit = lowest_bit(left);
            const ulong cell = codes[slot] << 6 | bit;
            bool seen = false;
            for (uint j = 0; j < 8 && !seen; ++j) {
                ulong cube = cell;
                for (uint axis = 0; axis < 3; ++axis)
                    cube = j >> axis & 1 ? step_down(cube, axis) : cube;
                const uint at = slot_of(THESE_WORDS, present, ranks, cube >> 6);
                seen = at != NOWHERE && (cut[at] >> (cube & 63) & 1);
            }
            vanished += seen ? 0 : samples[64 * (size_t)source[slot] + bit];
        }
    }
    lost[2 * gid] = sum;
    lost[2 * gid + 1] = vanished;
}

#endif
