// Vertices of a dual surface of voxels where the planes of the source mesh at the crossings meet
// [Ju 2002], and quads split along features. Host side: voxtool/svo/surface/sharp.py. Option: VOXELS.

#include "qef.h"
#include "svo/voxelization/fill/crossings.h"
#include "svo/surface/cubes.h"
#include "svo/surface/samples.h"
#include "svo/surface/relaxation.h"
#include "svo/surface/sharp.h"
#include "svo/surface/splits.h"

// The source in the grid's coordinates, and its crossings with rows along x, y and z: the host's
// Crossed.arguments.
#define SOURCE                                                                                     \
    __global const double *corners, __global const int *faces, __global const ulong *keys_x,       \
        __global const ulong *keys_y, __global const ulong *keys_z, __global const uint *crossed_x, \
        __global const uint *crossed_y, __global const uint *crossed_z, const uint4 counts,        \
        const uint4 key_bits, const int3 sides
#define THIS_SOURCE                                                                                \
    corners, faces, keys_x, keys_y, keys_z, crossed_x, crossed_y, crossed_z, counts, key_bits, sides

// The place of a link's crossing, from 0 at its lower end to 1, and the plane of the triangle there:
// its unit normal and a point on it.
typedef struct {
    double place;
    double3 normal, on;
} plane;

