// Computes exact signed distances at the vertices of a level's blocks. Host side:
// voxtool/adf/levels.py.

#include "adf/levels/lists.h"

// ---- distances

// The squared distances from the corners of the eight children to up to eight triangles. `corners`
// has one child per lane; `least` is the smallest distance so far at each corner.
typedef struct {
    double8 corners[8][8], least[8];
    uint count;
} rival_distances;

// The nearest triangle of a list to the centre of each child.
nearest nearest_to_middles(const scene_of_lists *scene, uint begin, uint end, const ways *middles)
{
    nearest found = nothing_found();
    for (uint j = begin; j < end; ++j) {
        const triangle t = triangle_at(scene, j);
        look_at(scene, j, squares_to(&t, middles), &found);
    }
    return found;
}

// Updates the vertices of a block with the triangles nearest to the centres, each triangle once.
void look_at_rivals(const scene_of_lists *scene, long8 which, const ways *points, nearest *found,
                    rival_distances *rivals)
{
    long places[8];
    vstore8(which, 0, places);
    rivals->count = 0;
    for (uint i = 0; i < 8; ++i) {
        found[i] = nothing_found();
        rivals->least[i] = INFINITY;
    }
    for (uint k = 0; k < 8; ++k) {
        bool known = places[k] == NO_TRIANGLE;
        for (uint other = 0; other < k; ++other)
            known |= places[other] == places[k];
        if (known)
            continue;
        const triangle t = triangle_at(scene, (uint)places[k]);
        double squares[POINTS];
        for (uint v = 0; v < POINTS / 8; ++v)
            vstore8(squares_to(&t, &points[v]), v, squares);
        for (uint i = 0; i < 8; ++i) {
            double corners[8], children[8];
            for (uint j = 0; j < 8; ++j) {
                corners[j] = squares[CORNERS[8 * i + j]];
                children[j] = squares[CORNERS[8 * j + i]];
            }
            look_at(scene, (uint)places[k], vload8(0, corners), &found[i]);
            const double8 other = rivals->corners[rivals->count][i] = vload8(0, children);
            rivals->least[i] = other < rivals->least[i] ? other : rivals->least[i];
        }
        ++rivals->count;
    }
}

// The children that need a triangle (all bits of a lane set), by its tangents at their centres, and
// in *nearer those of them where it may be nearest at a corner.
long8 children_that_need(const triangle *t, const ways *middles, double edge,
                         const rival_distances *rivals, long8 *nearer)
{
    ways way;
    MASKS feature;
    const double8 dd = triangle_ways(t, middles->x, middles->y, middles->z, &way, &feature);
    const double8 x = 0.25 * edge * way.x, y = 0.25 * edge * way.y, z = 0.25 * edge * way.z;
    const double8 base = dd - SLACK * (edge + sqrt(dd));
    double8 least[8]; // (tangent times distance at the centre) squared; 0 where negative
    long8 near = 0;
    for (uint i = 0; i < 8; ++i) {
        const double8 tangent = base + (i & 1 ? x : -x) + (i & 2 ? y : -y) + (i & 4 ? z : -z);
        least[i] = tangent > 0.0 ? tangent * tangent : 0.0;
        near |= !(least[i] > rivals->least[i] * dd); // also where there is no rival, and dd is 0
    }
    long8 needs = -1;
    for (uint other = 0; other < rivals->count; ++other) {
        long8 some = 0;
        for (uint i = 0; i < 8; ++i)
            some |= least[i] <= rivals->corners[other][i] * dd;
        needs &= some;
    }
    *nearer = near & needs;
    return needs;
}

// values[27 b + i] = distance at vertex i of block b, of cell identifiers[b]; places[27 b + i] =
// index in the lists of the nearest triangle with a side. Bit k of masks[j] is set if child k needs
// item j of the list. needed[8 b + k] = number of triangles that child k needs.
//
// The distance to a triangle is convex, so its tangent bounds it from below. Inside a cell, the
// trilinear interpolation of its corner values bounds it from above. So a triangle is nowhere
// nearest in a child if its tangent at the child's centre exceeds, at all corners, the distance to
// some other triangle. The candidates for that are the triangles nearest to the centres of the
// children.
__kernel void sample_blocks(const uint n, LISTS SIDES, __global double *values,
                            __global uint *places, __global uchar *masks, __global uint *needed)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const scene_of_lists scene = {SCENE_VALUES};
    const uint begin = begins[gid], end = begins[gid + 1];
    const uint3 cell = cell_of(identifiers[gid], level);
    const double edge = extent / (1ul << level) * 2;
    const ways middles = lattice_points(4 * cell, MIDDLES, 0, level + 2, extent);
    ways points[POINTS / 8];
    for (uint k = 0; k < POINTS / 8; ++k)
        points[k] = lattice_points(2 * cell, VERTICES, k, level + 1, extent);
    nearest found[8]; // at the corners of each child
    rival_distances rivals;
    look_at_rivals(&scene, nearest_to_middles(&scene, begin, end, &middles).which, points, found,
                   &rivals);

    const long8 bits = (long8)(1, 2, 4, 8, 16, 32, 64, 128);
    long8 total = 0;
    for (uint j = begin; j < end; ++j) {
        const triangle t = triangle_at(&scene, j);
        long8 nearer;
        const long8 needs = children_that_need(&t, &middles, edge, &rivals, &nearer);
        total -= needs;
        masks[j] = (uchar)gathered(needs & bits);
        for (uint left = gathered(nearer & bits), child = 0; left > 0; left >>= 1, ++child) {
            if (!(left & 1))
                continue;
            const ways corners = lattice_points(2 * cell + octant(child), CELL, 0, level + 1, extent);
            look_at(&scene, j, squares_to(&t, &corners), &found[child]);
            double reached[8];
#ifdef FLAT
            vstore8(found[child].sided, 0, reached);
#else
            vstore8(found[child].square, 0, reached);
#endif
            for (uint i = 0; i < 8; ++i)
                ((double *)&rivals.least[i])[child] = reached[i];
        }
    }
    long counted[8];
    vstore8(total, 0, counted);
    for (uint child = 0; child < 8; ++child) {
        needed[8 * (size_t)gid + child] = (uint)counted[child];
        // a shared vertex has the same value in each child
        double corners[8];
        long own[8];
        vstore8(sqrt(found[child].square), 0, corners);
        vstore8(found[child].which, 0, own);
        for (uint i = 0; i < 8; ++i) {
            const size_t vertex = 27 * (size_t)gid + CORNERS[8 * child + i];
            values[vertex] = corners[i];
#ifdef SIGNED
            places[vertex] = (uint)own[i];
#endif
        }
    }
}

