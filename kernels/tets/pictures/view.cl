// A volume from a viewpoint: each cell's exit faces as functions of the pixel, and where each ray
// enters. Host side: voxtool/tets/pictures/view.py.
//
// The signs of the edge functions of its projected vertices decide whether a ray enters by a face
// [Pineda 1988], in perspective [Olano 1997]. The function of an edge is the exact negation of that of the
// reversed edge, in floating point too, and the edge's direction decides to which side a ray through the
// edge belongs: faces that share an edge share it without a gap and without an overlap.
// Options: those of textures.h and view.h, and
//   EXACT   vertices are projected in float64

#include "tets/pictures/textures.h"
#include "tets/pictures/view.h"

#ifdef EXACT
#define real double
#define real4 double4
#define to_real4(v) (v)
#else
#define real float
#define real4 float4
#define to_real4(v) convert_float4(v)
#endif

bool is_kept(__global const uchar *kept, const uint cell)
{
    return kept[cell / BLOCK];
}

// One work-item a cell. Its record has `slots` exit faces, each the nearness a, b, c of its plane and the
// cell beyond it, and then the scalar on the ray, of view.h.
__kernel void set_up_cells(TEXTURES, __global const int *neighbours, __global const uchar *kept,
                   __global const double *viewpoint, const uint slots, __global float *records)
{
    const uint cell = get_global_id(0);
    if (cell >= cells || !is_kept(kept, cell))
        return;
    const Textures textures = THE_TEXTURES;
    const View view = view_of(viewpoint);
    __global float *record = records + 4 * (slots + 1) * (size_t)cell;
    uint slot = 0;
    for (uint face = 0; face < FACES; ++face) {
        float3 abc;
        if (!nearness(&view, plane_of(&textures, cell, face), &abc) || slot == slots)
            continue;
        const int beyond = neighbours[FACES * (size_t)cell + face];
        const int next = beyond >= 0 && is_kept(kept, beyond) ? beyond : NO_CELL;
        vstore4((float4)(abc, as_float(next)), slot++, record);
    }
    for (; slot < slots; ++slot)
        vstore4((float4)(0, 0, -FARTHEST, as_float(NO_CELL)), slot, record);
    vstore4(scalar_on_rays(&view, scalar_of(&textures, cell)), slots, record);
}

// One work-item a vertex: its position in the picture, (X, Y, Z) with x = X / Z and y = Y / Z, and its
// depth. In an orthographic picture Z is 1.
__kernel void project_vertices(__global const float *vertices, const uint n,
                               __global const double *viewpoint, __global real *projected)
{
    const uint vertex = get_global_id(0);
    if (vertex >= n)
        return;
    const View view = view_of(viewpoint);
    const double3 v = convert_double3(vload4(vertex, vertices).xyz) - view.origin;
#ifdef EXACT
    const double x = dot3(v, view.across[0]), y = dot3(v, view.across[1]), depth = dot3(v, view.across[2]);
#else
    const double depth = dot3(v, view.direction);
    const double x = dot3(v, view.right) / dot3(view.right, view.right);
    const double y = dot3(v, view.down) / dot3(view.down, view.down);
#endif
#ifdef PERSPECTIVE
    vstore4(to_real4((double4)(x, y, depth, depth - view.middle)), vertex, projected);
#else
    vstore4(to_real4((double4)(x, y, 1, depth)), vertex, projected);
#endif
}

// --- entries -------------------------------------------------------------------------------------

// A face in the picture.
typedef struct {
    real4 corners[SIDES];
    int2 columns, rows;      // of the pixels that may be in it, first and last
    float nearest, farthest; // of its corners
} Outline;

// A kernel's parameters for `n` exposed faces: cell * FACES + face; the vertices of the cells; where
// they are in the picture; which of a cell's vertices are on each of its faces; and the picture's size.
#define EXPOSED                                                                                  \
    __global const int *exposed, const uint n, __global const int *cells_vertices,               \
        __global const real *projected, __constant const uchar *sides, const int width,         \
        const int height
#define THE_OUTLINE \
    outline_of(exposed[get_global_id(0)], cells_vertices, projected, sides, (int2)(width, height))

Outline outline_of(const int face, __global const int *cells_vertices,
                   __global const real *projected, __constant const uchar *sides, const int2 size)
{
    Outline o;
    __global const int *cell = cells_vertices + CORNERS * (size_t)(face / FACES);
    __constant const uchar *side = sides + SIDES * (face % FACES);
    o.nearest = FARTHEST;
    o.farthest = -FARTHEST;
    float4 corners[SIDES];
    for (uint i = 0; i < SIDES; ++i) {
        o.corners[i] = vload4(cell[side[i]], projected);
        const float4 p = corners[i] = convert_float4(o.corners[i]);
        o.nearest = p.w < o.nearest ? p.w : o.nearest;
        o.farthest = p.w > o.farthest ? p.w : o.farthest;
    }
    cover(corners, SIDES, size, &o.columns, &o.rows);
    return o;
}

