// Sums along rows of voxels, of the areas and volumes of the parts of triangles: the shares of voxels and
// of their faces that lie inside. Host side: voxtool/svo/attribution/fraction_rows.py. Options: those of
// columns.h.

#include "svo/voxelization/columns.h"
#include "svo/attribution/fraction.h"

#define ONE (1l << UNIT_BITS) // a whole voxel, and a whole face of one
#define MAX_LEVELS 16

// The share of a voxel that is inside, from the integral of its winding number.
long share_of(long sum, uint rule)
{
    if (rule == PARITY) { // 0 at even numbers, 1 at odd ones, and linear between
        const long rest = sum & (2 * ONE - 1);
        return min(rest, 2 * ONE - rest);
    }
    return clamp(rule == NONZERO && sum < 0 ? -sum : sum, 0l, ONE);
}

// A share in units of 1 / WHOLE.
uint stored(long share) { return (uint)((share + (ONE / WHOLE) / 2) / (ONE / WHOLE)); }

// The winding number after touched voxels, where a row has none: that of the sum or, if it is no whole
// number or contradicts the rule, what the rule says.
long number_after(long sum, bool inside, uint rule, uint *wrong)
{
    const long number = (sum + ONE / 2) >> UNIT_BITS, whole = number << UNIT_BITS;
    const bool by_sum = rule == PARITY ? number & 1 : rule == NONZERO ? number != 0 : number > 0;
    if (by_sum == inside && abs(sum - whole) <= CLOSED)
        return whole;
    ++*wrong;
    return inside ? ONE : 0;
}

