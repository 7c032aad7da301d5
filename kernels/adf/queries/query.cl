// Evaluates a field at points [ADF, section 3.5]. Host side: voxtool/adf/queries/query.py.
//
// A work-item searches for the cells of BATCH points at a time. Each lane processes a run of RUN
// points of those in small cells and advances as soon as its own search ends: a table has the cells
// down to level `top`. Outputs are padded to whole work-groups. Options, in addition to those of
// search.h:
//   GRADIENT, BOUNDS, CELL   these values are written, too
//   HARDWARE                 distances are interpolated by the device's filter

#include "adf/queries/query.h"
#include "adf/queries/search.h"

#define ITEM (BATCH * RUN) // points of a work-item
#define PERIOD (3 * LANES) // numbers of points after which x is again in the first lane

// LANES numbers of points, or others where fewer are left.
doubles some_of(__global const double *points, const ulong left, const double *others)
{
    if (left >= LANES)
        return load(points);
    double numbers[LANES];
    EACH_LANE(i)
    numbers[i] = i < left ? points[i] : others[i];
    return load(numbers);
}

// Rounds the points of a work-item, of which `left` numbers are left, down to `fixed`: in units of
// 2^-32 sides, moved into the cube, 0 for NaN. Returns whether one is not in the cube.
int round_points(__global const double *points, const ulong left, const double3 origin,
                 const double side, uint *fixed)
{
    const double corner[3] = {origin.x, origin.y, origin.z};
    double origins[PERIOD];
    for (uint i = 0; i < PERIOD; ++i)
        origins[i] = corner[i % 3];
    longs inside = -1;
    for (ulong start = 0; start < 3 * ITEM; start += PERIOD)
        for (ulong i = 0; i < PERIOD; i += LANES) {
            const ulong at = min(start + i, left);
            const doubles p = some_of(points + at, left - at, origins + i);
            const doubles u = (p - load(origins + i)) / side;
            inside &= (u >= 0) & (u <= 1);
            const doubles low = u >= 0 ? u : (doubles)0; // 0 for NaN
            const doubles moved = low < 1 ? low : (doubles)(1 - 0x1p-32);
            store(to_uints(moved * 0x1p32), fixed + start + i);
        }
    return ANY(inside == 0);
}

int is_outside(__global const double *point, const double3 origin, const double side)
{
    const double x = (point[0] - origin.x) / side, y = (point[1] - origin.y) / side;
    const double z = (point[2] - origin.z) / side;
    return !(x >= 0 && x <= 1 && y >= 0 && y <= 1 && z >= 0 && z <= 1);
}

void read_point(const uint *point, uint *x, uint *y, uint *z)
{
    *x = point[0];
    *y = point[1];
    *z = point[2];
}

// For `count` of the points, whose places are `wanted`: the deepest cells that have blocks, their
// blocks and levels. All of their cells down to level `known` have blocks, which are set; no cell
// below `deepest` has one.
void find_deepest(const Hash *hash, const uint *points, const uint *wanted_points,
                  const uint count, const int known, const int deepest, uint *blocks, int *levels)
{
    // coherent: the first point of a run starts at the middle level
    const int start = SEARCH == LINEAR      ? known + 1
                      : SEARCH == BOTTOM_UP ? deepest
                                            : (known + 1 + deepest) >> 1;
    const uint run = (count + BATCH - 1) / BATCH;
    Wanted wanted;
    uint left[BATCH], at[BATCH]; // per run: points left, and the current point
    uint slot[BATCH];            // the deepest cell so far, if it is below `known`
    int level[BATCH];
#if SEARCH == BINARY
    int least[BATCH], most[BATCH]; // bounds on the level of the deepest cell
#else
    int way[BATCH]; // search direction: 1 down, -1 up, 0 at the start
#endif
    EACH_POINT(i)
    {
        left[i] = i * run < count ? min(run, count - i * run) : 0;
        at[i] = min(i * run, count - 1);
        slot[i] = 0;
        level[i] = known;
        wanted.level[i] = start;
#if SEARCH == BINARY
        least[i] = known + 1;
        most[i] = deepest;
#else
        way[i] = 0;
#endif
    }
    for (uint searching = count; searching > 0;) {
        EACH_POINT(i)
            read_point(points + 3 * wanted_points[at[i]], wanted.x + i, wanted.y + i, wanted.z + i);
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
            store(end ? (ints)(known + 1) : low, least + i);
            store(end ? (ints)deepest : high, most + i);
            store(end ? (ints)start : (low + high) >> 1, wanted.level + i);
#else
            const ints came = load(way + i), next = exists ? (ints)1 : (ints)-1;
            const ints end = exists ? (came < 0) | (tried == deepest) : came > 0;
            store(end ? (ints)0 : next, way + i);
            const ints again = SEARCH == COHERENT ? deeper : (ints)start;
            store(end ? again : tried + next, wanted.level + i);
#endif
            store(end, ended + i);
        }
        searching = 0;
        EACH_POINT(i) // a finished run repeats its last point; the result is unused
        {
            if (left[i] > 0 && ended[i]) {
                const uint point = wanted_points[at[i]];
                if (level[i] > known)
                    blocks[point] = hash->cells[WORDS * (size_t)slot[i] + WORDS - 1];
                levels[point] = level[i];
                level[i] = known;
                if (--left[i] > 0)
                    ++at[i];
            }
            searching += left[i];
        }
    }
}

