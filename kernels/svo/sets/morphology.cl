// Dilation of tiles of 16 x 16 x 16 voxels, as rows of bits along x. Host side: voxtool/svo/sets/morphology.py.
// Options: CODE.

#include "svo/sets/morphology.h"
#include "svo/voxelization/morton.h"

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

// Load the 16 rows of plane z of a tile, or none.
ushort16 plane_of(__global const ushort *rows, uint tile, uint z)
{
    return tile == NONE ? (ushort16)0 : vload16(16 * (size_t)tile + z, rows);
}

// 1 where a number of steps is at most a width, 0 elsewhere: without a comparison, as Oclgrind widens a
// vector of comparisons wrongly.
ushort16 is_within(ushort16 steps, int width)
{
    return (ushort16)1 - min(sub_sat(steps, (ushort16)width), (ushort16)1);
}

// sections[(16 i + z) (reach.z + 1) + k] = the 16 rows of plane z of tile i, dilated within the plane by the
// section of the element that is k steps away along z. steps[starts[w]] .. steps[starts[w + 1] - 1] are the
// rows, as steps along y and z, that the element covers to w voxels on either side.
__kernel __attribute__((vec_type_hint(ushort16))) void dilate_planes(
    __global const ushort *rows, __global const uint *beside, const int3 halo, __global const uint *starts,
    __global const ushort2 *steps, const int3 reach, const uint n, __global ushort *sections)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint side = 2 * halo.x + 1, tall = 2 * halo.y + 1, z = gid & 15, depth = reach.z + 1;
    __global const uint *around = beside + (size_t)(gid >> 4) * tall * side;
    __global ushort *out = sections + 16 * (size_t)gid * depth;
    const ushort16 own = plane_of(rows, around[(halo.y * side) + halo.x], z);
    if (all(own == (ushort16)0xffff)) {
        for (uint k = 0; k < depth; ++k)
            vstore16(own, k, out);
        return;
    }
    // the rows of the tiles side by side along y, and the steps to the nearest voxel before and after each
    ushort lines[16 * (2 * MAX_HALO + 1)];
    ushort16 before[2 * MAX_HALO + 1], after[2 * MAX_HALO + 1];
    ushort16 some = 0;
    for (uint j = 0; j < tall; ++j) {
        __global const uint *tiles = around + j * side + halo.x;
        const ushort16 row = plane_of(rows, tiles[0], z);
        ushort16 low = reach.x + 1, high = reach.x + 1;
        for (int i = halo.x; i > 0; --i) {
            const ushort16 left = plane_of(rows, tiles[-i], z), right = plane_of(rows, tiles[i], z);
            low = select(low, (ushort16)(16 * i - 15) + clz(left), left != (ushort16)0);
            high = select(high, (ushort16)(16 * i) - clz(right & -right), right != (ushort16)0);
        }
        vstore16(row, j, lines);
        before[j] = low;
        after[j] = high;
        some |= row | as_ushort16(low <= (ushort16)reach.x) | as_ushort16(high <= (ushort16)reach.x);
    }
    for (uint k = 0; k < depth; ++k)
        vstore16((ushort16)0, k, out);
    if (all(some == (ushort16)0))
        return;
    const ushort *middle = lines + 16 * halo.y;
    for (int width = 0; width <= reach.x; ++width) {
        for (uint j = 0; j < tall && width > 0; ++j) {
            const ushort16 row = vload16(j, lines);
            const ushort16 first = is_within(before[j], width), last = is_within(after[j], width) << (ushort16)15;
            vstore16(row | row << (ushort16)1 | row >> (ushort16)1 | first | last, j, lines);
        }
        for (uint s = starts[width]; s < starts[width + 1]; ++s) {
            const ushort2 step = steps[s];
            const ushort16 found = vload16(0, middle + step.x) | vload16(0, middle - step.x);
            vstore16(found | vload16(step.y, out), step.y, out);
        }
    }
}

// bricks[64 i + b] = brick b of wanted tile i: the union of the sections of the planes around each of its
// planes; above = the tiles of the sections, from -halo to halo along z from each wanted tile, or NONE.
__kernel __attribute__((vec_type_hint(ushort16))) void unite_planes(
    __global const ushort *sections, __global const uint *above, const int halo, const int reach,
    const uint n, __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint tile = gid >> 2, layer = gid & 3;
    ushort16 rows[4];
    for (int z = 0; z < 4; ++z) {
        rows[z] = 0;
        for (int dz = -reach; dz <= reach; ++dz) {
            const int at = 4 * (int)layer + z + dz;
            const uint from = above[tile * (2 * halo + 1) + halo + (at >> 4)];
            if (from != NONE)
                rows[z] |= vload16((16 * (size_t)from + (at & 15)) * (reach + 1) + abs(dz), sections);
        }
    }
    for (uint x = 0; x < 4; ++x) {
        ulong4 column = 0; // the bricks of one x, by y
        for (uint z = 0; z < 4; ++z) {
            const ushort16 four = rows[z] >> (ushort16)(4 * x);
            const ushort16 spread = (four & (ushort16)3) | (four & (ushort16)12) << (ushort16)6;
            const uint4 slice = convert_uint4(spread.s048c) | convert_uint4(spread.s159d) << row_shift(1, 0) |
                                convert_uint4(spread.s26ae) << row_shift(2, 0) |
                                convert_uint4(spread.s37bf) << row_shift(3, 0);
            column |= convert_ulong4(slice) << (ulong)row_shift(0, z);
        }
        __global ulong *out = bricks + 64 * (size_t)tile;
        out[brick_place(x, 0, layer)] = column.s0;
        out[brick_place(x, 1, layer)] = column.s1;
        out[brick_place(x, 2, layer)] = column.s2;
        out[brick_place(x, 3, layer)] = column.s3;
    }
}
