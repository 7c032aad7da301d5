// Colours and normals of the voxels of a surface: means over the parts of triangles in each voxel,
// weighted by their areas. Sums are of whole numbers, so that they do not depend on an order. Host side:
// voxtool/svo/attribution/surface_pass.py. Options: those of scan_conversion.h.

#include "svo/voxelization/columns.h"
#include "svo/attribution/colours.h"
#include "svo/attribution/textures.h"
#include "svo/attribution/part.h"
#include "svo/attribution/materials.h"

#define NO_FACE 0xFFFFFFFFu

// Add a whole number of 64 bits by its halves: OpenCL 1.2 has atomics of 32 bits. The carry goes up, so
// in the end the sum is right, whatever the order.
void add(volatile __global uint *halves, ulong value)
{
    const uint low = (uint)value, before = atomic_add(halves, low);
    const uint high = (uint)(value >> 32) + (before + low < before);
    if (high)
        atomic_add(halves + 1, high);
}

ulong whole_of(double x) { return (ulong)(x < 0 ? -(long)(0.5 - x) : (long)(x + 0.5)); }

// ---- pairs of a voxel and a triangle

// Receives the voxels of one triangle. With `greatest` and without `faces_of`, the area of the greatest
// part of each voxel is found; with both, the lowest triangle that has it. Otherwise areas, colours and
// normals are summed, and `faces_of` has the lowest triangle without an area.
typedef struct {
    __global const uint *masks, *starts; // words of bricks, and voxels set before each
    uint face;
    cutter parts;
    double3 normal; // of length 1
    double size;    // of the triangle, in 1/UNIT of a face of a voxel
    skin colours;
    volatile __global uint *areas, *colour_sums, *normal_sums, *greatest, *faces_of;
    uint3 cell; // level-1 node of the last voxel, and its index among the active nodes
    uint node;
} painter;

void put_box(painter *p, int level, ACTIVE_SET_PARAMETERS, uint3 voxel)
{
    const uint3 cell = voxel >> 3;
    if (any(cell != p->cell)) {
        p->cell = cell;
        p->node = set_index(words, ranks, stored_code(ACTIVE_SET, morton_encode(cell)));
    }
    const uint place = voxel_place(voxel), word = 16 * p->node + (place >> 5);
    const uint mask = p->masks[word], bit = 1u << (place & 31);
    if (!(mask & bit))
        return;
    const size_t index = p->starts[word] + popcount(mask & (bit - 1));
    const part *own = part_in(&p->parts, voxel);
    const double area = area_of(own) * p->size;
    const ulong weight = whole_of(area);
    const uint size = (uint)(weight >> 2);
    if (p->greatest && p->faces_of) {
        if (p->greatest[index] == size)
            atomic_min(&p->faces_of[index], p->face);
        return;
    }
    if (p->greatest)
        atomic_max(&p->greatest[index], size);
    if (weight == 0) {
        if (p->faces_of)
            atomic_min(&p->faces_of[index], p->face);
        return;
    }
    if (p->areas)
        add(p->areas + 2 * index, weight);
    if (p->colour_sums) {
        const double4 c = mean_colour(&p->colours, own) * area;
        add(p->colour_sums + 8 * index, whole_of(c.x));
        add(p->colour_sums + 8 * index + 2, whole_of(c.y));
        add(p->colour_sums + 8 * index + 4, whole_of(c.z));
        add(p->colour_sums + 8 * index + 6, whole_of(c.w));
    }
    if (p->normal_sums) {
        const double3 n = p->normal * area;
        add(p->normal_sums + 6 * index, whole_of(n.x));
        add(p->normal_sums + 6 * index + 2, whole_of(n.y));
        add(p->normal_sums + 6 * index + 4, whole_of(n.z));
    }
}

#define RECEIVER painter
#include "svo/voxelization/scan_conversion.h"

