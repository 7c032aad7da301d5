// Parallel primitives. Host side: voxtool/opencl/primitives.py. Options: KEY, for sort and
// compaction.

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

#ifndef KEY

// ---- scan

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

// ---- histopyramid

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

#else

// ---- radix sort

// The digit of a key at bit `shift`; `digits` is their number, a power of two.
uint digit_of(KEY key, uint shift, uint digits) { return (uint)(key >> shift) & (digits - 1); }

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

// ---- compaction

// flags[i] = 1 where a key is the last of equal ones.
__kernel void flag_last(__global const KEY *keys, const uint n, __global uint *flags)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        flags[gid] = gid == n - 1 || keys[gid] != keys[gid + 1];
}

// The flagged values; `places` is the exclusive scan of the n flags.
__kernel void move_flagged(__global const KEY *values, const uint n, __global const uint *places,
                           __global KEY *kept)
{
    const uint gid = get_global_id(0);
    if (gid < n && places[gid] != places[gid + 1])
        kept[places[gid]] = values[gid];
}

#endif
