// Compaction. Host side: voxtool/opencl/primitives.py. Option: KEY.

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
