// Turns refined children into the cells of the next level. Host side: voxtool/adf/construction.py.

// For the refined children, numbered by parent_ranks: identifiers, source indices and triangle counts.
__kernel void list_refined(const uint n, __global const uint *parent_ranks,
                           __global const ulong *parent_identifiers,
                           __global const uint *parent_needed, __global ulong *identifiers,
                           __global uint *sources, __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid >= n || parent_ranks[gid] == parent_ranks[gid + 1])
        return;
    const uint rank = parent_ranks[gid];
    identifiers[rank] = parent_identifiers[gid / 8] << 3 | gid % 8;
    sources[rank] = gid;
    counts[rank] = parent_needed[gid];
}

// Copies the triangles of refined cells from the lists of their parents.
__kernel void pass_lists_on(const uint n, __global const uint *sources,
                            __global const uint *parent_begins, __global const uint *parent_items,
                            __global const uchar *parent_masks, __global const uint *begins,
                            __global uint *items)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint parent = sources[gid] / 8, child = sources[gid] % 8;
    uint at = begins[gid];
    for (uint j = parent_begins[parent]; j < parent_begins[parent + 1]; ++j)
        if (parent_masks[j] >> child & 1)
            items[at++] = parent_items[j];
}
