// Common parts of scan conversion and crossings: the columns of boxes that a triangle meets, the
// tiles of columns that work-items process, edge functions of projections, and storage of voxels.
// Options: CODE, WIDE, COLUMN_TILE, PLANE_TILE, DESCENT, ANCESTORS.

#include "svo/octree/octree.h"
#include "svo/voxelization/scan_conversion_constants.h"
#include "svo/voxelization/morton.h"
#include "svo/voxelization/overlap.h"

// ---- columns of a triangle, and the tile of them that a work-item processes

typedef struct {
    int axis;       // direction of the columns: 0 x, 1 y, 2 z; p and q are the axes that follow it
    int3 low, high; // first and last box along p, q and the axis, clipped to the grid
    int tiles_p, tiles; // number of tiles along p, and total number
} columns;

// From (x, y, z) to (p, q, axis), where p and q follow the axis cyclically; and back.
int3 swizzle(int3 v, int axis) { return axis == 2 ? v : axis == 0 ? v.yzx : v.zxy; }
int3 unswizzle(int3 v, int axis) { return axis == 2 ? v : axis == 0 ? v.zxy : v.yzx; }

// `shape` is the grid in boxes of 2^level voxels; `pad` widens every box on both sides, in units.
columns columns_of(const triangle *t, int kind, int level, int3 shape, int3 pad)
{
    columns c;
    int3 low, high;
    find_bounds(t, &low, &high);
    const int bits = FIXED_POINT_BITS + level;
    if (kind == COVERED || kind == MET) {
        // cells of the lattice across x whose interior, or with MET whose square, meets the bounding box
        const int more = kind == MET;
        c.axis = 0;
        c.low = max((low - more) >> bits, (int3)(0));
        c.high = min((high - 1 + more) >> bits, shape - 1);
        if ((low.x - more) >> bits >= shape.x)
            c.high.y = c.low.y - 1; // beyond the high-x side: no column
    } else if (kind == CROSSED) { // rows of centres: the first and last voxel whose centre lies in the bounding box
        c.axis = 0;
        c.low = ((low - HALF - 1) >> bits) + 1;
        c.high = (high - HALF) >> bits;
        c.high.x = ((high.x - HALF - 1) >> bits) + 1; // the first centre at or beyond the high end
        c.low.yz = max(c.low.yz, (int2)(0));
        c.high.yz = min(c.high.yz, shape.yz - 1);
        if (c.low.x >= shape.x)
            c.high.y = c.low.y - 1; // beyond the high-x side: no column
    } else {
        const ulong3 n = abs(cross_of(t->v[1] - t->v[0], t->v[2] - t->v[0]));
        c.axis = n.z >= n.x && n.z >= n.y ? 2 : n.x >= n.y ? 0 : 1;
        c.low = max((low - pad - 1) >> bits, (int3)(0));
        c.high = min((kind == SEPARATING ? high - 1 : high + pad) >> bits, shape - 1);
    }
    c.low = swizzle(c.low, c.axis);
    c.high = swizzle(c.high, c.axis);
    const int2 size = c.high.xy - c.low.xy + 1;
    const int2 tiles = (max(size, (int2)(0)) + COLUMN_TILE - 1) / COLUMN_TILE;
    c.tiles_p = tiles.x;
    c.tiles = (kind == CROSSED || kind == COVERED || kind == MET || c.low.z <= c.high.z) ? tiles.x * tiles.y : 0;
    return c;
}

// The parameters that locate the triangles of a mesh, their tiles, and the boxes of the grid: the
// host's Scan.shares.
#define TRIANGLES                                                                                  \
    __global const int *vertices, __global const int *faces, const uint triangles,                 \
        __global const uint *tile_offsets, const uint n, const int level, const int3 shape,        \
        const int pad
#define THESE_TRIANGLES vertices, faces, triangles, tile_offsets, n, level, shape, pad

