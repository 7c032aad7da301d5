// Cells: split into tetrahedra, measured, and kept or dropped. Host side:
// voxtool/tets/construction/conforming.py.

#include "tets/volume/cells.h"
#include "tets/construction/conforming.h"
#include "tets/pictures/mixed.h"
#include "tets/pictures/vector.h"

// Each number is replaced by another one.
__kernel void renumber(__global uint *corners, const uint n, __global const uint *numbers)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        corners[gid] = numbers[corners[gid]];
}

// ---- splitting

// The splits of a kind of cell. quads[4 i ...]: the corners of quadrilateral i; templates[TEMPLATE *
// code ...]: the number of tetrahedra of a code, and four corners each.
#define KIND                                                                                       \
    const uint corners, __global const uchar *quads, const uint quad_count,                        \
        __global const uchar *templates
#define THIS_KIND corners, quads, quad_count, templates

// The code of a cell: its smallest vertex, then for each quadrilateral, whether it is cut from its
// second corner instead of its first. Returns its tetrahedra.
__global const uchar *template_of(KIND, __global const uint *cell)
{
    uint code = 0;
    for (uint i = 1; i < corners; ++i)
        if (cell[i] < cell[code])
            code = i;
    for (uint q = 0; q < quad_count; ++q) {
        uint least = 0;
        for (uint i = 1; i < 4; ++i)
            if (cell[quads[4 * q + i]] < cell[quads[4 * q + least]])
                least = i;
        code = 2 * code + (least & 1);
    }
    return templates + TEMPLATE * code;
}

bool repeats_a_vertex(const uint4 v)
{
    return v.x == v.y || v.x == v.z || v.x == v.w || v.y == v.z || v.y == v.w || v.z == v.w;
}

// A piece of a cell, of four vertices.
uint4 piece_of(__global const uint *cell, __global const uchar *piece)
{
    return (uint4)(cell[piece[0]], cell[piece[1]], cell[piece[2]], cell[piece[3]]);
}

// counts[i] = the tetrahedra of cell i that name no vertex twice; repeating[i] = 1 where the cell
// does.
__kernel void count_pieces(__global const uint *cells, KIND, const uint n, __global uint *counts,
                           __global uchar *repeating)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    __global const uint *cell = cells + (size_t)corners * gid;
    __global const uchar *pieces = template_of(THIS_KIND, cell);
    uint count = 0, twice = 0;
    for (uint i = 0; i < pieces[0]; ++i)
        count += !repeats_a_vertex(piece_of(cell, pieces + 1 + 4 * i));
    for (uint i = 1; i < corners; ++i)
        for (uint j = 0; j < i; ++j)
            twice |= cell[i] == cell[j];
    counts[gid] = count;
    repeating[gid] = twice;
}

// Those tetrahedra, from starts[i] and `offset` on, and the number of their cell, from
// `first_source` on.
__kernel void write_pieces(__global const uint *cells, KIND, const uint n,
                           __global const uint *starts, const uint offset, const uint first_source,
                           __global uint *pieces_of_all, __global uint *sources)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    __global const uint *cell = cells + (size_t)corners * gid;
    __global const uchar *pieces = template_of(THIS_KIND, cell);
    uint to = offset + starts[gid];
    for (uint i = 0; i < pieces[0]; ++i) {
        const uint4 piece = piece_of(cell, pieces + 1 + 4 * i);
        if (!repeats_a_vertex(piece)) {
            vstore4(piece, to, pieces_of_all);
            sources[to++] = first_source + gid;
        }
    }
}

// ---- measuring. `side` is the longest side of the mesh; a shape is the sign of the volume plus 1,
// with FLAT, THIN, DOUBTFUL or BENT.

double3 point_at(__global const double *points, const uint vertex) { return vload3(vertex, points); }

// Six times the volume of a tetrahedron; `magnitude` is the sum of the sizes of its terms.
double volume_of(const double3 a, const double3 b, const double3 c, double *magnitude)
{
    const double3 plus = (double3)(b.x * c.y, c.x * a.y, a.x * b.y);
    const double3 minus = (double3)(c.x * b.y, a.x * c.y, b.x * a.y);
    const double3 height = (double3)(a.z, b.z, c.z);
    const double3 term = height * (plus - minus);
    const double3 size = fabs(height) * (fabs(plus) + fabs(minus));
    *magnitude = size.x + size.y + size.z;
    return term.x + term.y + term.z;
}

// `face` is the largest product of two edges of a face.
uint shape_of(const double volume, const double face, const double size, const double side)
{
    const bool flat = fabs(volume) <= FLATTEST * size * face || face <= NEEDLE * size * size ||
                      size <= SMALLEST * side;
    const bool thin = fabs(volume) < THINNEST * size * face;
    return (1 + (volume > 0) - (volume < 0)) | (flat ? FLAT : 0) | (thin ? THIN : 0);
}

__kernel void measure_tetrahedra(__global const uint *cells, const uint n,
                                 __global const double *points, const double side,
                                 __global uchar *shapes)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint4 v = vload4(gid, cells);
    const double3 o = point_at(points, v.x);
    const double3 a = point_at(points, v.y) - o, b = point_at(points, v.z) - o;
    const double3 c = point_at(points, v.w) - o;
    double size = fmax(fmax(length3(a), length3(b)), length3(c));
    size = fmax(fmax(size, length3(a - b)), fmax(length3(b - c), length3(c - a)));
    double magnitude;
    const double volume = volume_of(a, b, c, &magnitude);
    const bool doubtful = fabs(volume) <= ROUNDING * magnitude || magnitude < LEAST_MAGNITUDE;
    double face = fmax(length3(cross3(a, b)), fmax(length3(cross3(b, c)), length3(cross3(c, a))));
    face = fmax(face, length3(cross3(b - a, c - a)));
    shapes[gid] = shape_of(volume, face, size, side) | (doubtful ? DOUBTFUL : 0);
}

