// Ray casting of a volume: section 4 of the text, by cells' adjacency.
// Host side: voxtool/tets/raycast.py.
//
// A work-item follows the rays of LANES pixels of a tile, side by side. A step takes each ray from its
// depth to where it leaves its cell, or to the first control point of the transfer function before
// that. A ray that leaves the volume goes on at its next entry.
// Options:
//   LANES        1 or 16
//   SLOTS        ways out in a record, as in view.cl
//   INTEGRATOR   LINEAR, AVERAGE, SAMPLED or PREINTEGRATED
//   CONSTANT     cells have one scalar each
//   PERSPECTIVE

#include "tets/volume.h"
#include "tets/raycast.h"
#include "tets/depth.h"
#include "tets/integrate.h"

#pragma OPENCL FP_CONTRACT OFF

#define WORDS (4 * (SLOTS + 1)) // of a record

// Where the rays are.
typedef struct {
    ints cell;     // or NOWHERE
    floats depth;
    floats scalar; // there, and its interval
    ints interval;
    ints fresh; // the cell is new to the ray: the scalar is yet to be found
    ints still; // steps since the ray last moved
} Place;

// The next entries of the lanes that are nowhere.
void enter(Place *place, uint *next, const uint *end, __global const uint *entries)
{
    int cells[LANES];
    float depths[LANES];
    store(place->cell, cells);
    store(place->depth, depths);
    for (uint lane = 0; lane < LANES; ++lane)
        if (cells[lane] == NOWHERE && next[lane] < end[lane]) {
            const uint2 entry = vload2(next[lane]++, entries);
            const float depth = as_float(entry.x);
            cells[lane] = entry.y;
            depths[lane] = depth > depths[lane] ? depth : depths[lane];
        }
    const ints waits = place->cell == NOWHERE;
    place->fresh |= waits;
    place->still = waits ? (ints)0 : place->still;
    place->cell = load(cells);
    place->depth = load(depths);
}

__kernel void cast(__global const float *records, __global const uint *ends,
                   __global const uint *entries, __global const float *points,
                   __global const float *rows, const int count, __global const float *table,
                   const float longest, const uint samples, const int eye_cell,
                   const float middle, const float right_square, const float down_square, const int width,
                   const int height, __global float *picture)
{
    const Integral integral = {{points, rows, count}, samples, table, longest};
    // the pixels of a work-item: part of a tile of 4 x 4
    const uint tiles = (width + 3) / 4, first = LANES * (uint)get_global_id(0);
    const int tile_x = 4 * (first / 16 % tiles), tile_y = 4 * (first / 16 / tiles);
    if (tile_y >= height)
        return;
    float xs[LANES], ys[LANES];
    uint next[LANES], end[LANES];
    int inside[LANES];
    for (uint lane = 0; lane < LANES; ++lane) {
        const int column = tile_x + (first + lane) % 4, row = tile_y + (first + lane) / 4 % 4;
        const int pixel = row * width + column;
        xs[lane] = column + (0.5f - 0.5f * width);
        ys[lane] = row + (0.5f - 0.5f * height);
        inside[lane] = column < width && row < height ? pixel : NOWHERE;
        next[lane] = inside[lane] > 0 ? ends[pixel - 1] : 0;
        end[lane] = inside[lane] >= 0 ? ends[pixel] : 0;
    }
    const floats x = load(xs), y = load(ys);
    const ints cells = load(inside);
#ifdef PERSPECTIVE
    const float behind = -middle - ON_PLANE; // where entries are none
    for (uint lane = 0; lane < LANES; ++lane)
        while (next[lane] < end[lane] && as_float(entries[2 * next[lane]]) < behind)
            ++next[lane];
    const floats length = sqrt((x * x * right_square + y * y * down_square) + 1); // of depth 1
    Place place = {cells >= 0 ? (ints)eye_cell : (ints)NOWHERE, -middle, 0, 0, cells >= 0, 0};
#else
    const floats length = 1;
    Place place = {NOWHERE, -FARTHEST, 0, 0, 0, 0};
#endif
    Light light = {0, 0, 0, 1};
    for (;;) {
        if (ANY(place.cell == NOWHERE))
            enter(&place, next, end, entries);
        const ints active = place.cell != NOWHERE;
        if (!ANY(active))
            break;
        floats record[WORDS];
        gather(records, active ? place.cell : (ints)0, WORDS / 16, record);
        // where the rays leave: the least depth, the greatest nearness
        floats nearness = -FARTHEST;
        ints beyond = NOWHERE;
        for (uint slot = 0; slot < SLOTS; ++slot) {
            const floats *out = record + 4 * slot;
            const floats n = (out[0] * x + out[1] * y) + out[2];
            const ints nearer = n > nearness;
            nearness = nearer ? n : nearness;
            beyond = nearer ? as_ints(out[3]) : beyond;
        }
#ifdef PERSPECTIVE
        const ints leaves = nearness > -1;
#else
        const ints leaves = nearness > -FARTHEST;
#endif
        floats depth = depths_of(leaves ? nearness : (floats)0, middle);
        const ints moves = leaves & (depth > place.depth);
        depth = moves ? depth : place.depth;
        depth = depth < DEEPEST ? depth : (floats)DEEPEST;
        // the scalars of this cell, not of the one before: that may be a sliver, whose are rough
        const floats *on_ray = record + 4 * SLOTS;
        const floats scalar = scalars_at(on_ray, x, y, depth, middle);
        const floats entered = scalars_at(on_ray, x, y, place.depth, middle);
        const ints interval = interval_of(&integral.transfer, scalar);
        const ints began = interval_of(&integral.transfer, entered);
        place.scalar = place.fresh ? entered : place.scalar;
        place.interval = place.fresh ? began : place.interval;
        const floats distance = (depth - place.depth) * length;
        const Segment segment = {place.scalar, scalar, place.interval, interval};
        floats to, share;
        ints follows;
        const ints goes_on = add_piece(&light, &integral, &segment,
                                       active ? distance : (floats)0, &to, &follows, &share);
        depth = goes_on ? place.depth + (depth - place.depth) * share : depth;
        // on
        place.still = (moves | goes_on) ? (ints)0 : place.still + 1;
        place.fresh = !goes_on;
        place.scalar = to;
        place.interval = follows;
        place.depth = active ? depth : place.depth;
        place.cell = goes_on ? place.cell : beyond;
        place.cell = (active & (place.still < MOST_STILL)) ? place.cell : (ints)NOWHERE;
        const ints opaque = light.through < LEAST_LIGHT;
        if (ANY(opaque)) {
            int done[LANES];
            store(opaque, done);
            for (uint lane = 0; lane < LANES; ++lane)
                next[lane] = done[lane] ? end[lane] : next[lane];
            place.cell = opaque ? (ints)NOWHERE : place.cell;
        }
    }
    float r[LANES], g[LANES], b[LANES], a[LANES];
    store(light.r, r);
    store(light.g, g);
    store(light.b, b);
    store(1 - light.through, a);
    for (uint lane = 0; lane < LANES; ++lane)
        if (inside[lane] >= 0)
            vstore4((float4)(r[lane], g[lane], b[lane], a[lane]), inside[lane], picture);
}
