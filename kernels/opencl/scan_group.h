// The scan of a work-group.

#include "opencl/primitives.h"

// The exclusive prefix sum of `value` over a work-group; `total` is the sum over the group.
// Hillis and Steele's scan, double-buffered in local memory.
uint scan_group(uint value, __local uint *buffer, uint *total)
{
    const uint lid = get_local_id(0);
    uint from = 0;
    buffer[lid] = value;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint step = 1; step < GROUP; step <<= 1) {
        const uint to = GROUP - from;
        buffer[to + lid] = buffer[from + lid] + (lid >= step ? buffer[from + lid - step] : 0);
        barrier(CLK_LOCAL_MEM_FENCE);
        from = to;
    }
    *total = buffer[from + GROUP - 1];
    return buffer[from + lid] - value;
}
