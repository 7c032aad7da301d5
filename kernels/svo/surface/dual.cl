// Dual surfaces over the cut cells: a vertex for each loop, a quad for each cut edge; a work-item
// for each tile. Host side: voxtool/svo/surface/dual.py. Options: VOXELS, or SAMPLE, the type of
// coverages.

#include "svo/surface/cubes.h"
#include "svo/surface/samples.h"
#include "svo/surface/splits.h"
#include "svo/surface/relaxation.h"

uint case_at(TILES, ulong cell)
{
    uint found = 0;
    for (uint j = 0; j < 8; ++j) {
        const ulong corner = corner_cell(cell, j);
        found |= (uint)(mask_of(THESE_TILES, corner >> 6) >> (corner & 63) & 1) << j;
    }
    return found;
}

ulong cell_beyond(ulong cell, uint face)
{
    return face & 1 ? step_up(cell, face >> 1) : step_down(cell, face >> 1);
}

// For each present tile: the cut cells, with their cases; those with the alternative, as their
// pinched face is also the pinched face of the adjacent cell; and those with several loops. In
// `first` the numbers of loops, n further of quads (cut edges that start in the tile), 2 n further
// of neighbours of vertices beyond the fourth, 3 n further of cut cells.
__kernel void classify_tiles(__global const ulong *codes, const uint n, TILES, __global ulong *cut,
                             __global uchar *cases, __global ulong *joined,
                             __global ulong *several, __global uint *first)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong corner[8];
    corner_masks(THESE_TILES, codes[gid], corner);
    uint loops = 0, quads = 0, beyond = 0;
    for (uint axis = 0; axis < 3; ++axis)
        quads += (uint)popcount(corner[0] ^ corner[1u << axis]);
    const ulong all = cut_cubes(corner);
    ulong alternatives = 0, more = 0;
    __global uchar *to = cases + 64 * (size_t)gid;
    for (ulong left = all; left; left &= left - 1) {
        const uint bit = lowest_bit(left);
        uint found = case_of(corner, bit);
        const uint face = PINCHED_FACE[found];
        *to++ = (uchar)found;
        if (face != NO_FACE) {
            const ulong adjacent = cell_beyond(codes[gid] << 6 | bit, face);
            if (PINCHED_FACE[case_at(THESE_TILES, adjacent)] == (face ^ 1)) {
                alternatives |= 1ul << bit;
                found += ALTERNATIVE;
            }
        }
        loops += LOOP_COUNT[found];
        beyond += BEYOND_COUNT[found];
        more |= (ulong)(LOOP_COUNT[found] > 1) << bit;
    }
    cut[gid] = all;
    joined[gid] = alternatives;
    several[gid] = more;
    first[gid] = loops;
    first[n + gid] = quads;
    first[2 * n + gid] = beyond;
    first[3 * n + gid] = (uint)popcount(all);
}

// Voxel faces: the vertex of each loop is the corner shared by eight samples.
__kernel void place_corners(__global const ulong *codes, const uint n, CUBES, const int shift,
                            __global int *points)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 corner = cell_coordinates(codes[gid] << 6) - shift + 1;
    size_t vertex = first[gid];
    uint k = 0;
    for (ulong left = cut[gid]; left; left &= left - 1) {
        const uint bit = lowest_bit(left), found = resolved_case(cases, joined, gid, k++, bit);
        for (uint i = 0; i < LOOP_COUNT[found]; ++i)
            vstore3((corner + place_in_tile(bit)) * LATTICE, vertex++, points);
    }
}

// Surface nets [Gibson 1998]: the vertex of a loop starts at the mean of its crossings. Stores the
// vertices of a cube of case `found`, from the corner `low` on.
void place_loops(TILES, SAMPLES, const ulong cell, const uint found, const int3 low,
                 int *points)
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

// The vertices of each of n cases from the corner of its cube, packed, MAX_LOOPS a case: edges
// between voxels are all crossed at the same place.
__kernel void find_means(TILES, SAMPLES, const uint n, __global ulong *means)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    int points[3 * MAX_LOOPS];
    place_loops(THESE_TILES, THESE_SAMPLES, 0, gid, (int3)(0), points);
    for (uint i = 0; i < LOOP_COUNT[gid]; ++i)
        means[MAX_LOOPS * gid + i] = pack(points[3 * i], points[3 * i + 1], points[3 * i + 2]);
}

#else

// Surface nets of coverages.
__kernel void place_means(__global const ulong *codes, const uint n, TILES, SAMPLES, CUBES,
                          const int shift, __global int *points)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 corner = cell_coordinates(codes[gid] << 6) - shift;
    size_t vertex = first[gid];
    uint k = 0;
    for (ulong left = cut[gid]; left; left &= left - 1) {
        const uint bit = lowest_bit(left), found = resolved_case(cases, joined, gid, k++, bit);
        const int3 low = (corner + place_in_tile(bit)) * LATTICE + LATTICE / 2;
        int loops[3 * MAX_LOOPS];
        place_loops(THESE_TILES, THESE_SAMPLES, codes[gid] << 6 | bit, found, low, loops);
        for (uint i = 0; i < LOOP_COUNT[found]; ++i)
            vstore3(vload3(i, loops), vertex++, points);
    }
}

