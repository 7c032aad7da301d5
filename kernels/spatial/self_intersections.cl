// Self-intersections of a mesh. Host side: voxtool/spatial/self_intersections.py.

#include "spatial/bvh.h"
#include "spatial/exact_sides.h"
#include "spatial/names.h"
#include "spatial/self_intersections.h"

#define STACK ((ARITY - 1) * MAX_LEVELS + 1)
double3 corner(__global const double *vertices, __global const int *faces, uint face, uint i)
{
    return vload3(faces[3 * (size_t)face + i], vertices);
}

// Whether three points are all below or above a box along some axis.
bool beside(const double3 *u, double3 low, double3 high)
{
    const long3 above = (u[0] > high) & (u[1] > high) & (u[2] > high);
    const long3 below = (u[0] < low) & (u[1] < low) & (u[2] < low);
    return any(above | below);
}

// Whether a plane has corners of a triangle on both sides, or on it; those in the bit set `on` are on it.
bool divided(const plane *by, const double3 *u, uint on, int *side)
{
    int least = 1, greatest = -1;
    for (uint i = 0; i < 3; ++i) {
        side[i] = on >> i & 1 ? 0 : side_of(by, u[i]);
        if (on >> i & 1)
            continue;
        least = min(least, side[i]);
        greatest = max(greatest, side[i]);
    }
    return least * greatest <= 0;
}

// Whether edges of triangle u, without the corners in `shared`, meet triangle t; side: on which side
// of the plane of t each corner of u lies. Edges in the plane do not count.
bool edges_meet(const double3 *t, const double3 *u, uint shared, const int *side)
{
    for (uint i = 0; i < 3; ++i) {
        const uint j = (i + 1) % 3;
        if (shared >> i & 1 || shared >> j & 1 || side[i] * side[j] > 0 || side[i] == side[j])
            continue;
        int least = 1, greatest = -1;
        for (uint k = 0; k < 3; ++k) {
            const plane around = plane_through(u[i], u[j], t[k]);
            const int turn = side_of(&around, t[(k + 1) % 3]);
            least = min(least, turn);
            greatest = max(greatest, turn);
        }
        if (least * greatest >= 0)
            return true;
    }
    return false;
}

double2 seen_along(uint axis, double3 p)
{
    return axis == 0 ? p.yz : axis == 1 ? p.zx : p.xy;
}

void to_the_left(double2 *t)
{
    if (turn_of(t[0], t[1], t[2]) > 0)
        return;
    const double2 last = t[2];
    t[2] = t[1];
    t[1] = last;
}

// Whether triangle u lies beyond an edge of triangle t, which turns to the left.
bool beyond_edge(const double2 *t, const double2 *u)
{
    for (uint i = 0; i < 3; ++i) {
        bool beyond = true;
        for (uint j = 0; j < 3; ++j)
            beyond &= turn_of(t[i], t[(i + 1) % 3], u[j]) < 0;
        if (beyond)
            return true;
    }
    return false;
}

// Whether the direction from corner 0 of triangle t, which turns to the left, to p lies between its
// edges there, or along one.
bool between_edges(const double2 *t, double2 p)
{
    return turn_of(t[0], t[1], p) >= 0 && turn_of(t[0], p, t[2]) >= 0;
}

// Whether two triangles in a plane meet outside the corners that they share, no more than two. If it
// is one, it is number at_t and at_u, and if there are two, those are the others'.
bool meet_in_plane(const double3 *t, const double3 *u, uint shared, uint at_t, uint at_u)
{
    double2 a[3], b[3];
    int turn = 0;
    for (uint axis = 0; turn == 0 && axis < 3; ++axis) { // along which the plane is seen
        for (uint i = 0; i < 3; ++i) {
            a[i] = seen_along(axis, t[(at_t + i) % 3]);
            b[i] = seen_along(axis, u[(at_u + i) % 3]);
        }
        turn = turn_of(a[0], a[1], a[2]);
    }
    to_the_left(a);
    to_the_left(b);
    if (shared == 0)
        return !beyond_edge(a, b) && !beyond_edge(b, a);
    if (shared == 2)
        return turn_of(a[1], a[2], b[0]) > 0;
    return between_edges(a, b[1]) || between_edges(a, b[2]) || between_edges(b, a[1]);
}

