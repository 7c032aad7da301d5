// Traversal of a 5:1 histopyramid (section 4.1 of the thesis): the host's Histopyramid.arguments.
#define HISTOPYRAMID                                                                               \
    __global const uint4 *pyramid_levels, __global const uint *pyramid_offsets,                    \
        const uint pyramid_height
#define THIS_HISTOPYRAMID pyramid_levels, pyramid_offsets, pyramid_height

// One step down from node i: the child whose interval holds *k, which is then counted from its begin.
uint histopyramid_step(HISTOPYRAMID, uint level, uint i, uint *k)
{
    const uint4 v = pyramid_levels[pyramid_offsets[level] + i]; // intervals may be empty
    const uint at = *k;
    *k = at - (at >= v.w ? v.w : at >= v.z ? v.z : at >= v.y ? v.y : at >= v.x ? v.x : 0);
    return 5 * i + (at >= v.x) + (at >= v.y) + (at >= v.z) + (at >= v.w);
}

// The input that has output k = get_global_id(0) of n; `r` is which of that input's outputs it is. All
// work-items of a group call this. Their outputs lie next to each other, and most of their way down is
// the same: the first of them finds where the ways part (level, node and first output: `fork`).
uint histopyramid_traverse(HISTOPYRAMID, uint n, __local uint *fork, uint *r)
{
    const uint k = get_global_id(0);
    if (get_local_id(0) == 0) {
        uint first = k, last = min(k + (uint)get_local_size(0), n) - 1, level = 0, i = 0;
        fork[2] = 0;
        for (; level < pyramid_height; ++level) {
            const uint next = histopyramid_step(THIS_HISTOPYRAMID, level, i, &first);
            if (next != histopyramid_step(THIS_HISTOPYRAMID, level, i, &last))
                break;
            i = next;
            fork[2] = k - first;
        }
        fork[0] = level;
        fork[1] = i;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    uint i = fork[1];
    *r = k - fork[2];
    if (k < n)
        for (uint level = fork[0]; level < pyramid_height; ++level)
            i = histopyramid_step(THIS_HISTOPYRAMID, level, i, r);
    return i;
}
