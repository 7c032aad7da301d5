// Triangle mesh -> voxels: active nodes, surface voxels, crossings along x.
// Host side: voxtool/svo/voxelize.py. Options: CODE, WIDE, BLOCKED.

#include "svo/octree.h"
#include "svo/voxelize.h"
#include "svo/morton.h"
#include "svo/active.h"
#include "svo/triangle.h"

// ---- which columns a triangle has, and which of them a work-item takes

typedef struct {
    int axis;      // columns run along this axis: 0 x, 1 y, 2 z; then the two others are p and q
    int3 low, high; // first and last box along p, q and the axis, clipped to the grid
    int tiles_p, tiles; // tiles along p, and in all
} columns;

// To coordinates (p, q, axis): the two that follow the axis cyclically, and the axis.
int3 swizzle(int3 v, int axis) { return axis == 2 ? v : axis == 0 ? v.yzx : v.zxy; }
int3 unswizzle(int3 v, int axis) { return axis == 2 ? v : axis == 0 ? v.zxy : v.yzx; }

// `shape`: boxes of 2^level voxels in the grid; `pad`: by how much boxes are widened on both sides.
columns columns_of(const triangle *t, int kind, int level, int3 shape, int3 pad)
{
    columns c;
    const int3 low = min(min(t->v[0], t->v[1]), t->v[2]);
    const int3 high = max(max(t->v[0], t->v[1]), t->v[2]);
    const int bits = FIXED_POINT_BITS + level;
    if (kind == CROSSED) { // rows of centres: first and last voxel whose centre is not outside
        c.axis = 0;
        c.low = ((low - HALF - 1) >> bits) + 1;
        c.high = (high - HALF) >> bits;
        c.high.x = ((high.x - HALF - 1) >> bits) + 1; // the first centre not before the end
        c.low.yz = max(c.low.yz, 0);
        c.high.yz = min(c.high.yz, shape.yz - 1);
        if (c.low.x >= shape.x)
            c.high.y = c.low.y - 1; // beyond the high-x side: no column
    } else {
        const int3 a = t->v[1] - t->v[0], b = t->v[2] - t->v[0];
        const long x = cross_term(a.y, b.z, b.y, a.z), y = cross_term(a.z, b.x, b.z, a.x),
                   z = cross_term(a.x, b.y, b.x, a.y);
        const ulong nx = abs(x), ny = abs(y), nz = abs(z);
        c.axis = nz >= nx && nz >= ny ? 2 : nx >= ny ? 0 : 1;
        c.low = max((low - pad - 1) >> bits, 0);
        c.high = min((kind == SEPARATING ? high - 1 : high + pad) >> bits, shape - 1);
    }
    c.low = swizzle(c.low, c.axis);
    c.high = swizzle(c.high, c.axis);
    const int2 size = c.high.xy - c.low.xy + 1;
    const int2 tiles = (max(size, 0) + TILE - 1) / TILE;
    c.tiles_p = tiles.x;
    c.tiles = (kind == CROSSED || c.low.z <= c.high.z) ? tiles.x * tiles.y : 0;
    return c;
}

// Narrow the columns to those of a tile.
void take_tile(columns *c, int tile)
{
    c->low.x += tile % c->tiles_p * TILE;
    c->low.y += tile / c->tiles_p * TILE;
    c->high.xy = min(c->high.xy, c->low.xy + TILE - 1);
}

// The work-items' shares: item `gid` takes triangle *index and the tile returned. Without
// `tiled` each triangle is one share.
int share_of(__global const uint *tile_offsets, uint triangles, uint tiled, uint gid, uint *index)
{
    *index = gid;
    if (!tiled)
        return 0;
    uint low = 0, high = triangles; // tile_offsets[low] <= gid < tile_offsets[high]
    while (high - low > 1) {
        const uint middle = low + (high - low) / 2;
        if (tile_offsets[middle] <= gid)
            low = middle;
        else
            high = middle;
    }
    *index = low;
    return (int)(gid - tile_offsets[low]);
}

// tiles[i] = the number of shares of triangle i.
__kernel void count_tiles(__global const int *vertices, __global const int *faces, const uint n,
                          const int kind, const int level, const int4 shape, const int pad,
                          __global uint *tiles)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const triangle t = fetch_triangle(vertices, faces, gid);
    tiles[gid] = columns_of(&t, kind, level, shape.xyz, (int3)(pad, 0, 0)).tiles;
}