// ---- signs

#ifdef WINDING
// An upper bound on the change of the winding number between a point and the middle of a face at
// most `reach` away; see voxtool/spatial/sides.py.
double sway(double x, double y, double z, double reach, __global const double *spheres, uint count)
{
    double sum = 0x1p-6; // exceeds the error of two winding numbers
    for (uint i = 0; i < count; ++i) {
        __global const double *sphere = spheres + 5 * i;
        const double dx = x - sphere[0], dy = y - sphere[1], dz = z - sphere[2];
        const double gap = sqrt(dx * dx + dy * dy + dz * dz) - sphere[3] - reach;
        if (!(gap > 0))
            return INFINITY;
        sum += sphere[4] * reach / (4 * PI * gap * gap);
    }
    return sum;
}
#endif

#ifdef SIGNED
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

// The longest edge of the triangles of a list.
double longest_edge(const scene_of_lists *scene, uint begin, uint end)
{
    double longest = 0;
    for (uint j = begin; j < end; ++j) {
        const double ee = triangle_at(scene, j).ee.s0;
        longest = ee > longest ? ee : longest;
    }
    return sqrt(longest);
}

// Assigns signs to distances. states[b] is the side of the mesh of the whole block, if known: from
// its parent, or where no triangles pass. Bit i of doubts[b] marks an unknown sign at vertex i. Bit
// i of asked[b] requests its winding number; where no triangles pass, only the block's centre is
// requested at first.
__kernel void sign_blocks(const uint n, LISTS SIDES BOUNDARY, __global const uint *sources,
                          __global const uchar *parent_states, __global const uint *places,
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
    __global const uint *nearest_of = places + 27 * (size_t)gid;
    const double radius = extent / (1ul << level) * 2 * HALF_DIAGONAL + SLACK;
    const bool apart = own[MIDDLE] > radius;
    uchar state = parent_states[sources[gid] / 8];
    double leeway = 0;
#ifdef WINDING
    if (state == UNKNOWN) {
        const double3 p = vertex_point(identifiers[gid], level, extent, MIDDLE);
        const double reach = own[MIDDLE] + 3 * radius + longest_edge(&scene, begins[gid], begins[gid + 1]);
        leeway = sway(p.x, p.y, p.z, reach, spheres, sphere_count);
    }
#endif
    if (state == UNKNOWN && apart) {
        const double3 p = vertex_point(identifiers[gid], level, extent, MIDDLE);
        const double number = number_beside(&scene, nearest_of[MIDDLE], p.x, p.y, p.z);
        if (fabs(number - 0.5) > leeway)
            state = number > 0.5 ? INSIDE : OUTSIDE;
    }
    uint doubtful = 0;
    for (uint i = 0; i < 27; ++i) {
        bool inside = state == INSIDE;
        if (state == UNKNOWN) {
            const double3 p = vertex_point(identifiers[gid], level, extent, i);
            const double number =
                apart ? NAN : number_beside(&scene, nearest_of[i], p.x, p.y, p.z);
            inside = number > 0.5;
            doubtful |= (fabs(number - 0.5) > leeway ? 0u : 1u) << i;
        }
        own[i] = with_sign(own[i], inside);
    }
    states[gid] = state;
#ifdef WINDING
    doubts[gid] = doubtful;
    asked[gid] = apart && doubtful ? 1u << MIDDLE : doubtful;
#endif
}
#endif

#ifdef WINDING
// counts[b] = number of vertices of block b whose winding number is requested.
__kernel void count_asked(const uint n, __global const uint *asked, __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        counts[gid] = popcount(asked[gid]);
}

// The points of the requested vertices.
__kernel void list_asked(const uint n, CELLS, __global const uint *asked,
                         __global const uint *begins, __global double *points)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint at = begins[gid];
    for (uint i = 0; i < 27; ++i)
        if (asked[gid] >> i & 1)
            vstore3(vertex_point(identifiers[gid], level, extent, i), at++, points);
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
            fabs(number - 0.5) > sway(p.x, p.y, p.z, radius, spheres, sphere_count);
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
