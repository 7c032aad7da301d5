// From triangles to the blocks of a distance field. Host side: voxtool/adf/build.py. Options:
// SIGNED, negative inside; WINDING, inside by the winding number (voxtool/proximity/sides.py), or
// else by pseudo-normals; CLOSED, the mesh is, or else JUMPS, signs may change away from the
// surface; FLAT, some triangles have no side.
//
// Lengths are in the mesh's own frame (voxtool/proximity/bvh.py), in which the cube is [-extent,
// extent]^3. A cell has a list of triangles, among which are the nearest ones to every point of the
// cell.

#include "adf/build.h"
#include "adf/samples.h"
#include "spatial/arctangent.h"
#include "spatial/bvh.h"
#include "spatial/names.h"
#include "morton_bits.h"

#pragma OPENCL FP_CONTRACT OFF

#define LANES double8 // one lane a point
#define MASKS long8
#include "spatial/point_triangle.h"

#define SLACK 0x1p-44 // of a length in the frame: more than rounding takes from it

// The cell of an identifier: a Morton code after a leading one.
uint3 cell_of(ulong identifier, uint level)
{
    const ulong code = identifier ^ 1ul << 3 * level;
    return (uint3)(gather_bits(code), gather_bits(code >> 1), gather_bits(code >> 2));
}

uint3 octant(uint child)
{
    return (uint3)(child & 1, child >> 1 & 1, child >> 2);
}

// A coordinate of the lattice of 2^level edges a side.
double8 lattice(double8 vertex, uint level, double extent)
{
    return extent * (vertex * (2.0 / (1ul << level)) - 1.0);
}

// Eight points of a lattice: POINTS from i on of a table of offsets from a vertex.
ways lattice_points(uint3 vertex, __constant const double *offsets, uint i, uint level, double extent)
{
    ways at;
    at.x = lattice(vertex.x + vload8(i, offsets), level, extent);
    at.y = lattice(vertex.y + vload8(i, offsets + POINTS), level, extent);
    at.z = lattice(vertex.z + vload8(i, offsets + 2 * POINTS), level, extent);
    return at;
}

double highest(double8 a)
{
    const double4 b = a.lo > a.hi ? a.lo : a.hi;
    const double2 c = b.lo > b.hi ? b.lo : b.hi;
    return c.x > c.y ? c.x : c.y;
}

double lowest(double8 a)
{
    return -highest(-a);
}

double8 absolute(double8 a)
{
    return a < 0.0 ? -a : a;
}

// Groups of parameters. LISTS: the cells of a level and their lists of triangles; SIDES: what tells
// the sides of triangles, where signs are computed; BOUNDARY: spheres about the mesh's boundary, and
// the length of boundary in each.
#define LISTS                                                                                          \
    __global const ulong *identifiers, const uint level, const double extent,                          \
        __global const uint *begins, __global const double *leaves, __global const uint *items
#ifdef SIGNED
#ifdef WINDING
#define FRONT , __global const double *front
#define FRONT_VALUE , front
#define BOUNDARY , __global const double *spheres, const uint sphere_count
#define in_front(scene, face) scene->front[face]
#else
#define FRONT
#define FRONT_VALUE
#define BOUNDARY
#define in_front(scene, face) 0.0
#endif
#define SIDES                                                                                          \
    , __global const uint *names, __global const uint *features, __global const double *normals FRONT
#define SCENE_VALUES leaves, items, names, features, normals FRONT_VALUE
#define has_side(scene, item) (scene->names[item] != NAMELESS)
#else
#define SIDES
#define SCENE_VALUES leaves, items
#define has_side(scene, item) true
#endif

typedef struct {
    __global const double *leaves;
    __global const uint *items;
#ifdef SIGNED
    __global const uint *names;
    __global const uint *features;
    __global const double *normals;
#ifdef WINDING
    __global const double *front;
#endif
#endif
} scene_of_lists;

// The triangle at a place of the lists.
triangle triangle_at(const scene_of_lists *scene, uint place)
{
    const uint item = scene->items[place];
    return one_triangle(scene->leaves + (size_t)(item / LEAF) * (FIELDS * LEAF), item % LEAF);
}

