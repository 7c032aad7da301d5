// The winding number of a mesh [Barill 2018]. Host side: voxtool/spatial/winding_number.py.

#include "spatial/angles.h"
#include "spatial/moments.h"
#include "spatial/solid_angles.h"
#include "spatial/twofold.h"

#define STACK ((ARITY - 1) * MAX_LEVELS + 1)

// The centre of a child's box; returns half of the diagonal.
double box_middle(__global const float *nodes, uint node, uint child, double *middle)
{
    __global const float *box = nodes + (size_t)node * (6 * ARITY) + child;
    double side[3];
    for (uint i = 0; i < 3; ++i) {
        const double low = box[i * ARITY], high = box[(3 + i) * ARITY];
        middle[i] = 0.5 * (low + high);
        side[i] = 0.5 * (high - low);
    }
    return length_of(side);
}

// The MOMENTS of a child, ARITY apart.
__global double *child_moments(__global double *all, uint node, uint child)
{
    return all + (size_t)node * (MOMENTS * ARITY) + child;
}

void store_moments(__global double *to, const double *centre, double reach, const moments *m)
{
    for (uint i = 0; i < 3; ++i)
        to[i * ARITY] = centre[i];
    to[3 * ARITY] = reach;
    for (uint i = 0; i < 3; ++i)
        to[(4 + i) * ARITY] = m->one[i];
    for (uint i = 0; i < 6; ++i)
        to[(7 + i) * ARITY] = m->two[i];
    for (uint i = 0; i < 10; ++i)
        to[(13 + i) * ARITY] = m->three[i];
}

// A missing child: zero moments, far from every point.
void store_nothing(__global double *to)
{
    for (uint i = 0; i < MOMENTS; ++i)
        to[i * ARITY] = i == 3 ? -1.0 : 0.0;
}

// The moments of the leaves over `count` triangles, stored in the nodes from `first` on.
__kernel void leaf_moments(__global const double *leaves, const uint count, __global const float *nodes,
                           const uint first, const double far, __global double *all)
{
    const uint gid = get_global_id(0), used = (count + LEAF - 1) / LEAF;
    if (gid >= (used + ARITY - 1) / ARITY * ARITY)
        return;
    const uint node = first + gid / ARITY, child = gid % ARITY;
    if (gid >= used) {
        store_nothing(child_moments(all, node, child));
        return;
    }
    double centre[3], radius = 0;
    box_middle(nodes, node, child, centre);
    moments m;
    clear(&m);
    for (uint k = 0; k < LEAF && gid * LEAF + k < count; ++k) {
        __global const double *leaf = leaves + (size_t)gid * (FIELDS * LEAF) + k;
        double e[3], g[3], v[3][3], sum[3], quadric[6] = {0, 0, 0, 0, 0, 0};
        for (uint i = 0; i < 3; ++i) {
            e[i] = leaf[(3 + i) * LEAF];
            g[i] = leaf[(6 + i) * LEAF];
            v[0][i] = leaf[i * LEAF] - centre[i];
            v[1][i] = v[0][i] + e[i];
            v[2][i] = v[0][i] + leaf[9 * LEAF] * e[i] + g[i];
            sum[i] = v[0][i] + v[1][i] + v[2][i];
        }
        const double area[3] = {0.5 * (e[1] * g[2] - e[2] * g[1]), 0.5 * (e[2] * g[0] - e[0] * g[2]),
                                0.5 * (e[0] * g[1] - e[1] * g[0])};
        for (uint i = 0; i < 3; ++i) {
            m.one[i] += area[i];
            const double distance = length_of(v[i]);
            radius = distance > radius ? distance : radius;
            add_two(quadric, 1.0 / 12, v[i], v[i]);
        }
        add_two(quadric, 1.0 / 12, sum, sum);
        add_two(m.two, 1.0 / 3, sum, area);
        add_three(m.three, 1, area, quadric);
    }
    make_harmonic(&m);
    store_moments(child_moments(all, node, child), centre, far * far * radius * radius, &m);
}

// The moments of the `count` nodes from `below` on, stored in the nodes from `first` on, one level
// above.
__kernel void node_moments(const uint below, const uint count, __global const float *nodes,
                           const uint first, const double far, __global double *all)
{
    const uint gid = get_global_id(0);
    if (gid >= (count + ARITY - 1) / ARITY * ARITY)
        return;
    const uint node = first + gid / ARITY, child = gid % ARITY;
    if (gid >= count) {
        store_nothing(child_moments(all, node, child));
        return;
    }
    double centre[3], radius = 0;
    const double diagonal = box_middle(nodes, node, child, centre);
    moments m;
    clear(&m);
    for (uint k = 0; k < ARITY; ++k) {
        __global const double *from = child_moments(all, below + gid, k);
        if (from[3 * ARITY] < 0)
            continue;
        double s[3], one[3], two[6], three[10], square[6] = {0, 0, 0, 0, 0, 0};
        for (uint i = 0; i < 3; ++i) {
            s[i] = from[i * ARITY] - centre[i];
            m.one[i] += one[i] = from[(4 + i) * ARITY];
        }
        for (uint i = 0; i < 6; ++i)
            m.two[i] += two[i] = from[(7 + i) * ARITY];
        for (uint i = 0; i < 10; ++i)
            m.three[i] += three[i] = from[(13 + i) * ARITY];
        add_two(square, 1, s, s);
        add_two(m.two, 1, s, one);
        add_three(m.three, 2, s, two);
        add_three(m.three, 1, one, square);
        const double reach = length_of(s) + sqrt(from[3 * ARITY]) / far;
        radius = reach > radius ? reach : radius;
    }
    make_harmonic(&m);
    radius = diagonal < radius ? diagonal : radius;
    store_moments(child_moments(all, node, child), centre, far * far * radius * radius, &m);
}

