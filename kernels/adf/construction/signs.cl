// Gives the distances at the vertices of a level's blocks their signs. Host side: voxtool/adf/construction.py.

#include "adf/construction/lists.h"
#include "spatial/boundary.h"

double3 vertex_point(ulong identifier, uint level, double extent, uint i)
{
    const uint3 cell = cell_of(identifier, level);
    const double8 vertex =
        (double8)(2 * cell.x + i % 3, 2 * cell.y + i / 3 % 3, 2 * cell.z + i / 9, 0, 0, 0, 0, 0);
    return lattice(vertex, level + 1, extent).s012;
}

double with_sign(double value, bool inside)
{
    const double distance = value < 0 ? -value : value;
    return inside && distance > 0 ? -distance : distance;
}

// The winding numbers beside the faces nearest to eight vertices of a block, from vertex 8 k on.
double8 vertex_numbers(const scene_of_lists *scene, __global const uint *nearest_of, ulong identifier,
                       uint level, double extent, uint k)
{
    long which[8];
    for (uint i = 0; i < 8; ++i)
        which[i] = nearest_of[min(8 * k + i, 26u)];
    const ways points = lattice_points(2 * cell_of(identifier, level), VERTICES, k, level + 1, extent);
    ways way;
    return numbers_beside(scene, vload8(0, which), &points, &way);
}

#ifdef WINDING
// The largest distance between a point of a triangle of a list and the point in front of its centroid
// (voxtool/spatial/sides.py): two thirds of a median, which is no longer than the longest edge, and a
// little.
double farthest_from_middle(const scene_of_lists *scene, uint begin, uint end)
{
    double longest = 0;
    for (uint j = begin; j < end; ++j) {
        const double ee = triangle_at(scene, j).ee.s0;
        longest = ee > longest ? ee : longest;
    }
    return 0.67 * sqrt(longest);
}

#ifdef FLAT
// The distance from a point to the triangle at an index of the lists; infinite if there is none.
double distance_to(const scene_of_lists *scene, uint place, double3 p)
{
    if (place == NO_TRIANGLE)
        return INFINITY;
    const triangle t = triangle_at(scene, place);
    const ways point = {(double8)p.x, (double8)p.y, (double8)p.z};
    return sqrt(squares_to(&t, &point).s0);
}
#endif
#endif

// Whether a number is on the same side of 1/2 as it is `way` away, where it changes by no more than this
// slope.
bool is_sure(double number, double way, double slope)
{
#ifdef WINDING
    return fabs(number - 0.5) > NUMBER_ERRORS + way * slope;
#else
    return number == number;
#endif
}

// Assigns signs to distances. states[b] is the side of the mesh of the whole block, if known: from
// its parent, or where no triangles pass. Bit i of doubts[b] marks an unknown sign at vertex i. Bit
// i of asked[b] requests its winding number; where no triangles pass, only the block's centre is
// requested at first.
__kernel void sign_blocks(const uint n, LISTS SIDES BOUNDARY, __global const uint *sources,
                          __global const uchar *parent_states, __global const uint *PLACES_OF_SIDES,
                          __global uchar *states,
#ifdef WINDING
                          __global uint *doubts, __global uint *asked,
#endif
                          __global double *values)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const scene_of_lists scene = {SCENE_VALUES};
    __global double *own = values + 27 * (size_t)gid;
    __global const uint *nearest_of = PLACES_OF_SIDES + 27 * (size_t)gid;
    const double radius = extent / (1ul << level) * 2 * HALF_DIAGONAL + SLACK;
    const bool apart = own[MIDDLE] > radius;
    uchar state = parent_states[sources[gid] / 8];
    double ways[27], slope = 0; // from vertices to the middles of faces; change of the winding number
    for (uint i = 0; i < 27; ++i)
        ways[i] = own[i];
