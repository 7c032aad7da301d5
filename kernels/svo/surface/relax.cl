// The relaxation of surface nets [Gibson 1998]: each vertex moves halfway to the mean of its
// neighbours, but stays in its cube. Host side: voxtool/svo/surface/triangles.py. Option: LANES.

#include "svo/surface/lattice.h"
#include "svo/surface/relaxation.h"
#include "lanes.h"

// LANES vertices.
__kernel void relax(__global const ulong *packed, RELAXATION, const uint n, __global ulong *relaxed)
{
    const size_t first = LANES * get_global_id(0);
    if (first >= n)
        return;
    ulong sums[LANES];
    EACH_LANE(i) // of the lanes beyond the last vertex, the last again
    {
        const size_t vertex = min(first + i, (size_t)n - 1);
        __global const uint *link = links + 4 * vertex;
        sums[i] = packed[link[0]] + packed[link[1]] + packed[link[2]] + packed[link[3]];
    }
    const uint end = beyond_start[get_global_id(0) + 1];
    for (uint i = beyond_start[get_global_id(0)]; i < end; ++i)
        sums[beyond[i].x - first] += packed[beyond[i].y];
    const ulongs here = load(packed + first), sum = load(sums);
    const ints about = to_ints(load(around + first)), count = about & 15;
    const floats inverse = 0.5f / to_floats(count);
    ulongs moved = 0;
    for (uint axis = 0; axis < 3; ++axis) {
        const uint shift = BITS * axis;
        const ints above = (about >> (int)(4 + 4 * axis) & 15) - 8;
        const ints at = to_ints(here >> (ulongs)shift) & COORDINATE;
        const ints all = to_ints(sum >> (ulongs)shift) & COORDINATE;
        const ints apart = all + above * LATTICE - max(count, 4) * at;
        const ints sign = apart >> 31, size = (apart ^ sign) - sign;
        // the product is below 2^15, and with the half at least 1 / 48 away from any integer
        const ints step = (to_ints((to_floats(size) + 0.5f) * inverse) ^ sign) - sign;
        const ints kept = clamp(at + step, NEAREST, LATTICE - NEAREST);
        moved |= to_ulongs(kept) << (ulongs)shift;
    }
    store(moved, relaxed + first);
}

// Sets the coordinates of the vertices in their cubes.
__kernel void unpack(__global const ulong *packed, const uint n, __global int *points)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong at = packed[gid];
    const int3 kept = {(int)at & COORDINATE, (int)(at >> BITS) & COORDINATE,
                       (int)(at >> 2 * BITS) & COORDINATE};
    const int3 low = ((vload3(gid, points) - LATTICE / 2) & ~(LATTICE - 1)) + LATTICE / 2;
    vstore3(low + kept, gid, points);
}
