// Crossings of lines with a mesh. Host side: voxtool/spatial/crossings.py.

#include "spatial/bvh.h"
#include "spatial/crossings.h"

#define STACK ((ARITY - 1) * MAX_LEVELS + 1)

// A line through a point of a face. The coordinates are permuted so that the direction is longest
// along z, and sheared so that it is the z axis.
typedef struct {
    double3 point, along;
    uint longest;
    double2 shear;
} line;

line line_of(double3 point, double3 along)
{
    line l = {point, along, 2, (double2)(0)};
    const double3 size = fabs(along);
    if (size.x >= size.y && size.x >= size.z)
        l.longest = 0;
    else if (size.y >= size.z)
        l.longest = 1;
    const double3 d = l.longest == 0 ? along.yzx : l.longest == 1 ? along.zxy : along;
    l.shear = d.xy / d.z;
    return l;
}

// A vertex relative to the line, which becomes the z axis. A vertex has the same value in all of its
// faces, so that a line passes between no two neighbours [Woop 2013].
double3 seen_from(const line *l, double3 vertex)
{
    const double3 v = vertex - l->point;
    const double3 p = l->longest == 0 ? v.yzx : l->longest == 1 ? v.zxy : v;
    return (double3)(p.xy - l->shear * p.z, p.z);
}

double area(double3 a, double3 b)
{
    return a.x * b.y - a.y * b.x;
}

// Whether the line is left of the edge from a to b; a line on the edge is moved by an infinitesimal,
// so that exactly one of the two directions of an edge has it to its left.
bool left_of(double3 a, double3 b)
{
    const double twice = area(a, b);
    return twice != 0 ? twice > 0 : a.y != b.y ? b.y > a.y : b.x > a.x;
}

// 1 if the line crosses a triangle ahead of its point, -1 if it does behind it, otherwise 0; crossings
// as near as `least` are left out. *leaves: whether the line then leaves what the triangle bounds.
int crossing(const line *l, const double3 *corners, double least, bool *leaves)
{
    double3 v[3];
    for (uint i = 0; i < 3; ++i)
        v[i] = seen_from(l, corners[i]);
    const bool left = left_of(v[0], v[1]);
    if (left_of(v[1], v[2]) != left || left_of(v[2], v[0]) != left)
        return 0;
    const double u = area(v[1], v[2]), w = area(v[2], v[0]), t = area(v[0], v[1]);
    const double whole = u + w + t;
    if (whole == 0)
        return 0;
    const double at = (u * v[0].z + w * v[1].z + t * v[2].z) / whole;
    if (fabs(at) <= least)
        return 0;
    const double d = l->longest == 0 ? l->along.x : l->longest == 1 ? l->along.y : l->along.z;
    *leaves = left == (d > 0);
    return (at > 0) == (d > 0) ? 1 : -1;
}

// The children of a node that the line may meet, by the axes that separate a line and a box.
long8 met(__global const float *nodes, uint node, const line *l)
{
    __global const float *box = nodes + (size_t)node * (6 * ARITY);
    double8 middle[3], half_side[3];
    long8 found = -1;
    for (uint i = 0; i < 3; ++i) {
        const double8 low = convert_double8(vload8(i, box)), high = convert_double8(vload8(3 + i, box));
        found &= low <= high; // a missing child has none
        middle[i] = 0.5 * (low + high);
        half_side[i] = 0.5 * (high - low);
    }
    const double p[3] = {l->point.x, l->point.y, l->point.z};
    const double d[3] = {l->along.x, l->along.y, l->along.z};
    for (uint i = 0; i < 3; ++i) {
        const uint j = (i + 1) % 3, k = (i + 2) % 3;
        const double8 apart = (middle[j] - p[j]) * d[k] - (middle[k] - p[k]) * d[j];
        found &= fabs(apart) <= half_side[j] * fabs(d[k]) + half_side[k] * fabs(d[j]);
    }
    return found;
}

// ahead[i] and behind[i] = how many faces line i crosses on either side of its point, without the
// face `own` on which the point lies.
__kernel void count_crossings(const uint n, __global const double *points, __global const double *along,
                              __global const uint *own, __global const double *vertices,
                              __global const int *faces, __global const uint *face_of,
                              const uint triangles, __global const float *nodes, const uint first_leaf,
                              __global uint *ahead, __global uint *behind)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const line l = line_of(vload3(gid, points), vload3(gid, along));
    uint ids[STACK], top = 1, found[2] = {0, 0};
    ids[0] = 0;
    while (top > 0) {
        const uint id = ids[--top];
        long hit[ARITY];
        vstore8(met(nodes, id, &l), 0, hit);
        for (uint i = 0; i < ARITY; ++i) {
            if (!hit[i])
                continue;
            const uint child = ARITY * id + 1 + i;
            if (child < first_leaf) {
                ids[top++] = child;
                continue;
            }
            const uint begin = (child - first_leaf) * LEAF;
            for (uint slot = begin; slot < min(begin + LEAF, triangles); ++slot) {
                const uint face = face_of[slot];
                double3 corners[3];
                for (uint k = 0; k < 3; ++k)
                    corners[k] = vload3(faces[3 * (size_t)face + k], vertices);
                bool leaves;
                const int side = face == own[gid] ? 0 : crossing(&l, corners, 1.0 / (1ul << TOUCHING_BITS), &leaves);
                found[0] += side > 0;
                found[1] += side < 0;
            }
        }
    }
    ahead[gid] = found[0];
    behind[gid] = found[1];
}

// counts[i] = how many faces the row along x through point i crosses before it, numbers[i] = how many
// of them enter minus how many leave, for the points which[..].
__kernel void count_before(const uint n, __global const double *points, __global const uint *which,
                           __global const double *vertices, __global const int *faces,
                           __global const uint *face_of, const uint triangles,
                           __global const float *nodes, const uint first_leaf, __global uint *counts,
                           __global int *numbers)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint point = which[gid];
    const line l = line_of(vload3(point, points), (double3)(1, 0, 0));
    uint ids[STACK], top = 1, found = 0;
    int number = 0;
    ids[0] = 0;
    while (top > 0) {
        const uint id = ids[--top];
        long hit[ARITY];
        vstore8(met(nodes, id, &l), 0, hit);
        for (uint i = 0; i < ARITY; ++i) {
            if (!hit[i])
                continue;
            const uint child = ARITY * id + 1 + i;
            if (child < first_leaf) {
                ids[top++] = child;
                continue;
            }
            const uint begin = (child - first_leaf) * LEAF;
            for (uint slot = begin; slot < min(begin + LEAF, triangles); ++slot) {
                double3 corners[3];
                for (uint k = 0; k < 3; ++k)
                    corners[k] = vload3(faces[3 * (size_t)face_of[slot] + k], vertices);
                bool leaves;
                if (crossing(&l, corners, 0, &leaves) < 0) {
                    ++found;
                    number += leaves ? -1 : 1;
                }
            }
        }
    }
    counts[point] = found;
    numbers[point] = number;
}
