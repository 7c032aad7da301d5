// The parts of a mesh: positions that faces connect. Host side: voxtool/mesh/parts.py.

#include "union_find.h"

// corners has the three positions of each of n faces.
__kernel void join_corners(__global const uint *corners, const uint n, volatile __global uint *roots)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    __global const uint *at = corners + 3 * (size_t)gid;
    unite(roots, at[0], at[1]);
    unite(roots, at[1], at[2]);
}

// roots[i] = the least position of the part of position i.
__kernel void find_parts(const uint n, volatile __global uint *roots)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        atomic_min(&roots[gid], root_of(roots, gid));
}
