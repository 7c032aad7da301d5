// What a field says at points: section 3.5 of the text. Host side: voxtool/adf/query.py.
//
// A work-item looks for the cells of BATCH points at a time, so that their reads of the textures wait
// for memory together; LANES of them make a vector. Each lane goes through a run of RUN consecutive
// points, on to the next as soon as its own search has ended. Points are padded to whole work-groups.
// Options:
//   SEARCH                   LINEAR, BINARY or COHERENT
//   LANES, BATCH, RUN        1 or 16; a multiple of LANES; any
//   OFFSET                   the type of the hash's offsets, uchar or ushort
//   W                        the hash has a fourth channel
//   WIDE                     identifiers have 64 bits
//   GRADIENT, BOUNDS, CELL   what is asked for beside the distance

#include "adf/field.h"
#include "adf/query.h"

#pragma OPENCL FP_CONTRACT OFF

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#if LANES == 1
#define VECTOR(type) type
#define load(p) (*(p))
#define store(v, p) (*(p) = (v))
#else
#define VECTOR(type) JOIN(type, LANES)
#define load(p) JOIN(vload, LANES)(0, p)
#define store(v, p) JOIN(vstore, LANES)(v, 0, p)
#endif
#define ints VECTOR(int)
#define uints VECTOR(uint)
#define floats VECTOR(float)
#define to_ints VECTOR(convert_int)
#define to_uints VECTOR(convert_uint)
#define to_floats VECTOR(convert_float)
#define EACH_POINT(i) for (uint i = 0; i < BATCH; ++i)
#define EACH_VECTOR(i) for (uint i = 0; i < BATCH; i += LANES)

#ifdef WIDE
#define identifiers VECTOR(ulong)
#define to_identifiers VECTOR(convert_ulong)
#define WORDS 3       // of a cell: its identifier and its block
#define CODE_LEVEL 20 // of the cells whose identifiers have all the bits
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

// The textures that find a cell, and the sizes of their sides.
typedef struct {
    __global const uint *cells;
    __global const OFFSET *offsets;
    __global const float *inverses; // of the numbers up to m, or r if that is more
    uint m, r;
} Hash;

// Points, in units of 2^-32 sides, and the levels of cells that hold them.
typedef struct {
    uint x[BATCH], y[BATCH], z[BATCH];
    int level[BATCH];
} Wanted;

void read_point(__global const uint *point, uint *x, uint *y, uint *z)
{
    *x = point[0];
    *y = point[1];
    *z = point[2];
}

// A coordinate of the keys of the cells: 2^level + the leading bits of the points (eq. 3-1).
floats keys_of(uints x, ints level)
{
    const uints led = x >> 1 | 1u << (POINT_BITS - 1);
    return to_floats(to_ints(led >> to_uints(POINT_BITS - 1 - level)));
}

// keys mod n, exactly, for keys < 2^21 and n < 2^21 whose inverse is rounded to nearest. The product
// is off by less than 1.01 * 2^-23 of itself, which is less than the 1 / 2n by which it is away from
// any whole number; all else is exact.
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

// Bits moved apart, bit i to bit 3 i: the CODE_LEVEL leading ones of coordinates.
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

// The identifiers of the cells of these levels: Morton codes after a leading one (section 3.4.3).
identifiers identifiers_of(uints x, uints y, uints z, ints level)
{
    const identifiers code = spread(x) | spread(y) << 1 | spread(z) << 2;
    return (code | (identifiers)1 << 3 * CODE_LEVEL) >> to_identifiers(3 * (CODE_LEVEL - level));
}

// H(k) of section 3.4.1 for BATCH cells: the slots where the hash puts them, and whether they are
// there.
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

// Of each of BATCH runs of points the deepest cells that have blocks, their slots and levels; all
// cells down to the level `full` have blocks, and none below `deepest`.
void find_deepest(const Hash *hash, __global const uint *points, const int full, const int deepest,
                  uint *slots, int *levels)
{
    // coherent: the first point of a run begins in the middle
    const int start = SEARCH == LINEAR ? min(full + 1, deepest) : (full + deepest) >> 1;
    Wanted wanted;
    uint left[BATCH], at[BATCH]; // of its run: the number of points, and the one that is looked for
    uint slot[BATCH];            // the deepest so far
    int level[BATCH];
#if SEARCH == BINARY
    int least[BATCH], most[BATCH]; // levels between which the deepest one is
#else
    int way[BATCH]; // 1 down, -1 up, 0 at the start
#endif
    EACH_POINT(i)
    {
        left[i] = RUN;
        at[i] = i * RUN;
        slot[i] = 0;
        level[i] = full;
        wanted.level[i] = start;
#if SEARCH == BINARY
        least[i] = full;
        most[i] = deepest;
#else
        way[i] = 0;
#endif
    }
    for (uint searching = 1; searching > 0;) {
        EACH_POINT(i)
            read_point(points + 3 * at[i], wanted.x + i, wanted.y + i, wanted.z + i);
        uint looked_at[BATCH];
        int exist[BATCH], ended[BATCH];
        find_cells(hash, &wanted, looked_at, exist);
        EACH_VECTOR(i)
        {
            const ints exists = load(exist + i), tried = load(wanted.level + i);
            const ints deeper = exists ? tried : load(level + i);
            store(deeper, level + i);
            store(exists ? load(looked_at + i) : load(slot + i), slot + i);
#if SEARCH == BINARY
            const ints low = exists ? tried + 1 : load(least + i);
            const ints high = exists ? load(most + i) : tried - 1;
            const ints end = low > high;
            store(end ? (ints)full : low, least + i);
            store(end ? (ints)deepest : high, most + i);
            store(end ? (ints)start : (low + high) >> 1, wanted.level + i);
#else
            const ints came = load(way + i), next = exists ? (ints)1 : (ints)-1;
            const ints end = exists ? (came < 0) | (tried == deepest) : came > 0;
            store(end ? (ints)0 : next, way + i);
            store(end ? (SEARCH == LINEAR ? (ints)start : deeper) : tried + next, wanted.level + i);
#endif
            store(end, ended + i);
        }
        searching = 0;
        EACH_POINT(i) // one whose run is at its end goes on with the last point, for nothing
        {
            if (left[i] > 0) {
                slots[at[i]] = slot[i];
                levels[at[i]] = level[i];
                left[i] -= ended[i] != 0;
            }
            at[i] = (i + 1) * RUN - max(left[i], 1u);
            searching += left[i];
        }
    }
}

