// Greedy meshing: merges coplanar unit squares into rectangles. Host side:
// voxtool/svo/surface/dual.py.

#include "svo/surface/lattice.h"
#include "svo/surface/greedy_meshing.h"

// A key holds, from the highest bits: the normal's axis a and sign (3 bits), the plane, then two
// coordinates of its low corner, along c = a + 2 and b = a + 1 (modulo 3). The key of a row has b and
// the row's length there. Each field has COORDINATE_BITS.
#define COORDINATE_MASK ((1ul << COORDINATE_BITS) - 1)

ulong with_field(ulong key, ulong field) { return key << COORDINATE_BITS | field; }

// Keys of squares, for rows along b: sorted by normal, plane, c, b.
__kernel void key_squares(__global const uint *quads, const uint n, __global const int *points,
                        __global ulong *keys, __global uint *order)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    int corner[3][3]; // the lowest corner and the two adjacent to it
    for (uint i = 0; i < 3; ++i) {
        const size_t vertex = quads[4 * (size_t)gid + (i == 2 ? 3 : i)];
        for (uint axis = 0; axis < 3; ++axis)
            corner[i][axis] = points[3 * vertex + axis] >> LATTICE_BITS;
    }
    uint a = 0;
    while (corner[1][a] != corner[0][a] || corner[2][a] != corner[0][a])
        ++a;
    const uint b = (a + 1) % 3, c = (a + 2) % 3;
    const bool outward = corner[1][b] != corner[0][b]; // the first edge is along b
    const ulong plane = with_field(2 * a + outward, corner[0][a]);
    keys[gid] = with_field(with_field(plane, corner[0][c]), corner[0][b]);
    order[gid] = gid;
}

// flags = 1 where a row starts, a run of squares side by side; places = the indices, for compaction.
__kernel void flag_rows(__global const ulong *keys, const uint n, __global uint *flags,
                        __global uint *places)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    flags[gid] = gid == 0 || keys[gid] != keys[gid - 1] + 1;
    places[gid] = gid;
}

// Keys of rows, for columns of rows with equal start and length: sorted by normal, plane, b and
// length, in a sort that keeps the order of c.
__kernel void key_rows(__global const ulong *square_keys, const uint count,
                       __global const uint *row_start, const uint n, __global ulong *keys,
                       __global uint *order)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint start = row_start[gid], end = gid + 1 < n ? row_start[gid + 1] : count;
    const ulong key = square_keys[start], b = key & COORDINATE_MASK;
    keys[gid] = with_field(with_field(key >> 2 * COORDINATE_BITS, b), end - start);
    order[gid] = gid;
}

// flags = 1 where a column of sorted rows starts, in which c rises by one; places as above.
__kernel void flag_columns(__global const ulong *row_keys, const uint n,
                           __global const uint *row_order, __global const uint *row_start,
                           __global const ulong *square_keys, __global uint *flags,
                           __global uint *places)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint before = max(gid, 1u) - 1;
    const ulong own = square_keys[row_start[row_order[gid]]];
    const ulong last = square_keys[row_start[row_order[before]]];
    flags[gid] = gid == 0 || row_keys[gid] != row_keys[before] ||
                 own != with_field((last >> COORDINATE_BITS) + 1, last & COORDINATE_MASK);
    places[gid] = gid;
}

// The rectangle of rows column_start[i] and following, with the corners of its corner quads. Marks
// the vertices in use.
__kernel void join_rows(__global const uint *column_start, const uint n,
                        __global const ulong *row_keys, __global const uint *row_order,
                        const uint rows, __global const uint *row_start,
                        __global const uint *square_order, __global const uint *quads,
                        __global uint *rectangles, volatile __global uint *used)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint first = column_start[gid], last = (gid + 1 < n ? column_start[gid + 1] : rows) - 1;
    const uint length = (uint)(row_keys[first] & COORDINATE_MASK);
    const uint outward = (uint)(row_keys[first] >> 3 * COORDINATE_BITS & 1);
    const uint low = row_start[row_order[first]], high = row_start[row_order[last]];
    for (uint corner = 0; corner < 4; ++corner) { // from low: b then c if outward, else c then b
        const bool far_b = corner == 2 || corner == (outward ? 1 : 3);
        const bool far_c = corner == 2 || corner == (outward ? 3 : 1);
        const uint quad = square_order[(far_c ? high : low) + (far_b ? length - 1 : 0)];
        const uint vertex = quads[4 * (size_t)quad + corner];
        rectangles[4 * (size_t)gid + corner] = vertex;
        atomic_or(&used[vertex], 1u);
    }
}

// The vertices in use, at their new indices.
__kernel void keep_points(__global const int *points, __global const uint *numbers, const uint n,
                          __global int *kept)
{
    const uint gid = get_global_id(0);
    if (gid >= n || numbers[gid] == numbers[gid + 1])
        return;
    vstore3(vload3(gid, points), numbers[gid], kept);
}

__kernel void renumber(__global uint *rectangles, const uint n, __global const uint *numbers)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        rectangles[gid] = numbers[rectangles[gid]];
}