double product(double3 a, double3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
double along(double3 v, uint axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }
int step_of(int3 v, uint axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }
uint count_of(uint4 v, uint axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }

// The plane of a face, from the centre of a voxel on; false if it has no area.
bool plane_of(__global const double *corners, __global const int *faces, uint face, int3 voxel,
              uint axis, plane *found)
{
    const double3 centre = convert_double3(voxel) + 0.5;
    const double3 u = vload3(faces[3 * (size_t)face], corners) - centre,
                  a = vload3(faces[3 * (size_t)face + 1], corners) - centre - u,
                  b = vload3(faces[3 * (size_t)face + 2], corners) - centre - u;
    const double3 n = {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    const double squares = product(n, n);
    if (!(squares > LEAST_SQUARE))
        return false;
    found->normal = n / sqrt(squares);
    found->on = u;
    const double slope = along(found->normal, axis);
    const double place = product(found->normal, u) / (slope == 0 ? 1 : slope);
    found->place = slope == 0 ? 0.5 : fmin(fmax(place, 0.0), 1.0);
    return true;
}

// The crossing of the link from a voxel to the next along an axis, of which one is inside; false if
// the source does not cross it. If there are several, the order is: a face that looks from the inside
// voxel to the outside one; the nearest to the inside voxel; the first face.
bool crossing_of_link(SOURCE, int3 voxel, uint axis, bool is_inside, plane *best)
{
    __global const ulong *keys = axis == 0 ? keys_x : axis == 1 ? keys_y : keys_z;
    __global const uint *crossed = axis == 0 ? crossed_x : axis == 1 ? crossed_y : crossed_z;
    const uint p = (axis + 1) % 3, q = (axis + 2) % 3, n = count_of(counts, axis);
    const ulong row = (ulong)step_of(voxel, q) * (uint)step_of(sides, p) + (uint)step_of(voxel, p);
    const ulong first = row << count_of(key_bits, axis) | (ulong)(step_of(voxel, axis) + 2) << 2;
    uint begin = 0, end = n;
    while (begin < end) {
        const uint middle = begin + (end - begin) / 2;
        if (keys[middle] < first)
            begin = middle + 1;
        else
            end = middle;
    }
    bool found = false, agreed = false;
    for (; begin < n && keys[begin] >> 2 == first >> 2; ++begin) {
        const bool agrees = ((keys[begin] & ENTERS) != 0) != is_inside;
        plane other;
        if ((agreed && !agrees) || !plane_of(corners, faces, crossed[begin], voxel, axis, &other))
            continue;
        const bool nearer = is_inside ? other.place < best->place : other.place > best->place;
        if (!found || (agrees && !agreed) || nearer)
            *best = other;
        found = true;
        agreed = agrees;
    }
    return found;
}

int to_lattice(double t) { return within((int)(t * LATTICE + 0.5)); }

ulong pack_point(double3 at) { return pack(to_lattice(at.x), to_lattice(at.y), to_lattice(at.z)); }

// The steps of the lattice from the corner of a cell to a point at most REACH beyond it.
int3 steps_to(double3 at)
{
    return convert_int3(at * LATTICE + (REACH * LATTICE + 0.5)) - REACH * LATTICE;
}

// Places the vertex of each loop, within REACH of its cell: kinds[i] says how it was found. `packed`
// holds the best places in the cells, `means` those of the crossings, and `errors` the squared
// distances to the planes, from the corner of the cell.
__kernel void place_features(__global const ulong *codes, const uint n, CUBES, SOURCE,
                             const int shift, __global int *points, __global ulong *packed,
                             __global ulong *means, __global uchar *kinds, __global qef *errors)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 corner = cell_coordinates(codes[gid] << 6) - shift;
    const double3 low = (double)NEAREST / LATTICE, high = 1 - low;
    size_t vertex = first[gid];
    uint k = 0;
    for (ulong left = cut[gid]; left; left &= left - 1) {
        const uint bit = lowest_bit(left), found = resolved_case(cases, joined, gid, k++, bit);
        const int3 cell = corner + place_in_tile(bit);
        qef sum = empty_qef();
        bool any = false;
        for (uint i = 0; i < EDGE_COUNT[found]; ++i) {
            const uint step = LOOP_STEPS[12 * found + i], edge = step & STEP_EDGE;
            const uint j = EDGE_CORNER[edge], axis = edge >> 2;
            const double3 start = convert_double3(place_in_tile(j));
            plane at;
            at.place = 0.5;
            if (crossing_of_link(THIS_SOURCE, cell + place_in_tile(j), axis, found >> j & 1, &at)) {
                add_plane(&sum, start + at.on, at.normal);
                any = true;
            }
            add_point(&sum, start + convert_double3(unit_of(axis)) * at.place);
            if (step & STEP_LAST) {
                bool inside, near = true;
                const double3 within_cell = minimum_of_qef(&sum, low, high, &inside);
                double3 at = within_cell;
                if (!inside)
                    at = minimum_of_qef(&sum, low - REACH, high + REACH, &near);
                kinds[vertex] = any ? near ? FREE : CONSTRAINED : OPEN;
                vstore3(cell * LATTICE + LATTICE / 2 + steps_to(near ? at : within_cell), vertex,
                        points);
                packed[vertex] = pack_point(within_cell);
                means[vertex] = pack_point(
                    (double3)(sum.points[0], sum.points[1], sum.points[2]) / sum.count);
                errors[vertex++] = sum;
                sum = empty_qef();
                any = false;
            }
        }
    }
}

// Puts back the vertices that have planes.
__kernel void hold_features(__global const ulong *held, const uint n, __global const uchar *kinds,
                            __global ulong *packed)
{
    const uint gid = get_global_id(0);
    if (gid < n && kinds[gid] != OPEN)
        packed[gid] = held[gid];
}

// Puts the vertices without planes where they relaxed to.
__kernel void put_open(__global const int *relaxed, const uint n, __global const uchar *kinds,
                       __global int *points)
{
    const uint gid = get_global_id(0);
    if (gid < n && kinds[gid] == OPEN)
        vstore3(vload3(gid, relaxed), gid, points);
}

// ---- quads

// The mean squared distance of a point to the planes of a vertex; places: vertices in their cells.
double error_at(__global const qef *errors, __global const int *places, const quad *q, uint corner,
                double3 at)
{
    const qef sum = errors[q->vertex[corner]];
    const int3 cell = (vload3(q->vertex[corner], places) - LATTICE / 2) >> LATTICE_BITS;
    return fmax(error_of_qef(&sum, at - convert_double3(cell) - 0.5), 0.0) / sum.count;
}

// The error of a diagonal: that of its middle from the planes of its two ends.
double error_of_diagonal(__global const qef *errors, __global const int *places, const quad *q,
                         uint first)
{
    const double3 middle = convert_double3(q->point[first] + q->point[first + 2]) / (2.0 * LATTICE);
    return error_at(errors, places, q, first, middle) +
           error_at(errors, places, q, first + 2, middle);
}

// Splits a quad along the diagonal that is nearer to the planes of its ends, as a diagonal along a
// feature is; along the shorter one where both are near; along the other if a triangle would have
// zero area.
__kernel void split_along_features(__global const uint *quads, const uint n,
                                   __global const int *points, __global const int *places,
                                   __global const qef *errors, __global uint *triangles)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const quad q = quad_of(vload4(gid, quads), points);
    const double even = error_of_diagonal(errors, places, &q, 0),
                 odd = error_of_diagonal(errors, places, &q, 1);
    uint first = shorter_diagonal(&q);
    if (fmax(even, odd) > NEAR_PLANES)
        first = even <= odd ? 0 : 1;
    store_split(&q, is_flat_split(&q, first) ? 1 - first : first, gid, triangles);
}
