// The fraction of each voxel that lies inside a closed mesh. Host side: voxtool/svo/attribution/fraction.py.
// Options: those of columns.h.
//
// Along a row of voxels, towards high x, a triangle begins or ends what is inside. Its part in a voxel
// has a signed area, across x, and a volume between the part and the voxel's high-x side. The volume
// of a voxel that lies inside is this volume plus the areas of all parts in the voxels before it. The
// sum of the areas up to the face between two voxels is the part of the face that lies inside; rows along
// y and z give the faces across these axes. Areas and volumes are rounded to whole numbers of
// 2^-UNIT_BITS, so that sums do not depend on an order.

#include "svo/voxelization/columns.h"
#include "svo/attribution/fraction.h"

#define UNITS ((double)(1ul << UNIT_BITS))
#define CORNERS 9 // a triangle's part in a cube has no more

// ---- parts of triangles
//
// A part is a polygon whose corners are known by what meets there: two sides of the triangle, a side and a
// plane between voxels, or the triangle and two such planes. So a corner's coordinate is a quotient of whole
// numbers: it is rounded once, and where rounding could matter, whole numbers decide which side of a plane it is on.

#define SIDES 3 // of the triangle: numbers below are sides, others SIDES + 2 axis + (0 low, 1 high) planes
#define DOUBTFUL 0x1p-16 // units: coordinates are rounded by less

typedef struct {
    int v[3][3];    // corners of the triangle, from the low corner of its first voxel, in units
    long normal[3];
    int bounds[6];  // where the planes of the voxel lie
} clipped;

// A corner is the meet of a line and a plane, or a corner of the triangle and 0; `what` also has the line
// that leads to the next corner.
typedef struct {
    double at[3][CORNERS]; // in units, from the low corner of the triangle's first voxel
    int what[CORNERS];
    int n;
} polygon;

#define WHAT(line, plane, next) ((line) | (plane) << 4 | (next) << 8)
#define NEXT(what) ((what) >> 8)

#ifdef WIDE
double to_double(wide a)
{
    const wide m = is_negative(a) ? wide_negative(a) : a;
    const double magnitude = (double)m.high * 0x1p64 + (double)m.low;
    return is_negative(a) ? -magnitude : magnitude;
}
#else
double to_double(wide a) { return (double)a; }
#endif

// The distance of a corner beyond a bound along an axis, in units: x / y, with y > 0. Both are whole numbers
// that are rounded once, so that the sign of x is exact.
double2 beyond(const clipped *t, int what, int axis, int bound)
{
    const int line = what & 15, plane = what >> 4 & 15;
    if (plane < SIDES)
        return (double2)((double)(t->v[line][axis] - bound), 1.0);
    const int a = (plane - SIDES) >> 1, b = (line - SIDES) >> 1; // the planes' axes
    const int at = t->bounds[plane - SIDES];
    if (axis == a)
        return (double2)((double)(at - bound), 1.0);
    if (line < SIDES) {
        const __private int *u = t->v[line], *w = t->v[line < 2 ? line + 1 : 0];
        const long length = (long)w[a] - u[a];
        const long over = (long)((ulong)((long)u[axis] - bound) * (ulong)length +
                                 (ulong)((long)w[axis] - u[axis]) * (ulong)((long)at - u[a]));
        return length < 0 ? (double2)(-(double)over, -(double)length) : (double2)((double)over, (double)length);
    }
    const int other = t->bounds[line - SIDES];
    if (axis == b)
        return (double2)((double)(other - bound), 1.0);
    const double over = to_double(wide_dot(t->normal[axis], t->normal[a], t->normal[b], (long)bound - t->v[0][axis],
                                           (long)at - t->v[0][a], (long)other - t->v[0][b]));
    const double slope = (double)t->normal[axis];
    return slope < 0 ? (double2)(over, -slope) : (double2)(-over, slope);
}

// The distance of corner i beyond a bound along an axis: rounded, with the exact sign.
double distance_of(const clipped *t, const polygon *p, int i, int axis, int bound)
{
    const double rounded = p->at[axis][i] - bound;
    return fabs(rounded) > DOUBTFUL ? rounded : beyond(t, p->what[i], axis, bound).x;
}

// Keep what lies on one side of a plane of the voxel: at least at the low one, at most at the high one.
void cut(const clipped *t, const polygon *p, int plane, polygon *kept)
{
    const int axis = plane >> 1, bound = t->bounds[plane];
    const double sign = plane & 1 ? -1 : 1, first = distance_of(t, p, 0, axis, bound) * sign;
    double here = first;
    int n = 0;
    for (int i = 0; i < p->n; ++i) {
        const double next = i + 1 < p->n ? distance_of(t, p, i + 1, axis, bound) * sign : first;
        const int what = p->what[i], line = NEXT(what);
        if (here >= 0) {
            for (int k = 0; k < 3; ++k)
                kept->at[k][n] = p->at[k][i];
            kept->what[n++] = here > 0 || next >= 0 ? what : WHAT(what & 255, 0, SIDES + plane);
        }
        if ((here < 0 && next > 0) || (here > 0 && next < 0)) {
            const int made = WHAT(line, SIDES + plane, here < 0 ? line : SIDES + plane);
            for (int k = 0; k < 3; ++k) {
                const double2 at = beyond(t, made, k, 0);
                kept->at[k][n] = at.x / at.y;
            }
            kept->what[n++] = made;
        }
        here = next;
    }
    kept->n = n;
}