// ---- the scene in numbers, for the plan

// Each work-item's partial sums over its triangles: largest extent in units, doubled projected
// areas along x, y, z in 1/256 voxel^2, whether one lies below x = 0, how many miss the grid.
__kernel void survey(__global const int *vertices, __global const int *faces, const uint n,
                     const int4 shape, __global ulong *partial)
{
    const uint gid = get_global_id(0), items = get_global_size(0);
    ulong extent = 0, x = 0, y = 0, z = 0, before = 0, outside = 0;
    const int3 end = shape.xyz * VOXEL;
    for (uint i = gid; i < n; i += items) {
        const triangle t = fetch_triangle(vertices, faces, i);
        const int3 low = min(min(t.v[0], t.v[1]), t.v[2]);
        const int3 high = max(max(t.v[0], t.v[1]), t.v[2]);
        if (any(high.yz < 0) || any(low > end)) {
            ++outside;
            continue;
        }
        if (low.x <= -HALF)
            before = 1;
        const uint3 size = as_uint3(high) - as_uint3(low);
        extent = max(extent, (ulong)max(max(size.x, size.y), size.z));
        const int3 a = t.v[1] - t.v[0], b = t.v[2] - t.v[0];
        x += abs(cross_term(a.y, b.z, b.y, a.z)) >> FIXED_POINT_BITS;
        y += abs(cross_term(a.z, b.x, b.z, a.x)) >> FIXED_POINT_BITS;
        z += abs(cross_term(a.x, b.y, b.x, a.y)) >> FIXED_POINT_BITS;
    }
    __global ulong *out = partial + 6 * gid;
    out[0] = extent;
    out[1] = x;
    out[2] = y;
    out[3] = z;
    out[4] = before;
    out[5] = outside;
}

// ---- scan conversion of a triangle into boxes

typedef struct {
    edge_function e[3];
} projection;

// The edge functions of a projection, evaluated at a box's low corner in boxes: >= 0 for all
// three where the box's projection touches the triangle's (eq. 3.4), or where the centre is
// within the 6-separating bound (section 3.2).
projection project(int kind, int ap, int aq, int bp, int bq, int cp, int cq, int sign, int size,
                   int pad_p, int pad_q, bool p_first)
{
    projection f;
    f.e[0] = edge_of(ap, aq, bp, bq, sign);
    f.e[1] = edge_of(bp, bq, cp, cq, sign);
    f.e[2] = edge_of(cp, cq, ap, aq, sign);
    for (int i = 0; i < 3; ++i) {
        edge_function *e = &f.e[i];
        if (kind == SEPARATING) {
            e->d += (e->p + e->q) * HALF + (long)max(abs(e->p), abs(e->q)) * HALF;
            if ((p_first ? shift_sign(e->p, e->q, 0) : shift_sign(e->q, e->p, 0)) < 0)
                e->d -= 1; // on the bound, and moving out
        } else {
            e->d += max(0l, e->p * (size + 2 * pad_p)) + max(0l, e->q * (size + 2 * pad_q)) -
                    e->p * pad_p - e->q * pad_q;
        }
        e->p *= size;
        e->q *= size;
    }
    return f;
}

bool holds(const projection *f, int p, int q)
{
    return edge_at(f->e[0], p, q) >= 0 && edge_at(f->e[1], p, q) >= 0 && edge_at(f->e[2], p, q) >= 0;
}

void set_bit(volatile __global uint *words, uint word, uint bit)
{
    if (!(words[word] & bit)) // most are set already, and looking is cheaper
        atomic_or(&words[word], bit);
}

// The brick's half (a 32-bit word) and the bit of a voxel in an active node.
uint voxel_word(ACTIVE_SET_PARAMETERS, uint3 voxel, uint *bit)
{
    const uint brick = 8 * node_index(ACTIVE_SET, morton_encode(voxel >> 3)) + brick_octant(voxel);
    const uint index = brick_bit(voxel);
    *bit = 1u << (index & 31);
    return 2 * brick + (index >> 5);
}