// The positions of points along an axis in their leaves, in [0, 1), given the levels of the leaves'
// parents.
floats weights(uints x, ints level)
{
    const uints fraction = x << to_uints(level + 1) >> (POINT_BITS - WEIGHT_BITS);
    return to_floats(to_ints(fraction)) * (1.0f / (1 << WEIGHT_BITS));
}

uints octant_bits(uints x, ints level)
{
    return x >> to_uints(POINT_BITS - 1 - level) & 1u;
}

// The corner distances of BATCH leaves: by x, then y, then z.
typedef struct {
    float v[8][BATCH];
} leaf_corners;

// The corners of leaves, which are children of blocks: the index of each leaf's first vertex in its
// block.
void read_corners(__global const float *voxels, const uint *block, const uint *first,
                  leaf_corners *leaves)
{
    EACH_POINT(i)
    {
        __global const float *v = voxels + (27 * (size_t)block[i] + first[i]);
        leaves->v[0][i] = v[0];
        leaves->v[1][i] = v[1];
        leaves->v[2][i] = v[3];
        leaves->v[3][i] = v[4];
        leaves->v[4][i] = v[9];
        leaves->v[5][i] = v[10];
        leaves->v[6][i] = v[12];
        leaves->v[7][i] = v[13];
    }
}

// The values of BATCH points in their leaves, given the levels of the leaves' parents: distances,
// where `unit` is a cube edge, and gradients with GRADIENT.
void interpolate(const leaf_corners *leaves, const uint *x, const uint *y, const uint *z,
                 const int *level, const double unit, __global double *distances, float *dx,
                 float *dy, float *dz)
{
    EACH_VECTOR(i)
    {
        const floats tx = weights(load(x + i), load(level + i));
        const floats ty = weights(load(y + i), load(level + i));
        const floats tz = weights(load(z + i), load(level + i));
        const floats a = load(leaves->v[0] + i), b = load(leaves->v[1] + i);
        const floats c = load(leaves->v[2] + i), d = load(leaves->v[3] + i);
        const floats e = load(leaves->v[4] + i), f = load(leaves->v[5] + i);
        const floats g = load(leaves->v[6] + i), h = load(leaves->v[7] + i);
        const floats v = lerp(bilerp(a, b, c, d, tx, ty), bilerp(e, f, g, h, tx, ty), tz);
        store(to_doubles(v) * unit, distances + i);
#ifdef GRADIENT
        const floats per_side = to_floats((ints)2 << load(level + i));
        store(bilerp(b - a, d - c, f - e, h - g, ty, tz) * per_side, dx + i);
        store(bilerp(c - a, d - b, g - e, h - f, tx, tz) * per_side, dy + i);
        store(bilerp(e - a, f - b, g - c, h - d, tx, ty) * per_side, dz + i);
#endif
    }
}

#ifdef HARDWARE
__constant sampler_t FILTER =
    CLK_NORMALIZED_COORDS_FALSE | CLK_ADDRESS_CLAMP_TO_EDGE | CLK_FILTER_LINEAR;

// The distance at a point as the device's filter interpolates it ([ADF] eq. 3-4), given its leaf.
// Blocks lie side by side in the image, `across` of them along x and y.
float filtered(__read_only image3d_t image, const uint2 across, const uint block, const uint octant,
               const uint3 point, const int level)
{
    const uint3 place = (uint3)(block % across.x, block / across.x % across.y,
                                block / (across.x * across.y));
    const uint3 first = 3u * place + (uint3)(octant & 1, octant >> 1 & 1, octant >> 2);
    const uint3 fraction = point << (uint)(level + 1) >> (uint)(POINT_BITS - WEIGHT_BITS);
    const float3 t = convert_float3(fraction) * (1.0f / (1 << WEIGHT_BITS));
    return read_imagef(image, FILTER, (float4)(convert_float3(first) + 0.5f + t, 0)).x;
}
#endif

