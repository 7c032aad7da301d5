// Tiles: 4 x 4 x 4 samples with a mask (bit set: sample inside) in the bit order of a brick.
// Present tiles have a slot; any other is completely inside or empty. A cell is the Morton code of
// a sample, and of the cube of eight samples with this lowest sample: the code of its tile, then 6
// bits.

#include "morton_bits.h"
#include "svo/surface/words.h"

#define ALL 0xFFFFFFFFFFFFFFFFul
#define AXIS 0x1249249249249249ul // the bits of x in a Morton code

// The code of the next cell, or tile, along an axis; outside the root it has more bits than the
// root's codes.
ulong step_up(ulong code, uint axis)
{
    const ulong m = AXIS << axis;
    return (((code | ~m) + 1) & m) | (code & ~m);
}

// The code of the previous cell; outside the root it has more bits than the root's codes.
ulong step_down(ulong code, uint axis)
{
    const ulong m = AXIS << axis;
    return (((code & m) - 1) & m) | (code & ~m);
}

// The cell, or tile, at corner j of a cube: zero or one step up along each axis.
ulong corner_cell(ulong code, uint j)
{
    const ulong x = AXIS, y = AXIS << 1, z = AXIS << 2;
    return (((code | ~x) + (j & 1)) & x) | (((code | ~y) + (j >> 1 & 1)) & y) |
           (((code | ~z) + (j >> 2)) & z);
}

int3 cell_coordinates(ulong cell)
{
    return (int3)((int)gather_bits(cell), (int)gather_bits(cell >> 1), (int)gather_bits(cell >> 2));
}

// The coordinates of sample `bit` in its tile.
int3 place_in_tile(uint bit)
{
    return (int3)((int)((bit & 1) | (bit >> 2 & 2)), (int)((bit >> 1 & 1) | (bit >> 3 & 2)),
                  (int)((bit >> 2 & 1) | (bit >> 4 & 2)));
}

// A step along an axis.
int3 unit_of(uint axis) { return (int3)(axis == 0, axis == 1, axis == 2); }

// The samples with coordinate 0 along an axis; the other layers are 1, 8 and 9 << axis bits above.
#define LAYER(axis)                                                                                \
    ((axis) == 0   ? 0x0055005500550055ul                                                          \
     : (axis) == 1 ? 0x0000333300003333ul                                                          \
                   : 0x000000000F0F0F0Ful)

// Shifts a mask down by one sample along an axis; `next` is the mask of the next tile.
ulong shift_mask(ulong mask, ulong next, uint axis)
{
    const ulong low = LAYER(axis);
    const uint one = 1u << axis, two = 8u << axis;
    return (mask >> one & (low | low << two)) | (mask >> (two - one) & low << one) |
           (next << (two + one) & low << (two + one));
}

// Converts the masks of a tile and its seven upper neighbours to corner masks: bit b of corner[j]
// is corner j of cube b.
void shift_to_corners(ulong *corner)
{
    for (uint axis = 0; axis < 3; ++axis)
        for (uint j = 0; j < 8; ++j)
            if (j >> axis & 1)
                corner[j] = shift_mask(corner[j ^ 1u << axis], corner[j], axis);
}

// The arguments that locate a word, and a present tile and its mask: the host's Tiles.arguments.
#define WORDS                                                                                      \
    __global const ulong *word_codes, __global const uint *places, const uint hash_shift
#define THESE_WORDS word_codes, places, hash_shift
#define TILES                                                                                      \
    WORDS, __global const ulong *present, __global const uint *ranks,                              \
        __global const ulong *inside, __global const ulong *masks
#define THESE_TILES THESE_WORDS, present, ranks, inside, masks

// The place of a listed word, by hashing with linear probing; NOWHERE if it is not listed.
uint word_of(WORDS, ulong code)
{
    const uint last = (uint)(ALL >> hash_shift);
    for (uint at = (uint)(code * WORD_MULTIPLIER >> hash_shift);; at = (at + 1) & last) {
        const uint place = places[at];
        if (place == NOWHERE || word_codes[place] == code)
            return place;
    }
}

uint slot_of(WORDS, __global const ulong *present, __global const uint *ranks, ulong tile)
{
    const uint at = word_of(THESE_WORDS, tile >> 6);
    if (at == NOWHERE)
        return NOWHERE;
    const ulong word = present[at], bit = 1ul << (tile & 63);
    return word & bit ? ranks[at] + (uint)popcount(word & (bit - 1)) : NOWHERE;
}

// The mask of a tile beside a present one; empty outside the root.
ulong mask_of(TILES, ulong tile)
{
    const uint at = word_of(THESE_WORDS, tile >> 6);
    if (at == NOWHERE)
        return 0;
    const ulong word = present[at], bit = 1ul << (tile & 63);
    const ulong all = inside[at] & bit ? ALL : 0; // without branches that go either way
    const uint slot = ranks[at] + (uint)popcount(word & (bit - 1));
    const ulong mask = masks[word & bit ? slot : 0];
    return word & bit ? mask : all;
}

// Bit b of corner[j]: is corner j of cube b of the tile inside?
void corner_masks(TILES, ulong tile, ulong *corner)
{
    for (uint j = 0; j < 8; ++j)
        corner[j] = mask_of(THESE_TILES, corner_cell(tile, j));
    shift_to_corners(corner);
}

// The cut cells: cubes with corners both inside and outside.
ulong cut_cubes(const ulong *corner)
{
    ulong any = 0, all = ALL;
    for (uint j = 0; j < 8; ++j) {
        any |= corner[j];
        all &= corner[j];
    }
    return any & ~all;
}

uint case_of(const ulong *corner, uint cube)
{
    uint found = 0;
    for (uint j = 0; j < 8; ++j)
        found |= (uint)(corner[j] >> cube & 1) << j;
    return found;
}

uint lowest_bit(ulong bits) { return 63 - (uint)clz(bits & -bits); }