// A triangle's columns with all that does not depend on the box (the set-up stage of section 3.2).
typedef struct {
    int size;                // of a box, in units
    int3 first;              // low corner of box (0, 0, c.low.z) from v0, in units
    projection xy, yz, zx;   // in swizzled axes
    long nx, ny, nz;         // normal, turned so that nz >= 0
    wide near, far;          // what n . (low corner - v0) gains on a box's near and far side
    float step;              // 1 / (nz size)
} scan;

scan set_up(const triangle *t, const columns *c, int kind, int level, int pad_x)
{
    scan s;
    const int3 pad = swizzle((int3)(pad_x, 0, 0), c->axis);
    const int3 u = swizzle(t->v[0], c->axis), v = swizzle(t->v[1], c->axis),
               w = swizzle(t->v[2], c->axis), a = v - u, b = w - u;
    s.size = VOXEL << level;
    s.first = (int3)(0, 0, c->low.z * s.size) - pad - u;
    s.nx = cross_term(a.y, b.z, b.y, a.z);
    s.ny = cross_term(a.z, b.x, b.z, a.x);
    s.nz = cross_term(a.x, b.y, b.x, a.y);
    s.xy = project(kind, u.x, u.y, v.x, v.y, w.x, w.y, s.nz < 0 ? -1 : 1, s.size, pad.x, pad.y,
                   c->axis != 1);
    s.yz = project(kind, u.y, u.z, v.y, v.z, w.y, w.z, s.nx < 0 ? -1 : 1, s.size, pad.y, pad.z,
                   c->axis != 0);
    s.zx = project(kind, u.z, u.x, v.z, v.x, w.z, w.x, s.ny < 0 ? -1 : 1, s.size, pad.z, pad.x,
                   c->axis != 2);
    if (s.nz < 0) {
        s.nx = -s.nx;
        s.ny = -s.ny;
        s.nz = -s.nz;
    }
    if (kind == SEPARATING) { // the centre is within half a voxel of the plane along the axis
        const int tie = c->axis == 2   ? shift_sign(s.nx, s.ny, s.nz)
                        : c->axis == 0 ? shift_sign(s.nz, s.nx, s.ny)
                                       : shift_sign(s.ny, s.nz, s.nx);
        s.far = wide_sum(wide_dot(s.nx, s.ny, s.nz, HALF, HALF, VOXEL), wide_product(tie < 0, -1));
        s.near = wide_sum(wide_dot(s.nx, s.ny, 0, HALF, HALF, 0), wide_product(tie > 0, 1));
    } else { // the plane passes between the critical points (eq. 3.1)
        const int3 box = s.size + 2 * pad;
        s.far = wide_dot(max(s.nx, 0l), max(s.ny, 0l), s.nz, box.x, box.y, box.z);
        s.near = wide_dot(min(s.nx, 0l), min(s.ny, 0l), 0, box.x, box.y, 0);
    }
    s.step = 1.0f / ((float)s.nz * (float)s.size);
    return s;
}

// a + n_axis r boxes: how n . (p - v0) rises along a column.
wide along(wide a, long n_axis, int r, int size)
{
    return wide_sum(a, wide_product(n_axis, (long)r * size));
}

// The least r in [0, last] with along(a, ..., r) >= 0, or last + 1: estimated in floating point,
// decided in integers.
int first_not_before(wide a, long n_axis, int size, float step, int last)
{
    if (!is_negative(a))
        return 0;
    int r = (int)clamp(-to_float(a) * step, 0.0f, (float)last);
    while (r <= last && is_negative(along(a, n_axis, r, size)))
        ++r;
    while (r > 0 && !is_negative(along(a, n_axis, r - 1, size)))
        --r;
    return r;
}

// The boxes of column (p, q) that the plane meets, from *r boxes above c.low.z on (fig. 3.4): from
// the first whose far side is not before the plane; `near` tells where they end.
wide enter_column(const scan *s, const columns *c, int p, int q, int *r)
{
    const wide low = wide_dot(s->nx, s->ny, s->nz, (long)p * s->size + s->first.x,
                              (long)q * s->size + s->first.y, s->first.z);
    *r = first_not_before(wide_sum(low, s->far), s->nz, s->size, s->step, c->high.z - c->low.z);
    return wide_sum(low, s->near);
}

bool in_column(const scan *s, const columns *c, wide near, int r)
{
    return r <= c->high.z - c->low.z && !is_positive(along(near, s->nz, r, s->size));
}

