// The parts of triangles that are further from a mesh than a given reach. Host side:
// voxtool/spatial/hausdorff.py.

#include "spatial/bvh.h"

#define LANES double4 // one lane per point
#define MASKS long4
#include "spatial/point_triangle.h"

#define BY_ROOT_3 0.5774 // exceeds 1 / sqrt(3)
#define STEPS 40 // halvings of an edge, at most
// A cut is worth its while if it takes this share of both edges, so that what remains is shorter; or
// this share of the area, and what remains is no sliver: its area, doubled, is at least FAT squares of
// the longest edge. Other triangles are halved, so all become small in the end.
#define SHARE 0.125
#define WORTH 0.25
#define FAT 0x1p-5

double3 vector_product(double3 a, double3 b)
{
    return (double3)(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

double square(double3 a)
{
    return a.x * a.x + a.y * a.y + a.z * a.z;
}

double3 between(double3 a, double3 b, double share)
{
    return a + share * (b - a);
}

// The distances of points to a triangle; the fourth lane repeats the third.
double4 distances_of(const triangle *t, double3 a, double3 b, double3 c)
{
    ways way;
    long4 feature;
    return sqrt(triangle_ways(t, (double4)(a.x, b.x, c.x, c.x), (double4)(a.y, b.y, c.y, c.y),
                              (double4)(a.z, b.z, c.z, c.z), &way, &feature));
}

// The shares of two edges, from their ends `in` to their ends `out`, that are within reach of a
// triangle, and in `found` the distances where these shares end: from reach - slack to reach. `found`
// holds the distances of the ends `in`, which are within reach; the ends `out` are not.
double2 shares_within(const triangle *t, double reach, double slack, const double3 *in,
                      const double3 *out, double2 *found)
{
    double2 low = 0, high = 1;
    for (uint i = 0; i < STEPS && any(reach - *found > slack); ++i) {
        const double2 middle = 0.5 * (low + high);
        const double3 p = between(in[0], out[0], middle.x), q = between(in[1], out[1], middle.y);
        const double2 d = distances_of(t, p, q, q).lo;
        const long2 within = d <= reach;
        low = within ? middle : low;
        high = within ? high : middle;
        *found = within ? d : *found;
    }
    return low;
}

void store_part(__global double *part, double3 a, double3 b, double3 c)
{
    vstore3(a, 0, part);
    vstore3(b, 1, part);
    vstore3(c, 2, part);
}

// Halves a triangle at the middle of its longest edge.
void halve(const double3 *v, __global double *parts)
{
    const double bc = square(v[2] - v[1]), ca = square(v[0] - v[2]), ab = square(v[1] - v[0]);
    const uint apex = bc >= ca && bc >= ab ? 0 : ca >= ab ? 1 : 2;
    const double3 a = v[apex], b = v[(apex + 1) % 3], c = v[(apex + 2) % 3], middle = 0.5 * (b + c);
    store_part(parts, a, b, middle);
    store_part(parts + 9, a, middle, c);
}

// Cuts off what is within reach of t, in the hull of the one or two corners that are and of points on
// the two edges between these and the others. Returns the number of triangles that remain, or 0 if
// the cut is not worth its while. `d` are the distances of the corners v; *covered receives a bound
// of those of what is cut off.
uint cut_off(const triangle *t, double reach, double slack, const double3 *v, const double *d,
             bool one, __global double *parts, double *covered)
{
    const uint alone = (d[0] <= reach) == one ? 0 : (d[1] <= reach) == one ? 1 : 2;
    const uint next = (alone + 1) % 3, last = (alone + 2) % 3;
    const double3 others[2] = {v[next], v[last]}, same[2] = {v[alone], v[alone]};
    const double3 *in = one ? same : others, *out = one ? others : same;
    double2 found = one ? (double2)(d[alone], d[alone]) : (double2)(d[next], d[last]);
    const double start = fmax(found.x, found.y);
    const double2 share = shares_within(t, reach, slack, in, out, &found);
    const double3 ab = v[1] - v[0], ac = v[2] - v[0], bc = v[2] - v[1];
    const double longest = fmax(square(ab), fmax(square(ac), square(bc)));
    const double rest = one ? 1 - share.x * share.y : (1 - share.x) * (1 - share.y);
    const bool fat = rest * sqrt(square(vector_product(ab, ac))) >= FAT * longest;
    const bool shorter = !one && share.x >= SHARE && share.y >= SHARE;
    if (!shorter && !(fat && rest <= 1 - WORTH))
        return 0;
    *covered = fmax(start, fmax(found.x, found.y));
    const double3 p = between(in[0], out[0], share.x), q = between(in[1], out[1], share.y);
    if (!one) {
        store_part(parts, v[alone], p, q);
        return 1;
    }
    const bool across = square(out[1] - p) < square(out[0] - q); // the shorter diagonal
    store_part(parts, p, out[0], across ? out[1] : q);
    store_part(parts + 9, across ? p : out[0], out[1], q);
    return 2;
}

// uppers[i] = a bound of the distances of face i's points from a mesh, those of the vertices given: no
// point of a triangle is further from the nearest corner than the longest edge by the root of 3.
__kernel void bound_faces(__global const double *vertices, __global const double *distances,
                          __global const int *faces, const uint n, __global double *uppers)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 face = vload3(gid, faces);
    const double3 a = vload3(face.x, vertices), b = vload3(face.y, vertices), c = vload3(face.z, vertices);
    const double longest = sqrt(fmax(square(b - a), fmax(square(c - b), square(a - c))));
    const double distance = fmax(distances[face.x], fmax(distances[face.y], distances[face.z]));
    uppers[gid] = distance + BY_ROOT_3 * longest;
}

// Cuts away the part of piece i, a triangle, that is within reach of triangle slots[i]: at most
// covered[i] <= reach from it. The counts[i] triangles from parts[2 i] on remain. The whole piece is at
// most uppers[i] away.
//
// The distance to a triangle is convex: a bound of it at some points holds in their convex hull.
__kernel void cut_pieces(__global const double *pieces, const uint n, __global const uint *slots,
                         __global const double *leaves, const double reach, const double slack,
                         __global double *parts, __global uchar *counts, __global double *uppers,
                         __global double *covered)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    __global const double *leaf = leaves + (size_t)(slots[gid] / LEAF) * (FIELDS * LEAF);
    const triangle t = one_triangle(leaf, slots[gid] % LEAF);
    double3 v[3];
    for (uint i = 0; i < 3; ++i)
        v[i] = vload3(3 * (size_t)gid + i, pieces);
    double d[4];
    vstore4(distances_of(&t, v[0], v[1], v[2]), 0, d);
    const uint within = (d[0] <= reach) + (d[1] <= reach) + (d[2] <= reach);
    const double upper = fmax(d[0], fmax(d[1], d[2]));
    double hull = within == 3 ? upper : 0;
    uint count = 0;
    __global double *own = parts + 18 * (size_t)gid;
    if (within == 1 || within == 2)
        count = cut_off(&t, reach, slack, v, d, within == 1, own, &hull);
    if (within < 3 && count == 0) {
        halve(v, own);
        count = 2;
    }
    counts[gid] = (uchar)count;
    uppers[gid] = upper;
    covered[gid] = hull;
}
