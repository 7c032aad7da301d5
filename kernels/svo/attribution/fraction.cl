// How much of each voxel lies inside a closed mesh. Host side: voxtool/svo/attribution/fraction.py.
// Options: those of columns.h.
//
// Along a row of voxels, towards high x, a triangle begins or ends what is inside. Its part in a voxel
// has a signed area, across x, and a volume between the part and the voxel's high-x side. The volume
// of a voxel that lies inside is this volume and the areas of all parts in the voxels before it. Both
// are rounded to whole numbers of 2^-UNIT_BITS, so that their sums do not depend on an order.

#include "svo/columns.h"
#include "svo/attribution/fraction.h"

#define UNITS ((double)(1ul << UNIT_BITS))
#define ONE (1l << UNIT_BITS) // a whole voxel, and a whole face of one
#define CORNERS 9             // a triangle's part in a cube has no more
#define UNTOUCHED 0xFFFFFFFFu

// ---- parts of triangles

typedef struct {
    double at[3][CORNERS]; // in units of the lattice, from the low corner of the triangle's first voxel
    int n;
} polygon;

// Keep what lies on one side of a plane across an axis: at most `bound` if `side` is -1, at least if 1.
void cut(const polygon *p, int axis, double bound, double side, polygon *kept)
{
    int n = 0;
    for (int i = 0; i < p->n; ++i) {
        const int j = i + 1 < p->n ? i + 1 : 0;
        const double a = (p->at[axis][i] - bound) * side, b = (p->at[axis][j] - bound) * side;
        if (a >= 0 && n < CORNERS) {
            for (int k = 0; k < 3; ++k)
                kept->at[k][n] = p->at[k][i];
            ++n;
        }
        if (((a < 0 && b > 0) || (a > 0 && b < 0)) && n < CORNERS) {
            const double t = a / (a - b);
            for (int k = 0; k < 3; ++k)
                kept->at[k][n] = p->at[k][i] + (p->at[k][j] - p->at[k][i]) * t;
            kept->at[axis][n++] = bound;
        }
    }
    kept->n = n;
}

void find_range(const polygon *p, int axis, double *low, double *high)
{
    *low = *high = p->at[axis][0];
    for (int i = 1; i < p->n; ++i) {
        *low = p->at[axis][i] < *low ? p->at[axis][i] : *low;
        *high = p->at[axis][i] > *high ? p->at[axis][i] : *high;
    }
}

// The first and last voxel along an axis whose interior meets the polygon, or that a flat one lies in.
int2 voxels_along(const polygon *p, int axis)
{
    double low, high;
    find_range(p, axis, &low, &high);
    const int first = (int)low >> FIXED_POINT_BITS, end = (int)high, last = end >> FIXED_POINT_BITS;
    const bool on_side = (double)(last << FIXED_POINT_BITS) == high;
    return (int2)(first, max(first, last - on_side));
}

// What lies in a slab of voxels along an axis: the polygon itself if all of it does, or `kept`.
const polygon *cut_slab(const polygon *p, int axis, int voxel, int2 range, polygon *spare, polygon *kept)
{
    const bool low = voxel > range.x, high = voxel < range.y;
    if (low)
        cut(p, axis, (double)(voxel * VOXEL), 1.0, high ? spare : kept);
    if (high)
        cut(low ? spare : p, axis, (double)((voxel + 1) * VOXEL), -1.0, kept);
    return low || high ? kept : p;
}

long rounded(double value) { return (long)(value * UNITS + (value < 0 ? -0.5 : 0.5)); }

// The signed area of a polygon across x, in faces of a voxel, and the volume between it and the plane
// x = high, in voxels.
void measure(const polygon *p, double high, double *area, double *volume)
{
    const double x = p->at[0][0], y = p->at[1][0], z = p->at[2][0];
    double twice = 0, moment = 0;
    for (int i = 1; i + 1 < p->n; ++i) {
        const double own = (p->at[2][i] - z) * (p->at[1][i + 1] - y) - (p->at[1][i] - y) * (p->at[2][i + 1] - z);
        twice += own;
        moment += own * ((high - x) + (high - p->at[0][i]) + (high - p->at[0][i + 1]));
    }
    *area = twice / (2.0 * VOXEL * VOXEL);
    *volume = moment / (6.0 * VOXEL * VOXEL * VOXEL);
}

// ---- sums of the parts in touched voxels

// A sum of 64 bits without atomics of 64 bits: each addition to the low half carries once.
void add(volatile __global uint *sum, long value)
{
    if (value == 0)
        return;
    const uint low = (uint)value, before = atomic_add(&sum[0], low);
    const uint high = (uint)((ulong)value >> 32) + (before + low < before ? 1u : 0u);
    if (high != 0)
        atomic_add(&sum[1], high);
}