uint3 box_at(const columns *c, int p, int q, int r)
{
    return as_uint3(unswizzle((int3)(p, q, c->low.z + r), c->axis));
}

bool touches(const scan *s, int p, int q, int z) { return holds(&s->yz, q, z) && holds(&s->zx, z, p); }

// Loop over the boxes of the columns: `box` in the body. A row of columns within a convex set is
// one run, so the first that is left ends it.
#define FOR_EACH_BOX(s, c, p, q, r, near)                                                          \
    for (int q = c.low.y; q <= c.high.y; ++q)                                                      \
        for (int p = c.low.x, entered = 0; p <= c.high.x; ++p)                                     \
            if (!holds(&s.xy, p, q)) {                                                             \
                if (entered)                                                                       \
                    break;                                                                         \
            } else                                                                                 \
                for (int r = 0, once = (entered = 1); once; once = 0)                              \
                    for (wide near = enter_column(&s, &c, p, q, &r); in_column(&s, &c, near, r);   \
                         ++r)                                                                      \
                        if (touches(&s, p, q, c.low.z + r))

// ---- active nodes (section 3.2; listing A.4)

// Set the bits of the boxes of 2^level voxels, widened by `pad` along x, that a triangle touches:
// level-1 nodes (level 3), or blocks of 8 x 8 x 8 of those (level 6).
__kernel void activate(__global const int *vertices, __global const int *faces, const uint n,
                       __global const uint *tile_offsets, const uint tiled, const uint items,
                       const int level, const int4 shape, const int pad, const uint to_blocks,
#ifdef BLOCKED
                       __global const uint *block_words, __global const uint *block_ranks,
#endif
                       volatile __global uint *words)
{
    const uint gid = get_global_id(0);
    if (gid >= items)
        return;
    uint index;
    const int tile = share_of(tile_offsets, n, tiled, gid, &index);
    const triangle t = fetch_triangle(vertices, faces, index);
    columns c = columns_of(&t, TOUCHED, level, shape.xyz, (int3)(pad, 0, 0));
    if (c.tiles == 0)
        return;
    take_tile(&c, tile);
    const scan s = set_up(&t, &c, TOUCHED, level, pad);
    FOR_EACH_BOX(s, c, p, q, r, near)
    {
        CODE code = morton_encode(box_at(&c, p, q, r));
#ifdef BLOCKED
        if (!to_blocks)
            code = (CODE)set_index(block_words, block_ranks, code >> 9) << 9 | (code & 511);
#endif
        set_bit(words, (uint)(code >> 5), 1u << (uint)(code & 31));
    }
}

// counts[i] = the number of bits set in word i.
__kernel void count_bits(__global const uint *words, const uint n, __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        counts[gid] = popcount(words[gid]);
}

// The Morton codes of the set bits, in order (listing A.5). In a blocked set, 16 words belong to
// each of the blocks, whose codes are given.
__kernel void write_mortons(__global const uint *words, const uint n, __global const uint *ranks,
                            __global const CODE *blocks, const uint blocked,
                            __global CODE *codes)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const CODE base = blocked ? (blocks[gid >> 4] << 9) | (CODE)((gid & 15) << 5) : (CODE)gid << 5;
    uint out = ranks[gid];
    for (uint word = words[gid]; word; word &= word - 1)
        codes[out++] = base | (CODE)popcount((word & -word) - 1u);
}

// ---- voxels

#define VOXELIZE_SURFACE(kind)                                                                     \
    const uint gid = get_global_id(0);                                                             \
    if (gid >= items)                                                                              \
        return;                                                                                    \
    uint index;                                                                                    \
    const int tile = share_of(tile_offsets, n, tiled, gid, &index);                                \
    const triangle t = fetch_triangle(vertices, faces, index);                                     \
    columns c = columns_of(&t, kind, 0, shape.xyz, (int3)(0));                                     \
    if (c.tiles == 0)                                                                              \
        return;                                                                                    \
    take_tile(&c, tile);                                                                           \
    const scan s = set_up(&t, &c, kind, 0, 0);                                                     \
    FOR_EACH_BOX(s, c, p, q, r, near)                                                              \
    {                                                                                              \
        uint bit;                                                                                  \
        const uint word = voxel_word(ACTIVE_SET, box_at(&c, p, q, r), &bit);                       \
        set_bit(bricks, word, bit);                                                                \
    }

