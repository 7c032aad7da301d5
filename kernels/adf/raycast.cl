// Ray casting of a distance field. Leaves along a ray are found by the coherent search of [ADF,
// section 3.5]. Host side: voxtool/adf/raycast.py.
//
// In a leaf, the field along a ray is a cubic polynomial; the ray meets the surface at its first
// root [Marmitt 2004]. At the exit of a leaf, the ray advances by a lower bound on the distance to
// the surface [Hart 1996].
//
// Lengths along a ray are float64. Integers that never decrease select the next leaf, so every ray
// terminates. Options: OFFSET, W and WIDE of search.h.

#define LANES 1
#define BATCH 1
#include "adf/raycast.h"
#include "adf/search.h"
#include "shading.h"

#define PARALLEL 0x1p-40 // nearly parallel to a face: the ray gets no nearer to it within the cube
#define HALVINGS 20      // of a ray's segment in a leaf, at most sqrt(3) of its edges long

double least_of(const double3 a)
{
    const double least = a.x < a.y ? a.x : a.y;
    return least < a.z ? least : a.z;
}

// ---- rays

// A ray in units of the cube's edge: origin + t way, with |way| = 1. For each axis, moves is -1 if
// the ray moves along it, and rises is -1 if it moves upward; both are 0 otherwise. inverse is 1 /
// way where it moves.
typedef struct {
    double3 origin, way, inverse;
    long3 moves, rises;
} Ray;

// The ray through a pixel at x to the right of the image centre and y below it.
Ray ray_through(__global const double *camera, const uint perspective, const double x,
                const double y)
{
    const double3 origin = vload3(0, camera), direction = vload3(1, camera);
    const double3 aside = x * vload3(2, camera) + y * vload3(3, camera);
    Ray ray;
    ray.origin = perspective ? origin : origin + aside;
    const double3 way = perspective ? direction + aside : direction;
    ray.way = way / sqrt(way.x * way.x + way.y * way.y + way.z * way.z);
    ray.moves = (ray.way > PARALLEL) | (ray.way < -PARALLEL);
    ray.rises = ray.way > 0;
    ray.inverse = 1 / (ray.moves ? ray.way : (double3)1);
    return ray;
}

// Moves a ray's origin to its entry into the cube, but not back beyond `earliest`. Returns the
// length of the ray from there; 0, negative or NaN if the ray misses the cube.
double enter_cube(Ray *ray, const double earliest)
{
    const double3 to_0 = -ray->origin * ray->inverse, to_1 = (1 - ray->origin) * ray->inverse;
    const long3 within = (ray->origin >= 0) & (ray->origin <= 1);
    if (any(!ray->moves & !within))
        return 0;
    const double3 near = ray->moves ? (ray->rises ? to_0 : to_1) : (double3)-INFINITY;
    const double3 far = ray->moves ? (ray->rises ? to_1 : to_0) : (double3)INFINITY;
    const double nearest = -least_of(-near), begin = nearest > earliest ? nearest : earliest;
    ray->origin += begin * ray->way;
    return least_of(far) - begin;
}

// ---- cells; points in units of 2^-32 cube edges

uint3 fixed(const double3 p)
{
    const double3 below_1 = p < 1 ? p : (double3)(1 - 0x1p-32);
    const double3 units = (p > 0 ? below_1 : (double3)0) * 0x1p32;
    return (uint3)((uint)units.x, (uint)units.y, (uint)units.z); // convert_uint3 is slow in some drivers
}

// The child, x + 2 y + 4 z, of a cell of this level that contains a point.
uint octant_of(const uint3 at, const int level)
{
    const uint3 child = at >> (uint)(POINT_BITS - 1 - level) & 1;
    return child.x + 2 * child.y + 4 * child.z;
}