// Of eight points: the squared distance to the nearest triangle, and where in the lists it stands;
// of those that have a side, if some are FLAT.
typedef struct {
    double8 square, sided;
    long8 which;
} nearest;

nearest nothing_found(void)
{
    const nearest found = {INFINITY, INFINITY, NO_TRIANGLE};
    return found;
}

// Take the triangle at a place of the lists into account, whose squared distances these are.
void look_at(const scene_of_lists *scene, uint place, double8 square, nearest *found)
{
#ifdef FLAT
    found->square = square < found->square ? square : found->square;
    const long8 nearer = square < (has_side(scene, scene->items[place]) ? found->sided : 0.0);
    found->sided = nearer ? square : found->sided;
#else
    const long8 nearer = square < found->square;
    found->square = nearer ? square : found->square;
#endif
    found->which = nearer ? (long8)place : found->which;
}

uint gathered(long8 bits)
{
    const long4 halves = bits.lo | bits.hi;
    const long2 quarters = halves.lo | halves.hi;
    return (uint)(quarters.x | quarters.y);
}

double8 squares_to(const triangle *t, const ways *points)
{
    ways way;
    MASKS feature;
    return triangle_ways(t, points->x, points->y, points->z, &way, &feature);
}

#ifdef SIGNED
// The winding number on the side of a face on which a point is, at the middle of the face; NAN
// where it is not known. The face is that of the triangle at a place of the lists.
double number_beside(const scene_of_lists *scene, long place, double x, double y, double z)
{
    if (place == NO_TRIANGLE)
        return NAN;
    const uint name = scene->names[scene->items[place]];
    const triangle t = triangle_at(scene, (uint)place);
    ways way;
    MASKS feature;
    triangle_ways(&t, x, y, z, &way, &feature);
    const double3 n = normal_of(name, (uint)feature.s0, scene->features, scene->normals);
    const bool behind = way.x.s0 * n.x + way.y.s0 * n.y + way.z.s0 * n.z < 0;
    return in_front(scene, name / 3) + (behind ? 1.0 : 0.0);
}

