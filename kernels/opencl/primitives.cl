// Parallel primitives. Host side: voxtool/opencl/primitives.py.

#define BLOCK 256u // work-items of a group
#define ITEMS 8u   // values of a work-item

// The exclusive prefix sum of `value` over a work-group; `total` is the sum over the group.
// Hillis and Steele's scan, double-buffered in local memory.
uint scan_group(uint value, __local uint *buffer, uint *total)
{
    const uint lid = get_local_id(0);
    uint from = 0;
    buffer[lid] = value;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint step = 1; step < BLOCK; step <<= 1) {
        const uint to = BLOCK - from;
        buffer[to + lid] = buffer[from + lid] + (lid >= step ? buffer[from + lid - step] : 0);
        barrier(CLK_LOCAL_MEM_FENCE);
        from = to;
    }
    *total = buffer[from + BLOCK - 1];
    return buffer[from + lid] - value;
}

// sums[g] = the sum of block g of `values`.
__kernel __attribute__((reqd_work_group_size(256, 1, 1))) void
sum_blocks(__global const uint *values, const uint n, __global uint *sums)
{
    __local uint buffer[2 * BLOCK];
    const uint start = (uint)get_global_id(0) * ITEMS;
    uint sum = 0, total;
    for (uint i = start; i < min(start + ITEMS, n); ++i)
        sum += values[i];
    scan_group(sum, buffer, &total);
    if (get_local_id(0) == 0)
        sums[get_group_id(0)] = total;
}

// out[i] = the sum of values[0 .. i - 1], where sums[g] is that before block g (a single block needs
// no sums); out[n] = the sum of all. `out` may be `values`.
__kernel __attribute__((reqd_work_group_size(256, 1, 1))) void
scan_blocks(__global const uint *values, const uint n, __global const uint *sums, __global uint *out)
{
    __local uint buffer[2 * BLOCK];
    const uint start = (uint)get_global_id(0) * ITEMS;
    uint value[ITEMS], sum = 0, total;
    for (uint i = 0; i < ITEMS; ++i) {
        value[i] = start + i < n ? values[start + i] : 0;
        sum += value[i];
    }
    uint running = scan_group(sum, buffer, &total);
    if (get_num_groups(0) > 1)
        running += sums[get_group_id(0)];
    for (uint i = 0; i < ITEMS && start + i <= n; ++i) {
        out[start + i] = running;
        running += value[i];
    }
}
