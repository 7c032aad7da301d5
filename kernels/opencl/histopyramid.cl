// The levels of a histopyramid. Host side: voxtool/opencl/primitives.py.

#include "opencl/primitives.h"

// A level of quadruples, from `offset` on, and the sums of its fives ([voCCeL], listing A.14).
// A quadruple is where the second to the fifth interval begin: the way down need not add. Saturated
// sums show that a total does not fit.
__kernel __attribute__((reqd_work_group_size(5 * QUADS, 1, 1))) void
build_level(__global const uint *values, const uint count, __global uint4 *levels, const uint offset,
            __global uint *sums, const uint fives)
{
    __local uint group[5 * QUADS];
    const uint gid = get_global_id(0), lid = get_local_id(0);
    group[lid] = gid < count ? values[gid] : 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    const uint i = QUADS * (uint)get_group_id(0) + lid;
    if (lid < QUADS && i < fives) {
        __local const uint *five = &group[5 * lid]; // five is odd: no bank conflicts
        const uint b = five[0], c = add_sat(b, five[1]), d = add_sat(c, five[2]);
        const uint e = add_sat(d, five[3]);
        levels[offset + i] = (uint4)(b, c, d, e);
        sums[i] = add_sat(e, five[4]);
    }
}
