// Histogram pyramids. Host side: voxtool/opencl/histopyramid.py. Option: ARITY.

#include "opencl/histopyramid.h"

// A level: for each of the `groups` groups of each run of `count` values its stored values, from
// `place` on, and its sum.
__kernel void reduce_level(__global const uint *values, const uint count, const uint n,
                           const uint groups, const uint place, __global uint *pyramid,
                           __global uint *sums)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint first = ARITY * (gid % groups);
    __global const uint *from = values + (size_t)(gid / groups) * count + first;
    __global uint *to = pyramid + place + STORED * (size_t)gid;
    uint sum = 0;
    for (uint child = 0; child < ARITY; ++child) {
        const uint value = first + child < count ? from[child] : 0;
        if (child < STORED)
            to[child] = value;
        sum += value;
    }
    sums[gid] = sum;
}

// The sum of the values before each one, with all runs before its own; at last the sum of all.
__kernel void number_inputs(const uint n, PYRAMID, __global const uint *sums,
                            __global uint *starts)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint run = gid + 1 < n ? gid / inputs : runs;
    uint sum = run < runs ? sum_before(THIS_PYRAMID, run, gid % inputs) : 0;
    for (uint before = 0; before < run; ++before)
        sum += sums[before];
    starts[gid] = sum;
}
