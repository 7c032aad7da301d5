// Winding numbers near holes: bounds for blocks of voxels, and numbers at voxels. Host side:
// voxtool/svo/fill/winding.py. Options: CODE=ulong, WIDE.

#include "svo/octree.h"
#include "svo/fill/crossings.h"
#include "svo/fill/winding.h"
#include "svo/morton.h"
#include "svo/overlap.h"
#include "spatial/angles.h"
#include "spatial/solid_angles.h"
#include "svo/fill/bricks.h"

#define STACK ((ARITY - 1) * MAX_LEVELS + 1)
#define SLACK 0x1p-30 // relative; above all rounding errors
#define MINOR 0x1p-6 // over the diagonal in voxels: a part of `rest` for which edges are not examined

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

// The centre of the voxel beyond the middle of a block, about which its winding number is expanded.
int3 middle_of(centres c) { return ((c.low + c.high) >> 1) + HALF; }

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

// The winding number of the caps about points d from a point: its value there, plus slope . d, plus
// bend[0 .. 2] . d^2 and bend[3 .. 5] . (yz, xz, xy), within `rest` as long as |d| is at most `radius`.
typedef struct {
    double slope[3], bend[6], rest, radius;
} expansion;

double squared(double3 v) { return v.x * v.x + v.y * v.y + v.z * v.z; }

double total(double8 v)
{
    const double4 halves = v.lo + v.hi;
    const double2 quarters = halves.lo + halves.hi;
    return quarters.x + quarters.y;
}

// Add the parts of eight boundary edges from a to b; `edges` holds the x, y, z of a, then those of b, and
// p is the point. By the law of Biot and Savart, the gradient is the integral of dl x r / (4 pi r^3)
// = b x a s / (4 pi). What it changes by with d, along d, is (b x a . d) (grad s . d). The terms of
// order k are at most dl radius^k / (4 pi r^(k + 1)).
void expand_edges(expansion *e, __global const double *edges, double3 p)
{
    const double8 ax = vload8(0, edges) - p.x, ay = vload8(1, edges) - p.y, az = vload8(2, edges) - p.z;
    const double8 bx = vload8(3, edges) - p.x, by = vload8(4, edges) - p.y, bz = vload8(5, edges) - p.z;
    const double8 x = bx - ax, y = by - ay, z = bz - az;
    const double8 ww = x * x + y * y + z * z, ab = ax * bx + ay * by + az * bz;
    double8 t = -(ax * x + ay * y + az * z) / (ww > 0x1p-300 ? ww : 1.0);
    t = t > 0.0 ? t < 1.0 ? t : 1.0 : 0.0;
    const double8 fx = ax + t * x, fy = ay + t * y, fz = az + t * z;
    const double8 distance = sqrt(fx * fx + fy * fy + fz * fz), ratio = e->radius / distance;
    if (!all(ratio < 1 - SLACK)) {
        e->rest = INFINITY;
        return;
    }
    const double8 length = sqrt(ww), spans = length < 2 * distance ? length / distance : 2.0;
    e->rest += total(spans * ratio * ratio * ratio / (1 - ratio)) / (4 * PI);
    const double8 cx = az * by - ay * bz, cy = ax * bz - az * bx, cz = ay * bx - ax * by;
    const double8 u = sqrt(ax * ax + ay * ay + az * az), v = sqrt(bx * bx + by * by + bz * bz), uv = u * v;
    const double8 cc = cx * cx + cy * cy + cz * cz;
    const double8 sum = ab < 0.0 ? cc / (uv - ab) : uv + ab; // no cancellation
    const double8 s = (u + v) / (uv * sum), both = uv + sum;
    // the gradient of s, from those of u, v and uv sum: -a / u, -b / v and the rest
    const double8 of_a = s * (v * both / u + uv) - 1 / u, of_b = s * (u * both / v + uv) - 1 / v;
    const double8 by_product = 1 / (uv * sum);
    const double8 gx = (of_a * ax + of_b * bx) * by_product, gy = (of_a * ay + of_b * by) * by_product,
                  gz = (of_a * az + of_b * bz) * by_product;
    e->slope[0] += total(s * cx), e->slope[1] += total(s * cy), e->slope[2] += total(s * cz);
    e->bend[0] += 0.5 * total(cx * gx), e->bend[1] += 0.5 * total(cy * gy), e->bend[2] += 0.5 * total(cz * gz);
    e->bend[3] += 0.5 * total(cy * gz + cz * gy);
    e->bend[4] += 0.5 * total(cx * gz + cz * gx);
    e->bend[5] += 0.5 * total(cx * gy + cy * gx);
}