// Whether the ray of (x, y) enters by the face: it is on the same side of all edges.
bool enters(const Outline *o, const real x, const real y)
{
    real from_x = o->corners[SIDES - 1].x - x * o->corners[SIDES - 1].z;
    real from_y = o->corners[SIDES - 1].y - y * o->corners[SIDES - 1].z;
    for (uint i = 0; i < SIDES; ++i) {
        const real to_x = o->corners[i].x - x * o->corners[i].z;
        const real to_y = o->corners[i].y - y * o->corners[i].z;
        const real turn = from_x * to_y - from_y * to_x;
        const real dx = to_x - from_x, dy = to_y - from_y;
        if (!(turn < 0 || (turn == 0 && (dy < 0 || (dy == 0 && dx < 0)))))
            return false;
        from_x = to_x;
        from_y = to_y;
    }
    return true;
}

// The depth at which the ray of (x, y) meets a face: that of its plane, clamped to those of its corners.
float depth_of(const Textures *textures, const View *view, const Outline *o, const int face,
               const float x, const float y)
{
    const double4 plane = plane_of(textures, face / FACES, face % FACES);
    const double3 aside = view->right * (double)x + view->down * (double)y;
#ifdef PERSPECTIVE
    const double along = dot3(plane.xyz, view->direction + aside);
    const double away = dot3(plane.xyz, view->origin) + plane.w;
#else
    const double along = dot3(plane.xyz, view->direction);
    const double away = dot3(plane.xyz, view->origin + aside) + plane.w;
#endif
    const double depth = along < 0 ? -away / along - view->middle : o->nearest;
    return depth < o->nearest ? o->nearest : depth > o->farthest ? o->farthest : convert_float(depth);
}

// One work-item an exposed face: one more entry for each pixel whose ray enters by it.
__kernel void count_entries(EXPOSED, __global uint *counts)
{
    if (get_global_id(0) >= n)
        return;
    const Outline o = THE_OUTLINE;
    for (int row = o.rows.x; row <= o.rows.y; ++row)
        for (int column = o.columns.x; column <= o.columns.y; ++column)
            if (enters(&o, column + (0.5f - 0.5f * width), row + (0.5f - 0.5f * height)))
                atomic_inc(counts + row * width + column);
}

// One work-item an exposed face: write the entries (depth, cell) from starts[pixel] on, in any order.
// starts[pixel] becomes the end of the pixel's entries.
__kernel void list_entries(TEXTURES, EXPOSED, __global const double *viewpoint,
                           __global uint *starts, __global uint *entries)
{
    if (get_global_id(0) >= n)
        return;
    const Textures textures = THE_TEXTURES;
    const View view = view_of(viewpoint);
    const int face = exposed[get_global_id(0)];
    const Outline o = THE_OUTLINE;
    for (int row = o.rows.x; row <= o.rows.y; ++row)
        for (int column = o.columns.x; column <= o.columns.y; ++column) {
            const float x = column + (0.5f - 0.5f * width), y = row + (0.5f - 0.5f * height);
            if (!enters(&o, x, y))
                continue;
            const uint at = atomic_inc(starts + row * width + column);
            const float depth = depth_of(&textures, &view, &o, face, x, y);
            vstore2((uint2)(as_uint(depth), face / FACES), at, entries);
        }
}

// One work-item a pixel: sort its entries by depth and, where depths are equal, by cell.
__kernel void sort_entries(__global const uint *ends, const uint n, __global uint *entries)
{
    const uint pixel = get_global_id(0);
    if (pixel >= n)
        return;
    const uint start = pixel > 0 ? ends[pixel - 1] : 0, end = ends[pixel];
    // Shell's sort with the increments of [Knuth 1998]
    uint gap = 1;
    while (gap < (end - start) / 3)
        gap = 3 * gap + 1;
    for (; gap > 0; gap /= 3)
        for (uint i = start + gap; i < end; ++i) {
            const uint2 entry = vload2(i, entries);
            uint at = i;
            for (; at >= start + gap; at -= gap) {
                const uint2 before = vload2(at - gap, entries);
                const float depth = as_float(before.x), own = as_float(entry.x);
                if (depth < own || (depth == own && before.y <= entry.y))
                    break;
                vstore2(before, at, entries);
            }
            vstore2(entry, at, entries);
        }
}
