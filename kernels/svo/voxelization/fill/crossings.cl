// The crossings of rows of voxel centres with triangles. Rows are along x; those along y and z are
// found in a grid and a mesh whose coordinates are rotated. Host side: voxtool/svo/voxelization/fill/rows.py.
// Options: those of columns.h; LISTED, for crossings with directions.

#include "svo/voxelization/columns.h"
#include "svo/voxelization/fill/crossings.h"
#include "svo/voxelization/fill/sums.h"

// Actions at the crossings of rows with a triangle.
#define FLIP 0  // flip the first voxel at or beyond each
#define COUNT 1 // count them
#define LIST 2  // write row, voxel and direction of each, and its triangle

typedef struct {
    sink out;
    volatile __global uint *entry;
    __global ulong *crossings;
    __global uint *crossed;
    uint count, x_bits;
    uint2 sums;
    bool checked;
} visitor;

// The bundle of 8 x 8 rows of row (j, k).
uint bundle_of(int j, int k, int ny) { return (j >> 3) + (k >> 3) * ((ny + 7) >> 3); }

// Flip a row from voxel i on. If i is -1, flip the state of the row on entry.
void flip_row(sink *out, volatile __global uint *entry, ACTIVE_SET_PARAMETERS, int3 shape, int i,
              int j, int k)
{
    if (i < 0) {
        const uint row = row_bit(j & 7, k & 7), bundle = bundle_of(j, k, shape.y);
        atomic_xor(&entry[2 * bundle + (row >> 5)], 1u << (row & 31));
    } else {
        put_voxel(out, ACTIVE_SET, (uint3)(i, j, k));
    }
}

// Visit the crossings of rows with a triangle ([voCCeL], eq. 3.5), each at the first voxel at or
// beyond it. A row crosses the triangle if its shifted centre lies in the triangle's projection. A
// centre on the triangle is beyond the crossing. Crossings before x = 0 are visited at voxel -1. The
// coordinates were rotated so that `axis` came first: the shift of centres is still least along z.
void visit_crossings(const triangle *t, const columns *c, int3 shape, uint axis, int what,
                     visitor *v, ACTIVE_SET_PARAMETERS)
{
    const int3 u = t->v[0], a = t->v[1] - u, b = t->v[2] - u;
    long3 n = cross_of(a, b);
    if (n.x == 0)
        return; // parallel to x: no row crosses it
    const int sign = n.x < 0 ? -1 : 1;
    n *= sign;
    const edge_functions e = project(CROSSED, (int3)(t->v[0].y, t->v[1].y, t->v[2].y),
                                     (int3)(t->v[0].z, t->v[1].z, t->v[2].z), sign, VOXEL, 0, 0, axis != 1);
    const int tie = axis == 0   ? 1
                    : axis == 1 ? shift_sign(n.z, n.x, n.y)
                                : shift_sign(n.y, n.z, n.x);
    const int last = c->high.z - c->low.z; // the axis is x
    const wide right = wide_product(n.y, VOXEL), up = wide_product(n.x, VOXEL);
    int2 first, end;
    for (first.y = c->low.y; first.y <= c->high.y; first.y = end.y + 1) {
        end.y = tile_end(first.y, c->high.y);
        for (first.x = c->low.x; first.x <= c->high.x; first.x = end.x + 1) {
            end.x = tile_end(first.x, c->high.x);
            if (!meets_tile(&e, first, end))
                continue;
            for (int k = first.y; k <= end.y; ++k) {
                long3 yz = e.p * first.x + e.q * k + e.d;
                int j = first.x;
                for (; j <= end.x && !none_negative(yz); ++j)
                    yz += e.p;
                if (j > end.x)
                    continue;
                // n . (centre - v0) of the first candidate voxel; it increases along x
                wide low = wide_dot(n.x, n.y, n.z, (long)c->low.z * VOXEL + HALF - u.x,
                                    (long)j * VOXEL + HALF - u.y, (long)k * VOXEL + HALF - u.z);
                low = wide_sum(low, wide_product(tie < 0, -1));
                for (; j <= end.x && none_negative(yz); ++j, yz += e.p, low = wide_sum(low, right)) {
                    wide at = low;
                    const int r = first_not_before(&at, n.x, VOXEL, up, last);
                    const int i = max(c->low.z + r, -1);
                    if (i >= shape.x)
                        continue; // beyond the high-x side
                    if (what == FLIP) {
                        flip_row(&v->out, v->entry, ACTIVE_SET, shape, i, j, k);
                        if (v->checked) {
                            const uint2 more = weighed(row_sums(1, max(i, 0), shape.x), bundle_of(j, k, shape.y));
                            v->sums += sign < 0 ? more : -more;
                        }
                    } else if (what == LIST) {
                        v->crossings[v->count] =
                            ((ulong)k * shape.y + j) << v->x_bits | (ulong)(i + 1) << 2 | (sign < 0 ? ENTERS : 0);
                        if (v->crossed)
                            v->crossed[v->count] = t->face;
                        ++v->count;
                    } else
                        ++v->count;
                }
            }
        }
    }
}

