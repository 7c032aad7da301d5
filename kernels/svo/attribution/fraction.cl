// How much of each voxel lies inside a closed mesh. Host side: voxtool/svo/attribution/fraction.py.
// Options: those of columns.h.
//
// Along a row of voxels, towards high x, a triangle begins or ends what is inside. Its part in a voxel
// has a signed area, across x, and a volume between the part and the voxel's high-x side. The volume
// of a voxel that lies inside is this volume plus the areas of all parts in the voxels before it. The
// sum of the areas up to the face between two voxels is the part of the face that lies inside; across y
// and z, along the rows of these axes, too. Areas and volumes are rounded to whole numbers of
// 2^-UNIT_BITS, so that sums do not depend on an order.

#include "svo/columns.h"
#include "svo/attribution/fraction.h"

#define UNITS ((double)(1ul << UNIT_BITS))
#define CORNERS 9 // a triangle's part in a cube has no more

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

// The first and last voxel along an axis whose interior meets the polygon. A flat one on a side between
// two voxels lies in the one that is inside: in the lower one if it `ends` the inside along the axis.
int2 voxels_along(const polygon *p, int axis, bool ends)
{
    double low, high;
    find_range(p, axis, &low, &high);
    const int first = (int)low >> FIXED_POINT_BITS, end = (int)high, last = end >> FIXED_POINT_BITS;
    const bool on_side = (double)(last << FIXED_POINT_BITS) == high;
    if (on_side && ends && low == high)
        return (int2)(first - 1);
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

// The signed areas of a polygon across x, y and z, in faces of a voxel; returns the volume between it
// and the plane x = high, in voxels.
double measure(const polygon *p, double high, double areas[3])
{
    double twice[3] = {0, 0, 0}, moment = 0;
    for (int i = 1; i + 1 < p->n; ++i) {
        double own[3];
        for (int a = 0; a < 3; ++a) {
            const int b = a < 2 ? a + 1 : 0, c = a > 0 ? a - 1 : 2;
            own[a] = (p->at[c][i] - p->at[c][0]) * (p->at[b][i + 1] - p->at[b][0]) -
                     (p->at[b][i] - p->at[b][0]) * (p->at[c][i + 1] - p->at[c][0]);
            twice[a] += own[a];
        }
        moment += own[0] * ((high - p->at[0][0]) + (high - p->at[0][i]) + (high - p->at[0][i + 1]));
    }
    for (int a = 0; a < 3; ++a)
        areas[a] = twice[a] / (2.0 * VOXEL * VOXEL);
    return moment / (6.0 * VOXEL * VOXEL * VOXEL);
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

// Move a voxel that is not touched, as rounding took a part across a side of the next one: along the
// axis in which the part is thinnest, which is returned, towards the side that is near; false if there
// is no voxel.
bool move_to_touched(const polygon *p, int3 shape, int3 first, int3 *voxel, int *axis)
{
    double least = 0, from = 0;
    for (int a = 0; a < 3; ++a) {
        double low, high;
        find_range(p, a, &low, &high);
        if (a == 0 || high - low < least) {
            least = high - low;
            *axis = a;
            from = low;
        }
    }
    int3 own = swizzle(*voxel, *axis);
    const int begin = (own.z - swizzle(first, *axis).z) << FIXED_POINT_BITS;
    own.z += from < begin + HALF ? -1 : 1;
    *voxel = unswizzle(own, *axis);
    return own.z >= 0 && own.z < swizzle(shape, *axis).z;
}

// Add the area and the volume of each triangle's part in each voxel to the voxel's sums, and the areas
// across y and z to those of `across`. Areas before x = 0 are added to the rows' states on entry.
// Columns are those of `kind`. `turned` says that the mesh is inside out.
__kernel void add_parts(TRIANGLES, const int kind, const uint turned, ACTIVE_SET_PARAMETERS, VOXELS,
                        volatile __global uint *sums, volatile __global uint *across,
                        volatile __global uint *entry)
{
    triangle t;
    columns c;
    if (!take_share(THESE_TRIANGLES, kind, &t, &c))
        return;
    const long3 normal = cross_of(t.v[1] - t.v[0], t.v[2] - t.v[0]);
    if (normal.x == 0 && !across)
        return; // parallel to x
    const int3 ends = convert_int3(turned ? normal < 0 : normal > 0); // the inside, along each axis
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
    const int2 along_z = voxels_along(&whole, 2, ends.z);
    for (int k = max(along_z.x, c.low.y - first.z); k <= min(along_z.y, c.high.y - first.z); ++k) {
        const polygon *in_row = cut_slab(&whole, 2, k, along_z, &spare, &row);
        if (in_row->n < 3)
            continue;
        const int2 along_y = voxels_along(in_row, 1, ends.y);
        for (int j = max(along_y.x, c.low.x - first.y); j <= min(along_y.y, c.high.x - first.y); ++j) {
            const polygon *in_column = cut_slab(in_row, 1, j, along_y, &spare, &column);
            if (in_column->n < 3)
                continue;
            const int2 along_x = voxels_along(in_column, 0, ends.x);
            const int before = -1 - first.x, begin = max(along_x.x, before);
            const int end = min(max(along_x.y, before), shape.x - 1 - first.x);
            for (int i = begin; i <= end; ++i) {
                const int x = first.x + i;
                const int2 range = (int2)(x < 0 ? i : along_x.x, along_x.y);
                const polygon *own = cut_slab(in_column, 0, i, range, &spare, &part);
                double areas[3];
                const double volume = measure(own, (double)((i + 1) << FIXED_POINT_BITS), areas);
                const long area = rounded(areas[0]);
                if (x < 0) {
                    if (entry)
                        add(entry + 2 * ((size_t)(first.z + k) * shape.y + (first.y + j)), area);
                    continue;
                }
                long whole_volume = rounded(volume);
                if (area == 0 && whole_volume == 0 && !across)
                    continue;
                int3 voxel = (int3)(x, first.y + j, first.z + k);
                uint number = number_of(ACTIVE_SET, THESE_VOXELS, as_uint3(voxel), &cell, &node);
                if (number == UNTOUCHED && own->n > 2) {
                    int axis;
                    if (!move_to_touched(own, shape, first, &voxel, &axis))
                        continue;
                    if (axis == 0)
                        whole_volume = voxel.x < x ? 0 : area;
                    number = number_of(ACTIVE_SET, THESE_VOXELS, as_uint3(voxel), &cell, &node);
                }
                if (number == UNTOUCHED)
                    continue;
                add(sums + 4 * (size_t)number, area);
                add(sums + 4 * (size_t)number + 2, whole_volume);
                if (across) {
                    add(across + 4 * (size_t)number, rounded(areas[1]));
                    add(across + 4 * (size_t)number + 2, rounded(areas[2]));
                }
            }
        }
    }
}
