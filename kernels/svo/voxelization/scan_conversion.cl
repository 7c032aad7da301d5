// Bits of the boxes that triangles touch: level-1 nodes, blocks of level-1 nodes, and voxels ([voCCeL],
// sections 3.2 and A.4). Host side: voxtool/svo/voxelization/scan_conversion.py. Options: those of scan_conversion.h.

#include "svo/voxelization/columns.h"

// tiles[i] = the number of tiles of triangle i.
__kernel void count_tiles(TRIANGLES, const int kind, __global uint *tiles)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const triangle t = fetch_triangle(vertices, faces, gid);
    tiles[gid] = columns_of(&t, kind, level, shape, (int3)(pad, 0, 0)).tiles;
}

// ---- storage of boxes

// Put the bit of a box of 2^level voxels: into bricks, or a set of nodes, of blocks or of regions.
void put_box(sink *out, int level, ACTIVE_SET_PARAMETERS, uint3 box)
{
    if (level == 0) {
        put_voxel(out, ACTIVE_SET, box);
        return;
    }
    const CODE code = stored_code(ACTIVE_SET, morton_encode(box));
    put(out, (uint)(code >> 5), 1u << (uint)(code & 31));
}

#define RECEIVER sink
#include "svo/voxelization/scan_conversion.h"

// ---- kernels

// Set the bits of boxes of 2^level voxels, widened by `pad` along x: those whose closed cube touches a
// triangle (`kind` is TOUCHED), or the 6-separating set (SEPARATING). Boxes are voxels, level-1 nodes
// (level 3), blocks of 8 x 8 x 8 of those (level 6), or regions of 8 x 8 x 8 blocks (level 9).
__kernel void set_boxes(TRIANGLES, const int kind, ACTIVE_SET_PARAMETERS,
                        volatile __global uint *target)
{
    triangle t;
    columns c;
    if (!take_share(THESE_TRIANGLES, kind, &t, &c))
        return;
    const scan s = set_up(&t, &c, kind, level, pad);
    sink out = open_sink(target, false);
    scan_convert(&s, &c, &out, level, ACTIVE_SET);
    flush(&out);
}

// ---- the set of active level-1 nodes, as bits in Morton order

// counts[i] = the number of bits set in word i.
__kernel void count_bits(__global const uint *words, const uint n, __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        counts[gid] = popcount(words[gid]);
}

// Write the Morton codes of the set bits, in order ([voCCeL], listing A.5). In a blocked set, every
// block has 16 words, and `blocks` holds the codes of the blocks.
__kernel void write_mortons(__global const uint *words, const uint n, __global const uint *ranks,
                            __global const CODE *blocks, __global CODE *codes)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const CODE base = blocks ? (blocks[gid >> 4] << 9) | (CODE)((gid & 15) << 5) : (CODE)gid << 5;
    uint out = ranks[gid];
    for (uint word = words[gid]; word; word &= word - 1)
        codes[out++] = base | (CODE)popcount((word & -word) - 1u);
}

// Set the bits of level-1 nodes, given by their codes, or of the boxes of 2^level voxels around them.
__kernel void activate_nodes(__global const CODE *codes, const uint n, const int level,
                             ACTIVE_SET_PARAMETERS, volatile __global uint *target)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const CODE code = stored_code(ACTIVE_SET, codes[gid] >> (3 * (level - NODE_LEVEL)));
    atomic_or(&target[(uint)(code >> 5)], 1u << (uint)(code & 31));
}
