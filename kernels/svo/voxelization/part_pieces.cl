// The pieces of triangles in voxels: which triangles touch the voxels of a mask, and the areas of these
// pieces. Host side: voxtool/svo/voxelization/part_pieces.py. Options: those of scan_conversion.h.

#include "svo/voxelization/columns.h"
#include "svo/voxelization/part_pieces.h"

// ---- pairs of a voxel and a triangle

// Receives the boxes of one triangle: with `voxels`, the voxels of the masks are listed, without, they
// are counted.
typedef struct {
    __global const ulong *masks;
    __global const uint *starts; // voxels of the masks before each brick
    __global uint *voxels, *faces;
    uint face, next;
    uint3 cell; // level-1 node of the last voxel, and its index among the active nodes
    uint node;
} lister;

void put_box(lister *l, int level, ACTIVE_SET_PARAMETERS, uint3 voxel)
{
    const uint3 cell = voxel >> 3;
    if (any(cell != l->cell)) {
        l->cell = cell;
        l->node = set_index(words, ranks, stored_code(ACTIVE_SET, morton_encode(cell)));
    }
    const uint place = voxel_place(voxel), brick = 8 * l->node + (place >> 6);
    const ulong mask = l->masks[brick], bit = 1ul << (place & 63);
    if (!(mask & bit))
        return;
    if (l->voxels) {
        l->voxels[l->next] = l->starts[brick] + (uint)popcount(mask & (bit - 1));
        l->faces[l->next] = l->face;
    }
    ++l->next;
}

#define RECEIVER lister
#include "svo/voxelization/scan_conversion.h"

// Without `voxels`, firsts[i] = the number of pairs of work-item i; with it, firsts[i] is the place of
// its first pair. A pair is the rank of a voxel among those of the masks, and a triangle that touches
// it (`kind` is TOUCHED), or for which it separates (SEPARATING).
__kernel void list_pieces(TRIANGLES, const int kind, ACTIVE_SET_PARAMETERS,
                          __global const ulong *masks, __global const uint *starts,
                          __global uint *firsts, __global uint *voxels, __global uint *of_faces)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    triangle t;
    columns c;
    lister l = {masks, starts, voxels, of_faces, 0, voxels ? firsts[gid] : 0, (uint3)(~0u), 0};
    if (take_share(THESE_TRIANGLES, kind, &t, &c)) {
        l.face = t.face;
        const scan s = set_up(&t, &c, kind, level, pad);
        scan_convert(&s, &c, &l, level, ACTIVE_SET);
    }
    if (!voxels)
        firsts[gid] = l.next;
}

// ---- areas

// A corner of a polygon, from the low corner of a voxel, in 1 / (VOXEL FINER) voxel. A triangle can
// reach 2^22 voxels from the voxel, so there are up to 43 bits.
#define SIDE ((long)VOXEL * FINER)

// step * at / span, rounded to nearest, for 0 <= at <= span < 2^44 and |step| < 2^48: the quotient is
// found 16 bits of the step at a time.
long along(long step, long at, long span)
{
    const ulong size = abs(step), s = (ulong)span;
    ulong quotient = 0, rest = 0;
    for (int shift = 32; shift >= 0; shift -= 16) {
        rest = (rest << 16) + (size >> shift & 0xFFFF) * (ulong)at;
        quotient = (quotient << 16) + rest / s;
        rest %= s;
    }
    quotient += 2 * rest >= s;
    return step < 0 ? -(long)quotient : (long)quotient;
}

// Cut a polygon of `count` corners by the plane where an axis is `at`; what lies on the side of
// `sign` stays. Sutherland and Hodgman's algorithm [Sutherland 1974].
int cut_polygon(long3 *polygon, int count, int axis, long at, int sign)
{
    long3 kept[MOST_CORNERS];
    int n = 0;
    for (int i = 0; i < count; ++i) {
        const long3 a = polygon[i], b = polygon[i + 1 < count ? i + 1 : 0];
        const long a_at = axis == 0 ? a.x : axis == 1 ? a.y : a.z,
                   b_at = axis == 0 ? b.x : axis == 1 ? b.y : b.z;
        const long from = sign * (a_at - at), to = sign * (b_at - at);
        if (from >= 0)
            kept[n++] = a;
        if ((from < 0) != (to < 0)) {
            const bool first = from >= 0;
            const long3 p = first ? a : b, q = first ? b : a, d = q - p;
            const long way = first ? from : to, span = way - (first ? to : from);
            long3 c = (long3)(p.x + along(d.x, way, span), p.y + along(d.y, way, span),
                              p.z + along(d.z, way, span));
            if (axis == 0) c.x = at;
            if (axis == 1) c.y = at;
            if (axis == 2) c.z = at;
            kept[n++] = c;
        }
    }
    for (int i = 0; i < n; ++i)
        polygon[i] = kept[i];
    return n;
}

// The whole number whose square is the largest up to v.
uint root_of(ulong v)
{
    uint root = 0;
    for (uint bit = 1u << 31; bit; bit >>= 1) {
        const ulong tried = root | bit;
        if (tried * tried <= v)
            root |= bit;
    }
    return root;
}

// areas[i] = the area of the triangle of pair i inside the closed cube of its voxel, times
// UNITS_OF_AREA for the area of a face of a voxel. `at` has the low corner of each voxel, by rank.
__kernel void measure_pieces(const uint n, __global const uint *voxels, __global const uint *of_faces,
                             __global const int *at, __global const int *vertices,
                             __global const int *faces, __global uint *areas)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const triangle t = fetch_triangle(vertices, faces, of_faces[gid]);
    const int3 low = vload3(voxels[gid], at) * VOXEL;
    long3 polygon[MOST_CORNERS];
    for (int i = 0; i < 3; ++i)
        polygon[i] = convert_long3(t.v[i] - low) * FINER;
    int count = 3;
    for (int axis = 0; axis < 3; ++axis) {
        count = cut_polygon(polygon, count, axis, 0, 1);
        count = cut_polygon(polygon, count, axis, SIDE, -1);
    }
    long3 sum = 0; // twice the area, along each axis
    for (int i = 2; i < count; ++i) {
        const long3 a = polygon[i - 1] - polygon[0], b = polygon[i] - polygon[0];
        sum += (long3)(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
    }
    const ulong3 size = abs(sum) >> DROPPED_BITS;
    areas[gid] = root_of(size.x * size.x + size.y * size.y + size.z * size.z);
}
