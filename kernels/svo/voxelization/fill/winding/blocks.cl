// Winding numbers near holes, bounds for blocks of voxels. Host side: voxtool/svo/voxelization/fill/winding.py.
// Options: CODE=ulong, WIDE.

#include "svo/voxelization/fill/winding/near.h"
#include "spatial/arctangent.h"

#define SLACK 0x1p-30 // relative; above all rounding errors
#define MINOR 0x1p-4 // over the diagonal in voxels: a part of `rest` for which edges are not examined

// The squared distance between two boxes.
double gap_between(double3 low, double3 high, double3 other_low, double3 other_high)
{
    const double3 after = other_low - high, before = low - other_high;
    double3 gap = after > before ? after : before;
    gap = gap > 0.0 ? gap : 0.0;
    return gap.x * gap.x + gap.y * gap.y + gap.z * gap.z;
}

void child_box(__global const float *nodes, const walk *w, double3 *low, double3 *high)
{
    __global const float *box = nodes + (size_t)w->id * (6 * ARITY) + w->i;
    *low = (double3)(box[0], box[ARITY], box[2 * ARITY]);
    *high = (double3)(box[3 * ARITY], box[4 * ARITY], box[5 * ARITY]);
}

// The winding number of the caps about points d from a point: its value there, plus slope . d, plus
// bend[0 .. 2] . d^2 and bend[3 .. 5] . (yz, xz, xy), plus twist . (x^3, y^3, z^3, x^2 y, x^2 z, y^2 x,
// y^2 z, z^2 x, z^2 y, xyz), within `rest` as long as |d| is at most `radius`.
typedef struct {
    double8 slope[3], bend[6], twist[10];
    double rest, radius;
} expansion;

double squared(double3 v) { return v.x * v.x + v.y * v.y + v.z * v.z; }

