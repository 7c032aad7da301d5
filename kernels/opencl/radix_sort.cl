// Radix sort. Host side: voxtool/opencl/primitives.py. Options: KEY; BLOCKS, for a sort by blocks.

#include "opencl/primitives.h"

// The digit of a key at bit `shift`; `digits` is their number, a power of two.
uint digit_of(KEY key, uint shift, uint digits) { return (uint)(key >> shift) & (digits - 1); }

#ifdef BLOCKS

#include "opencl/scan_group.h"

// ---- by blocks: work-group g has keys[GROUP * ITEMS * g ..], a block of count keys

#define MOST_DIGITS (1 << BLOCK_DIGIT_BITS)

// counts[digit * blocks + g] = how many keys of a block have this digit.
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void
count_block_digits(__global const KEY *keys, const uint count, const uint shift, const uint digits,
                   const uint blocks, __global uint *counts)
{
    __local uint found[MOST_DIGITS];
    const uint lid = get_local_id(0), group = get_group_id(0), start = group * GROUP * ITEMS;
    if (lid < digits)
        found[lid] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    const uint end = min(start + GROUP * ITEMS, count);
    for (uint i = start + lid; i < end; i += GROUP)
        atomic_inc(&found[digit_of(keys[i], shift, digits)]);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lid < digits)
        counts[lid * blocks + group] = found[lid];
}

// As scatter_keys, where starts[digit * blocks + g] is the place of a block's first key with a
// digit. A work-item has ITEMS consecutive keys. The scan of its counts, all work-items of a digit
// before those of the next, gives each key its rank in the block [Satish 2009].
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void
scatter_block_keys(__global const KEY *keys, const uint count, const uint shift, const uint digits,
                   const uint blocks, __global const uint *starts, __global KEY *sorted,
                   __global const uint *values, __global uint *sorted_values)
{
    __local uint ranks[MOST_DIGITS * GROUP], first[MOST_DIGITS], buffer[2 * GROUP];
    const uint lid = get_local_id(0), group = get_group_id(0);
    const uint start = (uint)get_global_id(0) * ITEMS, end = min(start + ITEMS, count);
    for (uint digit = 0; digit < digits; ++digit)
        ranks[digit * GROUP + lid] = 0;
    for (uint i = start; i < end; ++i)
        ++ranks[digit_of(keys[i], shift, digits) * GROUP + lid];
    barrier(CLK_LOCAL_MEM_FENCE);
    uint sum = 0, total;
    for (uint i = digits * lid; i < digits * (lid + 1); ++i)
        sum += ranks[i];
    uint running = scan_group(sum, buffer, &total);
    for (uint i = digits * lid; i < digits * (lid + 1); ++i) {
        const uint own = ranks[i];
        ranks[i] = running;
        running += own;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lid < digits)
        first[lid] = starts[lid * blocks + group] - ranks[lid * GROUP];
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint i = start; i < end; ++i) {
        const KEY key = keys[i];
        const uint digit = digit_of(key, shift, digits);
        const uint to = first[digit] + ranks[digit * GROUP + lid]++;
        sorted[to] = key;
        if (values)
            sorted_values[to] = values[i];
    }
}

#else

// ---- by portions: work-item gid of n has keys[portion * gid ..], a portion of count keys

// counts[digit * n + gid] = how many keys of a portion have this digit.
__kernel void count_digits(__global const KEY *keys, const uint count, const uint portion,
                           const uint shift, const uint digits, const uint n,
                           __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint found[1 << DIGIT_BITS];
    for (uint digit = 0; digit < digits; ++digit)
        found[digit] = 0;
    const uint end = min(portion * gid + portion, count);
    for (uint i = portion * gid; i < end; ++i)
        ++found[digit_of(keys[i], shift, digits)];
    for (uint digit = 0; digit < digits; ++digit)
        counts[digit * n + gid] = found[digit];
}

// Keys in the order of a digit, where starts[digit * n + gid] is the place of a portion's
// first key with it; their values too, if there are.
__kernel void scatter_keys(__global const KEY *keys, const uint count, const uint portion,
                           const uint shift, const uint digits, const uint n,
                           __global const uint *starts, __global KEY *sorted,
                           __global const uint *values, __global uint *sorted_values)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint place[1 << DIGIT_BITS];
    for (uint digit = 0; digit < digits; ++digit)
        place[digit] = starts[digit * n + gid];
    const uint end = min(portion * gid + portion, count);
    for (uint i = portion * gid; i < end; ++i) {
        const KEY key = keys[i];
        const uint to = place[digit_of(key, shift, digits)]++;
        sorted[to] = key;
        if (values)
            sorted_values[to] = values[i];
    }
}

#endif
