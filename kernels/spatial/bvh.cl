// Bounding volume hierarchy of a mesh's triangles. Host side: voxtool/spatial/bvh.py.

#include "spatial/bvh.h"
#include "spatial/hilbert.h"
#include "spatial/names.h"

double product(double3 a, double3 b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

double square(double3 a)
{
    return product(a, a);
}

double3 corner(__global const double *vertices, __global const int *faces, uint face, uint i)
{
    return vload3(faces[3 * (size_t)face + i], vertices);
}

// Enlarges the box to contain a face.
void enclose(__global const double *vertices, __global const int *faces, uint face, double3 *low,
             double3 *high)
{
    for (uint i = 0; i < 3; ++i) {
        const double3 p = corner(vertices, faces, face, i);
        *low = p < *low ? p : *low;
        *high = p > *high ? p : *high;
    }
}

// codes[f] = the Hilbert index of the centre of face f's box; order[f] = f.
__kernel void face_codes(__global const double *vertices, __global const int *faces, const uint n,
                         __global ulong *codes, __global uint *order)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    double3 low = INFINITY, high = -INFINITY;
    enclose(vertices, faces, gid, &low, &high);
    const double3 middle = 0.5 * (low + high);
    const uint3 cell = (uint3)(cell_of(middle.x, FACE_BITS), cell_of(middle.y, FACE_BITS),
                               cell_of(middle.z, FACE_BITS));
    codes[gid] = hilbert_index(cell, FACE_BITS);
    order[gid] = gid;
}

// The corner of a face at which its longest edge starts.
uint longest_edge(double3 a, double3 b, double3 c)
{
    const double ab = square(b - a), bc = square(c - b), ca = square(a - c);
    return bc > ab && bc >= ca ? 1 : ca > ab ? 2 : 0;
}

#define TINY 0x1p-900

// Leaf i holds faces LEAF i, LEAF i + 1, ... of the order; the last face pads the last leaf.
//
// A triangle is stored as its corner a, its longest edge e from a, its height vector g
// perpendicular to e, and the foot of the height along e, so that c = a + foot e + g (see
// point_triangle.h). A squared length whose inverse may overflow is stored as 1. face_of[slot] =
// the face.
__kernel void frame_triangles(__global const double *vertices, __global const int *faces,
                              const uint count, __global const uint *order,
                              __global double *leaves, __global uint *face_of)
{
    const uint gid = get_global_id(0);
    if (gid >= (count + LEAF - 1) / LEAF * LEAF)
        return;
    const uint face = order[min(gid, count - 1)];
    double3 a = corner(vertices, faces, face, 0);
    double3 b = corner(vertices, faces, face, 1);
    double3 c = corner(vertices, faces, face, 2);
    const uint turn = longest_edge(a, b, c);
    if (turn == 1) {
        const double3 first = a;
        a = b, b = c, c = first;
    } else if (turn == 2) {
        const double3 last = c;
        c = b, b = a, a = last;
    }
    const double3 e = b - a, f = c - a;
    const double ee = square(e);
    double foot = 0;
    double3 g = f;
    for (uint i = 0; i < 2 && ee > 0; ++i) { // the second pass removes the rounding error of the first
        const double more = product(g, e) / ee;
        foot += more;
        g -= more * e;
    }
    foot = foot < 0 ? 0 : foot > 1 ? 1 : foot;
    const double gg = square(g), rest = 1 - foot;
    const double edge = ee > TINY ? ee : 1, height = gg > TINY ? gg : 1;
    const double per_ac = 1 / (foot * foot * edge + height);
    const double per_bc = 1 / (rest * rest * edge + height);
    const double fields[FIELDS] = {a.x, a.y, a.z,  e.x,  e.y,      e.z,        g.x,   g.y,
                                   g.z, foot, edge, 1 / edge, 1 / height, per_ac, per_bc};
    __global double *leaf = leaves + (size_t)(gid / LEAF) * (FIELDS * LEAF) + gid % LEAF;
    for (uint i = 0; i < FIELDS; ++i)
        leaf[i * LEAF] = fields[i];
    face_of[gid] = face;
}

// names[slot] = three times the face plus the corner that is a; NAMELESS for faces without area.
__kernel void name_triangles(__global const double *vertices, __global const int *faces,
                             const uint n, __global const uint *face_of,
                             __global const uchar *flat, __global uint *names)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint face = face_of[gid];
    const uint turn = longest_edge(corner(vertices, faces, face, 0), corner(vertices, faces, face, 1),
                                   corner(vertices, faces, face, 2));
    names[gid] = flat[face] ? NAMELESS : 3 * face + turn;
}

// The box of a node's child i: low x, y, z and high x, y, z, ARITY apart.
__global float *child_box(__global float *nodes, uint node, uint i)
{
    return nodes + (size_t)node * (6 * ARITY) + i;
}

// The box of a missing child: infinitely far from everything.
void set_empty(__global float *box)
{
    for (uint side = 0; side < 6; ++side)
        box[side * ARITY] = side < 3 ? INFINITY : -INFINITY;
}

// The boxes of the leaves, in the nodes from `first` on. The margin exceeds the rounding to single
// precision, of the boxes and of points near the mesh.
__kernel void bound_leaves(__global const double *vertices, __global const int *faces, const uint count,
                           __global const uint *order, const uint first, __global float *nodes)
{
    const uint gid = get_global_id(0);
    const uint leaves = (count + LEAF - 1) / LEAF;
    if (gid >= (leaves + ARITY - 1) / ARITY * ARITY)
        return;
    __global float *box = child_box(nodes, first + gid / ARITY, gid % ARITY);
    if (gid >= leaves) {
        set_empty(box);
        return;
    }
    const float margin = 1.0f / (1u << MARGIN_BITS);
    double3 low = INFINITY, high = -INFINITY;
    for (uint i = gid * LEAF; i < min((gid + 1) * LEAF, count); ++i)
        enclose(vertices, faces, order[i], &low, &high);
    box[0 * ARITY] = (float)low.x - margin;
    box[1 * ARITY] = (float)low.y - margin;
    box[2 * ARITY] = (float)low.z - margin;
    box[3 * ARITY] = (float)high.x + margin;
    box[4 * ARITY] = (float)high.y + margin;
    box[5 * ARITY] = (float)high.z + margin;
}

// The boxes of the `count` nodes from `child` on, stored in the nodes from `first` on, one level
// above.
__kernel void bound_nodes(const uint child, const uint count, const uint first, __global float *nodes)
{
    const uint gid = get_global_id(0);
    if (gid >= (count + ARITY - 1) / ARITY * ARITY)
        return;
    __global float *box = child_box(nodes, first + gid / ARITY, gid % ARITY);
    if (gid >= count) {
        set_empty(box);
        return;
    }
    for (uint side = 0; side < 6; ++side) {
        __global const float *ends = child_box(nodes, child + gid, side * ARITY);
        float end = ends[0];
        for (uint i = 1; i < ARITY; ++i)
            end = (side < 3 ? ends[i] < end : ends[i] > end) ? ends[i] : end;
        box[side * ARITY] = end;
    }
}