#ifdef WINDING
// How far the winding number may change on the way from a point to the middle of a face `reach`
// away at most; see voxtool/proximity/sides.py.
double sway(double x, double y, double z, double reach, __global const double *spheres, uint count)
{
    double sum = 0x1p-6; // two winding numbers are wrong by less
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
#endif

// ---- the blocks of the cells that are refined

// The squared distances at the corners of the eight children to up to eight triangles: `corners`
// has a lane a child; `least` is the smallest so far at each corner.
typedef struct {
    double8 corners[8][8], least[8];
    uint count;
} rival_distances;

// Of each child's middle the nearest triangle of a list.
nearest nearest_to_middles(const scene_of_lists *scene, uint begin, uint end, const ways *middles)
{
    nearest found = nothing_found();
    for (uint j = begin; j < end; ++j) {
        const triangle t = triangle_at(scene, j);
        look_at(scene, j, squares_to(&t, middles), &found);
    }
    return found;
}

// Take the triangles nearest to the middles into account at the vertices of a block, each once.
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

// Which children need a triangle (all bits of a lane), and in which of these it may be the nearest
// at a corner: by its tangents from the middles.
long8 children_that_need(const triangle *t, const ways *middles, double edge,
                         const rival_distances *rivals, long8 *nearer)
{
    ways way;
    MASKS feature;
    const double8 dd = triangle_ways(t, middles->x, middles->y, middles->z, &way, &feature);
    const double8 x = 0.25 * edge * way.x, y = 0.25 * edge * way.y, z = 0.25 * edge * way.z;
    const double8 base = dd - SLACK * (edge + sqrt(dd));
    double8 least[8]; // tangents, times the distance of the middle, squared; 0 where negative
    long8 near = 0;
    for (uint i = 0; i < 8; ++i) {
        const double8 tangent = base + (i & 1 ? x : -x) + (i & 2 ? y : -y) + (i & 4 ? z : -z);
        least[i] = tangent > 0.0 ? tangent * tangent : 0.0;
        near |= least[i] <= rivals->least[i] * dd;
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

// values[27 b + i] = the distance at vertex i of block b, of the cell identifiers[b]; places[27 b + i]
// = where in the lists the nearest triangle with a side stands. masks[j] says for item j of its list
// which of the cell's children need it: bit k is child k. counts[8 b + k] = how many child k needs.
//
// The distance to a triangle is convex, and so is nowhere below its tangent. Inside a cell it is
// nowhere above the trilinear interpolation of its values at the corners. So a triangle is nowhere
// nearest in a child where its tangent from the child's middle is, at all corners, above the
// distance to some other one: here, to the nearest of the middle of any child.
__kernel void sample_blocks(const uint n, LISTS SIDES, __global double *values,
                            __global uint *places, __global uchar *masks, __global uint *counts)
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
    long8 needed = 0;
    for (uint j = begin; j < end; ++j) {
        const triangle t = triangle_at(&scene, j);
        long8 nearer;
        const long8 needs = children_that_need(&t, &middles, edge, &rivals, &nearer);
        needed -= needs;
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
    vstore8(needed, 0, counted);
    for (uint child = 0; child < 8; ++child) {
        counts[8 * (size_t)gid + child] = (uint)counted[child];
        // a vertex is a corner of one child, or has the same in each
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

// The length of the longest edge of the triangles of a list.
double longest_edge(const scene_of_lists *scene, uint begin, uint end)
{
    double longest = 0;
    for (uint j = begin; j < end; ++j) {
        const double ee = triangle_at(scene, j).ee.s0;
        longest = ee > longest ? ee : longest;
    }
    return sqrt(longest);
}

// Gives distances their signs. states[b] says on which side of the mesh the whole block is, if it is
// known: where its parent's is known, and where no triangles pass. Bit i of doubts[b] says that the
// sign of vertex i is not known, and that of asked[b] that its winding number is to be computed: at
// first, where no triangles pass, the middle's.
__kernel void sign_blocks(const uint n, LISTS SIDES BOUNDARY, __global const uint *sources,
                          __global const uchar *above, __global const uint *places,
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
    uchar state = above[sources[gid] / 8];
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
// counts[b] = of how many vertices of block b the number is asked.
__kernel void count_asked(const uint n, __global const uint *asked, __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        counts[gid] = popcount(asked[gid]);
}

// Their points.
__kernel void list_asked(const uint n, __global const ulong *identifiers, const uint level,
                         const double extent, __global const uint *asked,
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

// Their signs, from the numbers there. The number of the middle of a block that no triangle passes
// tells the side of all of it, if it can change no more than that; or else all vertices are asked.
__kernel void settle_signs(const uint n, __global const ulong *identifiers, const uint level,
                           const double extent, __global const double *spheres,
                           const uint sphere_count, __global const uint *begins,
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

// ---- continuity

// neighbours[27 b + i] = which of the blocks of this level is that of the cell beside cell b, or
// COARSE where that cell is a leaf or within one, OUT_OF_CUBE where it is out of the cube. Cell b is
// child sources[b] of the level above, whose refined children are numbered by `ranks`.
__kernel void find_neighbours(const uint n, __global const uint *sources, __global const uint *ranks,
                              __global const uint *above, __global uint *neighbours,
                              __global uint *unbalanced)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint parent = sources[gid] / 8;
    const int3 own = convert_int3(octant(sources[gid] % 8));
    for (int i = 0; i < 27; ++i) {
        const int3 at = own + (int3)(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1);
        const int3 up = at >> 1, bits = at & 1;
        const uint of = above[27 * (size_t)parent + (up.x + 1) + 3 * (up.y + 1) + 9 * (up.z + 1)];
        uint found = of;
        if (of < COARSE) {
            const size_t child = 8 * (size_t)of + bits.x + 2 * bits.y + 4 * bits.z;
            found = ranks[child] < ranks[child + 1] ? ranks[child] : COARSE;
        } else if (of == COARSE) {
            *unbalanced = 1;
        }
        neighbours[27 * (size_t)gid + i] = found;
    }
}

// Vertices of a block that lie on a coarser leaf get what is interpolated there, which is the mean
// of the ends of the edge, or the corners of the face, that they are the middle of: these are on
// the same leaf, and have been constrained before. Corners are those of the parent's block.
__kernel void constrain_blocks(const uint n, __global const uint *sources,
                               __global const uint *neighbours, __global const double *above,
                               __global double *values)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    __global double *own = values + 27 * (size_t)gid;
    __global const double *parent = above + 27 * (size_t)(sources[gid] / 8);
    const uint3 low = octant(sources[gid] % 8);
    for (uint corner = 0; corner < 8; ++corner) {
        const uint3 o = octant(corner), at = low + o;
        own[2 * o.x + 6 * o.y + 18 * o.z] = parent[at.x + 3 * at.y + 9 * at.z];
    }
    for (int i = 0; i < 27; ++i) {
        const int3 side = (int3)(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1);
        const int middles = (side.x == 0) + (side.y == 0) + (side.z == 0);
        if (middles == 0 || middles == 3)
            continue;
        bool hangs = false; // one of the cells that share the edge or face
        for (int j = 1; j < 8; ++j) {
            const int3 beside = side * (int3)(j & 1, j >> 1 & 1, j >> 2);
            const int cell = 13 + beside.x + 3 * beside.y + 9 * beside.z;
            hangs |= cell != 13 && neighbours[27 * (size_t)gid + cell] == COARSE;
        }
        if (!hangs)
            continue;
        double sum = 0;
        for (int j = 0; j < 1 << middles; ++j) {
            int3 at = side;
            int bit = j;
            if (side.x == 0)
                at.x = 2 * (bit & 1) - 1, bit >>= 1;
            if (side.y == 0)
                at.y = 2 * (bit & 1) - 1, bit >>= 1;
            if (side.z == 0)
                at.z = 2 * (bit & 1) - 1;
            sum += own[13 + at.x + 3 * at.y + 9 * at.z];
        }
        own[i] = sum / (1 << middles);
    }
}

// voxels = values, in sides of the cube.
__kernel void store_voxels(const uint n, __global const double *values, const double extent,
                           __global float *voxels)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        voxels[gid] = (float)(values[gid] / (2 * extent));
}

// ---- the children: leaves, or not

// The code of a bound in sides: the least whose value is not below it.
uchar code_of(double bound, __global const double *bounds)
{
    uint low = 1, high = JUMP; // which is that of a bound over 1, too
    while (low < high) {
        const uint middle = (low + high) / 2;
        if (bounds[middle] >= bound)
            high = middle;
        else
            low = middle + 1;
    }
    return (uchar)low;
}

// Whether distances at the corners of a cell differ by more than they can where the sign does not
// jump; those that hang on a leaf where it does, by more than interpolation of others can. Where
// triangles do not pass, no sign changes.
bool jumps(const double *corners, double edge, bool passed)
{
    for (uint i = 0; i < 8; ++i)
        for (uint j = i + 1; j < 8; ++j) {
            const double apart = corners[i] - corners[j], far = edge * edge * popcount(i ^ j);
            const bool alike = (corners[i] < 0) == (corners[j] < 0);
            if (!alike && !passed)
                return true;
            if (apart * apart > (alike ? 3 : 1) * far * (1 + 0x1p-20))
                return true;
        }
    return false;
}

// The triangles that a child of a block needs: those of the block's list that have its bit.
typedef struct {
    scene_of_lists scene;
    __global const uchar *masks;
    uint begin, end, child;
} child_list;

// The place of the first one from a place on; `end` if there is none.
uint from(const child_list *list, uint place)
{
    while (place < list->end && !(list->masks[place] >> list->child & 1))
        ++place;
    return place;
}

// How far the interpolation of distances of a certain size at the corners of a cell is from the
// distance to the mesh, at most, whatever its sign: above it and below it; and the distances at the
// corners to the triangle that bounds it best from above.
//
// The distance is the least of convex d_t. So it is nowhere above the interpolation of any d_t, or
// of the mean of two. And interpolation is a mean over corners v: with q nearest to p, n the way
// from q, and u, w the parts of v - p along and across n, d_t(v) <= |v - q| <= d_t(p) + u + w^2 /
// (2 (d_t(p) + u)), where the mean of u is 0 and that of w^2 is at most edge^2 / 2; edge^2 / 4
// beside an edge, along which q may slide, and 0 on one side of a face. The mean of |v - q| is no
// more than the root of that of its square, either.
typedef struct {
    double above, below;
    double8 best;
} bounds_apart;

// Take a triangle into account, by what it is at the corners.
void bound_by(bounds_apart *bounds, double8 d, const ways *way, MASKS feature, double8 size,
              double edge)
{
    const double excess = highest(d - size);
    bounds->best = excess < bounds->above ? d : bounds->best;
    bounds->above = excess < bounds->above ? excess : bounds->above;
    const bool one = all(feature == (MASKS)feature.s0), edge_alone = one && feature.s0 < A;
    double bend = 0;
    const bool aside = all(way->x * way->x.s0 + way->y * way->y.s0 + way->z * way->z.s0 > 0);
    if (!(one && feature.s0 == FACE && aside)) {
        const double squares = edge * edge, low = lowest(d) - edge * HALF_DIAGONAL;
        const double near = low > 0 ? low : 0, across = edge_alone ? 0.25 : 0.5;
        bend = sqrt(near * near + (across + 0.25) * squares) - near;
        const double ahead = low - 2 * edge * HALF_DIAGONAL; // d_t(p) + u is no less
        const double curved = across * squares / (2 * ahead);
        bend = ahead > 0 && curved < bend ? curved : bend;
    }
    const double shortfall = highest(size - d) + bend;
    bounds->below = shortfall > bounds->below ? shortfall : bounds->below;
}

double bound_apart(const child_list *list, const ways *at, double8 size, double edge)
{
    bounds_apart bounds = {INFINITY, 0, 0};
    double8 distances[KEPT];
    uint count = 0;
    for (uint j = from(list, list->begin); j < list->end; j = from(list, j + 1)) {
        const triangle t = triangle_at(&list->scene, j);
        ways way;
        MASKS feature;
        const double8 d = sqrt(triangle_ways(&t, at->x, at->y, at->z, &way, &feature));
        bound_by(&bounds, d, &way, feature, size, edge);
        if (count < KEPT)
            distances[count++] = d;
    }
    for (uint i = 0; i < count; ++i) {
        const double excess = highest(0.5 * (bounds.best + distances[i]) - size);
        bounds.above = excess < bounds.above ? excess : bounds.above;
    }
    return bounds.above > bounds.below ? bounds.above : bounds.below;
}

#ifdef CLOSED
// The same where triangles pass, with the signs of a closed mesh, and distances of `farthest` at
// most. If all normals are within an angle of the first, so is the way to the nearest point, and
// every distance is that to the plane of a triangle, divided by a cosine of at least that of twice
// the angle.
double bound_passed(const child_list *list, const ways *at, double8 field, double farthest)
{
    double3 axis = 0;
    double cosine = 1, apart = 0;
    const scene_of_lists *scene = &list->scene;
    for (uint j = from(list, list->begin); j < list->end && cosine > 0.75; j = from(list, j + 1)) {
        const triangle t = triangle_at(scene, j);
        const uint name = scene->names[scene->items[j]];
        double3 normal = normal_of(name, FACE, scene->features, scene->normals);
        const double square = normal.x * normal.x + normal.y * normal.y + normal.z * normal.z;
        if (square == 0)
            return INFINITY;
        normal /= sqrt(square);
        if (axis.x == 0 && axis.y == 0 && axis.z == 0)
            axis = normal;
        const double c = axis.x * normal.x + axis.y * normal.y + axis.z * normal.z;
        cosine = c < cosine ? c : cosine;
        const double8 plane =
            (at->x - t.ax) * normal.x + (at->y - t.ay) * normal.y + (at->z - t.az) * normal.z;
        const double misses = highest(absolute(plane - field));
        apart = misses > apart ? misses : apart;
    }
    return cosine > 0.75 ? apart + 2 * (1 - cosine * cosine) * farthest : INFINITY;
}
#endif

// How far the interpolation is from the distance at eight of a cell's samples, at most, by the
// triangles of a child's list; and how far the first of them is from these. In doubt, or if that is
// so far that the whole cell is on one side, the sign is that of the interpolation.
double sample_error(const child_list *list, const ways *points, uint k, const double *corners,
                    bool in_doubt, double radius, double *first)
{
    const scene_of_lists *scene = &list->scene;
    nearest found = nothing_found();
    for (uint j = from(list, list->begin); j < list->end; j = from(list, j + 1)) {
        const triangle t = triangle_at(scene, j);
        look_at(scene, j, squares_to(&t, points), &found);
    }
    const double8 distance = sqrt(found.square);
    *first = distance.s0;
    double8 interpolated = 0;
    for (uint i = 0; i < 8; ++i)
        interpolated += corners[i] * vload8(k, WEIGHTS + i * POINTS);
    double8 outward = interpolated;
#ifdef SIGNED
    if (!in_doubt && (k > 0 || *first <= radius)) {
        double x[8], y[8], z[8], numbers[8];
        long which[8];
        vstore8(points->x, 0, x);
        vstore8(points->y, 0, y);
        vstore8(points->z, 0, z);
        vstore8(found.which, 0, which);
        for (uint i = 0; i < 8; ++i)
            numbers[i] = number_beside(scene, which[i], x[i], y[i], z[i]);
        const double8 number = vload8(0, numbers);
        outward = number == number ? 0.5 - number : interpolated;
    }
#endif
    return highest(absolute(interpolated - (outward < 0.0 ? -distance : distance)));
}

// What decides whether a child is refined, in the frame: tolerance, how far points are misplaced by
// rounding, and how far from the surface cells are refined; whether children can be refined, must be
// where triangles pass, and whether all samples are taken.
#define LIMITS                                                                                         \
    const double tolerance, const double misplaced, const double band, const uint can_refine,          \
        const uint refine_coarse, const uint thorough

// A child of a block, and what is known of it. corners: its distances; radius: half of its diagonal;
// middle: the distance of its middle; passed: triangles may pass through it; in_doubt: the sign of a
// corner is not known. error: at most or at the samples so far; bound: of the error.
typedef struct {
    uint3 cell;
    double corners[8], edge, slope, radius, middle, error, bound;
    bool in_doubt, passed;
} child_cell;

// The steepest that the interpolation in a cell is.
double slope_of(double8 field, double edge)
{
    const double dx = highest(absolute(field.s11335577 - field.s00224466));
    const double dy = highest(absolute(field.s23672367 - field.s01450145));
    const double dz = highest(absolute(field.s45674567 - field.s01230123));
    return sqrt(dx * dx + dy * dy + dz * dz) / edge;
}

// The error at the first eight samples, which suffice to refine most children that are.
void sample_middle(const child_list *list, child_cell *c, uint level, double extent)
{
    const ways central = lattice_points(4 * c->cell, SAMPLES, 0, level + 3, extent);
    c->error = sample_error(list, &central, 0, c->corners, c->in_doubt, c->radius, &c->middle);
    c->passed = c->middle <= c->radius;
}

// The bound without samples; then, if this is over the tolerance, the errors at the other samples,
// until the child is `refined` unless this is thorough; and the bound between samples.
bool sample_all(const child_list *list, child_cell *c, uint level, double extent, bool refined,
                bool can_refine, double tolerance, double misplaced,
                uint refine_coarse, uint thorough)
{
    const double8 field = vload8(0, c->corners), size = absolute(field);
    const ways at = lattice_points(c->cell, CELL, 0, level + 1, extent);
#ifdef SIGNED
    if (!c->passed)
#endif
        c->bound = bound_apart(list, &at, size, c->edge);
#ifdef CLOSED
    if (c->passed)
        c->bound = bound_passed(list, &at, field, c->middle + 2 * c->radius);
#endif
    const double rounding = highest(size) * 0x1p-21 + SLACK + misplaced;
    c->bound += rounding;
    if (c->bound <= tolerance) {
        c->error = c->bound;
        return refined;
    }
    for (uint k = 1; k < POINTS / 8 && (thorough || !refined); ++k) {
        const ways points = lattice_points(4 * c->cell, SAMPLES, k, level + 3, extent);
        double elsewhere;
        const double miss = sample_error(list, &points, k, c->corners, c->in_doubt || !c->passed,
                                         c->radius, &elsewhere);
        c->error = miss > c->error ? miss : c->error;
        refined = can_refine && c->error > tolerance;
    }
    const double unsure = c->in_doubt && c->passed ? 2 * (c->middle + c->radius) : 0;
    const double between = c->error + unsure + rounding + (1 + c->slope) * (SAMPLE_GAP * c->edge);
    c->bound = between < c->bound ? between : c->bound;
    return refined || (can_refine && c->passed && refine_coarse);
}

// For each child c of block c / 8: flags[c] = 1 if it is to be refined. errors[c] = how far its
// interpolation is from the distance, in sides: at most, if that is within the tolerance, and else
// at its samples, the first ones of which that are over it suffice to refine, unless this is to be
// `thorough`; 0 beyond the band, and -1 where the sign jumps. codes[c] = the code of its bound.
__kernel void examine_children(const uint n, LISTS SIDES, LIMITS,
#ifdef WINDING
                               __global const uint *doubts,
#endif
                               __global const float *voxels, __global const double *bounds,
                               __global const uchar *masks, __global uint *flags,
                               __global float *errors, __global uchar *codes,
                               __global uint *steepest)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    child_list list = {{SCENE_VALUES}, masks, begins[gid], begins[gid + 1], 0};
    const uint3 parent = cell_of(identifiers[gid], level);
    const double side = 2 * extent;
    child_cell c;
    c.edge = side / (2ul << level);
    c.radius = c.edge * HALF_DIAGONAL + SLACK;
    float slope_of_leaves = 0;
    for (uint child = 0; child < 8; ++child) {
        const size_t place = 8 * (size_t)gid + child;
        list.child = child;
        c.cell = 2 * parent + octant(child);
        c.in_doubt = false;
        for (uint i = 0; i < 8; ++i) {
            c.corners[i] = voxels[27 * (size_t)gid + CORNERS[8 * child + i]] * side;
#ifdef WINDING
            c.in_doubt |= doubts[gid] >> CORNERS[8 * child + i] & 1;
#endif
        }
        c.slope = slope_of(vload8(0, c.corners), c.edge);
        c.bound = INFINITY;
        sample_middle(&list, &c, level, extent);
        const bool beyond = c.middle - c.radius > band, may_refine = can_refine && !beyond;
        bool jumped = false;
#ifdef JUMPS
        jumped = jumps(c.corners, c.edge, c.passed);
#endif
        bool refined = may_refine && (jumped ? refine_coarse : c.error > tolerance);
        if (!jumped && (!refined || thorough))
            refined = sample_all(&list, &c, level, extent, refined, may_refine, tolerance, misplaced,
                                 refine_coarse, thorough);
        flags[place] = refined;
        errors[place] = jumped ? -1 : beyond ? 0 : (float)(c.error / side);
        codes[place] = jumped ? JUMP : code_of(c.bound / side, bounds);
        if (!refined && !jumped && c.slope > slope_of_leaves)
            slope_of_leaves = (float)c.slope;
    }
    if (as_uint(slope_of_leaves) > *steepest)
        atomic_max(steepest, as_uint(slope_of_leaves));
}

// ---- down to the next level

// Of the refined children, which `ranks` numbers: their identifiers, where they come from, and how
// many triangles they need.
__kernel void list_refined(const uint n, __global const uint *ranks, __global const ulong *above,
                           __global const uint *needed, __global ulong *identifiers,
                           __global uint *sources, __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid >= n || ranks[gid] == ranks[gid + 1])
        return;
    const uint rank = ranks[gid];
    identifiers[rank] = above[gid / 8] << 3 | gid % 8;
    sources[rank] = gid;
    counts[rank] = needed[gid];
}

// The triangles that refined cells need, from the lists of their parents.
__kernel void pass_lists_on(const uint n, __global const uint *sources, __global const uint *above,
                        __global const uint *parent_items, __global const uchar *masks,
                        __global const uint *begins, __global uint *items)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint parent = sources[gid] / 8, child = sources[gid] % 8;
    uint at = begins[gid];
    for (uint j = above[parent]; j < above[parent + 1]; ++j)
        if (masks[j] >> child & 1)
            items[at++] = parent_items[j];
}