// The words of touched voxels, and the number of them before each word.
#define VOXELS __global const uint *touched, __global const uint *firsts
#define THESE_VOXELS touched, firsts

bool is_active(ACTIVE_SET_PARAMETERS, CODE code)
{
    if (block_words && !(block_words[(uint)(code >> 14)] >> (uint)(code >> 9 & 31) & 1))
        return false;
    const CODE stored = stored_code(ACTIVE_SET, code);
    return words[(uint)(stored >> 5)] >> (uint)(stored & 31) & 1;
}

// The number of a voxel among the touched ones, UNTOUCHED if it is not one of them. `cell` and `node`
// are the last level-1 cell that was sought, and its index, or UNTOUCHED.
uint number_of(ACTIVE_SET_PARAMETERS, VOXELS, uint3 voxel, uint3 *cell, uint *node)
{
    if (any(voxel >> 3 != *cell)) {
        *cell = voxel >> 3;
        const CODE code = morton_encode(*cell);
        *node = is_active(ACTIVE_SET, code) ? set_index(words, ranks, stored_code(ACTIVE_SET, code)) : UNTOUCHED;
    }
    if (*node == UNTOUCHED)
        return UNTOUCHED;
    const uint place = voxel_place(voxel), word = 16 * *node + (place >> 5), bit = 1u << (place & 31);
    return touched[word] & bit ? firsts[word] + popcount(touched[word] & (bit - 1)) : UNTOUCHED;
}

// Add the area and the volume of each triangle's part in each voxel to the voxel's sums. Areas before
// x = 0 are added to the rows' states on entry. A part may lie as near to a side of its voxel that
// rounding took it there from the next voxel, which is touched.
__kernel void add_parts(TRIANGLES, ACTIVE_SET_PARAMETERS, VOXELS, volatile __global uint *sums,
                        volatile __global uint *entry)
{
    triangle t;
    columns c;
    if (!take_share(THESE_TRIANGLES, COVERED, &t, &c))
        return;
    if (cross_term(t.v[1].y - t.v[0].y, t.v[2].z - t.v[0].z, t.v[2].y - t.v[0].y, t.v[1].z - t.v[0].z) == 0)
        return; // parallel to x
    int3 low, high;
    find_bounds(&t, &low, &high);
    const int3 first = low >> FIXED_POINT_BITS;
    polygon whole, spare, row, column, part;
    whole.n = 3;
    for (int i = 0; i < 3; ++i) {
        const int3 v = t.v[i] - first * VOXEL;
        whole.at[0][i] = v.x;
        whole.at[1][i] = v.y;
        whole.at[2][i] = v.z;
    }
    uint3 cell = (uint3)(UNTOUCHED);
    uint node = UNTOUCHED;
    const int2 along_z = voxels_along(&whole, 2);
    for (int k = max(along_z.x, c.low.y - first.z); k <= min(along_z.y, c.high.y - first.z); ++k) {
        const polygon *in_row = cut_slab(&whole, 2, k, along_z, &spare, &row);
        if (in_row->n < 3)
            continue;
        const int2 along_y = voxels_along(in_row, 1);
        for (int j = max(along_y.x, c.low.x - first.y); j <= min(along_y.y, c.high.x - first.y); ++j) {
            const polygon *in_column = cut_slab(in_row, 1, j, along_y, &spare, &column);
            if (in_column->n < 3)
                continue;
            const int2 along_x = voxels_along(in_column, 0);
            const int before = -1 - first.x, begin = max(along_x.x, before);
            const int end = min(max(along_x.y, before), shape.x - 1 - first.x);
            for (int i = begin; i <= end; ++i) {
                const int x = first.x + i;
                const int2 range = (int2)(x < 0 ? i : along_x.x, along_x.y);
                const polygon *own = cut_slab(in_column, 0, i, range, &spare, &part);
                double area, volume;
                measure(own, (double)((i + 1) << FIXED_POINT_BITS), &area, &volume);
                const long whole_area = rounded(area);
                if (x < 0) {
                    if (entry)
                        add(entry + 2 * ((size_t)(first.z + k) * shape.y + (first.y + j)), whole_area);
                    continue;
                }
                long whole_volume = rounded(volume);
                if (whole_area == 0 && whole_volume == 0)
                    continue;
                uint3 voxel = (uint3)(x, first.y + j, first.z + k);
                uint number = number_of(ACTIVE_SET, THESE_VOXELS, voxel, &cell, &node);
                if (number == UNTOUCHED) {
                    const bool at_low = abs(2 * whole_volume) > abs(whole_area);
                    voxel.x += at_low ? -1 : 1;
                    if ((int)voxel.x < 0 || (int)voxel.x >= shape.x)
                        continue;
                    whole_volume = at_low ? 0 : whole_area;
                    number = number_of(ACTIVE_SET, THESE_VOXELS, voxel, &cell, &node);
                }
                if (number != UNTOUCHED) {
                    add(sums + 4 * (size_t)number, whole_area);
                    add(sums + 4 * (size_t)number + 2, whole_volume);
                }
            }
        }
    }
}

