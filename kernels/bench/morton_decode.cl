// The coordinates of cells from their Morton codes: by bits, or with TABLE by a table of the
// coordinates of nine bits [voCCeL, section 5.1]. Host side: voxtool/bench/text_peers.py.

#include "morton_bits.h"

__kernel void decode(__global const ulong *codes, const uint n, __global const uchar *table,
                     __global uint *cells)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong code = codes[gid];
    for (uint axis = 0; axis < 3; ++axis) {
#ifdef TABLE
        uint found = 0;
        for (uint i = 0; i < 7; ++i)
            found |= (uint)table[512 * axis + (code >> 9 * i & 511)] << 3 * i;
#else
        const uint found = gather_bits(code >> axis);
#endif
        cells[3 * (size_t)gid + axis] = found;
    }
}
