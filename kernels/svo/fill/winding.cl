// Winding numbers near holes: bounds for blocks of voxels, and numbers at voxels. Host side:
// voxtool/svo/fill/winding.py. Options: CODE=ulong, WIDE.

#include "svo/octree.h"
#include "svo/fill/crossings.h"
#include "svo/fill/winding.h"
#include "svo/morton.h"
#include "svo/overlap.h"
#include "spatial/angles.h"
#include "spatial/solid_angles.h"

#define STACK ((ARITY - 1) * MAX_LEVELS + 1)
#define SLACK 0x1p-30 // relative; above all rounding errors

// The box of the voxel centres of a block of 2^level voxels.
typedef struct {
    int3 low, high; // 1/256 voxel
} centres;

centres centres_of(ulong code, uint level)
{
    const int3 corner = convert_int3(morton_decode(code) << level);
    const centres c = {corner * VOXEL + HALF, (corner + (1 << level)) * VOXEL - HALF};
    return c;
}

// A point in the frame of a tree: (units - frame.xyz) frame.w, with units of 1/256 voxel.
double3 to_local(int3 units, double4 frame)
{
    return (convert_double3(units) - frame.xyz) * frame.w;
}

// The squared distance between two boxes.
double gap_between(double3 low, double3 high, double3 other_low, double3 other_high)
{
    const double3 after = other_low - high, before = low - other_high;
    double3 gap = after > before ? after : before;
    gap = gap > 0.0 ? gap : 0.0;
    return gap.x * gap.x + gap.y * gap.y + gap.z * gap.z;
}

// A walk through the nodes of a tree, over the children of each.
typedef struct {
    uint ids[STACK], top; // inner nodes that are still to be visited
    uint id, i, child;    // child i of node `id`, and its own number
} walk;

void start(walk *w)
{
    w->ids[0] = 0;
    w->top = 1;
    w->i = ARITY - 1;
}

// Steps to the next child; returns whether there is one.
bool next_child(walk *w)
{
    if (++w->i == ARITY) {
        if (w->top == 0)
            return false;
        w->id = w->ids[--w->top];
        w->i = 0;
    }
    w->child = ARITY * w->id + 1 + w->i;
    return true;
}

// Returns whether the child is an inner node, whose children are then visited later.
bool descend(walk *w, uint first_leaf)
{
    if (w->child < first_leaf)
        w->ids[w->top++] = w->child;
    return w->child < first_leaf;
}

void child_box(__global const float *nodes, const walk *w, double3 *low, double3 *high)
{
    __global const float *box = nodes + (size_t)w->id * (6 * ARITY) + w->i;
    *low = (double3)(box[0], box[ARITY], box[2 * ARITY]);
    *high = (double3)(box[3 * ARITY], box[4 * ARITY], box[5 * ARITY]);
}

// ---- over blocks

// A bound of the gradient of the winding number in a box, due to a boundary edge from a to b. By the
// law of Biot and Savart it is at most the sum of dl / (4 pi r^2) along the edge, and at most
// 1 / (2 pi r) for an edge of any length.
double steepness_of(double3 a, double3 b, double3 low, double3 high, double radius)
{
    const double3 e = b - a, way = 0.5 * (low + high) - a;
    const double ee = e.x * e.x + e.y * e.y + e.z * e.z;
    double t = (way.x * e.x + way.y * e.y + way.z * e.z) / (ee > 0x1p-300 ? ee : 1.0);
    t = t > 0 ? t < 1 ? t : 1 : 0;
    const double3 rest = way - t * e;
    const double apart = sqrt(rest.x * rest.x + rest.y * rest.y + rest.z * rest.z) - radius;
    const double gap = sqrt(gap_between(low, high, a < b ? a : b, a < b ? b : a));
    const double r = apart > gap ? apart : gap;
    const double length = sqrt(ee);
    if (!(r > 0))
        return INFINITY;
    return (length < 2 * r ? length / r : 2) / (4 * PI * r);
}

// The same, due to triangles of this total area at a distance from the box: each is a dipole.
double steepness_of_area(double area, double squared_gap)
{
    return area / (2 * PI * squared_gap * sqrt(squared_gap));
}