// The largest distance of vertices of a hexahedron from the plane of their face, or outside another
// face. `way` is the sign of its volume.
double bend_of(const double3 *corner, const double way, double *size)
{
    double bent = 0;
    for (uint face = 0; face < 6; ++face) {
        __constant uchar *on = HEXAHEDRON_FACES + 4 * face;
        const double3 a = corner[on[0]], b = corner[on[1]], c = corner[on[2]], d = corner[on[3]];
        *size = fmax(fmax(*size, length3(b - a)), length3(c - b));
        *size = fmax(fmax(*size, length3(d - c)), length3(a - d));
        double3 normal = cross3(c - a, d - b) * way;
        const double area = length3(normal);
        if (area == 0)
            bent = INFINITY;
        normal /= area == 0 ? 1 : area;
        const double3 centre = (a + b + c + d) / 4;
        for (uint i = 0; i < 8; ++i) {
            const double height = dot3(corner[i] - centre, normal);
            const bool on_it = i == on[0] || i == on[1] || i == on[2] || i == on[3];
            bent = fmax(bent, on_it ? fabs(height) : height);
        }
    }
    return bent;
}

// Hexahedra: cell i has the pieces from starts[i] on.
__kernel void measure_hexahedra(__global const uint *cells, const uint n,
                                __global const double *points, const double side,
                                __global const uint *starts, __global const uint *pieces,
                                __global uchar *shapes)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    double3 corner[8];
    for (uint i = 0; i < 8; ++i)
        corner[i] = point_at(points, cells[8 * (size_t)gid + i]);
    double volume = 0, magnitude, size = 0;
    for (uint piece = starts[gid]; piece < starts[gid + 1]; ++piece) {
        const uint4 v = vload4(piece, pieces);
        const double3 o = point_at(points, v.x);
        volume += volume_of(point_at(points, v.y) - o, point_at(points, v.z) - o,
                            point_at(points, v.w) - o, &magnitude);
    }
    const double bent = bend_of(corner, volume < 0 ? -1.0 : 1.0, &size);
    shapes[gid] = shape_of(volume, size * size, size, side) | (bent > PLANAR * size ? BENT : 0);
}

// ---- dropping

// The vertices of a cell in ascending order.
void ascending(__global const uint *cells, const uint corners, const uint cell, uint *vertex)
{
    for (uint i = 0; i < corners; ++i) {
        const uint v = cells[(size_t)corners * cell + i];
        uint to = i;
        for (; to > 0 && vertex[to - 1] > v; --to)
            vertex[to] = vertex[to - 1];
        vertex[to] = v;
    }
}

// The bucket of a cell is its smallest vertex; cells of equal keys nearly always have the same
// vertices.
__kernel void key_cells(__global const uint *cells, const uint corners, const uint n,
                        __global uint *buckets, __global ulong *keys)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint vertex[8];
    ascending(cells, corners, gid, vertex);
    buckets[gid] = vertex[0];
    ulong key = 0;
    for (uint i = 1; i < corners; ++i)
        key = mixed(key + vertex[i]);
    keys[gid] = key;
}

// repeated[i] = 1 where an earlier cell has the vertices of cell i.
__kernel void find_repeated(__global const uint *cells, const uint corners, const uint n,
                            __global const uint *ends, __global const ulong *keys,
                            __global const uint *items, __global uchar *repeated)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint vertex[8], other[8];
    ascending(cells, corners, items[gid], vertex);
    const uint begin = vertex[0] ? ends[vertex[0] - 1] : 0;
    bool found = false;
    for (uint i = gid; i > begin && keys[i - 1] == keys[gid] && !found; --i) {
        ascending(cells, corners, items[i - 1], other);
        found = true;
        for (uint k = 1; k < corners; ++k)
            found &= vertex[k] == other[k];
    }
    repeated[items[gid]] = found;
}

// Decides the outcome of each cell, and sets keep[i] = 1 where it stays.
__kernel void judge(__global const uchar *shapes, __global const uchar *repeated, const uint n,
                    __global uchar *outcomes, __global uint *keep)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint shape = shapes[gid], sign = shape & SIGN;
    const uint outcome = repeated[gid]  ? DUPLICATE
                         : sign == 1    ? ZERO_VOLUME
                         : shape & FLAT ? TOO_FLAT
                         : sign == 0    ? TURNED
                                        : KEPT;
    outcomes[gid] = outcome;
    keep[gid] = outcome == TURNED || outcome == KEPT;
}

// The cells that stay, where `places` says, turned if their volume is negative, with the numbers
// of the cells they come from; used[v] = 1 where one has vertex v.
__kernel void keep_cells(__global const uint *cells, const uint corners, const uint n,
                         __global const uint *sources, __global const uchar *outcomes,
                         __global const uint *places, __global uint *kept,
                         __global uint *kept_sources, volatile __global uint *used)
{
    const uint gid = get_global_id(0);
    if (gid >= n || places[gid] == places[gid + 1])
        return;
    const size_t to = places[gid];
    for (uint i = 0; i < corners; ++i) {
        uint from = i;
        if (outcomes[gid] == TURNED) // opposite faces, or the first two vertices, change places
            from = corners == 8 ? i ^ 4 : i < 2 ? 1 - i : i;
        const uint vertex = cells[(size_t)corners * gid + from];
        kept[corners * to + i] = vertex;
        atomic_or(&used[vertex], 1u);
    }
    kept_sources[to] = sources[gid];
}
