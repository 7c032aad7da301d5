// Self-intersections of a mesh. Host side: voxtool/spatial/self_intersections.py.

#include "spatial/bvh.h"
#include "spatial/names.h"
#include "spatial/self_intersections.h"

#define STACK ((ARITY - 1) * MAX_LEVELS + 1)
#define GAP 0x1p-46 // exceeds the rounding error of a product with a unit vector

double product(double3 a, double3 b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

double3 cross_of(double3 a, double3 b)
{
    return (double3)(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

double3 unit(double3 a)
{
    const double aa = product(a, a);
    return aa > 0x1p-900 ? a / sqrt(aa) : (double3)0;
}

// Whether the projections of two triangles on an axis are disjoint.
bool apart_on(double3 axis, const double3 *t, const double3 *u)
{
    const double3 a = unit(axis);
    double low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY};
    for (uint i = 0; i < 3; ++i) {
        const double on[2] = {product(a, t[i]), product(a, u[i])};
        for (uint k = 0; k < 2; ++k) {
            low[k] = on[k] < low[k] ? on[k] : low[k];
            high[k] = on[k] > high[k] ? on[k] : high[k];
        }
    }
    return low[1] - high[0] > GAP || low[0] - high[1] > GAP;
}

// Whether two triangles are disjoint, by the separating axes of the general and coplanar cases
// [Gottschalk 1996].
bool triangles_apart(const double3 *t, const double3 *u)
{
    double3 e[3], f[3];
    for (uint i = 0; i < 3; ++i) {
        e[i] = t[(i + 1) % 3] - t[i];
        f[i] = u[(i + 1) % 3] - u[i];
    }
    const double3 n = cross_of(unit(e[0]), unit(e[1])), m = cross_of(unit(f[0]), unit(f[1]));
    if (apart_on(n, t, u) || apart_on(m, t, u))
        return true;
    for (uint i = 0; i < 3; ++i) {
        if (apart_on(cross_of(n, unit(e[i])), t, u) || apart_on(cross_of(m, unit(f[i])), t, u))
            return true;
        for (uint j = 0; j < 3; ++j)
            if (apart_on(cross_of(unit(e[i]), unit(f[j])), t, u))
                return true;
    }
    return false;
}

// Whether a plane with this normal, through a corner shared by two triangles, separates them. t and
// u are their edges from the corner; edges in the bit set `on` may lie in the plane.
bool parts(double3 normal, const double3 *t, const double3 *u, uint on)
{
    const double3 a = unit(normal);
    for (int way = -1; way <= 1; way += 2) {
        bool parted = a.x != 0 || a.y != 0 || a.z != 0;
        for (uint i = 0; i < 2; ++i) {
            parted &= on >> i & 1 || way * product(a, t[i]) > GAP;
            parted &= on >> (2 + i) & 1 || way * product(a, u[i]) < -GAP;
        }
        if (parted)
            return true;
    }
    return false;
}

// Whether two triangles that share a corner are disjoint elsewhere.
bool fans_apart(double3 t1, double3 t2, double3 u1, double3 u2)
{
    const double3 t[2] = {unit(t1), unit(t2)}, u[2] = {unit(u1), unit(u2)};
    const double3 n = cross_of(t[0], t[1]), m = cross_of(u[0], u[1]);
    if (parts(t[0] + t[1] - u[0] - u[1], t, u, 0) || parts(n, t, u, 3) || parts(m, t, u, 12))
        return true;
    for (uint i = 0; i < 2; ++i) {
        if (parts(cross_of(n, t[i]), t, u, 1 << i) || parts(cross_of(m, u[i]), t, u, 4 << i))
            return true;
        for (uint j = 0; j < 2; ++j)
            if (parts(cross_of(t[i], u[j]), t, u, 1 << i | 4 << j))
                return true;
    }
    return false;
}

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

// Whether two faces intersect outside their shared corners and edges; low, high: the box of face f.
bool meet(__global const double *vertices, __global const int *faces, __global const int *corners,
          uint f, uint g, double3 low, double3 high)
{
    double3 t[3], u[3];
    for (uint i = 0; i < 3; ++i)
        u[i] = corner(vertices, faces, g, i);
    if (beside(u, low, high))
        return false;
    uint shared = 0, at_f = 0, at_g = 0, apexes[2] = {0, 0};
    for (uint i = 0; i < 3; ++i) {
        t[i] = corner(vertices, faces, f, i);
        for (uint j = 0; j < 3; ++j)
            if (corners[3 * (size_t)f + i] == corners[3 * (size_t)g + j]) {
                ++shared;
                at_f = i;
                at_g = j;
                apexes[0] += i;
                apexes[1] += j;
            }
    }
    if (shared == 0)
        return !triangles_apart(t, u);
    if (shared == 3)
        return true;
    if (shared == 2) { // faces that leave their common edge in the same direction overlap
        double3 across[2];
        for (uint k = 0; k < 2; ++k) {
            const double3 *own = k == 0 ? t : u;
            const uint apex = k == 0 ? 3 - apexes[0] : 3 - apexes[1];
            const double3 along = unit(own[(apex + 2) % 3] - own[(apex + 1) % 3]);
            const double3 side = own[apex] - own[(apex + 1) % 3];
            across[k] = unit(side - product(side, along) * along);
        }
        const double3 apart = across[0] - across[1];
        return product(apart, apart) < GAP;
    }
    const double3 o = t[at_f];
    return !fans_apart(t[(at_f + 1) % 3] - o, t[(at_f + 2) % 3] - o, u[(at_g + 1) % 3] - o,
                       u[(at_g + 2) % 3] - o);
}

// found[f] = 1 if another face intersects face f, 0 if none does, UNDECIDED if more than `most` faces
// are near. Only faces with this `state` in found are examined. corners[3 f + i] are position
// indices; faces without a name have zero area.
__kernel void find_self_intersections(const uint n, __global const uint *names, __global const double *vertices,
                             __global const int *faces, __global const int *corners,
                             __global const float *nodes, const uint first_leaf, const uint most,
                             const uint state, __global uchar *found)
{
    const uint gid = get_global_id(0);
    if (gid >= n || names[gid] == NAMELESS)
        return;
    const uint own = names[gid] / 3;
    if (found[own] != state)
        return;
    double3 low = INFINITY, high = -INFINITY;
    for (uint i = 0; i < 3; ++i) {
        const double3 p = corner(vertices, faces, own, i);
        low = p < low ? p : low;
        high = p > high ? p : high;
    }
    uint ids[STACK], top = 1, near = 0;
    ids[0] = 0;
    found[own] = UNDECIDED;
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
            near += LEAF;
            if (near > most)
                return;
            for (uint j = first; j < min(first + LEAF, n); ++j)
                if (names[j] != NAMELESS && names[j] / 3 != own &&
                    meet(vertices, faces, corners, own, names[j] / 3, low, high)) {
                    found[own] = 1;
                    return;
                }
        }
    }
    found[own] = 0;
}

// ---- crossings of shells

// The side of a triangle's plane on which a point lies: 1, -1, or 0 if it is as near as rounding.
int side_of(const double3 *t, double3 p)
{
    const double3 a = t[1] - t[0], b = t[2] - t[0], c = p - t[0];
    const double3 n = cross_of(a, b);
    const double volume = product(n, c);
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
        side[i] = side_of(t, u[i]);
    for (uint i = 0; i < 3; ++i) {
        const uint j = (i + 1) % 3;
        if (side[i] * side[j] >= 0)
            continue;
        int least = 1, greatest = -1;
        for (uint k = 0; k < 3; ++k) {
            const double3 v[3] = {u[i], u[j], t[k]};
            const int around = side_of(v, t[(k + 1) % 3]);
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
