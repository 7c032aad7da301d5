// Cells and their triangle lists, shared by the stages of a level. Options: SIGNED: distances are
// negative inside. WINDING: the winding number decides the sign (voxtool/spatial/sides.py);
// otherwise pseudo-normals do. CLOSED: the mesh is closed; otherwise JUMPS: the sign may change
// away from the surface. FLAT: some triangles have zero area.
//
// Lengths are in the mesh's frame (voxtool/spatial/bvh.py), in which the cube is [-extent,
// extent]^3. The list of a cell includes the nearest triangle of each of its points, and the nearest one
// with a side.

#include "adf/construction/level.h"
#include "adf/construction/sample_points.h"
#include "spatial/arctangent.h"
#include "spatial/bvh.h"
#include "spatial/names.h"
#include "morton_bits.h"

#define LANES double8 // one point per lane
#define MASKS long8
#include "spatial/point_triangle.h"

#define SLACK 0x1p-44 // relative to a length in the frame; exceeds the rounding error

// The cell of an identifier: a Morton code preceded by a 1 bit.
uint3 cell_of(ulong identifier, uint level)
{
    const ulong code = identifier ^ 1ul << 3 * level;
    return (uint3)(gather_bits(code), gather_bits(code >> 1), gather_bits(code >> 2));
}

uint3 octant(uint child)
{
    return (uint3)(child & 1, child >> 1 & 1, child >> 2);
}

// A coordinate of the lattice with 2^level edges per axis.
double8 lattice(double8 vertex, uint level, double extent)
{
    return extent * (vertex * (2.0 / (1ul << level)) - 1.0);
}

// Eight lattice points: POINTS starting at entry i of a table of offsets from a vertex.
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

// Parameter groups. CELLS: the cells of a level. LISTS: these and their triangle lists. SIDES: the
// data for signs. BOUNDARY: bounding spheres of the mesh's boundary, and the boundary length in each.
#define CELLS __global const ulong *identifiers, const uint level, const double extent
#define LISTS                                                                                          \
    CELLS, __global const uint *begins, __global const double *leaves,                                 \
        __global const float *narrow, __global const uint *items
#ifdef SIGNED
#ifdef WINDING
#define FRONT , __global const double *front, __global uint *wanted
#define FRONT_VALUE , front, wanted
#define BOUNDARY , __global const double *spheres, const uint sphere_count
#else
#define FRONT
#define FRONT_VALUE
#define BOUNDARY
#define in_front(scene, face) 0.0
#endif
#define SIDES                                                                                          \
    , __global const uint *names, __global const uint *features, __global const double *normals FRONT
#define SCENE_VALUES leaves, narrow, items, names, features, normals FRONT_VALUE
#define has_side(scene, item) (scene->names[item] != NAMELESS)
#else
#define SIDES
#define SCENE_VALUES leaves, narrow, items
#define has_side(scene, item) true
#endif

typedef struct {
    __global const double *leaves;
    __global const float *narrow;
    __global const uint *items;
#ifdef SIGNED
    __global const uint *names;
    __global const uint *features;
    __global const double *normals;
#ifdef WINDING
    __global const double *front;
    __global uint *wanted;
#endif
#endif
} scene_of_lists;

// The triangle at an index of the lists.
triangle triangle_at(const scene_of_lists *scene, uint place)
{
    const uint item = scene->items[place];
    return one_triangle(scene->leaves + (size_t)(item / LEAF) * (FIELDS * LEAF), item % LEAF);
}

// For eight points: the squared distance to the nearest triangle and its index in the lists; with
// FLAT, also those of the nearest triangle with a side.
typedef struct {
    double8 square;
    long8 which;
#ifdef FLAT
    double8 square_sided;
    long8 sided;
#endif
} nearest;

#ifdef FLAT
#define SIDED sided
#define PLACES_OF_SIDES sided
#else
#define SIDED which
#define PLACES_OF_SIDES places
#endif

