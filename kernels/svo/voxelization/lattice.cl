// Survey of a mesh on a grid's lattice, for the plan. Host side: voxtool/svo/voxelization/lattice.py.

#include "svo/octree/octree.h"
#include "svo/voxelization/scan_conversion_constants.h"
#include "svo/voxelization/overlap.h"

// For the triangles of each work-item: the largest extent in units, twice the projected areas along x,
// y and z in 1/256 voxel^2, but no more than their boxes have in the grid, 1 if a triangle reaches below x = 0, and the number of triangles that
// touch no box of the grid.
__kernel void survey(__global const int *vertices, __global const int *faces, const uint count,
                     const int3 shape, __global ulong *partial)
{
    const uint gid = get_global_id(0), items = get_global_size(0);
    ulong extent = 0, before = 0, outside = 0;
    ulong3 areas = 0;
    // the high end of blocks of level-1 nodes, which are widened by half a voxel along x
    const long3 end = convert_long3((shape + NODE_BLOCK - 1) / NODE_BLOCK * NODE_BLOCK) * VOXEL + HALF;
    for (uint i = gid; i < count; i += items) {
        const triangle t = fetch_triangle(vertices, faces, i);
        int3 low, high;
        find_bounds(&t, &low, &high);
        if (any(high.yz < 0) || any(convert_long3(low) > end)) {
            ++outside;
            continue;
        }
        if (low.x < 0)
            before = 1;
        const uint3 size = as_uint3(high) - as_uint3(low);
        extent = max(extent, (ulong)max(max(size.x, size.y), size.z));
        const int3 part = max(min(high, shape * VOXEL) - max(low, 0), 0);
        const ulong3 box = convert_ulong3(part.yzx) * convert_ulong3(part.zxy) * 2;
        areas += min(abs(cross_of(t.v[1] - t.v[0], t.v[2] - t.v[0])), box) >> FIXED_POINT_BITS;
    }
    __global ulong *out = partial + 6 * gid;
    out[0] = extent;
    vstore3(areas, 0, out + 1);
    out[4] = before;
    out[5] = outside;
}