#ifndef LISTED

// sums[gid] = the sums of sums.h over the crossings of a work-item, with the sign of each, if asked for.
__kernel void flip_crossings(TRIANGLES, ACTIVE_SET_PARAMETERS, volatile __global uint *bricks,
                             volatile __global uint *entry, __global uint2 *sums)
{
    triangle t;
    columns c;
    if (!take_share(THESE_TRIANGLES, CROSSED, &t, &c))
        return;
    visitor v;
    v.out = open_sink(bricks, true);
    v.entry = entry;
    v.sums = 0;
    v.checked = sums != 0;
    visit_crossings(&t, &c, shape, 0, FLIP, &v, ACTIVE_SET);
    flush(&v.out);
    if (sums)
        sums[get_global_id(0)] = v.sums;
}

#else

// ---- crossings with directions

// Without `crossings`, firsts[i] = the number of crossings of work-item i. Otherwise the work-item
// writes them from firsts[i] on: the row, the voxel in x_bits - 2 bits, counted from -1, and ENTERS if
// the row, towards high x, enters the solid; and, where they are asked for, the triangles crossed.
__kernel void list_crossings(TRIANGLES, __global uint *firsts, const uint x_bits, const uint axis,
                             __global ulong *crossings, __global uint *crossed)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    visitor v;
    v.count = crossings ? firsts[gid] : 0;
    v.x_bits = x_bits;
    v.crossings = crossings;
    v.crossed = crossed;
    triangle t;
    columns c;
    if (take_share(THESE_TRIANGLES, CROSSED, &t, &c))
        visit_crossings(&t, &c, shape, axis, crossings ? LIST : COUNT, &v, NO_ACTIVE_SET);
    if (!crossings)
        firsts[gid] = v.count;
}

// Flip a row where the sum of its sorted crossings (+1 where it enters, -1 where it leaves) changes
// between inside and outside. Inside is a sum of 1 or more or, with `nonzero`, any other than 0. The
// work-item of the first crossing of a row processes the row.
__kernel void flip_changes(__global const ulong *crossings, const uint n, const uint x_bits,
                           const uint nonzero, const int3 shape, ACTIVE_SET_PARAMETERS,
                           volatile __global uint *bricks, volatile __global uint *entry)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong row = crossings[gid] >> x_bits;
    if (gid > 0 && crossings[gid - 1] >> x_bits == row)
        return;
    const int j = (int)(row % shape.y), k = (int)(row / shape.y);
    sink out = open_sink(bricks, true);
    int number = 0;
    bool inside = false;
    for (uint at = gid; at < n && crossings[at] >> x_bits == row; ++at) {
        number += crossings[at] & ENTERS ? 1 : -1;
        if (at + 1 < n && crossings[at + 1] >> 2 == crossings[at] >> 2)
            continue; // the next crossing is at the same voxel
        if (inside != (nonzero ? number != 0 : number > 0)) {
            inside = !inside;
            const int i = (int)(crossings[at] >> 2 & ((1ul << (x_bits - 2)) - 1)) - 1;
            flip_row(&out, entry, ACTIVE_SET, shape, i, j, k);
        }
    }
    flush(&out);
}

#endif