#endif

// ---- cells of a tile and beside it, in rows: those of a tile at PLACE

uint step_along(uint axis)
{
    return axis == 0 ? 1 : axis == 1 ? CELLS_ALONG : CELLS_ALONG * CELLS_ALONG;
}

// The cells with the highest coordinate along an axis.
ulong high_layer(uint axis) { return LAYER(axis) << (9u << axis); }

// The first vertices and cases of those of a tile's cut cells that are `wanted`; PLACE + offset is
// their place.
void number_cells(CUBES, uint slot, ulong wanted, int offset, uint *vertex, ushort *found)
{
    for (ulong left = wanted & cut[slot]; left; left &= left - 1) {
        const uint bit = lowest_bit(left);
        const ulong before = (1ul << bit) - 1;
        const uint k = (uint)popcount(cut[slot] & before);
        uint own = first[slot] + k;
        for (ulong more = several[slot] & before; more; more &= more - 1) {
            const uint other = lowest_bit(more);
            const uint at = (uint)popcount(cut[slot] & ((1ul << other) - 1));
            own += LOOP_COUNT[resolved_case(cases, joined, slot, at, other)] - 1;
        }
        vertex[PLACE[bit] + offset] = own;
        found[PLACE[bit] + offset] = (ushort)resolved_case(cases, joined, slot, k, bit);
    }
}

// The first vertices and cases of a tile's cut cells, and of the cut cells beside it in directions begin
// .. end - 1: from UP on along x, y and z, from DOWN on against them, from DIAGONAL on against x and y, y
// and z, z and x.
#define UP 0
#define DOWN 3
#define DIAGONAL 6
#define WAYS 9
void number_around(TILES, CUBES, __global const ulong *codes, uint gid, uint begin, uint end,
                   uint *vertex, ushort *found)
{
    number_cells(THESE_CUBES, gid, ALL, 0, vertex, found);
    for (uint way = begin; way < end; ++way) {
        const uint axis = way % 3, other = way < DIAGONAL ? axis : (axis + 1) % 3;
        const ulong low = LAYER(axis) & LAYER(other), high = high_layer(axis) & high_layer(other);
        if (!(cut[gid] & (way < DOWN ? high : low)))
            continue;
        ulong tile = way < DOWN ? step_up(codes[gid], axis) : step_down(codes[gid], axis);
        tile = way < DIAGONAL ? tile : step_down(tile, other);
        const uint slot = slot_of(THESE_WORDS, present, ranks, tile);
        if (slot == NOWHERE)
            continue;
        const int along = 4 * (int)step_along(axis);
        const int offset = way < DOWN       ? along
                           : way < DIAGONAL ? -along
                                            : -along - 4 * (int)step_along(other);
        number_cells(THESE_CUBES, slot, way < DOWN ? low : high, offset, vertex, found);
    }
}

// Clears the cells of a tile, and around it, if some of them lie below the low sides of the root and
// do not exist. Only the root of a window has such tiles, beyond its margin.
void clear_beyond(ulong tile, uint *vertex, ushort *found)
{
    if ((tile & AXIS) && (tile & AXIS << 1) && (tile & AXIS << 2))
        return;
    for (uint i = 0; i < NEAR_CELLS; ++i)
        vertex[i] = -NO_EDGE, found[i] = 0; // in case 0 no loop passes an edge: the sum is 0
}

#ifdef VOXELS

// The vertex into which a loop of a cell continues; vertex 0 if the cell there does not exist.
uint vertex_beyond(uint step, uint cell, const uint *vertices, const ushort *resolved)
{
    const uint face = step >> STEP_FACE & 7, along = step_along(face >> 1);
    const uint next = face & 1 ? cell + along : cell - along;
    return vertices[next] + LOOP_OF[12 * resolved[next] + (step >> STEP_ACROSS & STEP_EDGE)];
}

