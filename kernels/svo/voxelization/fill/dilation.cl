// Voxels up to a number of steps from a surface, and the outside grown by steps. Host side:
// voxtool/svo/voxelization/fill/dilation.py. Options: CODE.

#include "svo/octree/octree.h"
#include "svo/voxelization/fill/flood.h"
#include "svo/voxelization/morton.h"
#include "svo/voxelization/fill/beside.h"

// True if a brick has voxels whose coordinate along an axis is first, ... or last.
bool has_voxels(ulong mask, int axis, int first, int last)
{
    for (int i = max(first, 0); i <= min(last, 3); ++i)
        if (mask >> shift_to(axis, i) & LOW[axis])
            return true;
    return false;
}

// The level-1 nodes that lie up to `reach` voxels (1 to 8) from a node's voxels, or without masks from
// the whole node: firsts[i] = how many; with `found`, their codes from found[firsts[i]] on.
__kernel void list_reached(__global const CODE *codes, const uint n, __global const ulong *masks,
                           const int reach, __global uint *firsts, __global CODE *found)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    int low[3] = {-1, -1, -1}, high[3] = {1, 1, 1};
    for (int axis = 0; axis < 3 && masks; ++axis) {
        ulong halves[2] = {0, 0};
        for (int o = 0; o < 8; ++o)
            halves[o >> axis & 1] |= masks[8 * (size_t)gid + o];
        low[axis] = -(has_voxels(halves[0], axis, 0, reach - 1) || has_voxels(halves[1], axis, 0, reach - 5));
        high[axis] = has_voxels(halves[1], axis, 4 - reach, 3) || has_voxels(halves[0], axis, 8 - reach, 3);
    }
    if (!found) {
        firsts[gid] = (high[0] - low[0] + 1) * (high[1] - low[1] + 1) * (high[2] - low[2] + 1);
        return;
    }
    const uint3 own = morton_decode(codes[gid]);
    uint place = firsts[gid];
    for (int z = low[2]; z <= high[2]; ++z)
        for (int y = low[1]; y <= high[1]; ++y)
            for (int x = low[0]; x <= high[0]; ++x)
                found[place++] = morton_encode(own + convert_uint3((int3)(x, y, z)));
}

// grown[i] = the voxels up to `reach` steps (1 to 4) along an axis from those of the masks.
__kernel void dilate_along(__global const uint *beside, const uint n, const int axis, const int reach,
                           __global const ulong *masks, __global ulong *grown)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong line[12]; // the voxels of coordinate 0 in the brick before, ... 3 in the brick after
    for (int i = 0; i < 3; ++i) {
        const int step = i - 1;
        const int3 d = (int3)(axis == 0 ? step : 0, axis == 1 ? step : 0, axis == 2 ? step : 0);
        uint octant;
        const uint other = beside_brick(beside, gid >> 3, gid & 7, d, &octant);
        const bool brick = other != NOTHING && other & VALID;
        const ulong mask = brick ? masks[8 * (size_t)(other & LINK) + octant] : 0;
        for (int j = 0; j < 4; ++j)
            line[4 * i + j] = mask >> shift_to(axis, j) & LOW[axis];
    }
    ulong found = 0;
    for (int j = 0; j < 4; ++j) {
        ulong voxels = 0;
        for (int k = 4 + j - reach; k <= 4 + j + reach; ++k)
            voxels |= line[k];
        found |= voxels << shift_to(axis, j);
    }
    grown[gid] = found;
}

// grown[i] = outside[i] and the voxels of brick i's barrier that touch the outside: voxels of other
// bricks, or leaves.
__kernel void grow_outside(__global const uint *beside, const uint n, __global const uchar *states,
                           __global const ulong *barrier, __global const ulong *outside,
                           __global ulong *grown)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong left = barrier[gid] & ~outside[gid];
    ulong found = 0;
    for (int i = 0; i < 27 && left & ~found; ++i) {
        uint octant;
        const int3 d = direction(i);
        const uint other = beside_brick(beside, gid >> 3, gid & 7, d, &octant);
        ulong mask = ~0ul; // beyond the octree is outside
        if (other != NOTHING)
            mask = other & VALID ? outside[8 * (other & LINK) + octant] : states[other] == EMPTY ? ~0ul : 0;
        found |= mask ? spilled(mask, -d) : 0;
    }
    grown[gid] = outside[gid] | (found & left);
}