// Whether two faces intersect outside their shared corners and edges; low, high: the box of face f,
// own: its plane.
bool meet(__global const double *vertices, __global const int *faces, __global const int *corners,
          uint f, uint g, double3 low, double3 high, const plane *own)
{
    double3 u[3];
    for (uint i = 0; i < 3; ++i)
        u[i] = corner(vertices, faces, g, i);
    if (beside(u, low, high))
        return false;
    uint shared = 0, on_t = 0, on_u = 0, at_t = 0, at_u = 0; // `at`: the sum of shared corners
    for (uint i = 0; i < 3; ++i)
        for (uint j = 0; j < 3; ++j)
            if (corners[3 * (size_t)f + i] == corners[3 * (size_t)g + j]) {
                ++shared;
                on_t |= 1 << i;
                on_u |= 1 << j;
                at_t += i;
                at_u += j;
            }
    if (shared == 3)
        return true;
    int of_t[3], of_u[3];
    if (!divided(own, u, on_u, of_u))
        return false;
    const double3 t[3] = {own->a, own->b, own->c};
    if (of_u[0] == 0 && of_u[1] == 0 && of_u[2] == 0)
        return meet_in_plane(t, u, shared, shared == 2 ? 3 - at_t : at_t,
                             shared == 2 ? 3 - at_u : at_u);
    const plane other = plane_through(u[0], u[1], u[2]);
    return divided(&other, t, on_t, of_t) &&
           (edges_meet(t, u, on_u, of_u) || edges_meet(u, t, on_t, of_t));
}

// found[f] = 1 if another face intersects face f, 0 if none does, UNDECIDED if more than `most` faces
// are near. Only faces with this `state` in found are examined. corners[3 f + i] are position
// indices; faces without a name have zero area. Vertices are exact: scaled as local
// coordinates are, but not moved; `centre` is the origin of local coordinates.
__kernel void find_self_intersections(const uint n, __global const uint *names,
                                      __global const double *vertices, __global const int *faces,
                                      __global const int *corners, __global const double *centre,
                                      __global const float *nodes, const uint first_leaf,
                                      const uint most, const uint state, __global uchar *found)
{
    const uint gid = get_global_id(0);
    if (gid >= n || names[gid] == NAMELESS)
        return;
    const uint own = names[gid] / 3;
    if (found[own] != state)
        return;
    const plane by = plane_through(corner(vertices, faces, own, 0), corner(vertices, faces, own, 1),
                                   corner(vertices, faces, own, 2));
    const double3 low = fmin(fmin(by.a, by.b), by.c), high = fmax(fmax(by.a, by.b), by.c);
    const float3 from = convert_float3(low - vload3(0, centre));
    const float3 to = convert_float3(high - vload3(0, centre));
    uint ids[STACK], top = 1, near = 0;
    ids[0] = 0;
    found[own] = UNDECIDED;
    while (top > 0) {
        const uint id = ids[--top];
        __global const float *boxes = nodes + (size_t)id * (6 * ARITY);
        const int8 apart = (vload8(0, boxes) > to.x) | (vload8(1, boxes) > to.y) |
                           (vload8(2, boxes) > to.z) | (vload8(3, boxes) < from.x) |
                           (vload8(4, boxes) < from.y) | (vload8(5, boxes) < from.z);
        int away[ARITY];
        vstore8(apart, 0, away);
        for (uint i = 0; i < ARITY; ++i) {
            if (away[i])
                continue;
            const uint child = ARITY * id + 1 + i;
            if (child < first_leaf) {
                ids[top++] = child;
                continue;
            }
            const uint first = (child - first_leaf) * LEAF;
            near += LEAF;
            if (near > most)
                return;
            for (uint j = first; j < min(first + LEAF, n); ++j)
                if (names[j] != NAMELESS && names[j] / 3 != own &&
                    meet(vertices, faces, corners, own, names[j] / 3, low, high, &by)) {
                    found[own] = 1;
                    return;
                }
        }
    }
    found[own] = 0;
}

