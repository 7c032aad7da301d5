// Cell lookup [ADF, section 3.4], shared by query.cl and raycast.cl.
//
// BATCH cells are looked up at a time, so that their texture reads overlap. A vector has LANES of
// them. Options:
//   LANES, BATCH   1 or 16; a multiple of LANES
//   OFFSET         the type of the hash's offsets, uchar or ushort
//   W              the hash has a fourth channel
//   WIDE           identifiers have 64 bits

#include "adf/field/points.h"
#include "lanes.h"

#define EACH_POINT(i) for (uint i = 0; i < BATCH; ++i)
#define EACH_VECTOR(i) for (uint i = 0; i < BATCH; i += LANES)

#ifdef WIDE
#define identifiers VECTOR(ulong)
#define to_identifiers VECTOR(convert_ulong)
#define WORDS 3       // per cell: its identifier and its block
#define CODE_LEVEL 20 // identifiers of cells at this level use all bits
#else
#define identifiers uints
#define to_identifiers to_uints
#define WORDS 2
#define CODE_LEVEL 10
#endif
#ifdef W
#define CHANNELS 4
#else
#define CHANNELS 3
#endif

// Parameter group: the textures of a field, the level down to which all cells have blocks, and the
// deepest level that has any.
#define TEXTURES                                                                                       \
    __global const float *voxels, __global const uint *cells, __global const OFFSET *offsets,          \
        __global const float *inverses, const uint m, const uint r, const int full, const int deepest

// The textures used to find a cell, and their sizes along each axis.
typedef struct {
    __global const uint *cells;
    __global const OFFSET *offsets;
    __global const float *inverses; // of the numbers up to max(m, r)
    uint m, r;
} Hash;

// Points, in units of 2^-32 cube edges, and the level of the cell of each that is looked up.
typedef struct {
    uint x[BATCH], y[BATCH], z[BATCH];
    int level[BATCH];
} Wanted;

// A coordinate of the keys of the cells: 2^level + the leading bits of the points ([ADF] eq. 3-1).
floats keys_of(uints x, ints level)
{
    const uints led = x >> 1 | 1u << (POINT_BITS - 1);
    return to_floats(to_ints(led >> to_uints(POINT_BITS - 1 - level)));
}

// keys mod n, exact for keys < 2^21 and n < 2^21 with an inverse rounded to nearest. The relative
// error of the product is less than 1.01 * 2^-23. The product is at least 1 / 2n away from any
// integer, which exceeds this error. All other operations are exact.
floats remainders(floats keys, floats n, floats inverse)
{
    return keys - to_floats(to_ints((keys + 0.5f) * inverse)) * n;
}

// A coordinate of the slots: the keys mod w plus the offsets, mod m.
ints slots_along(floats keys, floats w, floats inverse, ints offsets, int m)
{
    const ints sum = to_ints(remainders(keys, w, inverse)) + offsets;
    return sum >= m ? sum - m : sum;
}

uint top_of(uint x, int top) { return x >> 1 >> (POINT_BITS - 1 - top); }

// The index, among the cells of level `top`, of the cell that holds a point.
uint top_cell(uint x, uint y, uint z, int top)
{
    return top_of(x, top) | (top_of(y, top) | top_of(z, top) << top) << top;
}

// Spreads the CODE_LEVEL leading bits of coordinates: bit i moves to bit 3 i.
identifiers spread(uints x)
{
    identifiers v = to_identifiers(x >> (POINT_BITS - CODE_LEVEL));
#ifdef WIDE
    v = (v | (v << 32)) & 0x1F00000000FFFFul;
    v = (v | (v << 16)) & 0x1F0000FF0000FFul;
    v = (v | (v << 8)) & 0x100F00F00F00F00Ful;
    v = (v | (v << 4)) & 0x10C30C30C30C30C3ul;
    v = (v | (v << 2)) & 0x1249249249249249ul;
#else
    v = (v | (v << 16)) & 0x030000FFu;
    v = (v | (v << 8)) & 0x0300F00Fu;
    v = (v | (v << 4)) & 0x030C30C3u;
    v = (v | (v << 2)) & 0x09249249u;
#endif
    return v;
}

// The identifiers of cells, given points and levels: Morton codes preceded by a 1 bit ([ADF],
// section 3.4.3).
identifiers identifiers_of(uints x, uints y, uints z, ints level)
{
    const identifiers code = spread(x) | spread(y) << 1 | spread(z) << 2;
    return (code | (identifiers)1 << 3 * CODE_LEVEL) >> to_identifiers(3 * (CODE_LEVEL - level));
}

floats lerp(floats a, floats b, floats t)
{
    return a + t * (b - a);
}

floats bilerp(floats a, floats b, floats c, floats d, floats s, floats t)
{
    return lerp(lerp(a, b, s), lerp(c, d, s), t);
}

// H(k) of [ADF], section 3.4.1, for BATCH cells: their slots, and whether each cell is present.
void find_cells(const Hash *hash, const Wanted *wanted, uint *slots, int *exist)
{
    const uint r = hash->r, m = hash->m;
    const floats n = (floats)(float)r, inverse = (floats)hash->inverses[r];
    uint bucket[BATCH];
    EACH_VECTOR(i)
    {
        const ints level = load(wanted->level + i);
        const floats x = remainders(keys_of(load(wanted->x + i), level), n, inverse);
        const floats y = remainders(keys_of(load(wanted->y + i), level), n, inverse);
        const floats z = remainders(keys_of(load(wanted->z + i), level), n, inverse);
        store(to_uints(to_ints(x)) + r * (to_uints(to_ints(y)) + r * to_uints(to_ints(z))),
              bucket + i);
    }
    int x[BATCH], y[BATCH], z[BATCH];
#ifdef W
    float ws[BATCH], inverse_ws[BATCH];
#endif
    EACH_POINT(i)
    {
        __global const OFFSET *offset = hash->offsets + CHANNELS * (size_t)bucket[i];
        x[i] = offset[0];
        y[i] = offset[1];
        z[i] = offset[2];
#ifdef W
        ws[i] = offset[3];
        inverse_ws[i] = hash->inverses[offset[3]];
#endif
    }
    EACH_VECTOR(i)
    {
#ifdef W
        const floats w = load(ws + i), inverse_w = load(inverse_ws + i);
#else
        const floats w = (floats)(float)m, inverse_w = (floats)hash->inverses[m];
#endif
        const ints level = load(wanted->level + i);
        const uints sx = to_uints(
            slots_along(keys_of(load(wanted->x + i), level), w, inverse_w, load(x + i), m));
        const uints sy = to_uints(
            slots_along(keys_of(load(wanted->y + i), level), w, inverse_w, load(y + i), m));
        const uints sz = to_uints(
            slots_along(keys_of(load(wanted->z + i), level), w, inverse_w, load(z + i), m));
        store(sx + m * (sy + m * sz), slots + i);
    }
    uint low[BATCH];
#ifdef WIDE
    uint high[BATCH];
#endif
    EACH_POINT(i)
    {
        __global const uint *cell = hash->cells + WORDS * (size_t)slots[i];
        low[i] = cell[0];
#ifdef WIDE
        high[i] = cell[1];
#endif
    }
    EACH_VECTOR(i)
    {
        const identifiers identifier =
            identifiers_of(load(wanted->x + i), load(wanted->y + i), load(wanted->z + i),
                           load(wanted->level + i));
        ints same = load(low + i) == to_uints(identifier);
#ifdef WIDE
        same = same & (load(high + i) == to_uints(identifier >> 32));
#endif
        store(same, exist + i);
    }
}
