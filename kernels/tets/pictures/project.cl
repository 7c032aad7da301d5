// Cells of a volume, projected and listed by tile. Host side: voxtool/tets/pictures/project.py, which says why the
// order is right. kernels/tets/pictures/composite.cl draws them.
//
// The cells that may be in the picture are listed by depth for each tile of it. Options: those of
// textures.h and view.h

#include "tets/pictures/textures.h"
#include "tets/pictures/view.h"
#include "tets/pictures/project.h"
#include "tets/pictures/record.h"

// --- cells ---------------------------------------------------------------------------------------

// One work-item a cell: its record, and a flag of 1 if it may be in the picture.
__kernel void project_cells(TEXTURES, __global const uchar *kept,
                            __global const int *cells_vertices, __global const float *projected,
                            __global const double *viewpoint, const int width, const int height,
                            __global float *records, __global uint *flags)
{
    const uint cell = get_global_id(0);
    if (cell >= cells)
        return;
    flags[cell] = 0;
    if (!kept[cell / BLOCK])
        return;
    const View view = view_of(viewpoint);
    float4 corners[CORNERS];
    float nearest = FARTHEST, farthest = -FARTHEST;
    for (uint i = 0; i < CORNERS; ++i) {
        const float4 p = corners[i] = vload4(cells_vertices[CORNERS * (size_t)cell + i], projected);
        nearest = p.w < nearest ? p.w : nearest;
        farthest = p.w > farthest ? p.w : farthest;
    }
    int2 columns, rows;
    cover(corners, CORNERS, (int2)(width, height), &columns, &rows);
    if (columns.x > columns.y || rows.x > rows.y)
        return;
    flags[cell] = 1;
    const Textures textures = THE_TEXTURES;
    __global float *record = records + WORDS * (size_t)cell;
    for (uint face = 0; face < FACES; ++face) {
        const double4 f = on_rays(&view, plane_of(&textures, cell, face));
        const bool beside = fabs(f.w) <= LEAST_SCALE;
        const bool in_at_0 = f.x > 0 || (f.x == 0 && f.y < 0);
        const int side = beside ? in_at_0 ? BESIDE : BESIDE_AT_0 : f.w > 0 ? LEAVES : ENTERS;
        // beside: in pixels, so that a line through their centres is exact
        const double pixel = fabs(f.x) > fabs(f.y) ? fabs(f.x) : fabs(f.y);
        const double scale = beside ? pixel > 0 ? pixel : 1 : f.w;
        vstore4((float4)(convert_float3(f.xyz / scale), as_float(side)), face, record);
    }
    vstore4(scalar_on_rays(&view, scalar_of(&textures, cell)), FACES, record);
    vstore4((float4)(nearest, farthest, as_float(columns.x | columns.y << 16),
                     as_float(rows.x | rows.y << 16)),
            FACES + 1, record);
}

// One work-item a cell: list it if it may be in the picture, with its depth as an integer that sorts like
// the float.
__kernel void list_cells(__global const float *records, __global const uint *starts, const uint n,
                         __global uint *depths, __global uint *listed)
{
    const uint cell = get_global_id(0);
    if (cell >= n || starts[cell] == starts[cell + 1])
        return;
    const uint bits = as_uint(records[WORDS * (size_t)cell + 4 * (FACES + 1)]);
    depths[starts[cell]] = bits >> 31 ? ~bits : bits | 0x80000000u;
    listed[starts[cell]] = cell;
}

// --- tiles ---------------------------------------------------------------------------------------

// The tiles that a cell covers: first and last column, first and last row.
int4 tiles_of(__global const float *records, const uint cell)
{
    const float4 place = vload4(PARTS * (size_t)cell + FACES + 1, records);
    const int columns = as_int(place.z), rows = as_int(place.w);
    return (int4)(columns & 0xffff, columns >> 16, rows & 0xffff, rows >> 16) / TILE;
}

// One work-item a listed cell.
__kernel void count_tiles(__global const float *records, __global const uint *listed, const uint n,
                          __global uint *counts)
{
    if (get_global_id(0) >= n)
        return;
    const int4 tiles = tiles_of(records, listed[get_global_id(0)]);
    counts[get_global_id(0)] = (tiles.y - tiles.x + 1) * (tiles.w - tiles.z + 1);
}

__kernel void list_pairs(__global const float *records, __global const uint *listed, const uint n,
                         __global const uint *starts, const uint tiles_across,
                         __global uint *pair_tiles, __global uint *pair_cells)
{
    if (get_global_id(0) >= n)
        return;
    const uint cell = listed[get_global_id(0)];
    const int4 tiles = tiles_of(records, cell);
    uint at = starts[get_global_id(0)];
    for (int row = tiles.z; row <= tiles.w; ++row)
        for (int column = tiles.x; column <= tiles.y; ++column, ++at) {
            pair_tiles[at] = row * tiles_across + column;
            pair_cells[at] = cell;
        }
}

// One work-item a sorted pair: where the list of each tile begins and ends.
__kernel void find_tiles(__global const uint *pair_tiles, const uint n, __global uint *ends)
{
    const uint pair = get_global_id(0);
    if (pair >= n)
        return;
    const uint tile = pair_tiles[pair];
    if (pair == 0 || pair_tiles[pair - 1] != tile)
        ends[2 * tile] = pair;
    if (pair + 1 == n || pair_tiles[pair + 1] != tile)
        ends[2 * tile + 1] = pair + 1;
}