// Visit the pairs of a triangle and a voxel of the masks that it touches; see `painter`. Sides of voxels
// across an axis are common ones from `inner_low` to `inner_high`: a triangle in one counts by half in
// each of its voxels.
__kernel void add_parts(TRIANGLES, ACTIVE_SET_PARAMETERS, LOOK, __global const uint *masks,
                        __global const uint *starts, const double3 scale, const int3 inner_low,
                        const int3 inner_high, volatile __global uint *areas,
                        volatile __global uint *colour_sums, volatile __global uint *normal_sums,
                        volatile __global uint *greatest, volatile __global uint *faces_of)
{
    painter p;
    triangle t;
    columns c;
    if (!take_share(THESE_TRIANGLES, TOUCHED, &t, &c))
        return;
    const double3 normal = normal_of(&t, scale);
    const double length = length_of(normal);
    int3 low, high;
    find_bounds(&t, &low, &high);
    const int3 side = low >> FIXED_POINT_BITS;
    const bool halved = any(low == high && side * VOXEL == low && side >= inner_low && side <= inner_high);
    p.masks = masks;
    p.starts = starts;
    p.face = t.face;
    p.normal = length > 0 ? normal / length : normal;
    p.size = length * (double)UNIT / ((halved ? 4.0 : 2.0) * VOXEL * VOXEL);
    if (colour_sums)
        p.colours = skin_of(THIS_LOOK, faces, t.face);
    p.areas = areas;
    p.colour_sums = colour_sums;
    p.normal_sums = normal_sums;
    p.greatest = greatest;
    p.faces_of = faces_of;
    p.cell = (uint3)(~0u);
    open_cutter(&p.parts, &t, c.axis);
    const scan s = set_up(&t, &c, TOUCHED, level, pad);
    scan_convert(&s, &c, &p, level, ACTIVE_SET);
}

// ---- values

// The values of the voxels of each word of the masks: means, or those of the triangles in `faces_of`
// where there is no area and, with `nearest`, of colours everywhere.
__kernel void finish_values(const uint n, __global const CODE *codes, __global const uint *masks,
                            __global const uint *starts, __global const int *vertices,
                            __global const int *faces, LOOK, const double3 scale, const int nearest,
                            __global const ulong *areas, __global const ulong *colour_sums,
                            __global const long *normal_sums, __global const uint *faces_of,
                            __global uchar *colour_values, __global float *normal_values)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint3 low = morton_decode(codes[gid >> 4]) << 3;
    size_t index = starts[gid];
    cutter parts;
    for (uint left = masks[gid]; left; left &= left - 1, ++index) {
        const ulong area = areas ? areas[index] : 0;
        const uint face = faces_of[index];
        if (area == 0 && face == NO_FACE)
            continue;
        const bool alone = nearest || area == 0; // a triangle decides the colour
        triangle t;
        if (alone)
            t = fetch_triangle(vertices, faces, face);
        if (colour_values) {
            uchar4 colour;
            if (alone) {
                const uint place = (gid & 15) * 32 + popcount((left & -left) - 1u);
                open_cutter(&parts, &t, 2);
                const part *own = part_in(&parts, low + morton_decode(place));
                const skin colours_of = skin_of(THIS_LOOK, faces, face);
                double u, v;
                find_centre(own, &u, &v);
                colour = nearest ? nearest_colour(&colours_of, u, v) : levels_of(mean_colour(&colours_of, own));
            } else {
                colour = levels_of(convert_double4(vload4(index, colour_sums)) / (double)area);
            }
            vstore4(colour, index, colour_values);
        }
        if (normal_values) {
            double3 normal = area ? convert_double3(vload3(index, normal_sums)) : normal_of(&t, scale);
            const double length = length_of(normal);
            const bool cancels = length == 0 || length * OPPOSED < (double)area;
            normal = cancels ? (double3)(0) : normal / length;
            vstore3(convert_float3(normal), index, normal_values);
        }
    }
}
