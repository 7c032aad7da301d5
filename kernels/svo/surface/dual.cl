// Dual surfaces over the cut cells: a vertex for each loop, a quad for each cut edge. Host side:
// voxtool/svo/surface/triangles.py. Options: VOXELS, or SAMPLE, the type of coverages.

#include "svo/surface/dual_case_tables.h"
#include "svo/surface/samples.h"
#include "svo/surface/relaxation.h"
#include "opencl/histopyramid.h"

// The arguments that locate a cut cell: the host's CutCubes.arguments.
#define CUBES __global const ulong *cut, __global const uint *first_cube
#define THESE_CUBES cut, first_cube

uint cube_of(TILES, CUBES, ulong cell, ulong near, uint slot)
{
    slot = cell >> 6 == near >> 6 ? slot : slot_of(present, ranks, cell >> 6);
    return first_cube[slot] + (uint)popcount(cut[slot] & ((1ul << (cell & 63)) - 1));
}

ulong cell_of(__global const uint *codes, uint place)
{
    return (ulong)codes[place >> 6] << 6 | (place & 63);
}

ulong cell_beyond(ulong cell, uint face)
{
    return face & 1 ? step_up(cell, face >> 1) : step_down(cell, face >> 1);
}

// The case of each cube, or its alternative if its pinched face is also the pinched face of the
// adjacent cube; and its numbers of loops, quads (cut edges that start in its low
// corner) and cut edges.
__kernel void resolve_cases(__global const uint *codes, TILES, CUBES, __global const uint *places,
                            __global const uchar *cases, const uint n, __global ushort *resolved,
                            __global uint *first_vertex, __global uint *quad_counts,
                            __global uint *first_beyond)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint found = cases[gid];
    const uint low_edges = found ^ (found & 1 ? 0xFF : 0); // corners that differ from the lowest
    quad_counts[gid] = (low_edges >> 1 & 1) + (low_edges >> 2 & 1) + (low_edges >> 4 & 1);
    const uint face = PINCHED_FACE[found];
    if (face != NO_FACE) {
        const ulong cell = cell_of(codes, places[gid]), beyond = cell_beyond(cell, face);
        const uint other = cube_of(THESE_TILES, THESE_CUBES, beyond, cell, places[gid] >> 6);
        if (PINCHED_FACE[cases[other]] == (face ^ 1))
            found += ALTERNATIVE;
    }
    resolved[gid] = (ushort)found;
    first_vertex[gid] = LOOP_COUNT[found];
    first_beyond[gid] = BEYOND_COUNT[found];
}

// Voxel faces: the vertex of each loop is the corner shared by eight samples.
__kernel void place_corners(__global const uint *codes, __global const uint *places, const uint n,
                            __global const uint *first_vertex, const int shift,
                            __global int *points)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 point = (cell_coordinates(cell_of(codes, places[gid])) - shift + 1) * LATTICE;
    for (size_t vertex = first_vertex[gid]; vertex < first_vertex[gid + 1]; ++vertex)
        vstore3(point, vertex, points);
}

// Surface nets [Gibson 1998]: the vertex of a loop starts at the mean of its crossings. Stores the
// vertices of a cube of case `found`, from the corner `low` on.
void place_loops(TILES, SAMPLES, const ulong cell, const uint found, const int3 low,
                 __global int *points)
{
    size_t vertex = 0;
    int3 sum = 0;
    int edges = 0;
    for (uint i = 0; i < EDGE_COUNT[found]; ++i) {
        const uint step = LOOP_STEPS[12 * found + i], edge = step & STEP_EDGE;
        const uint j = EDGE_CORNER[edge], axis = edge >> 2;
        const int t = crossing_of(THESE_TILES, THESE_SAMPLES, corner_cell(cell, j), axis,
                                  found >> j & 1);
        sum += place_in_tile(j) * LATTICE + unit_of(axis) * t;
        ++edges;
        if (step & STEP_LAST) {
            const int3 mean = (2 * sum + edges) / (2 * edges);
            vstore3(low + (int3)(within(mean.x), within(mean.y), within(mean.z)), vertex++, points);
            sum = 0, edges = 0;
        }
    }
}

#ifdef VOXELS

// The vertices of each of n cases from the corner of its cube, MAX_LOOPS a case: edges between
// voxels are all crossed at the same place.
__kernel void find_means(TILES, SAMPLES, const uint n, __global int *means)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        place_loops(THESE_TILES, THESE_SAMPLES, 0, gid, (int3)(0),
                    means + 3 * MAX_LOOPS * (size_t)gid);
}

#endif

__kernel void place_means(__global const uint *codes, TILES, SAMPLES, __global const uint *places,
                          __global const ushort *resolved, const uint n,
                          __global const uint *first_vertex, const int shift,
                          __global const int *means, __global int *points)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong cell = cell_of(codes, places[gid]);
    const int3 low = (cell_coordinates(cell) - shift) * LATTICE + LATTICE / 2;
    const size_t first = first_vertex[gid];
#ifdef VOXELS
    for (uint i = 0; first + i < first_vertex[gid + 1]; ++i)
        vstore3(low + vload3(MAX_LOOPS * resolved[gid] + i, means), first + i, points);