// Where in leaves, which are children of cells of these levels, points are along an axis: in [0, 1).
floats weights(uints x, ints level)
{
    const uints fraction = x << to_uints(level + 1) >> (POINT_BITS - WEIGHT_BITS);
    return to_floats(to_ints(fraction)) * (1.0f / (1 << WEIGHT_BITS));
}

uints octant_bits(uints x, ints level)
{
    return x >> to_uints(POINT_BITS - 1 - level) & 1u;
}

floats lerp(floats a, floats b, floats t)
{
    return a + t * (b - a);
}

floats bilerp(floats a, floats b, floats c, floats d, floats s, floats t)
{
    return lerp(lerp(a, b, s), lerp(c, d, s), t);
}

// What the field says at points: distances, in sides; of these, if asked for: gradients; the codes of
// the leaves' bounds; the leaves' levels and cells.
__kernel void query(__global const uint *points, __global const float *voxels,
                    __global const uint *cells, __global const OFFSET *offsets,
                    __global const float *inverses, const uint m, const uint r, const int full,
                    const int deepest, __global float *distances
#ifdef GRADIENT
                    , __global float *gradients
#endif
#ifdef BOUNDS
                    , __global const uchar *bounds, __global uchar *codes
#endif
#ifdef CELL
                    , __global uchar *leaf_levels, __global uint *leaves
#endif
)
{
    const Hash hash = {cells, offsets, inverses, m, r};
    const size_t first = get_global_id(0) * (BATCH * RUN);
    uint slots[BATCH * RUN];
    int levels[BATCH * RUN];
    find_deepest(&hash, points + 3 * first, full, deepest, slots, levels);
    for (uint begin = 0; begin < BATCH * RUN; begin += BATCH) {
        const int *level = levels + begin;
        uint x[BATCH], y[BATCH], z[BATCH], octant[BATCH], corner[BATCH], block[BATCH];
        EACH_POINT(i)
        {
            read_point(points + 3 * (first + begin + i), x + i, y + i, z + i);
            block[i] = cells[WORDS * (size_t)slots[begin + i] + WORDS - 1];
        }
        EACH_VECTOR(i)
        {
            const uints bx = octant_bits(load(x + i), load(level + i));
            const uints by = octant_bits(load(y + i), load(level + i));
            const uints bz = octant_bits(load(z + i), load(level + i));
            store(bx + 3 * by + 9 * bz, corner + i);
            store(bx + 2 * by + 4 * bz, octant + i);
        }
        // the distances at the vertices of the leaves, by their x, y and z
        float v000[BATCH], v100[BATCH], v010[BATCH], v110[BATCH];
        float v001[BATCH], v101[BATCH], v011[BATCH], v111[BATCH];
        EACH_POINT(i)
        {
            __global const float *v = voxels + (27 * (size_t)block[i] + corner[i]);
            v000[i] = v[0];
            v100[i] = v[1];
            v010[i] = v[3];
            v110[i] = v[4];
            v001[i] = v[9];
            v101[i] = v[10];
            v011[i] = v[12];
            v111[i] = v[13];
        }
        float dx[BATCH], dy[BATCH], dz[BATCH];
        EACH_VECTOR(i)
        {
            const floats tx = weights(load(x + i), load(level + i));
            const floats ty = weights(load(y + i), load(level + i));
            const floats tz = weights(load(z + i), load(level + i));
            const floats a = load(v000 + i), b = load(v100 + i), c = load(v010 + i);
            const floats d = load(v110 + i), e = load(v001 + i), f = load(v101 + i);
            const floats g = load(v011 + i), h = load(v111 + i);
            store(lerp(bilerp(a, b, c, d, tx, ty), bilerp(e, f, g, h, tx, ty), tz),
                  distances + first + begin + i);
#ifdef GRADIENT
            const floats per_side = to_floats((ints)2 << load(level + i));
            store(bilerp(b - a, d - c, f - e, h - g, ty, tz) * per_side, dx + i);
            store(bilerp(c - a, d - b, g - e, h - f, tx, tz) * per_side, dy + i);
            store(bilerp(e - a, f - b, g - c, h - d, tx, ty) * per_side, dz + i);
#endif
        }
#if defined(GRADIENT) || defined(BOUNDS) || defined(CELL)
        EACH_POINT(i)
        {
            const size_t point = first + begin + i;
#ifdef GRADIENT
            gradients[3 * point] = dx[i];
            gradients[3 * point + 1] = dy[i];
            gradients[3 * point + 2] = dz[i];
#endif
#ifdef BOUNDS
            codes[point] = bounds[8 * (size_t)block[i] + octant[i]];
#endif
#ifdef CELL
            const int above = POINT_BITS - 1 - level[i];
            leaf_levels[point] = (uchar)(level[i] + 1);
            leaves[3 * point] = x[i] >> above;
            leaves[3 * point + 1] = y[i] >> above;
            leaves[3 * point + 2] = z[i] >> above;
#endif
        }
#endif
    }
}
