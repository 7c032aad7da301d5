// The octree, bottom-up from shortened Morton codes ([voCCeL], section 3.2 and listing A.2). Host side:
// voxtool/svo/octree/build.py. Options: CODE.

#include "svo/octree/octree.h"

// stripped[i] = the code of the parent of refined node i; flags[i] = 1 if the node is the last refined
// child of its parent.
__kernel void strip_mortons(__global const CODE *codes, const uint n, __global CODE *stripped,
                            __global uint *flags)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    stripped[gid] = codes[gid] >> 3;
    flags[gid] = gid == n - 1 || codes[gid] >> 3 != codes[gid + 1] >> 3;
}

// Link refined node i, which is node `own` of its level, with its eight children; the children of a
// level-1 node are linked with their bricks.
__kernel void link_level(__global const CODE *codes, const uint n,
                         __global const uint *parent_index, const uint is_root, const uint level,
                         const uint offset, const uint child_offset, __global svo_node *nodes)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint own = is_root ? 0 : 8 * parent_index[gid] + (uint)(codes[gid] & 7);
    nodes[offset + own].child = VALID | (8 * gid);
    for (uint j = 8 * gid; j < 8 * gid + 8; ++j) {
        nodes[child_offset + j].parent = VALID | own;
        if (level == 1)
            nodes[child_offset + j].child = VALID | j;
    }
}
