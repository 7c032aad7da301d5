// The relaxation of surface nets [Gibson 1998]: each vertex moves halfway to the mean of its
// neighbours, but stays in its cube. Host side: voxtool/svo/surface/dual.py. Options: LANES, BATCH.

#include "svo/surface/lattice.h"
#include "svo/surface/relaxation.h"
#include "lanes.h"

// LANES vertices moved halfway to the mean of their neighbours, given the neighbours' sums.
ulongs moved(ulongs packed, ulongs sums, ints about)
{
    const ints count = about & 15;
    const floats inverse = 0.5f / to_floats(count);
    ulongs kept = 0;
    for (uint axis = 0; axis < 3; ++axis) {
        const uint shift = BITS * axis;
        const ints at = to_ints(packed >> (ulongs)shift) & COORDINATE;
        const ints sum = to_ints(sums >> (ulongs)shift) & COORDINATE;
        const ints above = (about >> (int)(4 + 4 * axis) & 15) - 8;
        const ints apart = sum + above * LATTICE - max(count, 4) * at;
        const ints sign = apart >> 31, size = (apart ^ sign) - sign;
        // the product is below 2^15, and with the half at least 1 / 48 away from any integer
        const ints step = (to_ints((to_floats(size) + 0.5f) * inverse) ^ sign) - sign;
        kept |= to_ulongs(clamp(at + step, NEAREST, LATTICE - NEAREST)) << (ulongs)shift;
    }
    return kept;
}

// BATCH vertices, LANES at a time; those beyond the last are unused.
__kernel void relax(__global const ulong *packed, RELAXATION, const uint n, __global ulong *relaxed)
{
    const size_t first = BATCH * get_global_id(0);
    if (get_global_id(0) >= n)
        return;
    ulong sums[BATCH];
    for (uint i = 0; i < BATCH; ++i) {
        __global const uint *link = links + 4 * (first + i);
        sums[i] = packed[link[0]] + packed[link[1]] + packed[link[2]] + packed[link[3]];
    }
    const uint end = beyond_start[get_global_id(0) + 1];
    for (uint i = beyond_start[get_global_id(0)]; i < end; ++i)
        sums[beyond[i].x - first] += packed[beyond[i].y];
    for (uint i = 0; i < BATCH; i += LANES)
        store(moved(load(packed + first + i), load(sums + i), to_ints(load(around + first + i))),
              relaxed + first + i);
}
