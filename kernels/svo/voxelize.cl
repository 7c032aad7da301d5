// Triangle mesh -> voxels: active nodes, surface voxels, crossings along x.
// Host side: voxtool/svo/voxelize.py. Options: CODE, WIDE, BLOCKED.

#include "svo/octree.h"
#include "svo/voxelize.h"
#include "svo/fill/winding.h"
#include "svo/morton.h"
#include "svo/active.h"
#include "svo/overlap.h"

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
        c.low.yz = max(c.low.yz, (int2)(0));
        c.high.yz = min(c.high.yz, shape.yz - 1);
        if (c.low.x >= shape.x)
            c.high.y = c.low.y - 1; // beyond the high-x side: no column
    } else {
        const int3 a = t->v[1] - t->v[0], b = t->v[2] - t->v[0];
        const long x = cross_term(a.y, b.z, b.y, a.z), y = cross_term(a.z, b.x, b.z, a.x),
                   z = cross_term(a.x, b.y, b.x, a.y);
        const ulong nx = abs(x), ny = abs(y), nz = abs(z);
        c.axis = nz >= nx && nz >= ny ? 2 : nx >= ny ? 0 : 1;
        c.low = max((low - pad - 1) >> bits, (int3)(0));
        c.high = min((kind == SEPARATING ? high - 1 : high + pad) >> bits, shape - 1);
    }
    c.low = swizzle(c.low, c.axis);
    c.high = swizzle(c.high, c.axis);
    const int2 size = c.high.xy - c.low.xy + 1;
    const int2 tiles = (max(size, (int2)(0)) + TILE - 1) / TILE;
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

