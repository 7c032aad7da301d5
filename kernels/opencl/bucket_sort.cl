// Bucket sort. Host side: voxtool/opencl/primitives.py.

#include "opencl/primitives.h"

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