nearest nothing_found(void)
{
#ifdef FLAT
    const nearest found = {INFINITY, NO_TRIANGLE, INFINITY, NO_TRIANGLE};
#else
    const nearest found = {INFINITY, NO_TRIANGLE};
#endif
    return found;
}

// Updates the nearest triangle with the triangle at an index of the lists, at these squared
// distances.
void look_at(const scene_of_lists *scene, uint place, double8 square, nearest *found)
{
    const long8 nearer = square < found->square;
    found->square = nearer ? square : found->square;
    found->which = nearer ? (long8)place : found->which;
#ifdef FLAT
    const long8 better = square < (has_side(scene, scene->items[place]) ? found->square_sided : 0.0);
    found->square_sided = better ? square : found->square_sided;
    found->sided = better ? (long8)place : found->sided;
#endif
}

double8 squares_to(const triangle *t, const ways *points)
{
    ways way;
    MASKS feature;
    return triangle_ways(t, points->x, points->y, points->z, &way, &feature);
}

#ifdef SIGNED
#define LANES_OF(i)                                                                                    \
    (double8)(own[0][(i) * LEAF], own[1][(i) * LEAF], own[2][(i) * LEAF], own[3][(i) * LEAF],          \
              own[4][(i) * LEAF], own[5][(i) * LEAF], own[6][(i) * LEAF], own[7][(i) * LEAF])

// The triangles of eight slots, one per lane.
triangle triangles_of(__global const double *leaves, const uint *slots)
{
    __global const double *own[8];
    for (uint i = 0; i < 8; ++i)
        own[i] = leaves + (size_t)(slots[i] / LEAF) * (FIELDS * LEAF) + slots[i] % LEAF;
    const triangle t = {LANES_OF(0),  LANES_OF(1),  LANES_OF(2),  LANES_OF(3),  LANES_OF(4),
                        LANES_OF(5),  LANES_OF(6),  LANES_OF(7),  LANES_OF(8),  LANES_OF(9),
                        LANES_OF(10), LANES_OF(11), LANES_OF(12), LANES_OF(13), LANES_OF(14)};
    return t;
}

#ifdef WINDING
// The winding number in front of a face, or NAN; one that has not been found yet is wanted.
double in_front(const scene_of_lists *scene, uint face)
{
    const double number = scene->front[face];
    if (number < INFINITY || number != number)
        return number;
    atomic_or(scene->wanted + face / 32, 1u << face % 32);
    return NAN;
}
#endif

// The winding numbers at the middles of eight faces, on the sides of the faces on which eight points
// lie; NAN where they are unknown. The faces are those of the triangles at these indices of the lists.
// way: from the nearest points of the triangles.
NOINLINE double8 numbers_beside(const scene_of_lists *scene, long8 which, const ways *points,
                                ways *way)
{
    long place[8], feature_of[8];
    double front[8], x[8], y[8], z[8];
    uint slots[8];
    vstore8(which, 0, place);
    for (uint i = 0; i < 8; ++i)
        slots[i] = place[i] == NO_TRIANGLE ? 0 : scene->items[place[i]];
    const triangle t = triangles_of(scene->leaves, slots);
    MASKS feature;
    triangle_ways(&t, points->x, points->y, points->z, way, &feature);
    vstore8(feature, 0, feature_of);
    for (uint i = 0; i < 8; ++i) {
        const uint name = scene->names[slots[i]];
        const bool known = place[i] != NO_TRIANGLE;
        const double3 n =
            known ? normal_of(name, (uint)feature_of[i], scene->features, scene->normals) : 0;
        x[i] = n.x, y[i] = n.y, z[i] = n.z;
        front[i] = known ? in_front(scene, name / 3) : NAN;
    }
    const double8 along =
        way->x * vload8(0, x) + way->y * vload8(0, y) + way->z * vload8(0, z);
    return vload8(0, front) + (along < 0.0 ? (double8)1.0 : (double8)0.0);
}
#endif