// The triangle and the columns that this work-item takes; false if there are none.
bool take_share(__global const int *vertices, __global const int *faces, uint n,
                __global const uint *tile_offsets, uint tiled, uint items, int kind, int level,
                int3 shape, int pad, triangle *t, columns *c)
{
    const uint gid = get_global_id(0);
    if (gid >= items)
        return false;
    uint index;
    const int tile = share_of(tile_offsets, n, tiled, gid, &index);
    *t = fetch_triangle(vertices, faces, index);
    *c = columns_of(t, kind, level, shape, (int3)(pad, 0, 0));
    if (c->tiles == 0)
        return false;
    take_tile(c, tile);
    return true;
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
// areas along x, y, z in 1/256 voxel^2, whether one lies below x = 0, how many miss every box of the grid.
__kernel void survey(__global const int *vertices, __global const int *faces, const uint n,
                     const int4 shape, __global ulong *partial)
{
    const uint gid = get_global_id(0), items = get_global_size(0);
    ulong extent = 0, x = 0, y = 0, z = 0, before = 0, outside = 0;
    // what the widest boxes reach: blocks of level-1 nodes, and half a voxel more along x
    const int3 end = ((shape.xyz + BLOCK - 1) / BLOCK * BLOCK) * VOXEL + HALF;
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

// ---- where boxes and voxels go

// Bits are gathered while they fall into one word, for atomics are dear; and a node's place is
// kept while its voxels follow each other.
typedef struct {
    volatile __global uint *words;
    uint word, bits; // those gathered
    uint3 cell;      // the last voxel's level-1 node, and its place
    uint node;
} sink;

#define NO_WORD 0xFFFFFFFFu

sink open_sink(volatile __global uint *words)
{
    sink s;
    s.words = words;
    s.word = NO_WORD;
    s.bits = 0;
    s.cell = NO_WORD;
    s.node = 0;
    return s;
}

void flush_or(sink *s)
{
    if (s->word != NO_WORD && (s->words[s->word] & s->bits) != s->bits)
        atomic_or(&s->words[s->word], s->bits); // not so if all are set already: most are
}

void flush_xor(sink *s)
{
    if (s->word != NO_WORD)
        atomic_xor(&s->words[s->word], s->bits);
}

void put_or(sink *s, uint word, uint bit)
{
    if (word != s->word) {
        flush_or(s);
        s->word = word;
        s->bits = 0;
    }
    s->bits |= bit;
}

void put_xor(sink *s, uint word, uint bit)
{
    if (word != s->word) {
        flush_xor(s);
        s->word = word;
        s->bits = 0;
    }
    s->bits ^= bit;
}

// The brick's half (a 32-bit word) and the bit of a voxel of an active node.
uint voxel_word(sink *s, ACTIVE_SET_PARAMETERS, uint3 voxel, uint *bit)
{
    const uint3 cell = voxel >> 3;
    if (any(cell != s->cell)) {
        s->cell = cell;
        s->node = node_index(ACTIVE_SET, morton_encode(cell));
    }
    const uint place = voxel_place(voxel);
    *bit = 1u << (place & 31);
    return 16 * s->node + (place >> 5);
}

// ---- scan conversion of a triangle into boxes

// The edge functions at box (i, j) of a projection's lattice of boxes: none is negative where the
// box's projection touches the triangle's (eq. 3.4), or where its centre, moved by the shift, is
// within the 6-separating bound (section 3.2) or in the triangle.
edge_functions project(int kind, int3 p, int3 q, int sign, int size, int pad_p, int pad_q,
                       bool p_first)
{
    edge_functions e = edges_of(p, q, sign);
    const long3 zero = 0;
    if (kind != TOUCHED) {
        e.d += (e.p + e.q) * HALF; // at the centre
        if (kind == SEPARATING)
            e.d += max(max(e.p, -e.p), max(e.q, -e.q)) * HALF;
        const long3 first = p_first ? e.p : e.q, second = p_first ? e.q : e.p;
        // on the bound, and moving out with the shift: the masks are -1 where true
        e.d += (first < zero) | ((first == zero) & (second < zero));
    } else {
        e.d += max(e.p * (size + 2 * pad_p), zero) + max(e.q * (size + 2 * pad_q), zero) -
               e.p * pad_p - e.q * pad_q;
    }
    e.p *= size;
    e.q *= size;
    return e;
}

// A triangle's columns with all that does not depend on the box (the set-up stage of section 3.2).
typedef struct {
    int size;                // of a box, in units
    int3 first;              // low corner of box (0, 0, c.low.z) from v0, in units
    edge_functions xy, yz, zx; // in swizzled axes
    long nx, ny, nz;         // normal, turned so that nz >= 0
    wide near, far;          // what n . (low corner - v0) gains on a box's near and far side
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
    const int3 x = (int3)(u.x, v.x, w.x), y = (int3)(u.y, v.y, w.y), z = (int3)(u.z, v.z, w.z);
    s.xy = project(kind, x, y, s.nz < 0 ? -1 : 1, s.size, pad.x, pad.y, c->axis != 1);
    s.yz = project(kind, y, z, s.nx < 0 ? -1 : 1, s.size, pad.y, pad.z, c->axis != 0);
    s.zx = project(kind, z, x, s.ny < 0 ? -1 : 1, s.size, pad.z, pad.x, c->axis != 2);
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
    return s;
}

// The least r in [0, last] from which on *a + r up >= 0, or last + 1 if there is none; *a becomes its
// value there. `up` is `normal` x `size`.
int first_not_before(wide *a, long normal, int size, wide up, int last)
{
    if (!is_negative(*a))
        return 0;
#ifdef WIDE // estimated in floating point, decided in integers
    int r = (int)clamp(-to_float(*a) / to_float(up), 0.0f, (float)last);
    *a = wide_sum(*a, wide_product(normal, (long)r * size));
    const wide down = wide_negative(up);
    for (; r > 0 && !is_negative(wide_sum(*a, down)); --r)
        *a = wide_sum(*a, down);
    for (; r <= last && is_negative(*a); ++r)
        *a = wide_sum(*a, up);
#else
    const int r = (int)min((up - 1 - *a) / up, last + 1l);
    *a += r * up;
#endif
    return r;
}

#define STORE_VOXELS 0 // in bricks
#define STORE_NODES 1  // in the volume of level-1 nodes
#define STORE_BLOCKS 2 // in the volume of blocks, which is dense

void put_box(sink *out, int store, ACTIVE_SET_PARAMETERS, uint3 box)
{
    if (store == STORE_VOXELS) {
        uint bit;
        const uint word = voxel_word(out, ACTIVE_SET, box, &bit);
        put_or(out, word, bit);
        return;
    }
    CODE code = morton_encode(box);
#ifdef BLOCKED
    if (store == STORE_NODES)
        code = (CODE)set_index(block_words, block_ranks, code >> 9) << 9 | (code & 511);
#endif
    put_or(out, (uint)(code >> 5), 1u << (uint)(code & 31));
}

// Store the boxes that the triangle touches, column by column. In a column, the plane meets the
// boxes from the first whose far side is not before it to the last whose near side is not behind it
// (fig. 3.4); from one column to the next, where they begin moves by no more than a box or two. A
// row of columns within a convex set is one run: the first that is left ends it.
void scan_convert(const scan *s, const columns *c, sink *out, int store, ACTIVE_SET_PARAMETERS)
{
    const int last = c->high.z - c->low.z;
    const wide right = wide_product(s->nx, s->size), up = wide_product(s->nz, s->size),
               down = wide_negative(up);
    const wide gap = wide_sum(s->near, wide_negative(s->far));
    for (int q = c->low.y; q <= c->high.y; ++q) {
        long3 xy = s->xy.p * c->low.x + s->xy.q * q + s->xy.d;
        int p = c->low.x;
        for (; p <= c->high.x && !none_negative(xy); ++p)
            xy += s->xy.p;
        if (p > c->high.x)
            continue;
        // box r of the column, its edge functions, and n . (p - v0) at its far side
        wide far = wide_sum(s->far, wide_dot(s->nx, s->ny, s->nz, (long)p * s->size + s->first.x,
                                             (long)q * s->size + s->first.y, s->first.z));
        int r = first_not_before(&far, s->nz, s->size, up, last);
        long3 yz = s->yz.p * q + s->yz.q * (c->low.z + r) + s->yz.d;
        long3 zx = s->zx.p * (c->low.z + r) + s->zx.q * p + s->zx.d;
        for (; p <= c->high.x && none_negative(xy); ++p) {
            for (; r <= last && is_negative(far); ++r, far = wide_sum(far, up)) {
                yz += s->yz.q;
                zx += s->zx.p;
            }
            for (; r > 0 && !is_negative(wide_sum(far, down)); --r, far = wide_sum(far, down)) {
                yz -= s->yz.q;
                zx -= s->zx.p;
            }
            long3 yz_box = yz, zx_box = zx;
            wide near = wide_sum(far, gap);
            for (int k = r; k <= last && !is_positive(near); ++k, near = wide_sum(near, up)) {
                if (none_negative(yz_box | zx_box)) {
                    const int3 box = (int3)(p, q, c->low.z + k);
                    put_box(out, store, ACTIVE_SET, as_uint3(unswizzle(box, c->axis)));
                }
                yz_box += s->yz.q;
                zx_box += s->zx.p;
            }
            xy += s->xy.p;
            zx += s->zx.q;
            far = wide_sum(far, right);
        }
    }
    flush_or(out);
}

// ---- active nodes (section 3.2; listing A.4)

// Set the bits of the boxes of 2^level voxels, widened by `pad` along x, that a triangle touches:
// level-1 nodes (level 3), or blocks of 8 x 8 x 8 of those (level 6).
__kernel void activate(__global const int *vertices, __global const int *faces, const uint n,
                       __global const uint *tile_offsets, const uint tiled, const uint items,
                       const int level, const int4 shape, const int pad, ACTIVE_SET_PARAMETERS,
                       volatile __global uint *target)
{
    triangle t;
    columns c;
    if (!take_share(vertices, faces, n, tile_offsets, tiled, items, TOUCHED, level, shape.xyz, pad, &t,
                    &c))
        return;
    const scan s = set_up(&t, &c, TOUCHED, level, pad);
    sink out = open_sink(target);
    scan_convert(&s, &c, &out, level == NODE_LEVEL ? STORE_NODES : STORE_BLOCKS, ACTIVE_SET);
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

// Set the bits of level-1 nodes, or of the blocks that hold them, by their codes.
__kernel void activate_nodes(__global const CODE *codes, const uint n, const int level,
                             ACTIVE_SET_PARAMETERS, volatile __global uint *target)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    CODE code = level == NODE_LEVEL ? codes[gid] : codes[gid] >> 9;
#ifdef BLOCKED
    if (level == NODE_LEVEL)
        code = (CODE)set_index(block_words, block_ranks, code >> 9) << 9 | (code & 511);
#endif
    atomic_or(&target[(uint)(code >> 5)], 1u << (uint)(code & 31));
}

// ---- voxels

// The voxels of a surface: of every triangle those whose closed cube touches it (TOUCHED), or the
// thesis's 6-separating set (SEPARATING). Option: KIND.
#ifdef KIND
__kernel void set_surface(__global const int *vertices, __global const int *faces, const uint n,
                          __global const uint *tile_offsets, const uint tiled, const uint items,
                          const int4 shape, ACTIVE_SET_PARAMETERS, volatile __global uint *bricks)
{
    triangle t;
    columns c;
    if (!take_share(vertices, faces, n, tile_offsets, tiled, items, KIND, 0, shape.xyz, 0, &t,
                    &c))
        return;
    const scan s = set_up(&t, &c, KIND, 0, 0);
    sink out = open_sink(bricks);
    scan_convert(&s, &c, &out, STORE_VOXELS, ACTIVE_SET);
}
#endif

// What is done with the crossings of rows of centres with a triangle.
#define FLIP 0  // the first voxel at or beyond each is flipped
#define COUNT 1 // they are counted
#define LIST 2  // they are written down, by row, voxel and direction

typedef struct {
    sink out;
    volatile __global uint *entry;
    __global ulong *crossings;
    uint count, x_bits;
} visitor;

uint tile_of(uint3 voxel, int3 shape)
{
    return (voxel.y >> 3) + (voxel.z >> 3) * (uint)((shape.y + 7) >> 3);
}

// Flip a row from voxel i on; from -1 on it is its state on entry.
void flip_row(sink *out, volatile __global uint *entry, ACTIVE_SET_PARAMETERS, int3 shape, int i,
              int j, int k)
{
    const uint3 voxel = (uint3)(max(i, 0), j, k);
    if (i < 0) {
        const uint row = row_bit(j & 7, k & 7);
        atomic_xor(&entry[2 * tile_of(voxel, shape) + (row >> 5)], 1u << (row & 31));
        return;
    }
    uint bit;
    const uint word = voxel_word(out, ACTIVE_SET, voxel, &bit);
    put_xor(out, word, bit);
}

// Visit the crossings of rows of centres with the triangle (eq. 3.5), each at the first voxel at or
// beyond it. Rows whose centre, moved by the infinitesimal shift, lies in the projection are
// crossed; a centre on the triangle is beyond the crossing. Crossings before x = 0 are at voxel -1.
void visit_crossings(const triangle *t, const columns *c, int3 shape, int what, visitor *v,
                     ACTIVE_SET_PARAMETERS)
{
    const int3 u = t->v[0], a = t->v[1] - u, b = t->v[2] - u;
    long nx = cross_term(a.y, b.z, b.y, a.z);
    if (nx == 0)
        return; // parallel to x: no row crosses it
    const int sign = nx < 0 ? -1 : 1;
    nx *= sign;
    const long ny = cross_term(a.z, b.x, b.z, a.x) * sign, nz = cross_term(a.x, b.y, b.x, a.y) * sign;
    const edge_functions e = project(CROSSED, (int3)(t->v[0].y, t->v[1].y, t->v[2].y),
                                     (int3)(t->v[0].z, t->v[1].z, t->v[2].z), sign, VOXEL, 0, 0, true);
    const int last = c->high.z - c->low.z; // the axis is x
    const wide right = wide_product(ny, VOXEL), up = wide_product(nx, VOXEL);
    for (int k = c->low.y; k <= c->high.y; ++k) {
        long3 yz = e.p * c->low.x + e.q * k + e.d;
        int j = c->low.x;
        for (; j <= c->high.x && !none_negative(yz); ++j)
            yz += e.p;
        if (j > c->high.x)
            continue;
        // n . (centre - v0) of the first voxel that it can be; it rises along x
        wide low = wide_dot(nx, ny, nz, (long)c->low.z * VOXEL + HALF - u.x,
                            (long)j * VOXEL + HALF - u.y, (long)k * VOXEL + HALF - u.z);
        for (; j <= c->high.x && none_negative(yz); ++j, yz += e.p, low = wide_sum(low, right)) {
            wide first = low;
            const int r = first_not_before(&first, nx, VOXEL, up, last);
            const int i = max(c->low.z + r, -1);
            if (i >= shape.x)
                continue; // beyond the high-x side
            if (what == FLIP)
                flip_row(&v->out, v->entry, ACTIVE_SET, shape, i, j, k);
            else if (what == LIST)
                v->crossings[v->count++] =
                    ((ulong)k * shape.y + j) << v->x_bits | (ulong)(i + 1) << 2 | (sign < 0 ? ENTERS : 0);
            else
                ++v->count;
        }
    }
}

__kernel void flip_crossings(__global const int *vertices, __global const int *faces, const uint n,
                             __global const uint *tile_offsets, const uint tiled, const uint items,
                             const int4 shape, ACTIVE_SET_PARAMETERS,
                             volatile __global uint *bricks, volatile __global uint *entry)
{
    triangle t;
    columns c;
    if (!take_share(vertices, faces, n, tile_offsets, tiled, items, CROSSED, 0, shape.xyz, 0, &t,
                    &c))
        return;
    visitor v;
    v.out = open_sink(bricks);
    v.entry = entry;
    visit_crossings(&t, &c, shape.xyz, FLIP, &v, ACTIVE_SET);
    flush_xor(&v.out);
}

// ---- crossings with their directions

// counts[i] = the number of crossings that share i lists.
__kernel void count_crossings(__global const int *vertices, __global const int *faces, const uint n,
                              __global const uint *tile_offsets, const uint tiled, const uint items,
                              const int4 shape, ACTIVE_SET_PARAMETERS, __global uint *counts)
{
    const uint gid = get_global_id(0);
    visitor v;
    v.count = 0;
    triangle t;
    columns c;
    if (take_share(vertices, faces, n, tile_offsets, tiled, items, CROSSED, 0, shape.xyz, 0, &t, &c))
        visit_crossings(&t, &c, shape.xyz, COUNT, &v, ACTIVE_SET);
    if (gid < items)
        counts[gid] = v.count;
}

// The crossings of share i from firsts[i] on: the row, x_bits - 2 bits of the voxel, counted from -1,
// and ENTERS where a row that runs towards high x enters a solid that faces outward.
__kernel void list_crossings(__global const int *vertices, __global const int *faces, const uint n,
                             __global const uint *tile_offsets, const uint tiled, const uint items,
                             const int4 shape, ACTIVE_SET_PARAMETERS, __global const uint *firsts,
                             const uint x_bits, __global ulong *crossings)
{
    triangle t;
    columns c;
    if (!take_share(vertices, faces, n, tile_offsets, tiled, items, CROSSED, 0, shape.xyz, 0, &t,
                    &c))
        return;
    visitor v;
    v.count = firsts[get_global_id(0)];
    v.x_bits = x_bits;
    v.crossings = crossings;
    visit_crossings(&t, &c, shape.xyz, LIST, &v, ACTIVE_SET);
}

// Flip rows where the number of crossings before, those that enter less those that leave, comes to
// be among those that are inside, or ceases to be: from 1 on, or with `nonzero` all but 0. The
// first crossing of a row walks it; crossings are sorted.
__kernel void flip_changes(__global const ulong *crossings, const uint n, const uint x_bits,
                           const uint nonzero, const int4 shape, ACTIVE_SET_PARAMETERS,
                           volatile __global uint *bricks, volatile __global uint *entry)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong row = crossings[gid] >> x_bits;
    if (gid > 0 && crossings[gid - 1] >> x_bits == row)
        return;
    const int j = (int)(row % shape.y), k = (int)(row / shape.y);
    sink out = open_sink(bricks);
    int number = 0;
    bool inside = false;
    for (uint at = gid; at < n && crossings[at] >> x_bits == row; ++at) {
        number += crossings[at] & ENTERS ? 1 : -1;
        if (at + 1 < n && crossings[at + 1] >> 2 == crossings[at] >> 2)
            continue; // another one at the same voxel
        if (inside != (nonzero ? number != 0 : number > 0)) {
            inside = !inside;
            const int i = (int)(crossings[at] >> 2 & ((1ul << (x_bits - 2)) - 1)) - 1;
            flip_row(&out, entry, ACTIVE_SET, shape.xyz, i, j, k);
        }
    }
    flush_xor(&out);
}