// Add the parts of eight boundary edges from a to b; `edges` holds the x, y, z of a, those of b, their
// lengths, and 1 over their squares, and p is the point. By the law of Biot and Savart, the gradient is
// the integral of dl x r / (4 pi r^3) = b x a s / (4 pi). Its change by d, along d, is
// (b x a . d) (grad s . d + d . H d / 2), where H has the second derivatives of s. The terms of order k
// are at most dl radius^k / (4 pi r^(k + 1)).
void expand_edges(expansion *e, __global const double *edges, double3 p)
{
    const double8 ax = vload8(0, edges) - p.x, ay = vload8(1, edges) - p.y, az = vload8(2, edges) - p.z;
    const double8 bx = vload8(3, edges) - p.x, by = vload8(4, edges) - p.y, bz = vload8(5, edges) - p.z;
    const double8 x = bx - ax, y = by - ay, z = bz - az;
    const double8 ab = ax * bx + ay * by + az * bz;
    double8 t = -(ax * x + ay * y + az * z) * vload8(7, edges);
    t = t > 0.0 ? t < 1.0 ? t : 1.0 : 0.0;
    const double8 fx = ax + t * x, fy = ay + t * y, fz = az + t * z;
    const double8 nearness = 1 / sqrt(fx * fx + fy * fy + fz * fz), ratio = e->radius * nearness;
    if (!all(ratio < 1 - SLACK)) {
        e->rest = INFINITY;
        return;
    }
    const double8 length = vload8(6, edges) * nearness, spans = length < 2.0 ? length : 2.0, square = ratio * ratio;
    e->rest += total(spans * square * square / (1 - ratio)) / (4 * PI);
    const double8 cx = az * by - ay * bz, cy = ax * bz - az * bx, cz = ay * bx - ax * by;
    const double8 u = sqrt(ax * ax + ay * ay + az * az), v = sqrt(bx * bx + by * by + bz * bz), uv = u * v;
    const double8 cc = cx * cx + cy * cy + cz * cz;
    const double8 sum = ab < 0.0 ? cc / (uv - ab) : uv + ab; // no cancellation
    const double8 by_u = 1 / u, by_v = 1 / v, by_product = 1 / (uv * sum);
    const double8 s = (u + v) * by_product, both = uv + sum, in_u = v * by_u, in_v = u * by_v;
    // the gradient of s, from those of u, v and p = uv sum: -a / u, -b / v and the rest
    const double8 p_a = both * in_u + uv, p_b = both * in_v + uv; // that of p is -p_a a - p_b b
    const double8 of_a = (s * p_a - by_u) * by_product, of_b = (s * p_b - by_v) * by_product;
    const double8 gx = of_a * ax + of_b * bx, gy = of_a * ay + of_b * by, gz = of_a * az + of_b * bz;
    // d . H d = dd d^2 + aa (a . d)^2 + 2 mixed (a . d) (b . d) + bb (b . d)^2, from p s = u + v: the
    // second derivatives of u are (d^2 - (a . d)^2 / u^2) / u, and those of the products follow
    const double8 dd = (by_u + by_v - s * (both * (in_u + in_v) + 2 * uv)) * by_product;
    const double8 by_uu = by_u * by_u, by_vv = by_v * by_v;
    const double8 aa = (2 * p_a * of_a - by_uu * by_u - s * in_u * (2 * in_u - both * by_uu + 2)) * by_product;
    const double8 bb = (2 * p_b * of_b - by_vv * by_v - s * in_v * (2 * in_v - both * by_vv + 2)) * by_product;
    const double8 mixed = (p_a * of_b + p_b * of_a - s * (2 + both * by_u * by_v + in_u + in_v)) * by_product;
    const double8 xa = aa * ax + mixed * bx, ya = aa * ay + mixed * by, za = aa * az + mixed * bz;
    const double8 xb = mixed * ax + bb * bx, yb = mixed * ay + bb * by, zb = mixed * az + bb * bz;
    const double8 xx = dd + xa * ax + xb * bx, yy = dd + ya * ay + yb * by, zz = dd + za * az + zb * bz;
    const double8 yz = 2 * (ya * az + yb * bz), xz = 2 * (xa * az + xb * bz), xy = 2 * (xa * ay + xb * by);
    e->slope[0] += s * cx, e->slope[1] += s * cy, e->slope[2] += s * cz;
    e->bend[0] += cx * gx, e->bend[1] += cy * gy, e->bend[2] += cz * gz;
    e->bend[3] += cy * gz + cz * gy;
    e->bend[4] += cx * gz + cz * gx;
    e->bend[5] += cx * gy + cy * gx;
    e->twist[0] += cx * xx, e->twist[1] += cy * yy, e->twist[2] += cz * zz;
    e->twist[3] += cx * xy + cy * xx, e->twist[4] += cx * xz + cz * xx;
    e->twist[5] += cy * xy + cx * yy, e->twist[6] += cy * yz + cz * yy;
    e->twist[7] += cz * xz + cx * zz, e->twist[8] += cz * yz + cy * zz;
    e->twist[9] += cx * yz + cy * xz + cz * xy;
}

// The amount that triangles of this total area at a distance add to `rest`: each is a dipole.
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
// to first[h + 1].
#define BLOCKS __global const ulong *blocks, const uint n, const uint level, const double4 frame
#define HOLES                                                                                          \
    __global const float *hole_nodes, __global const uint *hole_names, const uint hole_count,          \
        const uint hole_first_leaf, __global const double *areas, __global const double *hole_areas,   \
        __global const uint *first, __global const double *edges

// Expand the winding number of the caps in each block about the voxel beyond its middle: EXPANSION
// numbers, slope, bend, twist and rest; the rest is infinite if it is `limit` or more. A hole counts by its
// edges, or adds to the rest by the area of its cap, if that is less.
__kernel void expand_blocks(BLOCKS, HOLES, const double limit, __global double *expansions)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const centres box = centres_of(blocks[gid], level);
    const double3 low = to_local(box.low, frame), high = to_local(box.high, frame);
    const double3 middle = to_local(middle_of(box), frame);
    expansion sum = {{0}, {0}, {0}, 0, sqrt(squared(middle - low))};
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
                expand_edges(&one, edges + 64 * (size_t)at, middle);
            if (one.rest < by_area)
                sum = one;
            else
                sum.rest = by_area;
        }
    }
    __global double *to = expansions + (size_t)gid * EXPANSION;
    for (uint i = 0; i < 3; ++i)
        to[i] = total(sum.slope[i]) / (4 * PI);
    for (uint i = 0; i < 6; ++i)
        to[3 + i] = total(sum.bend[i]) / (8 * PI);
    for (uint i = 0; i < 10; ++i)
        to[9 + i] = total(sum.twist[i]) / (24 * PI);
    to[EXPANSION - 1] = sum.rest < limit ? sum.rest : INFINITY;
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
