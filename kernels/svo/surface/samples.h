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
#endif

// The samples of a tile; `each` is their coverages unless all are alike, or the mask of voxels.
#ifdef VOXELS
typedef ulong tile_samples;
typedef uint difference; // of coverages, in units of `isovalue`

tile_samples samples_of(TILES, SAMPLES, ulong tile) { return mask_of(THESE_TILES, tile); }

uint coverage_at(tile_samples tile, uint place) { return (uint)(tile >> place & 1); }
#else
typedef struct {
    __global const SAMPLE *each;
    uint all;
} tile_samples;
typedef DIFFERENCE difference; // of coverages, in units of `isovalue`

tile_samples samples_of(TILES, SAMPLES, ulong tile)
{
    const uint slot = slot_of(THESE_WORDS, present, ranks, tile);
    tile_samples found = {0, 0};
    if (slot == NOWHERE)
        found.all = mask_of(THESE_TILES, tile) & 1 ? full : 0;
    else if (source[slot] == NOWHERE)
        found.all = masks[slot] & 1 ? full : 0;
    else
        found.each = samples + 64 * (size_t)source[slot];
    return found;
}

uint coverage_at(tile_samples tile, uint place)
{
    return tile.each ? tile.each[place] : tile.all;
}
#endif

// Clamps a position along an edge away from both ends.
int within(int t) { return clamp(t, NEAREST, LATTICE - NEAREST); }

// The position, in LATTICE units per edge, where an edge crosses the surface, by the coverages of its
// two samples: t = (iso - a) / (b - a) from the outside sample, rounded once and clamped away from
// both ends.
int crossing(uint here, uint beyond, ulong isovalue, bool is_inside)
{
    const uint outer = is_inside ? beyond : here, inner = is_inside ? here : beyond;
    const difference above = (difference)isovalue - ((difference)outer << 16);
    const difference half_step = (difference)(inner - outer) << (15 - LATTICE_BITS);
    const int kept = within((int)((above + half_step) / (2 * half_step)));
    return is_inside ? LATTICE - kept : kept;
}

// The position of the crossing on an edge that the surface cuts and that starts at a cell.
int crossing_of(TILES, SAMPLES, ulong cell, uint axis, bool is_inside)
{
#ifdef VOXELS
    return crossing(is_inside, !is_inside, isovalue, is_inside);
#else
    const ulong end = step_up(cell, axis);
    const tile_samples own = samples_of(THESE_TILES, THESE_SAMPLES, cell >> 6);
    tile_samples next = own;
    if (end >> 6 != cell >> 6)
        next = samples_of(THESE_TILES, THESE_SAMPLES, end >> 6);
    const uint here = coverage_at(own, cell & 63), beyond = coverage_at(next, end & 63);
    return crossing(here, beyond, isovalue, is_inside);
#endif
}