#else
    place_loops(THESE_TILES, THESE_SAMPLES, cell, resolved[gid], low, points + 3 * first);
#endif
}

// The neighbours of each vertex, the vertices of the adjacent cubes into which its loop continues;
// and the vertex itself, packed.
__kernel void link_vertices(__global const uint *codes, TILES, CUBES, __global const uint *places,
                            __global const ushort *resolved, const uint n,
                            __global const uint *first_vertex, __global const uint *first_beyond,
                            __global const int *points, const uint lanes, RELAXATION,
                            __global ulong *packed)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong cell = cell_of(codes, places[gid]);
    const uint found = resolved[gid];
    uint vertex = first_vertex[gid], further = first_beyond[gid], count = 0;
    uint above = 0x8880;
    for (uint i = 0; i < EDGE_COUNT[found]; ++i) {
        const uint step = LOOP_STEPS[12 * found + i], face = step >> STEP_FACE & 7;
        const ulong next = cell_beyond(cell, face);
        const uint other = cube_of(THESE_TILES, THESE_CUBES, next, cell, places[gid] >> 6);
        const uint across = step >> STEP_ACROSS & STEP_EDGE;
        const uint neighbour = first_vertex[other] + LOOP_OF[12 * resolved[other] + across];
        if (count == 0 && vertex % lanes == 0)
            beyond_start[vertex / lanes] = further;
        if (count < 4)
            links[4 * (size_t)vertex + count] = neighbour;
        else
            beyond[further++] = (uint2)(vertex, neighbour);
        ++count;
        const uint along = 16u << 4 * (face >> 1);
        above += face & 1 ? along : -along;
        if (step & STEP_LAST) {
            if (count == 3)
                links[4 * (size_t)vertex + 3] = vertex;
            const int3 at = (vload3(vertex, points) - LATTICE / 2) & (LATTICE - 1);
            packed[vertex] = (ulong)at.z << 2 * BITS | (ulong)at.y << BITS | (ulong)at.x;
            around[vertex++] = (ushort)(above | count);
            above = 0x8880, count = 0;
        }
    }
    if (gid == n - 1)
        beyond_start[(vertex + lanes - 1) / lanes] = further;
}

// Output quad k is quad r of cube i: the four cubes around a cut edge, counter-clockwise seen from
// outside, the lowest first.
__kernel void list_quads(HISTOPYRAMID, const uint n, __global const uint *codes, TILES, CUBES,
                         __global const uint *places, __global const ushort *resolved,
                         __global const uint *first_vertex, __global uint *quads)
{
    const uint k = get_global_id(0);
    __local uint found[2 * WORK_GROUP];
    uint r;
    const uint i = histopyramid_input(THIS_HISTOPYRAMID, n, found, &r);
    if (k >= n)
        return;
    const ulong cell = cell_of(codes, places[i]);
    const bool outward = resolved[i] & 1; // whether the surface faces along the axis
    uint axis = 0;
    for (;; ++axis) {
        const bool cut_here = (resolved[i] >> (1u << axis) & 1) != outward;
        if (cut_here && r-- == 0)
            break;
    }
    const uint b = (axis + 1) % 3, c = (axis + 2) % 3;
    for (uint place = 0; place < 4; ++place) { // (low, low), (high, low), (high, high), (low, high)
        ulong at = place == 0 || place == 3 ? step_down(cell, b) : cell;
        at = place < 2 ? step_down(at, c) : at;
        const uint edge = EDGE_AROUND[4 * axis + place];
        const uint cube = cube_of(THESE_TILES, THESE_CUBES, at, cell, places[i] >> 6);
        quads[4 * (size_t)k + (outward ? place : (4 - place) % 4)] =
            first_vertex[cube] + LOOP_OF[12 * resolved[cube] + edge];
    }
}

bool is_flat(long3 a, long3 b, long3 c)
{
    const long3 p = b - a, q = c - a;
    return p.y * q.z == p.z * q.y && p.z * q.x == p.x * q.z && p.x * q.y == p.y * q.x;
}

long squared(long3 v) { return v.x * v.x + v.y * v.y + v.z * v.z; }

// Splits a quad into two triangles along its shorter diagonal, or along the other if a triangle
// would have zero area. The corners lie in four cells around an edge, so they are never all
// collinear.
__kernel void split_quads(__global const uint *quads, const uint n, __global const int *points,
                          __global uint *triangles)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint vertex[4];
    long3 point[4];
    for (uint i = 0; i < 4; ++i) {
        vertex[i] = quads[4 * (size_t)gid + i];
        point[i] = convert_long3(vload3(vertex[i], points));
    }
    const bool even = squared(point[2] - point[0]) <= squared(point[3] - point[1]);
    uint first = even ? 0 : 1; // one end of the diagonal; the other is the opposite corner
    if (is_flat(point[first], point[first + 1], point[first + 2]) ||
        is_flat(point[first], point[first + 2], point[(first + 3) % 4]))
        first = 1 - first;
    const uint begin = vertex[first], end = vertex[first + 2];
    vstore3((uint3)(begin, vertex[first + 1], end), 2 * (size_t)gid, triangles);
    vstore3((uint3)(begin, end, vertex[(first + 3) % 4]), 2 * (size_t)gid + 1, triangles);
}
