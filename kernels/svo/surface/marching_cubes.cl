// Marching cubes [Lorensen 1987] over the cut cells: a vertex for each cut edge, a work-item for
// each tile. Host side: voxtool/svo/surface/marching_cubes.py. Options: VOXELS, or SAMPLE, the type
// of coverages.

#include "svo/surface/case_tables.h"
#include "svo/surface/samples.h"

// For each present tile: its cut cells and their cases, and the cut edges that start in it
// along x, y and z; in `first` the numbers of vertices, n further of triangles, 2 n further of cut cells.
__kernel void classify_tiles(__global const ulong *codes, const uint n, TILES, __global ulong *cut,
                             __global uchar *cases, __global ulong *cut_edges,
                             __global uint *first)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong corner[8];
    corner_masks(THESE_TILES, codes[gid], corner);
    uint vertices = 0, triangles = 0;
    for (uint axis = 0; axis < 3; ++axis) {
        const ulong differing = corner[0] ^ corner[1u << axis];
        cut_edges[3 * gid + axis] = differing;
        vertices += (uint)popcount(differing);
    }
    const ulong found = cut_cubes(corner);
    __global uchar *to = cases + 64 * (size_t)gid;
    for (ulong left = found; left; left &= left - 1) {
        const uint cube = case_of(corner, lowest_bit(left));
        triangles += TRIANGLE_COUNT[cube];
        *to++ = (uchar)cube;
    }
    cut[gid] = found;
    first[gid] = vertices;
    first[n + gid] = triangles;
    first[2 * n + gid] = (uint)popcount(found);
}

// Numbers the edges, of those that start in a tile along an axis, whose cells are in `wanted`: of
// cell b, vertex[PLACE[b] + offset].
void number_edges(__global const ulong *cut_edges, __global const uint *first, uint slot, uint axis,
                  ulong wanted, uint offset, uint *vertex)
{
    const ulong edges = cut_edges[3 * slot + axis];
    uint before = first[slot];
    for (uint other = 0; other < axis; ++other)
        before += (uint)popcount(cut_edges[3 * slot + other]);
    for (ulong left = edges & wanted; left; left &= left - 1) {
        const uint bit = lowest_bit(left);
        vertex[PLACE[bit] + offset] = before + (uint)popcount(edges & ((1ul << bit) - 1));
    }
}

// The vertices of the edges that start in a tile, with their numbers: along x, then y, then z, in
// Morton order.
void place_vertices(TILES, SAMPLES, __global const ulong *codes, __global const ulong *cut_edges,
                    uint gid, size_t next_vertex, int shift, __global int *points, uint *vertex)
{
    const ulong tile = codes[gid], mask = masks[gid];
    const int3 corner = (cell_coordinates(tile << 6) - shift) * LATTICE + LATTICE / 2;
    const tile_samples own = samples_of(THESE_TILES, THESE_SAMPLES, tile);
    for (uint axis = 0; axis < 3; ++axis) {
        ulong left = cut_edges[3 * gid + axis];
        if (!left)
            continue;
        const tile_samples next = samples_of(THESE_TILES, THESE_SAMPLES, step_up(tile, axis));
        for (; left; left &= left - 1) {
            const uint bit = lowest_bit(left), end = (uint)step_up(bit, axis);
            const uint beyond = coverage_at(end < 64 ? own : next, end & 63);
            const int t = crossing(coverage_at(own, bit), beyond, isovalue, mask >> bit & 1);
            vertex[PLACE[bit] + axis] = (uint)next_vertex;
            const int3 low = corner + place_in_tile(bit) * LATTICE;
            vstore3(low + unit_of(axis) * t, next_vertex++, points);
        }
    }
}

// The vertices and the triangles of each of `count` tiles, cube by cube. Points are in units of
// 1 / LATTICE of a sample from the low corner of the grid, `shift` samples into the root.
__kernel void polygonise(__global const ulong *codes, const uint n, TILES, SAMPLES,
                         __global const ulong *cut, __global const uchar *cases,
                         __global const ulong *cut_edges, __global const uint *first,
                         const int shift, __global int *points, __global uint *triangles)
{
    const uint gid = get_global_id(0);
    if (gid >= n || !cut[gid])
        return;
    uint vertex[TILE_EDGES]; // of the edges along each axis from the corners of cubes
    place_vertices(THESE_TILES, THESE_SAMPLES, codes, cut_edges, gid, first[gid], shift, points,
                   vertex);
    for (uint j = 1; j < 7; ++j) { // the tiles above; all that cut edges start in are present
        const ulong beside = (j & 1 ? LAYER(0) : ALL) & (j & 2 ? LAYER(1) : ALL) &
                             (j & 4 ? LAYER(2) : ALL);
        const ulong tile = corner_cell(codes[gid], j);
        const uint slot = slot_of(THESE_WORDS, present, ranks, tile);
        if (slot == NOWHERE)
            continue;
        for (uint axis = 0; axis < 3; ++axis)
            if (!(j >> axis & 1))
                number_edges(cut_edges, first, slot, axis, beside, TILE_BEYOND[j] + axis, vertex);
    }
    __global const uchar *next_case = cases + 64 * (size_t)gid;
    __global uint *to = triangles + 3 * (size_t)(first[n + gid] - first[n]);
    __global const uint *end = triangles + 3 * (size_t)(first[n + gid + 1] - first[n]);
    for (ulong left = cut[gid]; left; left &= left - 1) {
        const uint *corner = vertex + PLACE[lowest_bit(left)];
        const uint found = *next_case++, count = 3 * TRIANGLE_COUNT[found];
        __constant const uchar *edge = TRIANGLES + 3 * MAX_TRIANGLES * found;
        if (to + 3 * MAX_TRIANGLES <= end) // the next cubes overwrite what is too much
            for (uint i = 0; i < 3 * MAX_TRIANGLES; ++i)
                to[i] = corner[edge[i]];
        else
            for (uint i = 0; i < count; ++i)
                to[i] = corner[edge[i]];
        to += count;
    }
}
