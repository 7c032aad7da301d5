// Marching cubes with a work-item for each vertex and each triangle, which finds its tile in a
// histogram pyramid [Dyken 2008]; [voCCeL, section 4.1]. Host side:
// voxtool/svo/surface/marching_cubes.py. Options: VOXELS, or SAMPLE, the type of coverages; ARITY.

#include "opencl/histopyramid.h"
#include "svo/surface/case_tables.h"
#include "svo/surface/samples.h"

#define VERTICES_RUN 0 // runs of the pyramid
#define TRIANGLES_RUN 1

// The place of the set bit with k set bits below it.
uint nth_bit(ulong mask, uint k)
{
    uint place = 0;
    for (uint half_width = 32; half_width; half_width >>= 1) {
        const uint below = (uint)popcount(mask >> place & ((1ul << half_width) - 1));
        if (k >= below) {
            k -= below;
            place += half_width;
        }
    }
    return place;
}

// A vertex: its edge is the k-th of its tile, along x, then y, then z, in Morton order. Points are
// those of `polygonise`.
__kernel void place_vertex(__global const ulong *codes, const uint n, TILES, SAMPLES, PYRAMID,
                           __global const ulong *cut_edges, const int shift, __global int *points)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint2 found = input_of(THIS_PYRAMID, VERTICES_RUN, gid);
    __global const ulong *edges = cut_edges + 3 * (size_t)found.x;
    uint axis = 0, k = found.y;
    for (uint here; k >= (here = (uint)popcount(edges[axis])); ++axis)
        k -= here;
    const uint bit = nth_bit(edges[axis], k);
    const ulong cell = codes[found.x] << 6 | bit;
    const int t = crossing_of(THESE_TILES, THESE_SAMPLES, cell, axis, masks[found.x] >> bit & 1);
    const int3 low = (cell_coordinates(cell) - shift) * LATTICE + LATTICE / 2;
    vstore3(low + unit_of(axis) * t, gid, points);
}

// The number of the vertex on the edge of a cube that starts in a cell, along an axis.
uint vertex_of(TILES, __global const ulong *cut_edges, __global const uint *first, ulong cell,
               uint axis)
{
    const uint slot = slot_of(THESE_WORDS, present, ranks, cell >> 6);
    __global const ulong *edges = cut_edges + 3 * (size_t)slot;
    uint number = first[slot] + (uint)popcount(edges[axis] & ((1ul << (cell & 63)) - 1));
    for (uint other = 0; other < axis; ++other)
        number += (uint)popcount(edges[other]);
    return number;
}

// A triangle: it is the k-th of its tile, cube by cube.
__kernel void place_triangle(__global const ulong *codes, const uint n, TILES, PYRAMID,
                             __global const ulong *cut, __global const uchar *cases,
                             __global const ulong *cut_edges, __global const uint *first,
                             __global uint *triangles)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint2 found = input_of(THIS_PYRAMID, TRIANGLES_RUN, gid);
    __global const uchar *each = cases + 64 * (size_t)found.x;
    uint k = found.y, cube = 0;
    for (; k >= TRIANGLE_COUNT[each[cube]]; ++cube)
        k -= TRIANGLE_COUNT[each[cube]];
    const ulong cell = codes[found.x] << 6 | nth_bit(cut[found.x], cube);
    __constant const uchar *edge = TRIANGLES + 3 * (MAX_TRIANGLES * each[cube] + k);
    for (uint i = 0; i < 3; ++i) {
        const uint corner = edge[i] / 3, rows = corner / CORNERS_ALONG;
        const uint j = corner % CORNERS_ALONG | (rows % CORNERS_ALONG) << 1 |
                       (rows / CORNERS_ALONG) << 2;
        triangles[3 * (size_t)gid + i] =
            vertex_of(THESE_TILES, cut_edges, first, corner_cell(cell, j), edge[i] % 3);
    }
}