// Traverse the octree along a bundle of 8 x 8 rows of an axis, all or the `chosen` ones. For rows along
// x, turn sums into shares of touched voxels, in units of 1 / WHOLE. The bricks, of the rule's voxels,
// become those that have a share; `partial` are those whose share is neither 0 nor WHOLE. For all rows,
// if `faces` are asked for, these become the shares of the two faces of touched voxels across the axis.
// The area of a voxel is
// areas[2 * number + start], its volume the next. `wrong` counts where sums and rule disagree.
__kernel void sum_rows(__global const svo_node *nodes, __constant uint *offsets, const uint top,
                       const int3 shape, const int axis, const uint n,
                       __global const uint *chosen, const uint rule,
                       __global const long *entry, __global const ulong *touched,
                       __global const uint *firsts, __global const long *areas, const uint start,
                       __global ulong *bricks, __global ulong *partial, __global uint *shares,
                       __global uint *faces, volatile __global uint *wrong)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int ap = axis < 2 ? axis + 1 : 0, aq = axis > 0 ? axis - 1 : 2; // rows are at (p, q)
    const uint3 size = as_uint3(swizzle(shape, axis));
    const uint bundle = chosen ? chosen[gid] : gid, bundles = (size.x + 7) / 8;
    const uint p = bundle % bundles, q = bundle / bundles;
    long sum[64];
    uint last[64]; // the voxel before, if it is touched
    for (uint row = 0; row < 64; ++row) {
        const uint j = 8 * p + (row & 7), k = 8 * q + (row >> 3);
        sum[row] = entry && j < size.x && k < size.y ? entry[(size_t)k * size.x + j] : 0;
        last[row] = UNTOUCHED;
    }
    ulong moved = entry ? ~0ul : 0; // rows whose sums are those of a touched voxel, or of the entry
    uint found = 0;
    const ulong pair_places = 1ul | 1ul << (1 << axis), row_places = pair_places | pair_places << (8 << axis);
    const uint end = (size.z + 7) / 8;
    uint path[MAX_LEVELS]; // the nodes that contain cell (x, p, q), by level
    path[top] = 0;
    uint x = 0, level = top;
    while (x < end) {
        uint child = nodes[offsets[top - level] + path[level]].child;
        while (level > 1 && (child & VALID)) {
            --level;
            const uint shift = level - 1;
            path[level] = (child & LINK) | ((x >> shift) & 1) << axis | ((p >> shift) & 1) << ap |
                          ((q >> shift) & 1) << aq;
            child = nodes[offsets[top - level] + path[level]].child;
        }
        uint next;
        if (child & VALID) {
            next = x + 1;
            const uint count = min(8u, size.z - 8 * x);
            for (uint o = 0; o < 4; ++o) {
                const size_t low = (child & LINK) + ((o & 1) << ap) + ((o >> 1) << aq);
                const size_t pair[2] = {low, low + (1 << axis)};
                const ulong any = touched[pair[0]] | touched[pair[1]];
                ulong set[2] = {0, 0}, part[2] = {0, 0};
                for (uint inner = 0; inner < 16; ++inner) {
                    const uint j = inner & 3, k = inner >> 2;
                    const uint row = (4 * (o & 1) + j) + 8 * (4 * (o >> 1) + k);
                    const uint at = (j & 1) << ap | (j >> 1) << (3 + ap) | (k & 1) << aq | (k >> 1) << (3 + aq);
                    if (!(any >> at & row_places) && !(moved >> row & 1))
                        continue;
                    long own = sum[row];
                    bool after = moved >> row & 1;
                    for (uint i = 0; i < count; ++i) {
                        const size_t brick = pair[i >> 2];
                        const uint bit = at + ((i & 1) << axis) + ((i >> 1 & 1) << (3 + axis)), word_of = bit >> 5;
                        const bool is_touched = touched[brick] >> bit & 1;
                        if (!is_touched && !after)
                            continue;
                        if (!is_touched)
                            own = number_after(own, bricks[brick] >> bit & 1, rule, &found);
                        if (faces && last[row] != UNTOUCHED)
                            faces[6 * (size_t)last[row] + 2 * axis + 1] = stored(share_of(own, rule));
                        last[row] = UNTOUCHED;
                        if (is_touched) {
                            const uint word = (uint)(touched[brick] >> (32 * word_of));
                            const uint number = firsts[2 * brick + word_of] + popcount(word & ((1u << (bit & 31)) - 1));
                            if (shares) {
                                const uint share = stored(share_of(own + areas[2 * (size_t)number + 1], rule));
                                shares[number] = share;
                                set[i >> 2] |= (ulong)(share > 0) << bit;
                                part[i >> 2] |= (ulong)(share > 0 && share < WHOLE) << bit;
                            }
                            if (faces)
                                faces[6 * (size_t)number + 2 * axis] = stored(share_of(own, rule));
                            own += areas[2 * (size_t)number + start];
                            last[row] = number;
                        }
                        after = is_touched;
                    }
                    sum[row] = own;
                    moved = (moved & ~(1ul << row)) | (ulong)after << row;
                }
                for (uint i = 0; i < 2 && shares; ++i) {
                    bricks[pair[i]] = (bricks[pair[i]] & ~touched[pair[i]]) | set[i];
                    partial[pair[i]] = part[i];
                }
            }
        } else {
            next = (x | ((1u << (level - 1)) - 1)) + 1;
            for (uint row = 0; row < 64 && moved; ++row) {
                if (!(moved >> row & 1))
                    continue;
                sum[row] = number_after(sum[row], child & INSIDE, rule, &found);
                if (faces && last[row] != UNTOUCHED)
                    faces[6 * (size_t)last[row] + 2 * axis + 1] = stored(share_of(sum[row], rule));
                last[row] = UNTOUCHED;
            }
            moved = 0;
        }
        level = min(33 - clz(x ^ next), top);
        x = next;
    }
    for (uint row = 0; row < 64 && faces; ++row) // at the high side of the grid
        if (last[row] != UNTOUCHED)
            faces[6 * (size_t)last[row] + 2 * axis + 1] = stored(share_of(sum[row], rule));
    if (found)
        atomic_add(wrong, found);
}

// The voxels of each brick that have a share, and a face that is not wholly inside.
__kernel void mask_faces(__global const ulong *touched, const uint n, __global const uint *firsts,
                         __global const uint *shares, __global const uint *faces, __global ulong *masks)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    ulong found = 0;
    uint number = firsts[2 * gid];
    for (ulong left = touched[gid]; left; left &= left - 1, ++number) {
        bool whole = true;
        for (uint f = 0; f < 6; ++f)
            whole &= faces[6 * (size_t)number + f] == WHOLE;
        if (shares[number] && !whole)
            found |= left & -left;
    }
    masks[gid] = found;
}
