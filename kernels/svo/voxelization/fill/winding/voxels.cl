// Winding numbers near holes, at voxels. Host side: voxtool/svo/voxelization/fill/winding.py. Options: CODE=ulong,
// WIDE.

#include "svo/voxelization/fill/winding/near.h"
#include "spatial/angles.h"
#include "spatial/solid_angles.h"

#define BARELY 0x1p-60 // a negligible angle, which carries a sign
#define ROUNDING 0x1p-44 // relative error of the sum in strip
#define CLOSE 0x1p-30 // relative; below it, triangle_vectors has lost digits to cancellation

// The strip that an edge from a to b sweeps towards +x subtends, from a voxel's shifted centre, twice
// the angle of the vector (x, y). *side is the side of the edge's projection on which the centre
// lies, decided by integers. a and b are relative to the centre; a_length and b_length are |a|, |b|.
void strip(int3 a, int3 b, double a_length, double b_length, double *x, double *y, int *side)
{
    const long turn = (long)a.y * b.z - (long)a.z * b.y;
    *side = shift_sign(turn, (long)a.z - b.z, (long)b.y - a.y);
    *x = 1;
    *y = *side * BARELY;
    if (*side == 0)
        return; // the edge is parallel to x
    const long along = (long)a.y * b.y + (long)a.z * b.z;
    if (a.y == 0 && a.z == 0) { // unless a is ahead, the shift gives its direction
        if (a.x <= 0) {
            *x = -(double)b.y;
            *y = b.z != 0 ? -(double)b.z : *y;
        }
    } else if (b.y == 0 && b.z == 0) {
        if (b.x <= 0) {
            *x = -(double)a.y;
            *y = a.z != 0 ? (double)a.z : *y;
        }
    } else {
        const double aa = (double)((long)a.y * a.y + (long)a.z * a.z);
        const double bb = (double)((long)b.y * b.y + (long)b.z * b.z);
        const double a_ahead = a.x > 0 ? a_length + a.x : aa / (a_length - a.x);
        const double b_ahead = b.x > 0 ? b_length + b.x : bb / (b_length - b.x);
        const double sum = (double)along + a_ahead * b_ahead;
        if (turn != 0) {
            *x = sum;
            *y = (double)turn;
        } else { // -1 if the centre is behind the edge or on it, 1 if in front
            *x = sum <= -ROUNDING * (double)along ? -1 : 1;
        }
    }
}

double length_of(int3 v)
{
    const double3 d = convert_double3(v);
    return sqrt(d.x * d.x + d.y * d.y + d.z * d.z);
}

// The winding number of a triangle about a voxel's shifted centre. The triangle and the strips that
// its edges sweep towards +x form a closed surface, whose winding number is the crossing of the row
// before the centre; the winding numbers of the strips are subtracted from it.
double number_of(const triangle *t, int3 centre)
{
    const int3 a = t->v[0] - centre, b = t->v[1] - centre, c = t->v[2] - centre;
    const double lengths[3] = {length_of(a), length_of(b), length_of(c)};
    double x[3], y[3];
    int side[3];
    strip(a, b, lengths[0], lengths[1], x, y, side);
    strip(b, c, lengths[1], lengths[2], x + 1, y + 1, side + 1);
    strip(c, a, lengths[2], lengths[0], x + 2, y + 2, side + 2);
    const double4 angle = angle_of((double4)(y[0], y[1], y[2], 0), (double4)(x[0], x[1], x[2], 1));
    int crossing = 0;
    if (side[0] == side[1] && side[1] == side[2] && side[0] != 0) {
        const long3 n = cross_of(b - a, c - a);
        const bool ahead = min(min(a.x, b.x), c.x) > 0, behind = max(max(a.x, b.x), c.x) <= 0;
        bool before = behind;
        if (!ahead && !behind) {
            const wide height = wide_dot(n.x, n.y, n.z, -(long)a.x, -(long)a.y, -(long)a.z);
            before = !is_negative(n.x < 0 ? wide_negative(height) : height);
        }
        crossing = before ? -side[0] : 0;
    }
    return crossing + (angle.x + angle.y + angle.z) / (2 * PI);
}

// numbers[i] = the sum of the crossings of a row before the shifted centre of voxel voxels[i];
// BEYOND_GRID for voxels beyond the grid.
__kernel void number_voxels(__global const ulong *voxels, const uint n, CROSSINGS,
                            __global double *numbers)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 voxel = convert_int3(morton_decode(voxels[gid]));
    numbers[gid] = BEYOND_GRID;
    if (any(voxel >= shape))
        return;
    uint at = first_crossing(shape, crossings, count, x_bits, voxel.y, voxel.z);
    numbers[gid] = number_until(shape, crossings, count, x_bits, voxel.x, voxel.y, voxel.z, &at);
}

// Subtract the winding number of the caps about the shifted centres of voxels. Near triangles are
// evaluated one by one, distant ones through the moments of the tree. Where more than `most` leaves
// are near, nothing is subtracted, and *crowds is set.
__kernel void subtract_caps(__global const ulong *voxels, const uint n, const double4 frame,
                            CAPS, __global const double *cap_leaves,
                            __global const double *moments, const uint most,
                            volatile __global uint *crowds, __global double *numbers)
{
    const uint gid = get_global_id(0);
    if (gid >= n || numbers[gid] == BEYOND_GRID)
        return;
    const int3 centre = convert_int3(morton_decode(voxels[gid])) * VOXEL + HALF;
    const double3 p = to_local(centre, frame);
    uint leaves = 0;
    walk w;
    start(&w);
    double8 angles = 0;
    double near = 0;
    long is_far[ARITY];
    while (next_child(&w)) {
        if (w.i == 0) {
            long8 far;
            angles += distant_angles(moments + (size_t)w.id * (MOMENTS * ARITY), p, &far);
            vstore8(far, 0, is_far);
        }
        if (is_far[w.i] || descend(&w, cap_first_leaf))
            continue;
        if (++leaves > most) {
            atomic_or(crowds, 1u);
            return;
        }
        const uint leaf = w.child - cap_first_leaf;
        double4 x, y, size;
        triangle_vectors(cap_leaves + (size_t)leaf * (FIELDS * LEAF), p, &x, &y, &size);
        const long4 close = x < CLOSE * size && (y < 0.0 ? -y : y) < CLOSE * size;
        double angle[LEAF];
        long is_close[LEAF];
        vstore4(angle_of(y, x), 0, angle);
        vstore4(close, 0, is_close);
        for (uint k = 0; k < LEAF && leaf * LEAF + k < cap_count; ++k) {
            if (!is_close[k]) {
                near += angle[k] / (2 * PI);
                continue;
            }
            const uint face = first_cap + cap_names[leaf * LEAF + k] / 3;
            const triangle t = fetch_triangle(vertices, faces, face);
            near += number_of(&t, centre);
        }
    }
    numbers[gid] = numbers[gid] - total(angles) / (4 * PI) - near;
}
