// Cells in order, and their textures. Host side: voxtool/tets/construction/textures.py. Options:
//   CORNERS    of a cell: 4 or 8
//   FLOATS     of a plane or a gradient in the textures: 3 or 4
//   CONSTANT   each cell has one scalar

#include "morton_bits.h"
#include "tets/pictures/faces.h"
#include "tets/construction/order.h"
#include "tets/pictures/vector.h"
#include "tets/volume/volume.h"

// ---- order. A point is a local position and a normalised scalar.

// The lattice coordinate of a local one.
uint on_lattice(const double at)
{
    const long place = (long)((at + 1) * (double)(1 << (MORTON_BITS - 1)));
    return (uint)clamp(place, 0l, (1l << MORTON_BITS) - 1);
}

// The key of a cell is the Morton code of its centroid; its bucket are the highest bits, from
// `shift` on.
__kernel void key_centroids(__global const uint *cells, const uint n,
                            __global const double *points, const uint shift,
                            __global uint *buckets, __global ulong *keys)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    double3 sum = 0;
    for (uint i = 0; i < CORNERS; ++i)
        sum += vload4(cells[CORNERS * (size_t)gid + i], points).xyz;
    const double3 centroid = sum / (double)CORNERS;
    const ulong code = spread_bits(on_lattice(centroid.x)) |
                       spread_bits(on_lattice(centroid.y)) << 1 |
                       spread_bits(on_lattice(centroid.z)) << 2;
    buckets[gid] = (uint)(code >> shift);
    keys[gid] = code;
}

// The cells in order; first[v] becomes the first of their corners that is vertex v.
__kernel void order_cells(__global const uint *cells, __global const uint *items, const uint n,
                          __global uint *ordered, volatile __global uint *first)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    for (uint i = 0; i < CORNERS; ++i) {
        const uint vertex = cells[CORNERS * (size_t)items[gid] + i];
        ordered[CORNERS * (size_t)gid + i] = vertex;
        atomic_min(&first[vertex], CORNERS * gid + i);
    }
}

// flags[i] = 1 where corner i is the first that is its vertex.
__kernel void flag_first(__global const uint *ordered, __global const uint *first, const uint n,
                         __global uint *flags)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        flags[gid] = first[ordered[gid]] == gid;
}

// The corners by the new numbers of their vertices: numbers[i] is that of corner i where it is a
// first one.
__kernel void renumber_corners(__global uint *ordered, __global const uint *first, const uint n,
                               __global const uint *numbers)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        ordered[gid] = numbers[first[ordered[gid]]];
}

// A number in float32; 0 where some devices would round it to 0.
float rounded(const double value) { return fabs(value) < LEAST ? 0.0f : convert_float_rte(value); }

float3 rounded3(const double3 v) { return (float3)(rounded(v.x), rounded(v.y), rounded(v.z)); }

// The points at their new numbers, and the vertices, which are the points in float32.
__kernel void place_points(__global const double *points, __global const uint *first, const uint n,
                           __global const uint *numbers, __global double *placed,
                           __global float *vertices)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint to = numbers[first[gid]];
    const double4 point = vload4(gid, points);
    vstore4(point, to, placed);
    vstore4((float4)(rounded3(point.xyz), rounded(point.w)), to, vertices);
}

// ---- planes and gradients

#define NARROW 0x1p-20 // of a product's factors: a smaller one has lost digits, so the shortest edge is taken

// A vector normal to a face.
double3 normal_of(const double3 *corner)
{
    const double3 along = corner[2] - corner[0], other = corner[SIDES - 1] - corner[1];
    const double3 product = cross3(along, other);
#if SIDES == 3
    if (length3(product) < NARROW * length3(along) * length3(other))
        return cross3(corner[1] - corner[0], along); // the third edge is short
#endif
    return product;
}

// Normal and offset of each face of cell i, in normals[cells * face + i], and the largest distance
// of a face's vertex, in float32, from its plane. A plane is computed from the vertices in one
// order, whichever cell has the face. Its offset is midway between those of the outermost and the
// innermost vertex.
__kernel void find_planes(__global const uint *cells, const uint n, __global const double *points,
                          __global const float *vertices, __global float *normals,
                          __global double *errors)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    double error = 0;
    for (uint face = 0; face < FACES; ++face) {
        uint loop[SIDES];
        const bool backward = loop_of(cells, gid, face, loop);
        double3 corner[SIDES];
        for (uint i = 0; i < SIDES; ++i)
            corner[i] = vload4(loop[i], points).xyz;
        const double3 product = normal_of(corner);
        const float3 normal = rounded3(product / length3(product));
        const double3 n64 = convert_double3(normal);
        double low = INFINITY, high = -INFINITY;
        for (uint i = 0; i < SIDES; ++i) {
            const double height = dot3(n64, corner[i]);
            low = fmin(low, height);
            high = fmax(high, height);
        }
        const float offset = rounded(-((low + high) / 2));
        for (uint i = 0; i < SIDES; ++i) {
            const double3 vertex = convert_double3(vload4(loop[i], vertices).xyz);
            error = fmax(error, fabs(dot3(n64, vertex) + offset));
        }
        const size_t texel = (size_t)face * n + gid;
        const float4 plane = (float4)(normal, offset) * (backward ? -1.0f : 1.0f);
#if FLOATS == 3
        vstore3(plane.xyz, texel, normals);
#else
        vstore4(plane, texel, normals);
#endif
    }
    errors[gid] = error;
}

