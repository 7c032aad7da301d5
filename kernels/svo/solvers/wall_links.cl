// Where links of a lattice, from the centres of voxels to those of their neighbours, first meet a mesh.
// Host side: voxtool/svo/solvers/wall_links.py. Option: WIDE, for triangles of more than 4096 voxels.

#include "spatial/bvh.h"
#include "svo/octree/octree.h"
#include "svo/voxelization/overlap.h"
#include "svo/solvers/wall_links.h"

#define STACK ((ARITY - 1) * MAX_LEVELS + 1)

#ifdef WIDE
double to_double(wide a)
{
    const wide m = is_negative(a) ? wide_negative(a) : a;
    const double magnitude = (double)m.high * 0x1p64 + (double)m.low;
    return is_negative(a) ? -magnitude : magnitude;
}
// By products: Oclgrind 21.10 does not support the shift of two words that one of 128 bits becomes.
wide times_voxel(wide a)
{
    const wide w = {(long)((ulong)a.high * VOXEL + mul_hi(a.low, (ulong)VOXEL)), a.low * VOXEL};
    return w;
}
#else
double to_double(wide a) { return (double)a; }
wide times_voxel(wide a) { return a * VOXEL; }
#endif

// a . step, where the components of the step are -1, 0 and 1.
wide along(long3 a, int3 step) { return wide_dot(a.x, a.y, a.z, step.x, step.y, step.z); }

bool is_zero(long3 a) { return a.x == 0 && a.y == 0 && a.z == 0; }

long component(long3 a, uint k) { return k == 0 ? a.x : k == 1 ? a.y : a.z; }

// The place, from 0 to 1, at which the link from 0 to a step of a voxel first meets the edge from a to
// b; INFINITY if it does not.
double place_on_edge(int3 a, int3 b, int3 step)
{
    const int3 edge = b - a;
    const long3 w = cross_of(step, edge), f = cross_of(a, step);
    if (is_zero(w)) { // they are parallel
        if (!is_zero(f))
            return INFINITY;
        const int3 ends = step.x != 0   ? (int3)(a.x, b.x, step.x)
                          : step.y != 0 ? (int3)(a.y, b.y, step.y)
                                        : (int3)(a.z, b.z, step.z);
        const int one = ends.x * ends.z, other = ends.y * ends.z;
        const int low = min(one, other), high = max(one, other);
        return high < 0 || low > VOXEL ? INFINITY : (double)max(low, 0) / VOXEL;
    }
    const wide apart = wide_dot(w.x, w.y, w.z, a.x, a.y, a.z);
    if (is_negative(apart) || is_positive(apart))
        return INFINITY; // they pass each other
    const uint k = w.x != 0 ? 0 : w.y != 0 ? 1 : 2;
    const long3 m = cross_of(a, edge);
    const long sign = component(w, k) < 0 ? -1 : 1, of = sign * component(w, k);
    const long of_edge = sign * component(f, k), of_link = sign * component(m, k);
    if (of_edge < 0 || of_edge > of || of_link < 0 || of_link > of * VOXEL)
        return INFINITY;
    return (double)of_link / (double)(of * VOXEL);
}

// The place, from 0 to 1, at which the link from 0 to a step of a voxel first meets a triangle of
// these corners and normal; ab, bc and ca are the cross products of its corners, and `out` that of the
// normal and a corner. INFINITY if it does not.
double place_on(const int3 *v, long3 n, wide out, long3 ab, long3 bc, long3 ca, int3 step)
{
    const wide slope = along(n, step);
    const bool down = is_negative(slope);
    if (!down && !is_positive(slope)) { // parallel to the plane
        if (is_negative(out) || is_positive(out))
            return INFINITY;
        if (!is_zero(n)) { // 0 lies in the plane: in the triangle?
            const uint k = n.x != 0 ? 0 : n.y != 0 ? 1 : 2;
            const long sign = component(n, k) < 0 ? -1 : 1;
            if (sign * component(ab, k) >= 0 && sign * component(bc, k) >= 0 &&
                sign * component(ca, k) >= 0)
                return 0;
        }
        return fmin(fmin(place_on_edge(v[0], v[1], step), place_on_edge(v[1], v[2], step)),
                    place_on_edge(v[2], v[0], step));
    }
    const long3 areas[3] = {ab, bc, ca};
    for (uint i = 0; i < 3; ++i) {
        const wide side = along(areas[i], step);
        if (down ? is_positive(side) : is_negative(side))
            return INFINITY;
    }
    const wide height = down ? wide_negative(out) : out;
    const wide whole = times_voxel(down ? wide_negative(slope) : slope);
    if (is_negative(height) || is_negative(wide_sum(whole, wide_negative(height))))
        return INFINITY;
    return to_double(height) / to_double(whole);
}

// The children of a node that may meet a box.
long8 near_box(__global const float *nodes, uint node, double3 centre, double half_side)
{
    __global const float *box = nodes + (size_t)node * (6 * ARITY);
    const double middle[3] = {centre.x, centre.y, centre.z};
    long8 found = -1;
    for (uint i = 0; i < 3; ++i) {
        const double8 low = convert_double8(vload8(i, box)), high = convert_double8(vload8(3 + i, box));
        found &= low <= high; // a missing child has none
        found &= (low <= middle[i] + half_side) & (high >= middle[i] - half_side);
    }
    return found;
}

// places[links i + k] = the place of the first point of the mesh on link k of voxel i, if bit k of
// wanted[i] is set; INFINITY if there is none. Boxes are in local coordinates: scale (units - centre).
__kernel void measure_links(const uint n, __global const int *voxels, __global const uint *wanted,
                            const uint links, __global const int *vertices, __global const int *faces,
                            __global const uint *face_of, const uint triangles,
                            __global const float *nodes, const uint first_leaf, const double x,
                            const double y, const double z, const double scale,
                            __global double *places)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 own = vload3(gid, voxels) * VOXEL + HALF;
    const double3 centre = (convert_double3(own) - (double3)(x, y, z)) * scale;
    const uint asked = wanted[gid];
    double best[MOST_LINKS];
    for (uint k = 0; k < MOST_LINKS; ++k)
        best[k] = INFINITY;
    uint ids[STACK], top = 1;
    ids[0] = 0;
    while (top > 0) {
        const uint id = ids[--top];
        long hit[ARITY];
        vstore8(near_box(nodes, id, centre, VOXEL * scale), 0, hit);
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
                triangle t = fetch_triangle(vertices, faces, face_of[slot]);
                for (uint k = 0; k < 3; ++k)
                    t.v[k] -= own;
                int3 low, high;
                find_bounds(&t, &low, &high);
                if (any(low > VOXEL) || any(high < -VOXEL))
                    continue;
                const long3 normal = cross_of(t.v[1] - t.v[0], t.v[2] - t.v[0]);
                const wide out = wide_dot(normal.x, normal.y, normal.z, t.v[0].x, t.v[0].y, t.v[0].z);
                const long3 ab = cross_of(t.v[0], t.v[1]), bc = cross_of(t.v[1], t.v[2]),
                            ca = cross_of(t.v[2], t.v[0]);
                for (uint k = 1; k < links; ++k)
                    if (asked >> k & 1) {
                        const int3 step = (int3)(STEPS[k][0], STEPS[k][1], STEPS[k][2]);
                        best[k] = fmin(best[k], place_on(t.v, normal, out, ab, bc, ca, step));
                    }
            }
        }
    }
    for (uint k = 0; k < links; ++k)
        places[(size_t)gid * links + k] = best[k];
}