// The block of the deepest cell with a block that contains a point. The search starts at *level and
// sets it to that cell's level; `refined` marks the children that have blocks.
uint find_block(const Hash *hash, __global const uchar *refined, const uint3 at, const int full,
                int *level)
{
    Wanted wanted = {{at.x}, {at.y}, {at.z}, {*level}};
    uint slot;
    int exists;
    find_cells(hash, &wanted, &slot, &exists);
    while (!exists && wanted.level[0] > full) {
        --wanted.level[0];
        find_cells(hash, &wanted, &slot, &exists);
    }
    uint block = hash->cells[WORDS * (size_t)slot + WORDS - 1];
    while (refined[block] >> octant_of(at, wanted.level[0]) & 1) {
        ++wanted.level[0];
        find_cells(hash, &wanted, &slot, &exists);
        block = hash->cells[WORDS * (size_t)slot + WORDS - 1];
    }
    *level = wanted.level[0];
    return block;
}

// ---- leaf; v: the field at its corners minus the offset, by x, then y, then z

// Linear interpolation, by start + step t, between two polynomials in t (1, t, t^2, t^3).
float4 lerp_along(const float4 p, const float4 q, const float start, const float step)
{
    const float4 d = q - p;
    return p + d * start + (float4)(0, d.xyz) * step;
}

// The field at start + t step, in leaf edges: a polynomial in t.
float4 field_along(const float8 v, const float3 start, const float3 step)
{
    // the four edges along x are linear: a + b t
    const float4 d = v.odd - v.even, a = v.even + d * start.x, b = d * step.x;
    const float4 p = lerp_along((float4)(a.x, b.x, 0, 0), (float4)(a.y, b.y, 0, 0), start.y, step.y);
    const float4 q = lerp_along((float4)(a.z, b.z, 0, 0), (float4)(a.w, b.w, 0, 0), start.y, step.y);
    return lerp_along(p, q, start.z, step.z);
}

float cubic(const float4 c, const float t)
{
    return c.x + t * (c.y + t * (c.z + t * c.w));
}

float within_0_1(const double t)
{
    return t > 0 ? t < 1 ? (float)t : 1 : 0;
}

// The first t in [0, 1] where a cubic is 0 or negative; false if there is none.
bool first_root(const float4 c, float *root)
{
    *root = 0;
    if (c.x <= 0)
        return true;
    const float third = 0x1.555556p-2f, b1 = c.x + c.y * third, b2 = b1 + (c.y + c.z) * third;
    if (b1 > 0 && b2 > 0 && cubic(c, 1) > 0) // all Bezier control points
        return false;
    // the cubic is monotonic between these
    float stops[3] = {0, 0, 1};
    const double slope = c.y, half_curve = c.z, cube = 3 * (double)c.w;
    const double discriminant = half_curve * half_curve - slope * cube;
    if (discriminant > 0) {
        const double size = sqrt(discriminant);
        const double q = half_curve < 0 ? size - half_curve : -size - half_curve;
        const double r = q / cube, s = slope / q; // infinite or NaN where there is none
        stops[0] = within_0_1(r < s ? r : s);
        stops[1] = within_0_1(r < s ? s : r);
    }
    float low = 0;
    for (uint i = 0; i < 3; ++i) {
        float high = stops[i];
        if (cubic(c, high) <= 0) {
            for (uint k = 0; k < HALVINGS; ++k) {
                const float middle = 0.5f * (low + high);
                const bool before = cubic(c, middle) > 0;
                low = before ? middle : low;
                high = before ? high : middle;
            }
            *root = high;
            return true;
        }
        low = high;
    }
    return false;
}

// The brightness of the surface at a point, in leaf edges, for a ray in direction `way`.
float shade(const float8 v, const float3 at, const double3 way, const float3 light)
{
    const float3 gradient = {
        bilerp(v.s1 - v.s0, v.s3 - v.s2, v.s5 - v.s4, v.s7 - v.s6, at.y, at.z),
        bilerp(v.s2 - v.s0, v.s3 - v.s1, v.s6 - v.s4, v.s7 - v.s5, at.x, at.z),
        bilerp(v.s4 - v.s0, v.s5 - v.s1, v.s6 - v.s2, v.s7 - v.s3, at.x, at.y),
    };
    const double3 g = convert_double3(gradient), along = g * way;
    const double size = sqrt(g.x * g.x + g.y * g.y + g.z * g.z);
    const double towards = along.x + along.y + along.z > 0 ? -1 : 1;
    const double3 normal = size > 0 ? g * (towards / size) : -way; // a leaf may be 0 everywhere
    const float3 n = convert_float3(normal);
    return brightness(n.x, n.y, n.z, light.x, light.y, light.z);
}

