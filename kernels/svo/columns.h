// What scan conversion and crossings have in common: the columns of boxes that a triangle meets, the
// work-items' shares of them, edge functions of its projections, and where voxels are stored.
// Options: CODE, WIDE, BLOCKED, COLUMN_TILE.

#include "svo/octree.h"
#include "svo/scan.h"
#include "svo/morton.h"
#include "svo/active.h"
#include "svo/overlap.h"

// ---- the columns of a triangle, and the share of them that a work-item takes

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
    const int2 tiles = (max(size, (int2)(0)) + COLUMN_TILE - 1) / COLUMN_TILE;
    c.tiles_p = tiles.x;
    c.tiles = (kind == CROSSED || c.low.z <= c.high.z) ? tiles.x * tiles.y : 0;
    return c;
}

// Narrow the columns to those of a tile.
void take_tile(columns *c, int tile)
{
    c->low.x += tile % c->tiles_p * COLUMN_TILE;
    c->low.y += tile / c->tiles_p * COLUMN_TILE;
    c->high.xy = min(c->high.xy, c->low.xy + COLUMN_TILE - 1);
}

// Work-item `gid` takes the tile returned of triangle *index. Without offsets each triangle is one
// share.
int share_of(__global const uint *tile_offsets, uint triangles, uint gid, uint *index)
{
    *index = gid;
    if (!tile_offsets)
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
bool take_share(__global const int *vertices, __global const int *faces, uint triangles,
                __global const uint *tile_offsets, uint shares, int kind, int level, int3 shape,
                int pad, triangle *t, columns *c)
{
    const uint gid = get_global_id(0);
    if (gid >= shares)
        return false;
    uint index;
    const int tile = share_of(tile_offsets, triangles, gid, &index);
    *t = fetch_triangle(vertices, faces, index);
    *c = columns_of(t, kind, level, shape, (int3)(pad, 0, 0));
    if (c->tiles == 0)
        return false;
    take_tile(c, tile);
    return true;
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

// ---- projections

// The edge functions at box (i, j) of a projection's lattice of boxes: none is negative where the
// box's projection touches the triangle's (eq. 3.4), or where its centre, moved by the shift, is
// within the 6-separating bound ([voCCeL] section 3.2) or in the triangle.
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
