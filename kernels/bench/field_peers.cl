// Distances of a field at points by the structures that [ADF] names beside its own, a point for each
// work-item. Host side: voxtool/bench/text_peers.py.
//
// Each writes the distance of voxtool's own queries, bit for bit, and how many slots of hashes it
// read.

#include "adf/field/points.h"
#include "morton_bits.h"

#define LEVEL_SHIFT (POINT_BITS - 1)

float lerp(float a, float b, float t) { return a + t * (b - a); }

// The interpolation of the eight corners of a child of a cell of a level: along x, then y, then z.
float interpolated(const float *v, const uint *p, uint level)
{
    float t[3];
    for (uint i = 0; i < 3; ++i)
        t[i] = (float)(p[i] << (level + 1) >> (POINT_BITS - WEIGHT_BITS)) * (1.0f / (1 << WEIGHT_BITS));
    const float low = lerp(lerp(v[0], v[1], t[0]), lerp(v[2], v[3], t[0]), t[1]);
    return lerp(low, lerp(lerp(v[4], v[5], t[0]), lerp(v[6], v[7], t[0]), t[1]), t[2]);
}

void round_point(__global const double *point, const double3 origin, const double side, uint *p)
{
    const double corner[3] = {origin.x, origin.y, origin.z};
    for (uint i = 0; i < 3; ++i)
        p[i] = (uint)((point[i] - corner[i]) / side * 0x1p32);
}

// The child of a cell of a level in which a point lies.
uint octant_of(const uint *p, uint level)
{
    const uint shift = LEVEL_SHIFT - level;
    return (p[0] >> shift & 1) | (p[1] >> shift & 1) << 1 | (p[2] >> shift & 1) << 2;
}

// Multiplicative hashing: the slot at which probing begins.
uint home_of(ulong key, uint bits) { return (uint)(key * 0x9E3779B97F4A7C15ul >> (64 - bits)); }

// The slot of a key, found by linear probing, or a free one, whose key is 0.
uint probe(__global const ulong *keys, uint bits, ulong key, uint *probes)
{
    uint slot = home_of(key, bits);
    for (++*probes; keys[slot] != key && keys[slot] != 0; ++*probes)
        slot = (slot + 1) & ((1u << bits) - 1);
    return slot;
}

// An octree of pointers. A node is the first of its children, 0 for a leaf; with EIGHT, its eight
// samples follow. Otherwise the samples are in a hash table by the place of a vertex, in edges of the
// deepest leaves.
__kernel void query_pointers(__global const double *points, const uint n, const double3 origin,
                             const double side, __global const uint *nodes, const uint depth,
#ifndef EIGHT
                             __global const ulong *keys, const uint bits,
                             __global const float *samples,
#endif
                             __global double *distances, __global uint *probes)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint p[3];
    round_point(points + 3 * (size_t)gid, origin, side, p);
    uint level = 0, read = 0;
    float v[8];
#ifdef EIGHT
    size_t node = 9 * (size_t)(nodes[0] + octant_of(p, 0));
    for (; nodes[node]; ++level)
        node = 9 * (size_t)(nodes[node] + octant_of(p, level + 1));
    for (uint i = 0; i < 8; ++i)
        v[i] = as_float(nodes[node + 1 + i]);
#else
    size_t node = nodes[0] + octant_of(p, 0);
    for (; nodes[node]; ++level)
        node = nodes[node] + octant_of(p, level + 1);
    for (uint i = 0; i < 8; ++i) {
        ulong key = 1;
        for (uint axis = 0; axis < 3; ++axis) {
            const ulong cell = (p[axis] >> (LEVEL_SHIFT - level)) + (i >> axis & 1);
            key |= cell << (depth - level - 1) << (1 + 21 * axis);
        }
        v[i] = samples[probe(keys, bits, key, &read)];
    }
#endif
    distances[gid] = (double)interpolated(v, p, level) * side;
    probes[gid] = read;
}

// Blocks of 3 x 3 x 3 samples, and a hash of the identifiers of their cells: perfect, or with PROBED
// by linear probing. A cell of one level after another is looked up.
__kernel void query_hash(__global const double *points, const uint n, const double3 origin,
                         const double side, __global const float *voxels, const uint depth,
                         __global const ulong *keys, __global const uint *blocks,
#ifdef PROBED
                         const uint bits,
#else
                         __global const ushort *offsets, const uint m, const uint r,
#endif
                         __global double *distances, __global uint *probes)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint p[3];
    round_point(points + 3 * (size_t)gid, origin, side, p);
    uint level = 0, block = 0, read = 0;
    for (uint tried = 0; tried < depth; ++tried) {
        uint c[3] = {0, 0, 0};
        for (uint i = 0; tried && i < 3; ++i)
            c[i] = p[i] >> (POINT_BITS - tried);
        const ulong code = spread_bits(c[0]) | spread_bits(c[1]) << 1 | spread_bits(c[2]) << 2;
        const ulong key = code | 1ul << 3 * tried;
#ifdef PROBED
        const uint slot = probe(keys, bits, key, &read);
#else
        uint slot = 0;
        for (uint i = 0; i < 3; ++i)
            c[i] += 1u << tried;
        __global const ushort *offset = offsets + 4 * (c[0] % r + r * (c[1] % r + (size_t)r * (c[2] % r)));
        for (uint i = 3; i-- > 0;)
            slot = m * slot + (c[i] % offset[3] + offset[i]) % m;
        ++read;
#endif
        if (keys[slot] != key)
            break;
        level = tried;
        block = blocks[slot];
    }
    const uint o = octant_of(p, level);
    __global const float *at = voxels + 27 * (size_t)block + (o & 1) + 3 * (o >> 1 & 1) + 9 * (o >> 2);
    const float v[8] = {at[0], at[1], at[3], at[4], at[9], at[10], at[12], at[13]};
    distances[gid] = (double)interpolated(v, p, level) * side;
    probes[gid] = read;
}
