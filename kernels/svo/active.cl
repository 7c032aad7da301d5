// The set of active level-1 nodes as bits in Morton order. Host side: voxtool/svo/active.py. Options:
// CODE, BLOCKED.

#include "svo/octree.h"
#include "svo/scan.h"
#include "svo/active.h"

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

// Set the bits of level-1 nodes, given by their codes, or of the blocks that contain them.
__kernel void activate_nodes(__global const CODE *codes, const uint n, const int level,
                             ACTIVE_SET_PARAMETERS, volatile __global uint *target)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const CODE code =
        level == NODE_LEVEL ? stored_code(ACTIVE_SET, codes[gid]) : codes[gid] >> 9;
    atomic_or(&target[(uint)(code >> 5)], 1u << (uint)(code & 31));
}
