#include "svo/surface/lattice.h"
#include "svo/surface/cut_cells.h"

// The arguments for the coverage of a sample: the host's Tiles.arguments. The unit of `isovalue` is
// 2^-16 of a voxel's coverage.
#ifdef VOXELS
#define SAMPLES const ulong isovalue
#define THESE_SAMPLES isovalue
#else
#define SAMPLES                                                                                    \
    __global const uint *source, __global const SAMPLE *samples, const uint full,                  \
        const ulong isovalue
#define THESE_SAMPLES source, samples, full, isovalue

// The number of occupied voxels in a sample; `slot` is its tile's slot, or NOWHERE.
uint coverage_of(TILES, SAMPLES, ulong cell, uint slot)
{
    const ulong tile = cell >> 6;
    if (slot == NOWHERE)
        return tile >> 6 < words && (inside[tile >> 6] >> (tile & 63) & 1) ? full : 0;
    if (source[slot] == NOWHERE)
        return masks[slot] & 1 ? full : 0;
    return samples[64 * (size_t)source[slot] + (cell & 63)];
}
#endif

// Clamps positions along axes away from both ends of an edge.
int3 within(int3 t) { return clamp(t, (int3)(NEAREST), (int3)(LATTICE - NEAREST)); }

// The position, in LATTICE units per edge, where the edge from a cell along an axis crosses the
// surface: t = (iso - a) / (b - a) from the outside sample, rounded once and clamped away from both
// ends. The cell's tile has a slot.
int crossing(TILES, SAMPLES, ulong cell, uint slot, uint axis, bool cell_is_inside)
{
#ifdef VOXELS
    const ulong outer = 0, inner = 1;
#else
    const ulong next = step_up(cell, axis), tile = next >> 6;
    uint next_slot = slot;
    if (tile != cell >> 6)
        next_slot = tile >> 6 < words ? slot_of(present, ranks, tile) : NOWHERE;
    const uint here = coverage_of(THESE_TILES, THESE_SAMPLES, cell, slot);
    const uint beyond = coverage_of(THESE_TILES, THESE_SAMPLES, next, next_slot);
    const ulong outer = cell_is_inside ? beyond : here, inner = cell_is_inside ? here : beyond;
#endif
    const ulong above = isovalue - (outer << 16), range = (inner - outer) << 16;
    const long t = (long)((2 * above * LATTICE + range) / (2 * range));
    const int kept = within((int)t).x;
    return cell_is_inside ? LATTICE - kept : kept;
}