// The triangle and the columns that this work-item processes; false if there are none. Without
// offsets, a work-item processes a complete triangle, otherwise a tile of one.
bool take_share(TRIANGLES, int kind, triangle *t, columns *c)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return false;
    uint index = tile_offsets ? 0 : gid, end = triangles;
    while (tile_offsets && end - index > 1) { // tile_offsets[index] <= gid < tile_offsets[end]
        const uint middle = index + (end - index) / 2;
        if (tile_offsets[middle] <= gid)
            index = middle;
        else
            end = middle;
    }
    *t = fetch_triangle(vertices, faces, index);
    *c = columns_of(t, kind, level, shape, (int3)(pad, 0, 0));
    if (c->tiles == 0)
        return false;
    const int tile = tile_offsets ? (int)(gid - tile_offsets[index]) : 0;
    c->low.x += tile % c->tiles_p * COLUMN_TILE;
    c->low.y += tile / c->tiles_p * COLUMN_TILE;
    c->high.xy = min(c->high.xy, c->low.xy + COLUMN_TILE - 1);
    return true;
}

// ---- the set of active level-1 nodes

// Bits in Morton order, with the number of set bits before each word, give the index of an active node
// in constant time. In large grids, only active blocks of 8 x 8 x 8 nodes have bits, and `block_words`,
// a set of the same form, holds these blocks; in larger ones only active regions of 8 x 8 x 8 blocks
// have bits in that, which `region_words` holds. While blocks are found, regions take their place.

uint set_index(__global const uint *words, __global const uint *ranks, CODE code)
{
    const uint word = (uint)(code >> 5);
    return ranks[word] + popcount(words[word] & ((1u << (uint)(code & 31)) - 1u));
}

#ifdef DESCENT // with the octree, and its offsets from the root's level down to level 0
#define ACTIVE_SET_PARAMETERS                                                                      \
    __global const uint *region_words, __global const uint *region_ranks,                          \
        __global const uint *block_words, __global const uint *block_ranks, __global const uint *words, \
        __global const uint *ranks, __global const svo_node *tree, __global const uint *tree_offsets, \
        const uint top
#define ACTIVE_SET region_words, region_ranks, block_words, block_ranks, words, ranks, tree, tree_offsets, top
#define NO_ACTIVE_SET 0, 0, 0, 0, 0, 0, 0, 0, 0
#else
#define ACTIVE_SET_PARAMETERS                                                                      \
    __global const uint *region_words, __global const uint *region_ranks,                          \
        __global const uint *block_words, __global const uint *block_ranks, __global const uint *words, \
        __global const uint *ranks
#define ACTIVE_SET region_words, region_ranks, block_words, block_ranks, words, ranks
#define NO_ACTIVE_SET 0, 0, 0, 0, 0, 0
#endif

// The code under which the bit of a level-1 node, or of a block or region, is stored.
CODE stored_code(ACTIVE_SET_PARAMETERS, CODE code)
{
    if (!block_words)
        return code;
    CODE block = code >> 9;
    if (region_words)
        block = (CODE)set_index(region_words, region_ranks, block >> 9) << 9 | (block & 511);
    return (CODE)set_index(block_words, block_ranks, block) << 9 | (code & 511);
}

// ---- storage of boxes and voxels

// Atomic operations are expensive: bits are collected as long as they belong to one word. The index
// of a level-1 node is looked up once for consecutive voxels of the node.
typedef struct {
    volatile __global uint *words;
    bool flips;      // bits are flipped, not set
    uint word, bits; // the bits collected for a word
    uint3 cell;      // level-1 node of the last voxel
    uint node;       // index of this node among the active nodes
    CODE code;       // of this node
    uint place;      // its index in level 1 of the octree
} sink;

#define NO_WORD 0xFFFFFFFFu

sink open_sink(volatile __global uint *words, bool flips)
{
    const sink s = {words, flips, NO_WORD, 0, (uint3)(NO_WORD), 0, ~(CODE)0, 0};
    return s;
}