// The vector of a leaf's triangle as of triangle_vectors, with twice the precision.
NOINLINE double2 precise_vector(__global const double *leaf, uint lane, double3 p)
{
    const double from[3] = {p.x, p.y, p.z}, foot = leaf[9 * LEAF + lane];
    twofold a[3], b[3], c[3], normal[3];
    double e[3], g[3];
    for (uint i = 0; i < 3; ++i) {
        e[i] = leaf[(3 + i) * LEAF + lane];
        g[i] = leaf[(6 + i) * LEAF + lane];
        a[i] = sum_of(leaf[i * LEAF + lane], -from[i]);
        b[i] = plus(a[i], (twofold){e[i], 0});
        c[i] = plus(plus(a[i], product_of(foot, e[i])), (twofold){g[i], 0});
    }
    for (uint i = 0; i < 3; ++i) {
        const uint j = (i + 1) % 3, k = (i + 2) % 3;
        normal[i] = plus(product_of(e[j], g[k]), product_of(-e[k], g[j]));
    }
    const twofold u = root_of(dot_of(a, a)), v = root_of(dot_of(b, b)), w = root_of(dot_of(c, c));
    const twofold first = plus(times(times(u, v), w), times(dot_of(a, b), w));
    const twofold last = plus(times(dot_of(b, c), u), times(dot_of(c, a), v));
    return (double2)(plus(first, last).high, dot_of(a, normal).high);
}

// The solid angle of a leaf's triangles is twice the sum of angle_of over them. Near an edge, as above
// a sliver, both numbers of a vector may be as small as their rounding errors.
double leaf_angle(__global const double *leaf, uint n, double3 p)
{
    double4 x, y, size;
    triangle_vectors(leaf, p, &x, &y, &size);
    const long4 small = fabs(x) + fabs(y) < 0x1p-38 * size;
    if (any(small)) {
        double xs[LEAF], ys[LEAF];
        long precise[LEAF];
        vstore4(x, 0, xs);
        vstore4(y, 0, ys);
        vstore4(small, 0, precise);
        for (uint i = 0; i < LEAF; ++i)
            if (precise[i]) {
                const double2 vector = precise_vector(leaf, i, p);
                xs[i] = vector.x;
                ys[i] = vector.y;
            }
        x = vload4(0, xs);
        y = vload4(0, ys);
    }
    const double4 angle = angle_of(y, x);
    double sum = angle.x; // the last leaf may hold fewer triangles
    sum += n > 1 ? angle.y : 0;
    sum += n > 2 ? angle.z : 0;
    return sum + (n > 3 ? angle.w : 0);
}

// numbers[i] = the winding number of point i. Children are added in a fixed order, so that the sum
// is the same on every device.
__kernel void wind(__global const double *points, __global const uint *order, const uint n,
                   __global const double *leaves, const uint triangles, const uint first_leaf,
                   __global const double *all, __global double *numbers)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint own = order[gid];
    const double3 p = vload3(own, points);
    const double beyond = (double)(1ul << FAR_BITS);
    if (!(p.x * p.x + p.y * p.y + p.z * p.z < beyond * beyond)) {
        numbers[own] = 0;
        return;
    }
    uint ids[STACK];
    uint top = 1;
    ids[0] = 0;
    double8 sums = 0;
    double angles = 0;
    while (top > 0) {
        const uint id = ids[--top];
        __global const double *m = all + (size_t)id * (MOMENTS * ARITY);
        long8 far;
        sums += distant_angles(m, p, &far);
        long near[ARITY];
        vstore8(far, 0, near);
        for (uint i = 0; i < ARITY; ++i) {
            if (near[i])
                continue;
            const uint child = ARITY * id + 1 + i;
            if (child >= first_leaf) {
                const uint leaf = child - first_leaf;
                angles += leaf_angle(leaves + (size_t)leaf * (FIELDS * LEAF), triangles - leaf * LEAF, p);
            } else {
                ids[top++] = child;
            }
        }
    }
    const double4 halves = sums.lo + sums.hi;
    const double2 quarters = halves.lo + halves.hi;
    numbers[own] = (quarters.x + quarters.y + 2 * angles) / (4 * PI);
}
