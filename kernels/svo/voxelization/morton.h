#include "morton_bits.h"

// Morton codes ([voCCeL], eq. 2.2), x in the lowest bit. The plan selects CODE: uint if the level-1
// cells fit 10 bits an axis, otherwise ulong. With MORTON_TABLE, a code of cells of up to 16 bits an
// axis is looked up byte by byte ([voCCeL], section 5.1).

#ifdef MORTON_TABLE
#include "svo/voxelization/morton_table.h"

ulong spread_by_table(uint value, uint axis)
{
    return (ulong)SPREAD[axis][value >> 8] << 24 | SPREAD[axis][value & 255];
}

CODE morton_encode(uint3 cell)
{
    return (CODE)(spread_by_table(cell.x, 0) | spread_by_table(cell.y, 1) | spread_by_table(cell.z, 2));
}
#else
CODE morton_encode(uint3 cell)
{
    return (CODE)(spread_bits(cell.x) | spread_bits(cell.y) << 1 | spread_bits(cell.z) << 2);
}
#endif

uint3 morton_decode(CODE code)
{
    const ulong c = code;
    return (uint3)(gather_bits(c), gather_bits(c >> 1), gather_bits(c >> 2));
}

// The bit of a voxel among the 8 x 64 bits of the bricks of its level-1 node.
uint voxel_place(uint3 voxel)
{
    const uint3 v = voxel & 7u;
    const uint3 spread = (v | v << 2 | v << 4) & 0x49u;
    return spread.x | spread.y << 1 | spread.z << 2;
}

// The bit of a row along x in the 64-bit state of its bundle of 8 x 8 rows, in which the faces
// (voxels of x = 0) of four bricks are interleaved: see face_of.
uint row_bit(uint y, uint z)
{
    return ((y >> 2) & 1) | (y & 1) << 1 | (z & 1) << 2 | ((z >> 2) & 1) << 3 |
           ((y >> 1) & 1) << 4 | ((z >> 1) & 1) << 5;
}
