// Computes exact signed distances at the vertices of a level's blocks. Host side:
// voxtool/adf/levels.py.

#include "adf/levels/lists.h"

// ---- distances

// The distances from the corners of the eight children, one per lane, to up to eight triangles, the
// rivals of the others. `own` is the distance to the rival nearest to a child's centre, `lowest` the
// smallest.
typedef struct {
    double8 corners[8][8], own[8], lowest[8];
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

#define SIDES_X (double8)(-1, 1, -1, 1, -1, 1, -1, 1)
#define SIDES_Y (double8)(-1, -1, 1, 1, -1, -1, 1, 1)
#define SIDES_Z (double8)(-1, -1, -1, -1, 1, 1, 1, 1)

// Updates the vertices of a block with the triangles nearest to the centres, each triangle once.
void look_at_rivals(const scene_of_lists *scene, long8 which, const ways *points, nearest *found,
                    rival_distances *rivals)
{
    long places[8];
    vstore8(which, 0, places);
    rivals->count = 0;
    for (uint i = 0; i < 8; ++i) {
        found[i] = nothing_found();
        rivals->lowest[i] = INFINITY;
    }
    uint rival_of[8];
    for (uint k = 0; k < 8; ++k) {
        bool known = places[k] == NO_TRIANGLE;
        rival_of[k] = rivals->count;
        for (uint other = 0; other < k; ++other)
            if (places[other] == places[k]) {
                known = true;
                rival_of[k] = rival_of[other];
            }
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
            const double8 other = rivals->corners[rivals->count][i] = sqrt(vload8(0, children));
            rivals->lowest[i] = other < rivals->lowest[i] ? other : rivals->lowest[i];
        }
        ++rivals->count;
    }
    for (uint i = 0; i < 8; ++i) {
        double own[8];
        for (uint k = 0; k < 8; ++k)
            own[k] = rivals->count == 0 ? INFINITY : ((double *)&rivals->corners[rival_of[k]][i])[k];
        rivals->own[i] = vload8(0, own);
    }
}

// The tangents of a triangle's distance at the centres of the children, one per lane: the values
// there, lowered by more than the rounding error, and the changes along half an edge.
typedef struct {
    double8 base, x, y, z;
} tangents;

// The children that need a triangle: all bits of a lane are set.
long8 children_that_need(const tangents *at, const rival_distances *rivals)
{
    double8 corners[8];
    long8 needs = 0, open = 0;
    for (uint i = 0; i < 8; ++i) {
        corners[i] = at->base + (i & 1 ? at->x : -at->x) + (i & 2 ? at->y : -at->y) +
                     (i & 4 ? at->z : -at->z);
        needs |= corners[i] <= rivals->lowest[i];
        open |= corners[i] <= rivals->own[i];
    }
    open &= ~needs; // excluded by no rival yet, but nowhere below all of them
    for (uint other = 0; other < rivals->count && any(open); ++other) {
        long8 some = 0;
        for (uint i = 0; i < 8; ++i)
            some |= corners[i] <= rivals->corners[other][i];
        open &= some;
    }
    return needs | open;
}

tangents tangents_at(const triangle *t, const ways *middles, double edge)
{
    ways way;
    MASKS feature;
    const double8 dd = triangle_ways(t, middles->x, middles->y, middles->z, &way, &feature);
    const double8 d = sqrt(dd), slope = dd > 0.0 ? 0.25 * edge / d : 0.0;
    const tangents at = {d - SLACK * (edge + d), slope * way.x, slope * way.y, slope * way.z};
    return at;
}

// Updates the nearest triangles at the corners of the `needing` children, one per bit, with the
// triangle at an index of the lists, where its tangents do not exceed the distance so far.
void look_at_corners(const scene_of_lists *scene, uint place, const triangle *t, uint needing,
                     const tangents *at, const ways *corners, nearest *found)
{
    double base[8], x[8], y[8], z[8];
    vstore8(at->base, 0, base);
    vstore8(at->x, 0, x);
    vstore8(at->y, 0, y);
    vstore8(at->z, 0, z);
    for (uint left = needing; left > 0; left &= left - 1) {
        const uint child = 31 - clz(left & -left);
        const double8 tangent = base[child] + x[child] * SIDES_X + y[child] * SIDES_Y +
                                z[child] * SIDES_Z;
#ifdef FLAT
        const double8 least = found[child].sided;
#else
        const double8 least = found[child].square;
#endif
        if (any(tangent <= 0.0 || tangent * tangent <= least))
            look_at(scene, place, squares_to(t, &corners[child]), &found[child]);
    }
}

// values[27 b + i] = distance at vertex i of block b, of cell identifiers[b]; places[27 b + i] =
// index in the lists of the nearest triangle with a side; centres[8 b + k] = distance at the centre
// of child k. Bit k of masks[j] is set if child k needs item j of the list. needed[8 b + k] = number
// of triangles that child k needs.
//
// The distance to a triangle is convex, so its tangent bounds it from below. Inside a cell, the
// trilinear interpolation of its corner values bounds it from above. So a triangle is nowhere
// nearest in a child if its tangent at the child's centre exceeds, at all corners, the distance to
// some other triangle. The candidates for that are the triangles nearest to the centres of the
// children.
__kernel void sample_blocks(const uint n, LISTS SIDES, __global double *values,
                            __global double *centres, __global uint *places,
                            __global uchar *masks, __global uint *needed)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const scene_of_lists scene = {SCENE_VALUES};
    const uint begin = begins[gid], end = begins[gid + 1];
    const uint3 cell = cell_of(identifiers[gid], level);
    const double edge = extent / (1ul << level) * 2;
    const ways middles = lattice_points(4 * cell, MIDDLES, 0, level + 2, extent);
    ways points[POINTS / 8], corners[8]; // vertices, and those of each child
    for (uint child = 0; child < 8; ++child)
        corners[child] = lattice_points(2 * cell + octant(child), CELL, 0, level + 1, extent);
    for (uint k = 0; k < POINTS / 8; ++k)
        points[k] = lattice_points(2 * cell, VERTICES, k, level + 1, extent);
    nearest found[8]; // at the corners of each child
    rival_distances rivals;
    const nearest central = nearest_to_middles(&scene, begin, end, &middles);
    vstore8(sqrt(central.square), gid, centres);
    look_at_rivals(&scene, central.which, points, found, &rivals);

    const long8 bits = (long8)(1, 2, 4, 8, 16, 32, 64, 128);
    long8 total = 0;
    for (uint j = begin; j < end; ++j) {
        const triangle t = triangle_at(&scene, j);
        const tangents at = tangents_at(&t, &middles, edge);
        const long8 needs = children_that_need(&at, &rivals);
        total -= needs;
        masks[j] = (uchar)gathered(needs & bits);
        look_at_corners(&scene, j, &t, masks[j], &at, corners, found);
    }
    long counted[8];
    vstore8(total, 0, counted);
    for (uint child = 0; child < 8; ++child) {
        needed[8 * (size_t)gid + child] = (uint)counted[child];
        // a shared vertex has the same value in each child
        double distances[8];
        long own[8];
        vstore8(sqrt(found[child].square), 0, distances);
        vstore8(found[child].which, 0, own);
        for (uint i = 0; i < 8; ++i) {
            const size_t vertex = 27 * (size_t)gid + CORNERS[8 * child + i];
            values[vertex] = distances[i];
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