// The first and last voxel along an axis whose interior meets the polygon. A flat one on a side between
// two voxels lies in the one that is inside: in the lower one if it `ends` the inside along the axis.
int2 voxels_along(const clipped *t, const polygon *p, int axis, bool ends)
{
    int first = INT_MAX, end = 0;
    for (int i = 0; i < p->n; ++i) {
        const double at = p->at[axis][i];
        const int nearest = ((int)at + HALF) >> FIXED_POINT_BITS; // side
        const double past = distance_of(t, p, i, axis, nearest << FIXED_POINT_BITS);
        first = min(first, nearest - (past < 0));
        end = max(end, nearest + (past > 0));
    }
    if (first == end && ends)
        return (int2)(first - 1);
    return (int2)(first, max(first, end - 1));
}

// The part of a polygon in a slab of voxels along an axis: the polygon itself if all of it is, or `kept`.
const polygon *cut_slab(clipped *t, const polygon *p, int axis, int voxel, int2 range, polygon *spare, polygon *kept)
{
    const bool low = voxel > range.x, high = voxel < range.y;
    t->bounds[2 * axis] = voxel << FIXED_POINT_BITS;
    t->bounds[2 * axis + 1] = (voxel + 1) << FIXED_POINT_BITS;
    if (low)
        cut(t, p, 2 * axis, high ? spare : kept);
    if (high)
        cut(t, low ? spare : p, 2 * axis + 1, kept);
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

// The number of a voxel among the touched ones, of which it is one. `cell` and `node` are the level-1 cell
// that was sought last, and its index.
uint number_of(ACTIVE_SET_PARAMETERS, VOXELS, uint3 voxel, uint3 *cell, uint *node)
{
    if (any(voxel >> 3 != *cell)) {
        *cell = voxel >> 3;
        *node = set_index(words, ranks, stored_code(ACTIVE_SET, morton_encode(*cell)));
    }
    const uint place = voxel_place(voxel), word = 16 * *node + (place >> 5);
    return firsts[word] + popcount(touched[word] & ((1u << (place & 31)) - 1));
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
    if (normal.x == 0 && (!across || (normal.y == 0 && normal.z == 0)))
        return; // parallel to x, or without an area
    const int3 ends = convert_int3(turned ? normal < 0 : normal > 0); // the inside, along each axis
    int3 low, high;
    find_bounds(&t, &low, &high);
    const int3 first = low >> FIXED_POINT_BITS;
    clipped own;
    polygon whole, spare, row, column, part;
    whole.n = 3;
    for (int i = 0; i < 3; ++i) {
        const int3 v = t.v[i] - first * VOXEL;
        vstore3(v, 0, own.v[i]);
        whole.at[0][i] = v.x;
        whole.at[1][i] = v.y;
        whole.at[2][i] = v.z;
        whole.what[i] = WHAT(i, 0, i);
    }
    vstore3(normal, 0, own.normal);
    uint3 cell = (uint3)(UNTOUCHED);
    uint node = UNTOUCHED;
    const int2 along_z = voxels_along(&own, &whole, 2, ends.z);
    for (int k = max(along_z.x, c.low.y - first.z); k <= min(along_z.y, c.high.y - first.z); ++k) {
        const polygon *in_row = cut_slab(&own, &whole, 2, k, along_z, &spare, &row);
        const int2 along_y = voxels_along(&own, in_row, 1, ends.y);
        for (int j = max(along_y.x, c.low.x - first.y); j <= min(along_y.y, c.high.x - first.y); ++j) {
            const polygon *in_column = cut_slab(&own, in_row, 1, j, along_y, &spare, &column);
            const int2 along_x = voxels_along(&own, in_column, 0, ends.x);
            const int before = -1 - first.x, begin = max(along_x.x, before);
            const int end = min(max(along_x.y, before), shape.x - 1 - first.x);
            for (int i = begin; i <= end; ++i) {
                const int x = first.x + i;
                const int2 range = (int2)(x < 0 ? i : along_x.x, along_x.y);
                double areas[3];
                const polygon *in_voxel = cut_slab(&own, in_column, 0, i, range, &spare, &part);
                const double volume = measure(in_voxel, (double)((i + 1) << FIXED_POINT_BITS), areas);
                const long area = rounded(areas[0]);
                if (x < 0) {
                    if (entry)
                        add(entry + 2 * ((size_t)(first.z + k) * shape.y + (first.y + j)), area);
                    continue;
                }
                const uint3 voxel = (uint3)(x, first.y + j, first.z + k);
                const uint number = number_of(ACTIVE_SET, THESE_VOXELS, voxel, &cell, &node);
                add(sums + 4 * (size_t)number, area);
                add(sums + 4 * (size_t)number + 2, rounded(volume));
                if (across) {
                    add(across + 4 * (size_t)number, rounded(areas[1]));
                    add(across + 4 * (size_t)number + 2, rounded(areas[2]));
                }
            }
        }
    }
}