// What triangles of this total area at a distance add to `rest`: each is a dipole.
double rest_of_area(const expansion *e, double area, double squared_gap)
{
    return e->radius * area / (2 * PI * squared_gap * sqrt(squared_gap));
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
// the areas of its nodes and of the caps; hole h's edges in the frame, the groups of eight from first[h]
// to first[h + 1]. CAPS: the caps, and the rest of the tree over them.
#define BLOCKS __global const ulong *blocks, const uint n, const uint level, const double4 frame
#define HOLES                                                                                          \
    __global const float *hole_nodes, __global const uint *hole_names, const uint hole_count,          \
        const uint hole_first_leaf, __global const double *areas, __global const double *hole_areas,   \
        __global const uint *first, __global const double *edges
#define CAPS                                                                                           \
    __global const uint *cap_names, const uint cap_count, const uint cap_first_leaf,                   \
        __global const int *vertices, __global const int *faces, const uint first_cap

// Expand the winding number of the caps in each block about the voxel beyond its middle: EXPANSION
// numbers, slope, bend and rest; the rest is infinite if it is `limit` or more. A hole counts by its
// edges, or adds to the rest by the area of its cap, if that is less.
__kernel void expand_blocks(BLOCKS, HOLES, const double limit, __global double *expansions)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const centres box = centres_of(blocks[gid], level);
    const double3 low = to_local(box.low, frame), high = to_local(box.high, frame);
    const double3 middle = to_local(middle_of(box), frame);
    expansion sum = {{0}, {0}, 0, sqrt(squared(middle - low))};
    walk w;
    start(&w);
    while (sum.rest < limit && next_child(&w)) {
        double3 box_low, box_high;
        child_box(hole_nodes, &w, &box_low, &box_high);
        if (!(box_low.x <= box_high.x))
            continue; // no child
        const double gap = gap_between(low, high, box_low, box_high);
        const double diagonal = sqrt(squared(box_high - box_low)), minor = MINOR * VOXEL * frame.w / diagonal;
        const double part = rest_of_area(&sum, areas[w.child], gap);
        if (part < minor) {
            sum.rest += part;
            continue;
        }
        if (descend(&w, hole_first_leaf))
            continue;
        const uint leaf = (w.child - hole_first_leaf) * LEAF;
        for (uint k = leaf; k < min(leaf + LEAF, hole_count); ++k) {
            const uint hole = hole_names[k] / 3;
            const double by_area = sum.rest + rest_of_area(&sum, hole_areas[hole], gap);
            expansion one = sum;
            for (uint at = first[hole]; at < first[hole + 1] && one.rest < limit; ++at)
                expand_edges(&one, edges + 48 * (size_t)at, middle);
            if (one.rest < by_area)
                sum = one;
            else
                sum.rest = by_area;
        }
    }
    __global double *to = expansions + (size_t)gid * EXPANSION;
    for (uint i = 0; i < 3; ++i)
        to[i] = sum.slope[i] / (4 * PI);
    for (uint i = 0; i < 6; ++i)
        to[3 + i] = sum.bend[i] / (4 * PI);
    to[9] = sum.rest < limit ? sum.rest : INFINITY;
}

// met[i] = 1 if a cap may pass between the voxels of block i.
__kernel void meet_caps(BLOCKS, CAPS, __global const float *cap_nodes, __global uchar *met)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    met[gid] = 0;
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
                met[gid] = 1;
                return;
            }
        }
    }
}

