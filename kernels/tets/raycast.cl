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
#include "tets/integrators.h"
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

// Where rays enter cells: those that hold the eye, one after the other for as long as a ray has not left
// it, and then what is listed for its pixel.
typedef struct {
    __global const uint *eye_cells;
    uint eye_count;
    float at_eye; // depth
    __global const uint *entries;
    uint next_eye_cell[LANES], next[LANES], end[LANES];
} Entries;

// The next entries of the lanes that are nowhere.
void enter(Place *place, Entries *e)
{
    int cells[LANES];
    float depths[LANES];
    store(place->cell, cells);
    store(place->depth, depths);
    for (uint lane = 0; lane < LANES; ++lane)
        if (cells[lane] != NOWHERE)
            continue;
        else if (e->next_eye_cell[lane] < e->eye_count && depths[lane] <= e->at_eye)
            cells[lane] = e->eye_cells[e->next_eye_cell[lane]++];
        else if (e->next[lane] < e->end[lane]) {
            const uint2 entry = vload2(e->next[lane]++, e->entries);
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

// The cells that rays go on in that leave the volume: those across other faces that they meet there too,
// as well as rounding can tell, or NOWHERE. Beside a notch they would be lost else: where they come in
// again is decided by the edges, which may say that they never left. `slack` pixels are rounding.
ints beyond_edge(const floats *record, const floats x, const floats y, const floats nearness,
                 const floats slack)
{
    floats least = nearness, best = -FARTHEST;
    ints beyond = NOWHERE;
    for (uint pass = 0; pass < 2; ++pass)
        for (uint slot = 0; slot < SLOTS; ++slot) {
            const floats *out = record + 4 * slot;
            const floats n = (out[0] * x + out[1] * y) + out[2];
            const floats doubt = slack * (fabs(out[0]) + fabs(out[1]));
            if (pass == 0) {
                least = n >= nearness ? nearness - doubt : least;
                continue;
            }
            // not one along the rays
            const ints nearer = (n + doubt >= least) & (n > best) & (doubt < 1) &
                                (as_ints(out[3]) != NOWHERE);
            best = nearer ? n : best;
            beyond = nearer ? as_ints(out[3]) : beyond;
        }
    return beyond;
}

__kernel void cast(__global const float *records, __global const uint *ends,
                   __global const uint *entries, __global const float *points,
                   __global const float *rows, const int count, __global const float *table,
                   const float longest, const uint samples, __global const uint *eye_cells,
                   const uint eye_count, const float middle, const float right_square,
                   const float down_square, const int width, const int height,
                   __global float *picture)
{
    const Integral integral = {{points, rows, count}, samples, table, longest};
    // the pixels of a work-item: part of a tile of 4 x 4
    const uint tiles = (width + 3) / 4, first = LANES * (uint)get_global_id(0);
    const int tile_x = 4 * (first / 16 % tiles), tile_y = 4 * (first / 16 / tiles);
    if (tile_y >= height)
        return;
    float xs[LANES], ys[LANES];
    int inside[LANES];
    Entries to_enter = {.eye_cells = eye_cells, .eye_count = eye_count, .entries = entries};
    for (uint lane = 0; lane < LANES; ++lane) {
        const int column = tile_x + (first + lane) % 4, row = tile_y + (first + lane) / 4 % 4;
        const int pixel = row * width + column;
        xs[lane] = column + (0.5f - 0.5f * width);
        ys[lane] = row + (0.5f - 0.5f * height);
        inside[lane] = column < width && row < height ? pixel : NOWHERE;
        to_enter.next_eye_cell[lane] = inside[lane] >= 0 ? 0 : eye_count;
        to_enter.next[lane] = inside[lane] > 0 ? ends[pixel - 1] : 0;
        to_enter.end[lane] = inside[lane] >= 0 ? ends[pixel] : 0;
    }
    const floats x = load(xs), y = load(ys);
    const float edge_slack = ON_PLANE / sqrt(right_square);
#ifdef PERSPECTIVE
    const float behind = -middle - ON_PLANE; // where entries are none
    for (uint lane = 0; lane < LANES; ++lane)
        while (to_enter.next[lane] < to_enter.end[lane] &&
               as_float(entries[2 * to_enter.next[lane]]) < behind)
            ++to_enter.next[lane];
    const floats length = sqrt((x * x * right_square + y * y * down_square) + 1); // of depth 1
    const float start = -middle;
#else
    const floats length = 1;
    const float start = -FARTHEST;
#endif
    to_enter.at_eye = start + ON_PLANE;
    Place place = {NOWHERE, start, 0, 0, 0, 0};
    Light light = {0, 0, 0, 1};
    for (;;) {
        if (ANY(place.cell == NOWHERE))
            enter(&place, &to_enter);
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
        const ints out = active & leaves & (beyond == NOWHERE);
        if (ANY(out)) {
#ifdef PERSPECTIVE
            const floats slack = edge_slack * ((1 + nearness) / middle);
#else
            const floats slack = edge_slack;
#endif
            beyond = out ? beyond_edge(record, x, y, nearness, slack) : beyond;
        }
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
        place.cell = (active & (place.still < MAX_STILL)) ? place.cell : (ints)NOWHERE;
        const ints opaque = light.through < LEAST_LIGHT;
        if (ANY(opaque)) {
            int done[LANES];
            store(opaque, done);
            for (uint lane = 0; lane < LANES; ++lane)
                to_enter.next[lane] = done[lane] ? to_enter.end[lane] : to_enter.next[lane];
            place.cell = opaque ? (ints)NOWHERE : place.cell;
        }
    }
    float r[LANES], g[LANES], b[LANES], a[LANES];
    store(light.r, r);
    store(light.g, g);
    store(light.b, b);
    store(alpha_of(&light), a);
    for (uint lane = 0; lane < LANES; ++lane)
        if (inside[lane] >= 0)
            vstore4((float4)(r[lane], g[lane], b[lane], a[lane]), inside[lane], picture);
}
