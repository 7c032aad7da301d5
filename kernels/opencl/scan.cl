// Prefix sums. Host side: voxtool/opencl/primitives.py.

#include "opencl/scan_group.h"

// sums[g] = the sum of block g of `values`.
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void
sum_blocks(__global const uint *values, const uint count, __global uint *sums)
{
    __local uint buffer[2 * GROUP];
    const uint start = (uint)get_global_id(0) * ITEMS;
    uint sum = 0, total;
    for (uint i = start; i < min(start + ITEMS, count); ++i)
        sum += values[i];
    scan_group(sum, buffer, &total);
    if (get_local_id(0) == 0)
        sums[get_group_id(0)] = total;
}

// out[i] = the sum of values[0 .. i - 1], where sums[g] is that before block g (a single block needs
// no sums); out[n] = the sum of all. `out` may be `values`.
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void
scan_blocks(__global const uint *values, const uint count, __global const uint *sums,
            __global uint *out)
{
    __local uint buffer[2 * GROUP];
    const uint start = (uint)get_global_id(0) * ITEMS;
    uint value[ITEMS], sum = 0, total;
    for (uint i = 0; i < ITEMS; ++i) {
        value[i] = start + i < count ? values[start + i] : 0;
        sum += value[i];
    }
    uint running = scan_group(sum, buffer, &total);
    if (get_num_groups(0) > 1)
        running += sums[get_group_id(0)];
    for (uint i = 0; i < ITEMS && start + i <= count; ++i) {
        out[start + i] = running;
        running += value[i];
    }
}
