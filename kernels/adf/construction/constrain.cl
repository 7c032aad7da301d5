// Continuity across levels: blocks take the values of coarser leaves on shared faces and edges.
// Host side: voxtool/adf/construction.py.

#include "adf/construction/level.h"

uint3 octant(uint child)
{
    return (uint3)(child & 1, child >> 1 & 1, child >> 2);
}

// neighbours[27 b + i] = the block, on this level, of neighbour i of cell b; COARSE where the
// neighbour is a leaf or inside one, OUT_OF_CUBE where it is outside the cube. Cell b is child
// sources[b] of the level above; parent_ranks numbers that level's refined children.
__kernel void find_neighbours(const uint n, __global const uint *sources,
                              __global const uint *parent_ranks,
                              __global const uint *parent_neighbours, __global uint *neighbours,
                              __global uint *unbalanced)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint parent = sources[gid] / 8;
    const int3 own = convert_int3(octant(sources[gid] % 8));
    for (int i = 0; i < 27; ++i) {
        const int3 at = own + (int3)(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1);
        const int3 up = at >> 1, bits = at & 1;
        const uint beside = (up.x + 1) + 3 * (up.y + 1) + 9 * (up.z + 1);
        const uint of = parent_neighbours[27 * (size_t)parent + beside];
        uint found = of;
        if (of < COARSE) {
            const size_t child = 8 * (size_t)of + bits.x + 2 * bits.y + 4 * bits.z;
            const uint rank = parent_ranks[child];
            found = rank < parent_ranks[child + 1] ? rank : COARSE;
        } else if (of == COARSE) {
            *unbalanced = 1;
        }
        neighbours[27 * (size_t)gid + i] = found;
    }
}

// Sets the vertices of a block that lie on a coarser leaf to the leaf's interpolated value: the
// mean of the ends of the edge, or of the corners of the face, whose midpoint is the vertex. These
// corners lie on the same leaf and are already constrained. They belong to the parent's block. A
// vertex where the interpolation has the other sign keeps its distance, unless the sign jumps between
// the corners; *kept counts these.
// strays[27 b + i] = the change of vertex i from its distance.
__kernel void constrain_blocks(const uint n, const double edge, __global const uint *sources,
                               __global const uint *neighbours,
                               __global const double *parent_values, __global double *values,
                               __global float *strays, __global uint *kept)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    __global double *own = values + 27 * (size_t)gid;
    __global const double *parent = parent_values + 27 * (size_t)(sources[gid] / 8);
    const uint3 low = octant(sources[gid] % 8);
    __global float *astray = strays + 27 * (size_t)gid;
    uint count = 0;
    for (uint i = 0; i < 27; ++i)
        astray[i] = 0;
    for (uint corner = 0; corner < 8; ++corner) {
        const uint3 o = octant(corner), at = low + o;
        const uint i = 2 * o.x + 6 * o.y + 18 * o.z;
        const double value = parent[at.x + 3 * at.y + 9 * at.z];
        astray[i] = (float)(value - own[i]);
        own[i] = value;
    }
    for (int i = 0; i < 27; ++i) {
        const int3 side = (int3)(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1);
        const int middles = (side.x == 0) + (side.y == 0) + (side.z == 0);
        if (middles == 0 || middles == 3)
            continue;
        bool hangs = false; // a hanging vertex: a cell that shares the edge or face is coarser
        for (int j = 1; j < 8; ++j) {
            const int3 beside = side * (int3)(j & 1, j >> 1 & 1, j >> 2);
            const int cell = 13 + beside.x + 3 * beside.y + 9 * beside.z;
            hangs |= cell != 13 && neighbours[27 * (size_t)gid + cell] == COARSE;
        }
        if (!hangs)
            continue;
        double sum = 0, least = INFINITY, most = -INFINITY;
        for (int j = 0; j < 1 << middles; ++j) {
            int3 at = side;
            int bit = j;
            if (side.x == 0)
                at.x = 2 * (bit & 1) - 1, bit >>= 1;
            if (side.y == 0)
                at.y = 2 * (bit & 1) - 1, bit >>= 1;
            if (side.z == 0)
                at.z = 2 * (bit & 1) - 1;
            const double end = own[13 + at.x + 3 * at.y + 9 * at.z];
            sum += end;
            least = end < least ? end : least;
            most = end > most ? end : most;
        }
        const double value = sum / (1 << middles);
#ifdef JUMPS
        const bool jumps = most - least > edge * (middles == 1 ? 1 : 1.5);
#else
        const bool jumps = false;
#endif
        if (!jumps && (value < 0) != (own[i] < 0)) {
            ++count;
            continue;
        }
        astray[i] = (float)(value - own[i]);
        own[i] = value;
    }
    if (count)
        atomic_add(kept, count);
}
