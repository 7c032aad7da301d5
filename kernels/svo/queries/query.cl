// Queries of an octree at points. Host side: voxtool/svo/queries/query.py.
//
// The octree: words, the `child` words of its nodes above level 0, root first; firsts[d], the place of
// the first node d levels below the root; bricks. A node has size 2^k voxels: k = 0 voxels, 2 bricks,
// `root` the root.

#include "svo/octree/octree.h"
#include "svo/queries/query.h"

#define BRICK 2 // k of a brick

#define OCTREE                                                                                     \
    __global const uint *words, __global const ulong *firsts, __global const ulong *bricks,        \
        const int root

// found[i] of a voxel: of size 2^0, whether it is set; otherwise the place of the node of size
// 2^finest around it among those of its level, after NODES, or that of a leaf above, EMPTY or FULL.
__kernel void find_nodes(const uint n, __global const ushort *voxels, OCTREE, const int finest,
                         __global uint *found)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint x = voxels[3 * gid], y = voxels[3 * gid + 1], z = voxels[3 * gid + 2];
    uint node = 0;
    for (int k = root; k > BRICK && k > finest; --k) {
        const uint word = words[firsts[root - k] + node];
        if (!(word & VALID)) {
            found[gid] = word & INSIDE ? FULL : EMPTY;
            return;
        }
        const int below = k - 1;
        node = (word & LINK) +
               ((x >> below & 1) | (y >> below & 1) << 1 | (z >> below & 1) << 2);
    }
    if (finest) {
        found[gid] = NODES + node;
        return;
    }
    const uint bit = (x & 1) | (y & 1) << 1 | (z & 1) << 2 | (x & 2) << 2 | (y & 2) << 3 |
                     (z & 2) << 4;
    found[gid] = bricks[node] >> bit & 1 ? FULL : EMPTY;
}