#ifdef WINDING
    if (state == UNKNOWN) {
        const double3 p = vertex_point(identifiers[gid], level, extent, MIDDLE);
        const double along = farthest_from_middle(&scene, begins[gid], begins[gid + 1]);
        double farthest = 0;
#ifdef FLAT // the nearest face with a side may be farther away
        const double to_side = radius + distance_to(&scene, nearest_of[MIDDLE], p);
        for (uint i = 0; i < 27; ++i)
            ways[i] = to_side;
#endif
        for (uint i = 0; i < 27; ++i) {
            ways[i] += along;
            farthest = ways[i] > farthest ? ways[i] : farthest;
        }
        slope = steepest(p.x, p.y, p.z, radius + farthest, spheres, sphere_count);
    }
#endif
    if (state == UNKNOWN && apart) {
        double numbers[8];
        vstore8(vertex_numbers(&scene, nearest_of, identifiers[gid], level, extent, MIDDLE / 8), 0, numbers);
        const double number = numbers[MIDDLE % 8];
        if (is_sure(number, ways[MIDDLE] + radius, slope))
            state = number > 0.5 ? INSIDE : OUTSIDE;
    }
    uint doubtful = 0;
    for (uint k = 0; k < POINTS / 8; ++k) {
        double numbers[8];
        const bool beside = state == UNKNOWN && !apart;
        vstore8(beside ? vertex_numbers(&scene, nearest_of, identifiers[gid], level, extent, k) : NAN, 0,
                numbers);
        for (uint i = 8 * k; i < min(8 * k + 8, 27u); ++i) {
            const double number = numbers[i % 8];
            if (state == UNKNOWN)
                doubtful |= (is_sure(number, ways[i], slope) ? 0u : 1u) << i;
            own[i] = with_sign(own[i], state == UNKNOWN ? number > 0.5 : state == INSIDE);
        }
    }
    states[gid] = state;
#ifdef WINDING
    doubts[gid] = doubtful;
    asked[gid] = apart && doubtful ? 1u << MIDDLE : doubtful;
#endif
}

#ifdef WINDING
// counts[b] = number of vertices of block b whose winding number is requested.
__kernel void count_asked(const uint n, __global const uint *asked, __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        counts[gid] = popcount(asked[gid]);
}

// The points of the requested vertices, and a number for each vertex of the lattice.
__kernel void list_asked(const uint n, CELLS, __global const uint *asked,
                         __global const uint *begins, __global double *points,
                         __global ulong *vertices)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong side = (2ul << level) + 1;
    const uint3 low = 2 * cell_of(identifiers[gid], level);
    uint at = begins[gid];
    for (uint i = 0; i < 27; ++i)
        if (asked[gid] >> i & 1) {
            vertices[at] = low.x + i % 3 + side * (low.y + i / 3 % 3 + side * (low.z + i / 9));
            vstore3(vertex_point(identifiers[gid], level, extent, i), at++, points);
        }
}

// Sets the signs from these winding numbers. If no triangle passes a block, the number at its
// centre decides the side of the whole block, provided that it changes little enough across the
// block; otherwise all vertices are requested.
__kernel void settle_signs(const uint n, CELLS BOUNDARY, __global const uint *begins,
                           __global const double *numbers, __global uint *doubts,
                           __global uint *asked, __global uchar *states, __global double *values)
{
    const uint gid = get_global_id(0);
    if (gid >= n || asked[gid] == 0)
        return;
    __global double *own = values + 27 * (size_t)gid;
    if (asked[gid] == 1u << MIDDLE && doubts[gid] != 1u << MIDDLE) {
        const double3 p = vertex_point(identifiers[gid], level, extent, MIDDLE);
        const double number = numbers[begins[gid]], radius = extent / (1ul << level) * 2 * HALF_DIAGONAL;
        const bool sure =
            is_sure(number, radius, steepest(p.x, p.y, p.z, radius, spheres, sphere_count));
        asked[gid] = sure ? 0 : doubts[gid];
        if (!sure)
            return;
        states[gid] = number > 0.5 ? INSIDE : OUTSIDE;
        doubts[gid] = 0;
        for (uint i = 0; i < 27; ++i)
            own[i] = with_sign(own[i], number > 0.5);
        return;
    }
    uint at = begins[gid];
    for (uint i = 0; i < 27; ++i)
        if (asked[gid] >> i & 1)
            own[i] = with_sign(own[i], numbers[at++] > 0.5);
    asked[gid] = 0;
}
#endif