// The neighbours of each vertex, the vertices of the adjacent cells into which its loop continues;
// and the vertex itself, at the mean of its crossings.
__kernel void link_vertices(__global const ulong *codes, const uint n, TILES, CUBES,
                            __global const ulong *means, const uint batch, RELAXATION,
                            __global ulong *packed)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint vertices[NEAR_CELLS];
    ushort resolved[NEAR_CELLS];
    clear_beyond(codes[gid], vertices, resolved);
    number_around(THESE_TILES, THESE_CUBES, codes, gid, UP, DIAGONAL, vertices, resolved);
    uint further = first[2 * n + gid] - first[2 * n];
    for (ulong left = cut[gid]; left; left &= left - 1) {
        const uint cell = PLACE[lowest_bit(left)], found = resolved[cell];
        __constant const ushort *steps = LOOP_STEPS + 12 * found;
        for (uint loop = 0; loop < LOOP_COUNT[found]; ++loop) {
            const uint vertex = vertices[cell] + loop, about = AROUND[MAX_LOOPS * found + loop];
            const uint count = about & 15; // at least 3
            if ((vertex & (batch - 1)) == 0)
                beyond_start[vertex / batch] = further;
            for (uint i = 0; i < 4; ++i) {
                const uint next = vertex_beyond(steps[min(i, count - 1)], cell, vertices, resolved);
                links[4 * (size_t)vertex + i] = i < count ? next : vertex;
            }
            for (uint i = 4; i < count; ++i)
                beyond[further++] =
                    (uint2)(vertex, vertex_beyond(steps[i], cell, vertices, resolved));
            packed[vertex] = means[MAX_LOOPS * found + loop];
            around[vertex] = (ushort)about;
            steps += count;
        }
    }
    if (gid == n - 1) {
        uint vertex = first[n]; // the sum of all
        for (; vertex & (batch - 1); ++vertex)
            vstore4((uint4)(0), vertex, links);
        beyond_start[vertex / batch] = further;
    }
}

// The vertices of surface nets, from their coordinates in their cells.
__kernel void unpack(__global const ulong *codes, const uint n, CUBES, const int shift,
                     __global const ulong *packed, __global int *points)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 corner = cell_coordinates(codes[gid] << 6) - shift;
    size_t vertex = first[gid];
    uint k = 0;
    for (ulong left = cut[gid]; left; left &= left - 1) {
        const uint bit = lowest_bit(left), found = resolved_case(cases, joined, gid, k++, bit);
        const int3 low = (corner + place_in_tile(bit)) * LATTICE + LATTICE / 2;
        for (uint i = 0; i < LOOP_COUNT[found]; ++i) {
            const ulong at = packed[vertex];
            const int3 kept = {(int)at & COORDINATE, (int)(at >> BITS) & COORDINATE,
                               (int)(at >> 2 * BITS) & COORDINATE};
            vstore3(low + kept, vertex++, points);
        }
    }
}

#endif

// Splits a quad into two triangles along its shorter diagonal, or along the other if a triangle
// would have zero area. The corners lie in four cells around an edge, so they are never all
// collinear.
void split_quad(uint4 vertices, __global const int *points, uint index, __global uint *triangles)
{
    const quad q = quad_of(vertices, points);
    const uint first = shorter_diagonal(&q);
    store_split(&q, is_flat_split(&q, first) ? 1 - first : first, index, triangles);
}

__kernel void split_quads(__global const uint *quads, const uint n, __global const int *points,
                          __global uint *triangles)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        split_quad(vload4(gid, quads), points, gid, triangles);
}

// The quad of each cut edge that starts in a tile: the four cells around it, counter-clockwise seen
// from outside, the lowest first; with the option SPLIT its two triangles. Cells below the low sides
// of a window's root do not exist; their quads, which are beyond the window's margin, have vertex 0
// there.
__kernel void list_quads(__global const ulong *codes, const uint n, TILES, CUBES,
#ifdef SPLIT
                         __global const int *points,
#endif
                         __global uint *quads)
{
    const uint gid = get_global_id(0);
    if (gid >= n || !cut[gid])
        return;
    uint vertices[NEAR_CELLS];
    ushort resolved[NEAR_CELLS];
    clear_beyond(codes[gid], vertices, resolved);
    number_around(THESE_TILES, THESE_CUBES, codes, gid, DOWN, WAYS, vertices, resolved);
    uint to = first[n + gid] - first[n];
    for (ulong left = cut[gid]; left; left &= left - 1) {
        const uint cell = PLACE[lowest_bit(left)];
        const bool outward = resolved[cell] & 1; // whether the surface faces along the axis
        for (uint axis = 0; axis < 3; ++axis) {
            if ((resolved[cell] >> (1u << axis) & 1) == outward)
                continue;
            const uint b = step_along((axis + 1) % 3), c = step_along((axis + 2) % 3);
            const uint around[4] = {cell - b - c, cell - c, cell, cell - b};
            uint v[4];
            for (uint place = 0; place < 4; ++place) {
                const uint at = around[place], edge = EDGE_AROUND[4 * axis + place];
                v[place] = vertices[at] + LOOP_OF[12 * resolved[at] + edge];
            }
            const uint4 quad = outward ? (uint4)(v[0], v[1], v[2], v[3])
                                       : (uint4)(v[0], v[3], v[2], v[1]);
#ifdef SPLIT
            split_quad(quad, points, to++, quads);
#else
            vstore4(quad, to++, quads);
#endif
        }
    }
}
