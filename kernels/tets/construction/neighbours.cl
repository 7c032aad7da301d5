// The cells on both sides of each face. Host side: voxtool/tets/construction/neighbours.py. Option: CORNERS.

#include "tets/pictures/faces.h"
#include "tets/pictures/mixed.h"

// Face f of cell c is FACES c + f. Its bucket is its smallest vertex. Faces of equal keys have the
// same vertices, quadrilaterals nearly always.
__kernel void key_faces(__global const uint *cells, const uint n, __global uint *buckets,
                        __global ulong *keys)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint loop[SIDES];
    loop_of(cells, gid / FACES, gid % FACES, loop);
    buckets[gid] = loop[0];
    const ulong beside = (ulong)loop[1] << 32 | loop[SIDES - 1];
    keys[gid] = SIDES == 3 ? beside : mixed(mixed(beside) + loop[2]);
}

// Whether a face of the same bucket and key has the same vertices.
bool is_same(__global const uint *cells, const uint item, const uint *loop)
{
    uint other[SIDES];
    loop_of(cells, item / FACES, item % FACES, other);
    return other[1] == loop[1] && other[2] == loop[2] && other[SIDES - 1] == loop[SIDES - 1];
}

// neighbours[i] = the cell on the other side of face i, or -1. Counts the faces of more than two
// cells in counts[0], those of two cells on one side in counts[1].
__kernel void match_faces(__global const uint *cells, __global const uint *ends,
                          __global const ulong *keys, __global const uint *items, const uint n,
                          __global int *neighbours, volatile __global uint *counts)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint item = items[gid];
    const ulong key = keys[gid];
    uint loop[SIDES], other = 0, others = 0;
    const bool backward = loop_of(cells, item / FACES, item % FACES, loop);
    const uint begin = loop[0] ? ends[loop[0] - 1] : 0, end = ends[loop[0]];
    for (uint i = gid; i > begin && keys[i - 1] == key && others < 2; --i)
        if (is_same(cells, items[i - 1], loop)) {
            other = items[i - 1];
            ++others;
        }
    const bool first = others == 0;
    for (uint i = gid + 1; i < end && keys[i] == key && others < 2; ++i)
        if (is_same(cells, items[i], loop)) {
            other = items[i];
            ++others;
        }
    const bool folded =
        others == 1 && backward == loop_of(cells, other / FACES, other % FACES, loop);
    neighbours[item] = others == 1 && !folded ? (int)(other / FACES) : -1;
    if (first && others == 2)
        atomic_inc(&counts[0]);
    if (first && folded)
        atomic_inc(&counts[1]);
}