// ---- crossings of shells

// The side of a triangle's plane on which a point lies: 1, -1, or 0 if it is as near as rounding.
int clear_side(const double3 *t, double3 p)
{
    const double3 a = t[1] - t[0], b = t[2] - t[0], c = p - t[0];
    const double3 n = plane_through(t[0], t[1], t[2]).normal * c;
    const double volume = n.x + n.y + n.z;
    const double size = (fabs(a.x) + fabs(a.y) + fabs(a.z)) * (fabs(b.x) + fabs(b.y) + fabs(b.z)) *
                        (fabs(c.x) + fabs(c.y) + fabs(c.z));
    return fabs(volume) <= 0x1p-48 * size ? 0 : volume > 0 ? 1 : -1;
}

// 2 if an edge of triangle u passes through triangle t clear of its edges, 1 if it passes through one
// of them, otherwise 0.
int pierced(const double3 *t, const double3 *u)
{
    int side[3], most = 0;
    for (uint i = 0; i < 3; ++i)
        side[i] = clear_side(t, u[i]);
    for (uint i = 0; i < 3; ++i) {
        const uint j = (i + 1) % 3;
        if (side[i] * side[j] >= 0)
            continue;
        int least = 1, greatest = -1;
        for (uint k = 0; k < 3; ++k) {
            const double3 v[3] = {u[i], u[j], t[k]};
            const int around = clear_side(v, t[(k + 1) % 3]);
            least = min(least, around);
            greatest = max(greatest, around);
        }
        if (least == greatest && least != 0)
            return 2;
        if (least * greatest >= 0)
            most = 1;
    }
    return most;
}

// found[CROSSED gid ..] = the numbers, plus 1, of other shells that a face crosses, up to CROSSED of
// them, with CLEAR where it does so clear of edges; `of` is the shell of each face.
__kernel void list_crossing_shells(const uint n, __global const uint *names,
                                   __global const double *vertices, __global const int *faces,
                                   __global const int *of, __global const float *nodes,
                                   const uint first_leaf, __global int *found)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint own = names[gid] / 3;
    double3 t[3], low = INFINITY, high = -INFINITY;
    for (uint i = 0; i < 3; ++i) {
        t[i] = corner(vertices, faces, own, i);
        low = fmin(low, t[i]);
        high = fmax(high, t[i]);
    }
    uint ids[STACK], top = 1, listed = 0;
    ids[0] = 0;
    while (top > 0) {
        const uint id = ids[--top];
        for (uint i = 0; i < ARITY; ++i) {
            __global const float *box = nodes + (size_t)id * (6 * ARITY) + i;
            if (box[0] > high.x || box[ARITY] > high.y || box[2 * ARITY] > high.z ||
                box[3 * ARITY] < low.x || box[4 * ARITY] < low.y || box[5 * ARITY] < low.z)
                continue;
            const uint child = ARITY * id + 1 + i;
            if (child < first_leaf) {
                ids[top++] = child;
                continue;
            }
            const uint first = (child - first_leaf) * LEAF;
            for (uint j = first; j < min(first + LEAF, n); ++j) {
                const uint other = names[j] / 3;
                uint place = 0;
                __global int *own_list = found + CROSSED * (size_t)gid;
                while (place < listed && (own_list[place] & ~CLEAR) != of[other] + 1)
                    ++place;
                const bool known = place < listed;
                if (of[other] == of[own] || (known ? own_list[place] & CLEAR : listed == CROSSED))
                    continue;
                double3 u[3];
                for (uint k = 0; k < 3; ++k)
                    u[k] = corner(vertices, faces, other, k);
                const int through = beside(u, low, high) ? 0 : max(pierced(t, u), pierced(u, t));
                if (through == 0)
                    continue;
                own_list[place] = (of[other] + 1) | (through == 2 ? CLEAR : 0);
                listed += !known;
            }
        }
    }
}