// False only if a triangle and a box are disjoint, by a separating axis test with tolerance SLACK:
// the axes of the box, the normal of the triangle, and the cross products of their edges.
bool may_meet(const triangle *t, centres c)
{
    int3 low, high;
    find_bounds(t, &low, &high);
    if (any(low > c.high) || any(high < c.low))
        return false;
    const double3 half_size = 0.5 * convert_double3(c.high - c.low);
    const double size[3] = {half_size.x, half_size.y, half_size.z};
    double v[3][3]; // from the middle
    for (uint i = 0; i < 3; ++i) {
        const double3 way = convert_double3(t->v[i] - c.low) - half_size;
        v[i][0] = way.x;
        v[i][1] = way.y;
        v[i][2] = way.z;
    }
    for (uint i = 0; i < 3; ++i) {
        for (uint p = 0; p < 3; ++p) {
            const uint q = (p + 1) % 3, next = (i + 1) % 3;
            const double mp = v[i][q] - v[next][q], mq = v[next][p] - v[i][p];
            const double on_edge = mp * v[i][p] + mq * v[i][q];
            const double beyond = mp * v[(i + 2) % 3][p] + mq * v[(i + 2) % 3][q];
            const double reach = (mp < 0 ? -mp : mp) * size[p] + (mq < 0 ? -mq : mq) * size[q];
            const double least = on_edge < beyond ? on_edge : beyond;
            const double most = on_edge < beyond ? beyond : on_edge;
            const double slack = SLACK * (reach + most - least);
            if (least > reach + slack || most < -reach - slack)
                return false;
        }
    }
    double height = 0, reach = 0, slack = 0;
    for (uint p = 0; p < 3; ++p) {
        const uint q = (p + 1) % 3, r = (p + 2) % 3;
        const double n = (v[1][q] - v[0][q]) * (v[2][r] - v[0][r]) -
                         (v[1][r] - v[0][r]) * (v[2][q] - v[0][q]);
        const double m = n < 0 ? -n : n, part = n * v[0][p];
        height += part;
        reach += m * size[p];
        slack += part < 0 ? -part : part;
    }
    return (height < 0 ? -height : height) <= reach + SLACK * (reach + slack);
}

// Parameter groups. BLOCKS: blocks of 2^level voxels, by Morton codes. HOLES: the tree over the holes;
// the areas of its nodes and of the caps; hole h's loop, the points first[h] to first[h + 1], in the
// frame. CAPS: the caps, and the rest of the tree over them.
#define BLOCKS __global const ulong *blocks, const uint n, const uint level, const double4 frame
#define HOLES                                                                                          \
    __global const float *hole_nodes, __global const uint *hole_names, const uint hole_count,          \
        const uint hole_first_leaf, __global const double *areas, __global const double *hole_areas,   \
        __global const uint *first, __global const double *loops
#define CAPS                                                                                           \
    __global const uint *cap_names, const uint cap_count, const uint cap_first_leaf,                   \
        __global const int *vertices, __global const int *faces, const uint first_cap

// variations[i] = a bound of the difference between the winding number of the caps at the voxels of
// block i and in its middle; infinite if it is `limit` or more. A hole contributes the lower one of
// two bounds: by the area of its cap, and by its edges.
__kernel void bound_variation(BLOCKS, HOLES, const double limit, __global double *variations)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const centres c = centres_of(blocks[gid], level);
    const double3 low = to_local(c.low, frame), high = to_local(c.high, frame), size = high - low;
    const double radius = 0.5 * sqrt(size.x * size.x + size.y * size.y + size.z * size.z);
    walk w;
    start(&w);
    double steepness = 0;
    while (steepness * radius < limit && next_child(&w)) {
        double3 box_low, box_high;
        child_box(hole_nodes, &w, &box_low, &box_high);
        if (!(box_low.x <= box_high.x))
            continue; // no child
        const double3 box = box_high - box_low;
        const double gap = gap_between(low, high, box_low, box_high);
        if (gap > box.x * box.x + box.y * box.y + box.z * box.z) {
            steepness += steepness_of_area(areas[w.child], gap);
            continue;
        }
        if (descend(&w, hole_first_leaf))
            continue;
        const uint leaf = (w.child - hole_first_leaf) * LEAF;
        for (uint k = leaf; k < min(leaf + LEAF, hole_count); ++k) {
            const uint hole = hole_names[k] / 3;
            double sum = 0;
            double3 a = vload3(first[hole + 1] - 1, loops);
            for (uint at = first[hole]; at < first[hole + 1]; ++at) {
                const double3 b = vload3(at, loops);
                sum += steepness_of(a, b, low, high, radius);
                a = b;
            }
            const double by_area = steepness_of_area(hole_areas[hole], gap);
            steepness += by_area < sum ? by_area : sum;
        }
    }
    const double variation = steepness * radius;
    variations[gid] = variation < limit ? variation : INFINITY;
}