void flush(sink *s)
{
    if (s->word == NO_WORD)
        return;
    if (s->flips)
        atomic_xor(&s->words[s->word], s->bits);
    else if ((s->words[s->word] & s->bits) != s->bits) // most bits are set already
        atomic_or(&s->words[s->word], s->bits);
}

void put(sink *s, uint word, uint bit)
{
    if (word != s->word) {
        flush(s);
        s->word = word;
        s->bits = 0;
    }
    s->bits = s->flips ? s->bits ^ bit : s->bits | bit;
}

// The level of the lowest common ancestor of two level-1 nodes ([voCCeL], algorithm 2).
uint ancestor_level(CODE a, CODE b)
{
    uint level = 1;
    for (; a != b; ++level) {
        a >>= 3;
        b >>= 3;
    }
    return level;
}

// The index of an active node among the active nodes; undefined for other nodes. With DESCENT, it is
// found in the octree, from the root ([voCCeL], algorithm 1). With ANCESTORS, the descent begins at the
// common ancestor with the node that was found last, if this takes fewer steps: if the ancestor is in
// the lower half of the octree (section 5.1). Before the first, the code is ~0, and the ancestor is
// above the root.
uint find_node(sink *s, ACTIVE_SET_PARAMETERS, CODE code)
{
#ifdef DESCENT
    uint level = top, place = 0;
#ifdef ANCESTORS
    const uint common = ancestor_level(code, s->code);
    if (2 * (common - 1) < top - 1)
        for (level = 1, place = s->place; level < common; ++level)
            place = tree[tree_offsets[top - level] + place].parent & LINK;
#endif
    for (; level > 1; --level)
        place = (tree[tree_offsets[top - level] + place].child & LINK) +
                ((uint)(code >> (3 * (level - 2))) & 7);
    s->code = code;
    s->place = place;
    return (tree[tree_offsets[top - 1] + place].child & LINK) >> 3;
#else
    return set_index(words, ranks, stored_code(ACTIVE_SET, code));
#endif
}

// Put the bit of a voxel of an active node into its 32-bit word, half a brick.
void put_voxel(sink *s, ACTIVE_SET_PARAMETERS, uint3 voxel)
{
    const uint3 cell = voxel >> 3;
    if (any(cell != s->cell)) {
        s->cell = cell;
        s->node = find_node(s, ACTIVE_SET, morton_encode(cell));
    }
    const uint place = voxel_place(voxel);
    put(s, 16 * s->node + (place >> 5), 1u << (place & 31));
}

// ---- projections

// The edge functions at box (i, j) of a projected lattice of boxes. None is negative if the
// projections of box and triangle touch (TOUCHED; eq. 3.4), if the shifted centre is within the
// 6-separating bound (SEPARATING; [voCCeL], section 3.2), or if it is in the triangle (CROSSED).
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
        // subtract 1 if the shift moves a centre on the bound outwards: masks are -1 where true
        e.d += (first < zero) | ((first == zero) & (second < zero));
    } else {
        e.d += max(e.p * (size + 2 * pad_p), zero) + max(e.q * (size + 2 * pad_q), zero) -
               e.p * pad_p - e.q * pad_q;
    }
    e.p *= size;
    e.q *= size;
    return e;
}

// The columns of a row that are visited together: all, or with PLANE_TILE those of a square tile of so
// many, if a column of the tile may be in the projection ([voCCeL], section 3.2, listing A.6).
#ifdef PLANE_TILE
int tile_end(int first, int last) { return min(first | (PLANE_TILE - 1), last); }

bool meets_tile(const edge_functions *e, int2 first, int2 last)
{
    const long3 zero = 0;
    return none_negative(e->p * first.x + e->q * first.y + e->d +
                         max(e->p * (last.x - first.x), zero) + max(e->q * (last.y - first.y), zero));
}
#else
int tile_end(int first, int last) { return last; }

bool meets_tile(const edge_functions *e, int2 first, int2 last) { return true; }
#endif

// The smallest r in [0, last] with *a + r up >= 0, or last + 1 if there is none; *a is set to
// *a + r up. `up` is `normal` x `size`.
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