// For each cell of level `top`, by x, y, z: the block of the deepest cell down to this level that
// has one, and its level.
__kernel void find_tops(TEXTURES, const int top, __global uint2 *tops)
{
    const Hash hash = {cells, offsets, inverses, m, r};
    const uint first = get_global_id(0) * ITEM;
    uint points[3 * ITEM], every[ITEM], blocks[ITEM];
    int levels[ITEM];
    for (uint i = 0; i < ITEM; ++i) {
        every[i] = i;
        for (uint axis = 0; axis < 3; ++axis)
            points[3 * i + axis] = (first + i) >> (top * axis) << (POINT_BITS - top);
    }
    find_deepest(&hash, points, every, ITEM, min(full, top) - 1, top, blocks, levels);
    for (uint i = 0; i < ITEM; ++i)
        tops[first + i] = (uint2)(blocks[i], (uint)levels[i]);
}

// The values of the field at `count` points, whose numbers begin at points[start]: distances, where
// `unit` is a cube edge; whether points are outside the cube; optionally gradients, codes of the
// leaves' error bounds, and the leaves' levels and cells.
__kernel void query(__global const double *points, const uint start, const uint count,
                    const double3 origin, const double side, const double unit, TEXTURES,
                    const int top, __global const uint2 *tops, __global double *distances,
                    __global uchar *outside
#ifdef HARDWARE
                    , __read_only image3d_t image, const uint2 across
#endif
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
    const size_t first = get_global_id(0) * ITEM;
    if (first >= count)
        return;
    __global const double *own = points + start + 3 * first;
    uint fixed[3 * ITEM], blocks[ITEM], below[ITEM], searched = 0; // points in cells below `top`
    int levels[ITEM];
    const int some_outside = round_points(own, 3 * (count - first), origin, side, fixed);
    for (uint i = 0; i < ITEM; ++i)
        outside[first + i] =
            some_outside && first + i < count && is_outside(own + 3 * i, origin, side);
    for (uint i = 0; i < ITEM; ++i) {
        uint x, y, z;
        read_point(fixed + 3 * i, &x, &y, &z);
        const uint2 found = tops[top_cell(x, y, z, top)];
        blocks[i] = found.x;
        levels[i] = (int)found.y;
        below[searched] = i;
        searched += levels[i] == top && top < deepest;
    }
    if (searched > 0)
        find_deepest(&hash, fixed, below, searched, top, deepest, blocks, levels);
    for (uint begin = 0; begin < ITEM; begin += BATCH) {
        const int *level = levels + begin;
        uint x[BATCH], y[BATCH], z[BATCH], octant[BATCH], corner[BATCH];
        const uint *block = blocks + begin;
        EACH_POINT(i)
            read_point(fixed + 3 * (begin + i), x + i, y + i, z + i);
        EACH_VECTOR(i)
        {
            const uints bx = octant_bits(load(x + i), load(level + i));
            const uints by = octant_bits(load(y + i), load(level + i));
            const uints bz = octant_bits(load(z + i), load(level + i));
            store(bx + 3 * by + 9 * bz, corner + i);
            store(bx + 2 * by + 4 * bz, octant + i);
        }
        leaf_corners corners;
        read_corners(voxels, block, corner, &corners);
        float dx[BATCH], dy[BATCH], dz[BATCH];
        interpolate(&corners, x, y, z, level, unit, distances + first + begin, dx, dy, dz);
#ifdef HARDWARE
        EACH_POINT(i)
        distances[first + begin + i] = unit * filtered(image, across, block[i], octant[i],
                                                       (uint3)(x[i], y[i], z[i]), level[i]);
#endif
#if defined(GRADIENT) || defined(BOUNDS) || defined(CELL)
        EACH_POINT(i)
        {
            const size_t point = first + begin + i;
#ifdef GRADIENT
            vstore3((float3)(dx[i], dy[i], dz[i]), point, gradients);
#endif
#ifdef BOUNDS
            codes[point] = bounds[8 * (size_t)block[i] + octant[i]];
#endif
#ifdef CELL
            const int above = POINT_BITS - 1 - level[i];
            leaf_levels[point] = (uchar)(level[i] + 1);
            vstore3((uint3)(x[i] >> above, y[i] >> above, z[i] >> above), point, leaves);
#endif
        }
#endif
    }
}