// variations[i] = infinite if a cap may pass between the voxels of block i.
__kernel void exclude_caps(BLOCKS, CAPS, __global const float *cap_nodes,
                           __global double *variations)
{
    const uint gid = get_global_id(0);
    if (gid >= n || variations[gid] == INFINITY)
        return;
    const centres c = centres_of(blocks[gid], level);
    const double3 low = to_local(c.low, frame), high = to_local(c.high, frame);
    walk w;
    start(&w);
    while (next_child(&w)) {
        double3 box_low, box_high;
        child_box(cap_nodes, &w, &box_low, &box_high);
        if (any(box_low > high) || any(box_high < low) || descend(&w, cap_first_leaf))
            continue;
        const uint leaf = (w.child - cap_first_leaf) * LEAF;
        for (uint k = leaf; k < min(leaf + LEAF, cap_count); ++k) {
            const triangle t = fetch_triangle(vertices, faces, first_cap + cap_names[k] / 3);
            if (may_meet(&t, c)) {
                variations[gid] = INFINITY;
                return;
            }
        }
    }
}

// crowded[i] = 1 if more than `most` leaves of the caps are near every voxel of block i, as
// subtract_caps has it.
__kernel void find_crowds(BLOCKS, const uint cap_first_leaf, __global const double *moments,
                          const uint most, __global uchar *crowded)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const centres c = centres_of(blocks[gid], level);
    const double3 low = to_local(c.low, frame), size = to_local(c.high, frame) - low;
    const double3 p = low + 0.5 * size;
    const double radius = 0.5 * sqrt(size.x * size.x + size.y * size.y + size.z * size.z);
    uint near = 0;
    walk w;
    start(&w);
    while (near <= most && next_child(&w)) {
        __global const double *m = moments + (size_t)w.id * (MOMENTS * ARITY) + w.i;
        const double x = m[0] - p.x, y = m[ARITY] - p.y, z = m[2 * ARITY] - p.z;
        const double reach = m[3 * ARITY] > 0 ? sqrt(m[3 * ARITY]) * (1 - SLACK) - radius : 0;
        const bool within = reach > 0 && x * x + y * y + z * z < reach * reach;
        near += within && !descend(&w, cap_first_leaf);
    }
    crowded[gid] = near > most;
}

// ---- at voxels

// The sum of the crossings of a row up to a voxel: +1 where the row enters, -1 where it leaves.
int number_before(__global const ulong *crossings, uint n, uint x_bits, ulong row, int x)
{
    uint low = 0, high = n; // the first crossing of the row
    while (low < high) {
        const uint middle = low + (high - low) / 2;
        if (crossings[middle] >> x_bits < row)
            low = middle + 1;
        else
            high = middle;
    }
    const ulong end = (row << x_bits) + ((ulong)(x + 2) << 2);
    int number = 0;
    for (; low < n && crossings[low] < end; ++low)
        number += crossings[low] & ENTERS ? 1 : -1;
    return number;
}

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
__kernel void number_voxels(__global const ulong *voxels, const uint n, const int3 shape,
                            __global const ulong *crossings, const uint count, const uint x_bits,
                            __global double *numbers)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 voxel = convert_int3(morton_decode(voxels[gid]));
    const ulong row = (ulong)voxel.z * shape.y + voxel.y;
    numbers[gid] = any(voxel >= shape)
                       ? BEYOND_GRID
                       : number_before(crossings, count, x_bits, row, voxel.x);
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
    const double4 halves = angles.lo + angles.hi;
    const double2 quarters = halves.lo + halves.hi;
    numbers[gid] = numbers[gid] - (quarters.x + quarters.y) / (4 * PI) - near;
}

// bricks[places[i]] = masks[i].
__kernel void place_bricks(__global const ulong *masks, __global const uint *places, const uint n,
                           __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        bricks[places[gid]] = masks[gid];
}
