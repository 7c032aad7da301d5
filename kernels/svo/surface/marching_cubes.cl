// Marching cubes [Lorensen 1987] over the cut cells: a vertex for each cut edge, a work-item for
// each triangle. Host side: voxtool/svo/surface/triangles.py. Options: VOXELS, or SAMPLE, the
// type of coverages.

#include "svo/surface/case_tables.h"
#include "svo/surface/samples.h"
#include "opencl/histopyramid.h"

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
    const int3 corner = cell_coordinates((ulong)codes[gid] << 6) - shift;
    size_t vertex = first_vertex[3 * gid];
    for (uint axis = 0; axis < 3; ++axis)
        for (ulong left = cut_edges[3 * gid + axis]; left; left &= left - 1) {
            const uint bit = lowest_bit(left);
            const ulong cell = (ulong)codes[gid] << 6 | bit;
            const int t =
                crossing(THESE_TILES, THESE_SAMPLES, cell, gid, axis, masks[gid] >> bit & 1);
            const int3 low = (corner + place_in_tile(bit)) * LATTICE + LATTICE / 2;
            vstore3(low + unit_of(axis) * t, vertex++, points);
        }
}

// The vertex of the edge that starts at a cell.
uint vertex_of(TILES, __global const ulong *cut_edges, __global const uint *first_vertex,
               ulong cell, uint axis)
{
    const uint edges = 3 * slot_of(present, ranks, cell >> 6) + axis;
    return first_vertex[edges] + (uint)popcount(cut_edges[edges] & ((1ul << (cell & 63)) - 1));
}

// The number of triangles of each cut cell.
__kernel void count_triangles(__global const uchar *cases, const uint n, __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        counts[gid] = TRIANGLE_COUNT[cases[gid]];
}

// Output triangle k is triangle r of cube i, located by the histopyramid [Dyken 2008].
__kernel void polygonise(HISTOPYRAMID, const uint n, __global const uint *codes, TILES,
                         __global const uint *places, __global const uchar *cases,
                         __global const ulong *cut_edges, __global const uint *first_vertex,
                         __global uint *triangles)
{
    const uint k = get_global_id(0);
    __local uint found[2 * WORK_GROUP];
    uint r;
    const uint i = histopyramid_input(THIS_HISTOPYRAMID, n, found, &r);
    if (k >= n)
        return;
    const ulong cell = (ulong)codes[places[i] >> 6] << 6 | (places[i] & 63);
    for (uint corner = 0; corner < 3; ++corner) {
        const uint edge = TRIANGLES[3 * (MAX_TRIANGLES * cases[i] + r) + corner];
        triangles[3 * (size_t)k + corner] = vertex_of(THESE_TILES, cut_edges, first_vertex,
                                                      corner_cell(cell, edge & 7), edge >> 3);
    }
}