// crowded[i] = the number of voxels near which more than `most` leaves of the caps are, as subtract_caps
// has it: NONE of block i, ALL of them, or SOME if this is not certain.
__kernel void find_crowds(BLOCKS, const uint cap_first_leaf, __global const double *moments,
                          const uint most, __global uchar *crowded)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const centres c = centres_of(blocks[gid], level);
    const double3 low = to_local(c.low, frame), half_size = 0.5 * (to_local(c.high, frame) - low);
    const double3 p = low + half_size;
    const double radius = sqrt(squared(half_size));
    uint near_all = 0, near_any = 0;
    walk w;
    start(&w);
    while (near_all <= most && next_child(&w)) {
        __global const double *m = moments + (size_t)w.id * (MOMENTS * ARITY) + w.i;
        if (m[3 * ARITY] < 0)
            continue; // no child
        const double3 way = (double3)(m[0], m[ARITY], m[2 * ARITY]) - p;
        const double distance = sqrt(squared(way)), reach = sqrt(m[3 * ARITY]);
        if (distance > reach * (1 + SLACK) + radius || descend(&w, cap_first_leaf))
            continue;
        ++near_any;
        near_all += distance < reach * (1 - SLACK) - radius;
    }
    crowded[gid] = near_all > most ? ALL : near_any > most ? SOME : NONE;
}

// ---- at voxels

// Parameter group: the sorted crossings of the rows of the grid.
#define CROSSINGS                                                                                      \
    const int3 shape, __global const ulong *crossings, const uint count, const uint x_bits