// Every voxel whose closed cube touches the triangle.
__kernel void surface26(__global const int *vertices, __global const int *faces, const uint n,
                        __global const uint *tile_offsets, const uint tiled, const uint items,
                        const int4 shape, ACTIVE_SET_PARAMETERS, volatile __global uint *bricks)
{
    VOXELIZE_SURFACE(TOUCHED)
}

// The thesis's 6-separating set.
__kernel void surface6(__global const int *vertices, __global const int *faces, const uint n,
                       __global const uint *tile_offsets, const uint tiled, const uint items,
                       const int4 shape, ACTIVE_SET_PARAMETERS, volatile __global uint *bricks)
{
    VOXELIZE_SURFACE(SEPARATING)
}

// Flip the first voxel at or beyond each crossing of a row of centres with the triangle (eq. 3.5).
// Rows whose centre, moved by the infinitesimal shift, lies in the projection are crossed; a centre
// on the triangle is beyond the crossing. Crossings before x = 0 flip the row's state on entry.
__kernel void flip_crossings(__global const int *vertices, __global const int *faces, const uint n,
                             __global const uint *tile_offsets, const uint tiled, const uint items,
                             const int4 shape, ACTIVE_SET_PARAMETERS,
                             volatile __global uint *bricks, volatile __global uint *entry)
{
    const uint gid = get_global_id(0);
    if (gid >= items)
        return;
    uint index;
    const int tile = share_of(tile_offsets, n, tiled, gid, &index);
    const triangle t = fetch_triangle(vertices, faces, index);
    columns c = columns_of(&t, CROSSED, 0, shape.xyz, (int3)(0));
    if (c.tiles == 0)
        return;
    take_tile(&c, tile);

    const int3 u = t.v[0], a = t.v[1] - u, b = t.v[2] - u;
    long nx = cross_term(a.y, b.z, b.y, a.z);
    if (nx == 0)
        return; // parallel to x: no row crosses it
    const int sign = nx < 0 ? -1 : 1;
    nx *= sign;
    const long ny = cross_term(a.z, b.x, b.z, a.x) * sign, nz = cross_term(a.x, b.y, b.x, a.y) * sign;
    edge_function e[3];
    for (int i = 0; i < 3; ++i) {
        const int3 from = t.v[i], to = t.v[(i + 1) % 3];
        e[i] = edge_of(from.y, from.z, to.y, to.z, sign);
        e[i].d += (e[i].p + e[i].q) * HALF;
        if (shift_sign(e[i].p, e[i].q, 0) < 0)
            e[i].d -= 1; // on the edge, and moving out
        e[i].p *= VOXEL;
        e[i].q *= VOXEL;
    }
    const float step = 1.0f / ((float)nx * (float)VOXEL);
    const int last = c.high.z - c.low.z; // the axis is x
    for (int k = c.low.y; k <= c.high.y; ++k) {
        bool entered = false;
        for (int j = c.low.x; j <= c.high.x; ++j) {
            if (edge_at(e[0], j, k) < 0 || edge_at(e[1], j, k) < 0 || edge_at(e[2], j, k) < 0) {
                if (entered)
                    break;
                continue;
            }
            entered = true;
            // n . (centre - v0) of the first voxel that it can be; it rises along x
            const wide at_low =
                wide_dot(nx, ny, nz, (long)c.low.z * VOXEL + HALF - u.x,
                         (long)j * VOXEL + HALF - u.y, (long)k * VOXEL + HALF - u.z);
            const int r = first_not_before(at_low, nx, VOXEL, step, last);
            const int i = c.low.z + r;
            if (i >= shape.x)
                continue; // beyond the high-x side
            if (i < 0) {
                const uint row = row_bit(j & 7, k & 7);
                const uint tile = (j >> 3) + (k >> 3) * ((shape.y + 7) >> 3);
                atomic_xor(&entry[2 * tile + (row >> 5)], 1u << (row & 31));
                continue;
            }
            uint bit;
            const uint word = voxel_word(ACTIVE_SET, (uint3)(i, j, k), &bit);
            atomic_xor(&bricks[word], bit);
        }
    }
}
