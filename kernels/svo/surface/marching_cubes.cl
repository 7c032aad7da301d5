// Marching cubes [Lorensen 1987] over the cut cells: a vertex for each cut edge, a work-item for
// each tile. Host side: voxtool/svo/surface/triangles.py. Options: VOXELS, or SAMPLE, the type of
// coverages.

#include "svo/surface/case_tables.h"
#include "svo/surface/samples.h"

// The vertices of the edges that start in a tile: along x, then y, then z, in Morton order. Points
// are in units of 1 / LATTICE of a sample from the low corner of the grid, `shift` samples into the
// root.
__kernel void place_vertices(__global const uint *codes, const uint n, TILES, SAMPLES,
                             __global const ulong *cut_edges, __global const uint *first_vertex,
                             const int shift, __global int *points)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong tile = codes[gid];
    const int3 corner = cell_coordinates(tile << 6) - shift;
    const tile_samples own = samples_of(THESE_TILES, THESE_SAMPLES, tile);
    size_t vertex = first_vertex[3 * gid];
    for (uint axis = 0; axis < 3; ++axis) {
        ulong left = cut_edges[3 * gid + axis];
        if (!left)
            continue;
        const tile_samples next =
            samples_of(THESE_TILES, THESE_SAMPLES, step_up(tile, axis));
        for (; left; left &= left - 1) {
            const uint bit = lowest_bit(left), end = (uint)step_up(bit, axis);
            const uint beyond = coverage_at(end < 64 ? own : next, end & 63);
            const int t =
                crossing(coverage_at(own, bit), beyond, isovalue, masks[gid] >> bit & 1);
            const int3 low = (corner + place_in_tile(bit)) * LATTICE + LATTICE / 2;
            vstore3(low + unit_of(axis) * t, vertex++, points);
        }
    }
}

// The number of triangles of each tile.
__kernel void count_triangles(__global const uchar *cases, __global const uint *first_cube,
                              const uint n, __global uint *first_triangle)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint count = 0;
    for (uint cube = first_cube[gid]; cube < first_cube[gid + 1]; ++cube)
        count += TRIANGLE_COUNT[cases[cube]];
    first_triangle[gid] = count;
}

// The triangles of each tile, cube by cube.
__kernel void polygonise(__global const uint *codes, const uint n, TILES,
                         __global const ulong *cut, __global const uint *first_cube,
                         __global const uchar *cases, __global const ulong *cut_edges,
                         __global const uint *first_vertex, __global const uint *first_triangle,
                         __global uint *triangles)
{
    const uint gid = get_global_id(0);
    if (gid >= n || first_triangle[gid] == first_triangle[gid + 1])
        return;
    uint slot[8]; // of the tile and those above it; all that cut edges start in are present
    for (uint j = 0; j < 8; ++j) {
        const ulong tile = corner_cell(codes[gid], j);
        slot[j] = tile >> 6 < words ? slot_of(present, ranks, tile) : NOWHERE;
    }
    uint cube = first_cube[gid];
    size_t to = 3 * (size_t)first_triangle[gid];
    for (ulong left = cut[gid]; left; left &= left - 1) {
        const uint bit = lowest_bit(left), found = cases[cube++];
        uint vertex[12];
        for (uint i = 0; i < EDGE_COUNT[found]; ++i) {
            const uint edge = EDGES[12 * found + i]; // corner where it begins, and axis
            const uint begin = (uint)corner_cell(bit, edge & 7);
            const uint edges = 3 * slot[begin >> 6] + (edge >> 3);
            const ulong before = cut_edges[edges] & ((1ul << (begin & 63)) - 1);
            vertex[i] = first_vertex[edges] + (uint)popcount(before);
        }
        for (uint i = 0; i < 3 * TRIANGLE_COUNT[found]; ++i)
            triangles[to++] = vertex[TRIANGLES[3 * MAX_TRIANGLES * found + i]];
    }
}