#ifdef CONSTANT

// No gradient, and the scalar of each cell: scalars[items[i]].
__kernel void find_gradients(__global const double *scalars, __global const uint *items,
                             const uint n, __global float *gradients)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        vstore4((float4)(0, 0, 0, rounded(scalars[items[gid]])), gid, gradients);
}

#elif CORNERS == 4

// Exchange the corners of a flat tetrahedron so that its shortest edge is between the first two.
void shortest_first(double4 *corner)
{
    const double3 a = corner[1].xyz - corner[0].xyz, b = corner[2].xyz - corner[0].xyz;
    const double3 c = corner[3].xyz - corner[0].xyz;
    if (fabs(dot3(a, cross3(b, c))) >= NARROW * length3(a) * length3(b) * length3(c))
        return;
    uint first = 0, second = 1;
    double least = INFINITY;
    for (uint i = 0; i < 4; ++i)
        for (uint j = i + 1; j < 4; ++j) {
            const double size = length3(corner[j].xyz - corner[i].xyz);
            if (size < least) {
                least = size;
                first = i;
                second = j;
            }
        }
    double4 other = corner[0];
    corner[0] = corner[first];
    corner[first] = other;
    other = corner[1];
    corner[1] = corner[second];
    corner[second] = other;
}

// Gradient and scalar term of each tetrahedron, by the inverse of its edges, and the largest
// difference of its scalar at a vertex from that of the vertex in float32. The term is midway
// between those by which the cell has the scalars of its vertices.
__kernel void find_gradients(__global const uint *cells, const uint n,
                             __global const double *points, __global const float *vertices,
                             __global float *gradients, __global double *errors)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint4 v = vload4(gid, cells);
    double4 corner[4] = {vload4(v.x, points), vload4(v.y, points), vload4(v.z, points),
                               vload4(v.w, points)};
    shortest_first(corner);
    const double4 a = corner[1] - corner[0], b = corner[2] - corner[0], c = corner[3] - corner[0];
    const double3 along_a = cross3(b.xyz, c.xyz), along_b = cross3(c.xyz, a.xyz);
    const double3 along_c = cross3(a.xyz, b.xyz);
    const double3 slope = a.w * along_a + b.w * along_b + c.w * along_c;
    const float3 gradient = rounded3(slope / dot3(a.xyz, along_a));
    const double3 g64 = convert_double3(gradient);
    double low = INFINITY, high = -INFINITY, error = 0;
    for (uint i = 0; i < 4; ++i) {
        const double term = corner[i].w - dot3(g64, corner[i].xyz);
        low = fmin(low, term);
        high = fmax(high, term);
    }
    const float term = rounded((low + high) / 2);
    const uint numbers[4] = {v.x, v.y, v.z, v.w};
    for (uint i = 0; i < 4; ++i) {
        const double4 vertex = convert_double4(vload4(numbers[i], vertices));
        error = fmax(error, fabs(dot3(g64, vertex.xyz) + term - vertex.w));
    }
    errors[gid] = error;
#if FLOATS == 3
    vstore3(gradient, gid, gradients);
#else
    vstore4((float4)(gradient, term), gid, gradients);
#endif
}

#endif

// ---- ranges

#ifdef CONSTANT
#define SCALARS 1 // of a cell
#define SCALAR(i) scalars[4 * (i) + 3]
#else
#define SCALARS CORNERS
#define SCALAR(i) scalars[4 * (size_t)cells[i] + 3]
#endif

// The least and the largest scalar of each block of `count` cells: `scalars` are the gradients if
// CONSTANT, or else the vertices.
__kernel void find_ranges(__global const uint *cells, const uint count,
                          __global const float *scalars, const uint n, __global float *ranges)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const size_t begin = SCALARS * (size_t)BLOCK * gid;
    const size_t end = SCALARS * (size_t)min(BLOCK * gid + BLOCK, count);
    float low = INFINITY, high = -INFINITY;
    for (size_t i = begin; i < end; ++i) {
        low = fmin(low, SCALAR(i));
        high = fmax(high, SCALAR(i));
    }
    vstore2((float2)(low, high), gid, ranges);
}
