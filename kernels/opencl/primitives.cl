// Parallel primitives. Host side: voxtool/opencl/primitives.py. Options: KEY, for sort and
// compaction; BLOCKS, for a sort by blocks.

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

// ---- bucket sort

// counts[b] = the number of items in bucket b; 0 before.
__kernel void count_buckets(__global const uint *buckets, const uint n,
                            volatile __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        atomic_inc(&counts[buckets[gid]]);
}

// Moves each item to its bucket, in any order; next[b], where bucket b begins, becomes its end.
__kernel void fill_buckets(__global const uint *buckets, __global const ulong *keys, const uint n,
                           volatile __global uint *next, __global ulong *sorted,
                           __global uint *items)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint to = atomic_inc(&next[buckets[gid]]);
    sorted[to] = keys[gid];
    items[to] = gid;
}

// Whether a key comes before another one; equal ones in the order of their items.
bool before(ulong key, uint item, ulong other_key, uint other_item)
{
    return key < other_key || (key == other_key && item < other_item);
}

// Moves the root of a heap of `count` down to its place.
void sift_down(__global ulong *keys, __global uint *items, uint root, const uint count)
{
    const ulong key = keys[root];
    const uint item = items[root];
    for (uint child; (child = 2 * root + 1) < count; root = child) {
        if (child + 1 < count &&
            before(keys[child], items[child], keys[child + 1], items[child + 1]))
            ++child;
        if (!before(key, item, keys[child], items[child]))
            break;
        keys[root] = keys[child];
        items[root] = items[child];
    }
    keys[root] = key;
    items[root] = item;
}

void insertion_sort(__global ulong *keys, __global uint *items, const uint count)
{
    for (uint i = 1; i < count; ++i) {
        const ulong key = keys[i];
        const uint item = items[i];
        uint to = i;
        for (; to > 0 && before(key, item, keys[to - 1], items[to - 1]); --to) {
            keys[to] = keys[to - 1];
            items[to] = items[to - 1];
        }
        keys[to] = key;
        items[to] = item;
    }
}

// In time n log n, whatever the order of the items.
void heap_sort(__global ulong *keys, __global uint *items, const uint count)
{
    for (uint root = count / 2; root-- > 0;)
        sift_down(keys, items, root, count);
    for (uint last = count; last-- > 1;) {
        const ulong key = keys[last];
        const uint item = items[last];
        keys[last] = keys[0];
        items[last] = items[0];
        keys[0] = key;
        items[0] = item;
        sift_down(keys, items, 0, last);
    }
}

// Sorts each bucket.
__kernel void sort_buckets(__global const uint *ends, const uint n, __global ulong *keys,
                           __global uint *items)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint begin = gid ? ends[gid - 1] : 0, count = ends[gid] - begin;
    if (count <= FEW)
        insertion_sort(keys + begin, items + begin, count);
    else
        heap_sort(keys + begin, items + begin, count);
}

#else

// ---- radix sort

// The digit of a key at bit `shift`; `digits` is their number, a power of two.
uint digit_of(KEY key, uint shift, uint digits) { return (uint)(key >> shift) & (digits - 1); }

#ifdef BLOCKS

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
#endif
