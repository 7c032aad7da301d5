// The cut cells of tiles, and their cases.

#include "svo/surface/dual_case_tables.h"

// The arguments that describe the cut cells of tiles: the host's CutCubes.arguments.
#define CUBES                                                                                      \
    __global const ulong *cut, __global const uchar *cases, __global const ulong *joined,          \
        __global const ulong *several, __global const uint *first
#define THESE_CUBES cut, cases, joined, several, first

// The case of cut cell k of a tile, which is at `bit`; or its alternative.
uint resolved_case(__global const uchar *cases, __global const ulong *joined, uint slot, uint k,
                   uint bit)
{
    return cases[64 * (size_t)slot + k] + (joined[slot] >> bit & 1 ? ALTERNATIVE : 0);
}
