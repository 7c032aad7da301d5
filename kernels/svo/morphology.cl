// Dilation of tiles of 16 x 16 x 16 voxels, as rows of bits along x. Host side: voxtool/svo/morphology.py.
// Options: CODE.

#include "svo/morphology.h"
#include "svo/morton.h"

// The place of a brick among the 64 of a tile, in Morton order.
uint brick_place(uint x, uint y, uint z)
{
    return (x & 1) | (y & 1) << 1 | (z & 1) << 2 | (x & 2) << 2 | (y & 2) << 3 | (z & 2) << 4;
}

// The lowest bit of row (y, z) of a brick; the others follow it by 1, 8 and 9.
uint row_shift(uint y, uint z) { return (y & 1) << 1 | (z & 1) << 2 | (y & 2) << 3 | (z & 2) << 4; }

// rows[256 i + 16 z + y] = the voxels of row (y, z) of tile i; bit x is voxel x.
__kernel void rows_of_bricks(__global const ulong *bricks, const uint n, __global ushort *rows)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint y = gid & 15, z = gid >> 4 & 15, shift = row_shift(y & 3, z & 3);
    uint row = 0;
    for (uint x = 0; x < 4; ++x) {
        const uint four = (uint)(bricks[64 * (size_t)(gid >> 8) + brick_place(x, y >> 2, z >> 2)] >> shift);
        row |= ((four & 3) | (four >> 6 & 12)) << 4 * x;
    }
    rows[gid] = (ushort)row;
}

// bricks[64 i + b] = the voxels of brick b of tile i.
__kernel void bricks_of_rows(__global const ushort *rows, const uint n, __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint b = gid & 63, x = (b & 1) | (b >> 2 & 2), y = (b >> 1 & 1) | (b >> 3 & 2),
               z = (b >> 2 & 1) | (b >> 4 & 2);
    ulong brick = 0;
    for (uint i = 0; i < 16; ++i) {
        const uint row = rows[256 * (size_t)(gid >> 6) + 16 * (4 * z + (i >> 2)) + 4 * y + (i & 3)];
        const uint four = row >> 4 * x & 15;
        brick |= (ulong)((four & 3) | (four & 12) << 6) << row_shift(i & 3, i >> 2);
    }
    bricks[gid] = brick;
}

// The index of a code among `count` ascending ones, or NONE.
uint find_code(__global const CODE *codes, uint count, CODE code)
{
    uint low = 0, high = count;
    while (low < high) {
        const uint middle = low + (high - low) / 2;
        if (codes[middle] < code)
            low = middle + 1;
        else
            high = middle;
    }
    return low < count && codes[low] == code ? low : NONE;
}

// beside[i] = the index of each tile around the wanted ones, x fastest, or NONE: of wanted tile 0 those
// from -halo to halo, then of tile 1.
__kernel void find_beside(__global const CODE *codes, const uint count, __global const CODE *wanted,
                          const int3 halo, const uint n, __global uint *beside)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint3 side = convert_uint3(2 * halo + 1);
    const uint each = side.x * side.y * side.z, place = gid % each;
    const int3 step = (int3)(place % side.x, place / side.x % side.y, place / (side.x * side.y)) - halo;
    const int3 cell = convert_int3(morton_decode(wanted[gid / each])) + step;
    beside[gid] = any(cell < 0) ? NONE : find_code(codes, count, morton_encode(convert_uint3(cell)));
}

// grown = the rows of each wanted tile and of its surroundings up to `reach`, grown along x by 0, 1, ...
// reach.x voxels: of tile 0, all rows grown by 0, then by 1; y runs fastest, then z.
__kernel void grow_rows(__global const ushort *rows, __global const uint *beside, const int3 halo,
                        const int3 reach, const uint n, __global ushort *grown)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int ny = TILE + 2 * reach.y, nz = TILE + 2 * reach.z, sx = 2 * halo.x + 1;
    const uint plane = ny * nz, tile = gid / plane, place = gid % plane;
    const int y = (int)(place % ny) - reach.y, z = (int)(place / ny) - reach.z;
    const size_t line = ((size_t)tile * (2 * halo.z + 1) + (z >> 4) + halo.z) * (2 * halo.y + 1) +
                        (y >> 4) + halo.y;
    __global const uint *own = beside + line * sx + halo.x;
    const uint at = 16 * (z & 15) + (y & 15);
    uint row = own[0] == NONE ? 0 : rows[256 * (size_t)own[0] + at];
    // steps from the tile to the nearest voxel before it, and after it
    int before = reach.x + 1, after = reach.x + 1;
    for (int i = 1; i <= halo.x && before > reach.x; ++i) {
        const uint word = own[-i] == NONE ? 0 : rows[256 * (size_t)own[-i] + at];
        if (word)
            before = 16 * i - (31 - (int)clz(word));
    }
    for (int i = 1; i <= halo.x && after > reach.x; ++i) {
        const uint word = own[i] == NONE ? 0 : rows[256 * (size_t)own[i] + at];
        if (word)
            after = 16 * (i - 1) + 1 + (int)popcount((word & -word) - 1u);
    }
    __global ushort *out = grown + (size_t)tile * (reach.x + 1) * plane + place;
    for (int width = 0; width <= reach.x; ++width) {
        out[(size_t)width * plane] = (ushort)row;
        row |= row << 1 | row >> 1 | (uint)(before <= width + 1) | (uint)(after <= width + 1) << 15;
        row &= 0xffff;
    }
}

// rows[256 i + 16 z + y] = the union of the rows around row (y, z) of wanted tile i, each grown along x by
// its width: widths[|dz| (reach.y + 1) + |dy|], or none where that is negative.
__kernel void unite_rows(__global const ushort *grown, __global const int *widths, const int3 reach,
                         const uint n, __global ushort *rows)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int ny = TILE + 2 * reach.y, nz = TILE + 2 * reach.z, z = gid & 15;
    const size_t plane = ny * nz;
    __global const ushort *of_tile = grown + (size_t)(gid >> 4) * (reach.x + 1) * plane;
    ushort16 found = 0;
    for (int dz = -reach.z; dz <= reach.z; ++dz)
        for (int dy = -reach.y; dy <= reach.y; ++dy) {
            const int width = widths[abs(dz) * (reach.y + 1) + abs(dy)];
            if (width >= 0)
                found |= vload16(0, of_tile + width * plane + (z + dz + reach.z) * ny + dy + reach.y);
        }
    vstore16(found, 0, rows + 16 * (size_t)gid);
}