// One ray per pixel; a work-group takes TILE x TILE pixels. Arguments in addition to those of
// query.cl: refined: a bit per child of a block, set if the child has a block; room: for each cell
// of ROOM_LEVEL, the largest leap of a ray in cell edges; leap: the largest leap per unit of
// distance; camera: origin, direction, right and down; pixels: premultiplied colour and opacity.
__kernel void raycast(TEXTURES, __global const uchar *refined, __global const uchar *room,
                      const float leap, __global const double *camera, const uint perspective, const uint width,
                      const uint height, const float offset, const float3 light,
                      const float3 colour, __global float *pixels)
{
    const Hash hash = {cells, offsets, inverses, m, r};
    const uint across = (width + TILE - 1) / TILE;
    const uint tile = get_global_id(0) / (TILE * TILE), within = get_global_id(0) % (TILE * TILE);
    const uint column = tile % across * TILE + within % TILE;
    const uint row = tile / across * TILE + within / TILE;
    if (column >= width || row >= height)
        return;
    __global float *pixel = pixels + 4 * ((size_t)row * width + column);
    vstore4((float4)0, 0, pixel);

    Ray ray = ray_through(camera, perspective, column + 0.5 - 0.5 * width, row + 0.5 - 0.5 * height);
    const double end = enter_cube(&ray, perspective ? 0 : -INFINITY);
    const int3 moves = convert_int3(ray.moves), rises = convert_int3(ray.rises);
    uint3 at = fixed(ray.origin);
    int level = (full + deepest) >> 1; // the level of the leaf's parent, where the next search starts
    float side = 0; // side of the surface where the ray starts: 1 outside, -1 inside
    for (double t = 0; t < end;) {
        const uint block = find_block(&hash, refined, at, full, &level);
        const uint above = POINT_BITS - 1 - level;
        const uint3 leaf = at >> above, octant = leaf & 1;
        __global const float *corner =
            voxels + (27 * (size_t)block + octant.x + 3 * octant.y + 9 * octant.z);
        const float8 v = (float8)(vload2(0, corner), vload2(0, corner + 3), vload2(0, corner + 9),
                                  vload2(0, corner + 12)) - offset;

        const double leaves_a_side = 2u << level;
        const double3 low = (double3)(leaf.x, leaf.y, leaf.z);
        const double3 faces = (ray.rises ? low + 1 : low) * (1 / leaves_a_side);
        const double3 to_faces =
            ray.moves ? (faces - ray.origin) * ray.inverse : (double3)INFINITY;
        const double to_face = least_of(to_faces), exit = to_face > t ? to_face : t;
        const double3 place = (ray.origin + t * ray.way) * leaves_a_side - low;
        const double3 below_1 = place < 1 ? place : (double3)1;
        const float3 start = convert_float3(place > 0 ? below_1 : (double3)0);
        const float3 step = convert_float3((exit - t) * leaves_a_side * ray.way);

        const float4 along = field_along(v, start, step);
        side = side != 0 ? side : along.x >= 0 ? 1 : -1;
        float root;
        if (first_root(side * along, &root)) {
            const float bright = shade(v, start + root * step, ray.way, light);
            vstore4((float4)(bright * colour, 1), 0, pixel);
            return;
        }

        // into the next leaf, and past all leaves that cannot contain the surface
        const int3 passed = convert_int3(to_faces == to_face);
        const uint3 last = rises ? (uint3)((2u << level) - 1) : (uint3)0;
        if (any(passed & (leaf == last)))
            return;
        const uint3 next = rises ? (leaf + 1) << above : (leaf << above) - 1;
        at = passed ? next : at;
        const uint3 cell = at >> (POINT_BITS - ROOM_LEVEL);
        const float free = room[cell.x + (cell.y << ROOM_LEVEL) + (cell.z << 2 * ROOM_LEVEL)] *
                           (1.0f / (1 << ROOM_LEVEL));
        const float away = side * cubic(along, 1) * leap;
        t = exit + (away < free ? away : free);
        const uint3 there = fixed(ray.origin + t * ray.way);
        at = moves & (rises ? there > at : there < at) ? there : at;
    }
}