// ---- rows

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

// The rows along x of a quadrant of a level-1 node's bricks, from the two bricks on: bit places of
// x = 0 in a brick.
#define X_VOXELS 0x303ul

// Traverse the octree along a bundle of 8 x 8 rows and turn sums into shares of touched voxels, in
// units of 1 / WHOLE. The bricks, of the rule's voxels, become those that have a share; `partial` are
// those whose share is neither 0 nor WHOLE. `wrong` counts the places where sums and rule disagree.
__kernel void sum_rows(__global const svo_node *nodes, __constant uint *offsets, const uint top,
                       const int3 shape, const uint n, const uint rule, __global const long *entry,
                       __global const ulong *touched, __global const uint *firsts,
                       __global const long *sums, __global ulong *bricks, __global ulong *partial,
                       __global uint *shares, volatile __global uint *wrong)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint bundles_y = (uint)(shape.y + 7) / 8, y = gid % bundles_y, z = gid / bundles_y;
    long sum[64];
    for (uint row = 0; row < 64; ++row) {
        const uint j = 8 * y + (row & 7), k = 8 * z + (row >> 3);
        sum[row] = entry && j < (uint)shape.y && k < (uint)shape.z ? entry[(size_t)k * shape.y + j] : 0;
    }
    ulong moved = entry ? ~0ul : 0; // rows whose sums are those of a touched voxel, or of the entry
    uint found = 0;
    const uint end = (uint)(shape.x + 7) / 8;
    uint path[MAX_LEVELS]; // the nodes that contain cell (x, y, z), by level
    path[top] = 0;
    uint x = 0, level = top;
    while (x < end) {
        uint child = nodes[offsets[top - level] + path[level]].child;
        while (level > 1 && (child & VALID)) {
            --level;
            const uint shift = level - 1;
            path[level] = (child & LINK) | ((x >> shift) & 1) | ((y >> shift) & 1) << 1 |
                          ((z >> shift) & 1) << 2;
            child = nodes[offsets[top - level] + path[level]].child;
        }
        uint next;
        if (child & VALID) {
            next = x + 1;
            const uint last = min(8u, (uint)shape.x - 8 * x);
            for (uint o = 0; o < 4; ++o) {
                const size_t pair = (child & LINK) + 2 * o;
                const ulong any = touched[pair] | touched[pair + 1];
                ulong set[2] = {0, 0}, part[2] = {0, 0};
                for (uint inner = 0; inner < 16; ++inner) {
                    const uint j = inner & 3, k = inner >> 2;
                    const uint row = (4 * (o & 1) + j) + 8 * (4 * (o >> 1) + k);
                    const uint at = (j & 1) << 1 | (j >> 1) << 4 | (k & 1) << 2 | (k >> 1) << 5;
                    if (!(any >> at & X_VOXELS) && !(moved >> row & 1))
                        continue;
                    long own = sum[row];
                    bool after = moved >> row & 1;
                    for (uint i = 0; i < last; ++i) {
                        const size_t brick = pair + (i >> 2);
                        const uint bit = at + (i & 1) + 8 * (i >> 1 & 1), word_of = bit >> 5;
                        if (touched[brick] >> bit & 1) {
                            const uint word = (uint)(touched[brick] >> (32 * word_of));
                            const uint number = firsts[2 * brick + word_of] + popcount(word & ((1u << (bit & 31)) - 1));
                            const long share = share_of(own + sums[2 * (size_t)number + 1], rule);
                            const uint stored = (uint)((share + (ONE / WHOLE) / 2) / (ONE / WHOLE));
                            own += sums[2 * (size_t)number];
                            shares[number] = stored;
                            set[i >> 2] |= (ulong)(stored > 0) << bit;
                            part[i >> 2] |= (ulong)(stored > 0 && stored < WHOLE) << bit;
                            after = true;
                        } else if (after) {
                            own = number_after(own, bricks[brick] >> bit & 1, rule, &found);
                            after = false;
                        }
                    }
                    sum[row] = own;
                    moved = (moved & ~(1ul << row)) | (ulong)after << row;
                }
                for (uint i = 0; i < 2; ++i) {
                    bricks[pair + i] = (bricks[pair + i] & ~touched[pair + i]) | set[i];
                    partial[pair + i] = part[i];
                }
            }
        } else {
            next = (x | ((1u << (level - 1)) - 1)) + 1;
            for (uint row = 0; row < 64 && moved; ++row)
                if (moved >> row & 1)
                    sum[row] = number_after(sum[row], child & INSIDE, rule, &found);
            moved = 0;
        }
        level = min(33 - clz(x ^ next), top);
        x = next;
    }
    if (found)
        atomic_add(wrong, found);
}