// The first crossing of row (j, k), or of a later one.
uint first_crossing(CROSSINGS, int j, int k)
{
    const ulong row = (ulong)k * shape.y + j;
    uint low = 0, high = count;
    while (low < high) {
        const uint middle = low + (high - low) / 2;
        if (crossings[middle] >> x_bits < row)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

// Sum the crossings of a row up to voxel (i, j, k), from crossing *at on, which is moved to the first
// one beyond: +1 where the row enters, -1 where it leaves.
int number_until(CROSSINGS, int i, int j, int k, uint *at)
{
    const ulong end = (((ulong)k * shape.y + j) << x_bits) + ((ulong)(i + 2) << 2);
    int number = 0;
    for (; *at < count && crossings[*at] < end; ++*at)
        number += crossings[*at] & ENTERS ? 1 : -1;
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

// The sums of the caps over a brick; false if more than `most` leaves are near it.
bool sum_brick(brick_sums *sums, int3 low, double4 frame, CAPS, __global const double *moments,
               __global const double *cap_areas, double reach, uint most)
{
    const int3 first = low * VOXEL + HALF;
    const double3 p = to_local(low * VOXEL + 2 * VOXEL, frame);
    const double voxels = 1 / (VOXEL * frame.w);
    uint leaves = 0;
    walk w;
    start(&w);
    while (next_child(&w)) {
        __global const double *m = moments + (size_t)w.id * (MOMENTS * ARITY) + w.i;
        if (m[3 * ARITY] < 0)
            continue; // no child
        const double x = m[0] - p.x, y = m[ARITY] - p.y, z = m[2 * ARITY] - p.z;
        const double distance = sqrt(x * x + y * y + z * z) * voxels, far = sqrt(m[3 * ARITY]) * voxels;
        const double area = cap_areas[w.child] * voxels * voxels;
        if (is_linear(sums, distance, far, far / reach, area)) {
            sums->far += angles_at_corners(m, p, SPREAD / (float)voxels);
            continue;
        }
        if (descend(&w, cap_first_leaf))
            continue;
        if (++leaves > most)
            return false;
        const uint leaf = (w.child - cap_first_leaf) * LEAF;
        for (uint k = leaf; k < min(leaf + LEAF, cap_count); ++k) {
            const triangle t = fetch_triangle(vertices, faces, first_cap + cap_names[k] / 3);
            add_triangle(sums, &t, first);
        }
    }
    return true;
}

// For each brick: inside[i] = the voxels of winding number 1/2 or more; open[i] = those that are left to
// decide, because their number may be within `doubt` of 1/2, or more than `most` leaves of the caps are
// near the brick; same[i] = 1 if none is left, and those inside are those that N >= 1 gives.
__kernel void decide_bricks(__global const ulong *bricks, const uint n, const double4 frame, CROSSINGS,
                            CAPS, __global const double *moments, __global const double *cap_areas,
                            const double reach, const uint most, const double doubt,
                            __global ulong *inside, __global ulong *open, __global uchar *same)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 low = convert_int3(morton_decode(bricks[gid])) << BRICK_LEVEL;
    brick_sums sums = {0};
    const bool summed = sum_brick(&sums, low, frame, cap_names, cap_count, cap_first_leaf, vertices, faces,
                                  first_cap, moments, cap_areas, reach, most);
    float caps[16 * PER_BRICK], doubts[16 * PER_BRICK], far[8];
    for (uint g = 0; g < PER_BRICK; ++g) {
        vstore16(sums.near[g], g, caps);
        vstore16(sums.doubt[g], g, doubts);
    }
    vstore8(sums.far, 0, far);
    ulong in = 0, left = 0, enclosed = 0;
    for (uint row = 0; row < 16; ++row) {
        const int j = row & 3, k = row >> 2;
        const double y = j / (2 * SPREAD), z = k / (2 * SPREAD);
        const double begin = mix_of(mix_of(far[0], far[2], y), mix_of(far[4], far[6], y), z);
        const double end = mix_of(mix_of(far[1], far[3], y), mix_of(far[5], far[7], y), z);
        if (low.y + j >= shape.y || low.z + k >= shape.z)
            continue;
        uint at = first_crossing(shape, crossings, count, x_bits, low.y + j, low.z + k);
        int number = 0;
        for (int i = 0; i < 4 && low.x + i < shape.x; ++i) {
            number += number_until(shape, crossings, count, x_bits, low.x + i, low.y + j, low.z + k, &at);
            const uint place = voxel_place((uint3)(i, j, k));
            const double part = mix_of(begin, end, i / (2 * SPREAD)) / (4 * PI);
            const double over = number - caps[place] / (2 * PI) - part - 0.5;
            const double margin = doubt + sums.error + SINGLE * doubts[place];
            in |= (ulong)(over >= 0) << place;
            left |= (ulong)(!(over > margin || over < -margin) || !summed) << place;
            enclosed |= (ulong)(number >= 1) << place;
        }
    }
    inside[gid] = in;
    open[gid] = left;
    same[gid] = in == enclosed && !left;
}

// Decide the voxels of bricks as decide_bricks does, by the expansion of brick i's block, parents[i].
// `values` holds the winding number of the mesh about the voxel beyond the block's middle; that of its
// caps, negated, if `counted`: then the mesh crosses the block and no cap does, and the crossings
// before each voxel are added.
__kernel void decide_by_expansions(__global const ulong *bricks, const uint n, const double4 frame,
                                   CROSSINGS, __global const uint *parents,
                                   __global const ulong *blocks, __global const uchar *levels,
                                   __global const double *expansions, __global const double *values,
                                   __global const uchar *counted, __global ulong *inside,
                                   __global ulong *open, __global uchar *same)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint block = parents[gid];
    const int3 low = convert_int3(morton_decode(bricks[gid])) << BRICK_LEVEL;
    const int3 middle = middle_of(centres_of(blocks[block], levels[block]));
    const double3 d0 = convert_double3(low * VOXEL + HALF - middle) * frame.w;
    __global const double *e = expansions + (size_t)block * EXPANSION;
    const double margin = e[EXPANSION - 1], voxel = VOXEL * frame.w;
    ulong in = 0, left = 0, enclosed = 0;
    for (uint row = 0; row < 16; ++row) {
        const int j = row & 3, k = row >> 2;
        if (low.y + j >= shape.y || low.z + k >= shape.z)
            continue;
        const double y = d0.y + j * voxel, z = d0.z + k * voxel;
        uint at = first_crossing(shape, crossings, count, x_bits, low.y + j, low.z + k);
        int number = 0;
        for (int i = 0; i < 4 && low.x + i < shape.x; ++i) {
            const double x = d0.x + i * voxel;
            number += number_until(shape, crossings, count, x_bits, low.x + i, low.y + j, low.z + k, &at);
            const double change = x * (e[0] + e[3] * x + e[7] * z + e[8] * y) + y * (e[1] + e[4] * y + e[6] * z) +
                                  z * (e[2] + e[5] * z);
            const double over = values[block] - change + (counted[block] ? number : 0) - 0.5;
            const uint place = voxel_place((uint3)(i, j, k));
            in |= (ulong)(over >= 0) << place;
            left |= (ulong)!(over > margin || over < -margin) << place;
            enclosed |= (ulong)(number >= 1) << place;
        }
    }
    inside[gid] = in;
    open[gid] = left;
    same[gid] = in == enclosed && !left;
}

// bricks[places[i]] = masks[i].
__kernel void place_bricks(__global const ulong *masks, __global const uint *places, const uint n,
                           __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        bricks[places[gid]] = masks[gid];
}
