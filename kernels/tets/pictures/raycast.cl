// Ray casting of a volume from cell to cell [TetVol, section 4], [Weiler 2003].
// Host side: voxtool/tets/pictures/raycast.py.
//
// A work-item follows the rays of LANES pixels of a tile of 4 x 4, side by side. A step takes each ray
// from its depth to where it leaves its cell, or to the first control point of the transfer function
// before that. A ray that leaves the volume continues at its next entry.
// Options: those of integrate.h and rays.h, and
//   SLOTS   exit faces in a record, as in view.cl

#include "tets/volume/volume.h"
#include "tets/pictures/integrators.h"
#include "tets/pictures/raycast.h"
#include "tets/pictures/depth.h"
#include "tets/pictures/integrate.h"
#include "tets/pictures/rays.h"

#define WORDS (4 * (SLOTS + 1)) // of a record

#ifdef PERSPECTIVE
#define EYE_DEPTH(middle) (-(middle))
#define LEAST_NEARNESS -1 // of planes in front of the eye
#define AT_EYE(middle) ((middle) * (1 << (PLANE_BITS - 1))) // a nearness: all cells there are listed
#else
#define EYE_DEPTH(middle) -FARTHEST
#define LEAST_NEARNESS -FARTHEST
#define AT_EYE(middle) FARTHEST
#endif

// The state of the rays.
typedef struct {
    ints cell;       // or NO_CELL
    floats depth;
    floats scalar;   // at this depth
    ints interval;   // of the transfer function, which holds the scalar
    ints fresh;      // the ray has just entered the cell: its scalar is not known yet
    ints still;      // steps since the ray last moved
#ifdef SURFACES
    ints rank;       // as in surfaces.h, or NO_RANK
#endif
} Place;

// Where the rays enter cells: first those that hold the eye, one after the other until the ray leaves
// it, and then the entries that are listed for its pixel.
typedef struct {
    __global const uint *eye_cells;
    uint eye_count;
    float at_eye; // depth
    __global const uint *entries;
    uint next_eye_cell[LANES], next[LANES], end[LANES];
} Entries;

void entries_of(const Rays *rays, __global const uint *ends, __global const uint *entries,
                __global const uint *eye_cells, const uint eye_count, Entries *e)
{
    e->eye_cells = eye_cells;
    e->eye_count = eye_count;
    e->entries = entries;
    e->at_eye = EYE_DEPTH(rays->middle) + ON_PLANE;
    for (uint lane = 0; lane < LANES; ++lane) {
        const int pixel = rays->pixel[lane];
        e->next_eye_cell[lane] = pixel >= 0 ? 0 : eye_count;
        e->next[lane] = pixel > 0 ? ends[pixel - 1] : 0;
        e->end[lane] = pixel >= 0 ? ends[pixel] : 0;
#ifdef PERSPECTIVE
        while (e->next[lane] < e->end[lane] &&
               as_float(entries[2 * e->next[lane]]) < EYE_DEPTH(rays->middle) - ON_PLANE)
            ++e->next[lane]; // it is behind the eye
#endif
    }
}

// Move the rays that are in no cell to their next entries.
void enter(Place *place, Entries *e)
{
    int cells[LANES];
    float depths[LANES];
    store(place->cell, cells);
    store(place->depth, depths);
    for (uint lane = 0; lane < LANES; ++lane)
        if (cells[lane] != NO_CELL)
            continue;
        else if (e->next_eye_cell[lane] < e->eye_count && depths[lane] <= e->at_eye)
            cells[lane] = e->eye_cells[e->next_eye_cell[lane]++];
        else if (e->next[lane] < e->end[lane]) {
            const uint2 entry = vload2(e->next[lane]++, e->entries);
            const float depth = as_float(entry.x);
            cells[lane] = entry.y;
            depths[lane] = depth > depths[lane] ? depth : depths[lane];
        }
    const ints waits = place->cell == NO_CELL;
    place->fresh |= waits;
    place->still = waits ? (ints)0 : place->still;
    place->cell = load(cells);
#ifdef SURFACES
    const ints apart = waits & (load(depths) > place->depth + GAP);
    place->rank = apart ? (ints)NO_RANK : place->rank;
#endif
    place->depth = load(depths);
}

// The cells in which rays continue that leave the volume at an edge: those across another face that they
// meet at the same depth, within rounding, or NO_CELL. A ray beside a notch needs this: the edge
// functions that list entries may say that it never left. `slack` pixels are rounding.
ints beyond_edge(const floats *record, const Rays *rays, const floats nearness, const floats slack)
{
    floats least = nearness, best = -FARTHEST;
    ints beyond = NO_CELL;
    for (uint pass = 0; pass < 2; ++pass)
        for (uint slot = 0; slot < SLOTS; ++slot) {
            const floats *out = record + 4 * slot;
            const floats n = (out[0] * rays->x + out[1] * rays->y) + out[2];
            const floats doubt = slack * (fabs(out[0]) + fabs(out[1]));
            if (pass == 0) {
                least = n >= nearness ? nearness - doubt : least;
                continue;
            }
            // faces parallel to the ray do not count
            const ints nearer = (n + doubt >= least) & (n > best) & (doubt < 1) &
                                (as_ints(out[3]) != NO_CELL);
            best = nearer ? n : best;
            beyond = nearer ? as_ints(out[3]) : beyond;
        }
    return beyond;
}

// The cells that rays enter next, or NO_CELL, and the nearness of the planes by which they leave: the
// greatest. `edge_slack` is the rounding at the depth of the middle, in pixels.
ints exits_of(const floats *record, const Rays *rays, const ints active, const float edge_slack,
              floats *nearness)
{
    floats greatest = -FARTHEST;
    ints beyond = NO_CELL;
    for (uint slot = 0; slot < SLOTS; ++slot) {
        const floats *out = record + 4 * slot;
        const floats n = (out[0] * rays->x + out[1] * rays->y) + out[2];
        const ints nearer = n > greatest;
        greatest = nearer ? n : greatest;
        beyond = nearer ? as_ints(out[3]) : beyond;
    }
    *nearness = greatest;
    const ints out = active & (greatest > LEAST_NEARNESS) & (greatest < AT_EYE(rays->middle)) &
                     (beyond == NO_CELL);
    if (!ANY(out))
        return beyond;
#ifdef PERSPECTIVE
    const floats slack = edge_slack * ((1 + greatest) / rays->middle);
#else
    const floats slack = edge_slack;
#endif
    return out ? beyond_edge(record, rays, greatest, slack) : beyond;
}

// Integrate to where rays leave their cells, or to the first control point or isosurface before that.
// `beyond` and `nearness` are those of exits_of.
void step(Place *place, Light *light, const Integral *integral, const Rays *rays,
          const floats *record, const ints active, const ints beyond, const floats nearness)
{
    const ints leaves = nearness > LEAST_NEARNESS;
    floats depth = depths_of(leaves ? nearness : (floats)0, rays->middle);
    const ints moves = leaves & (depth > place->depth);
    depth = moves ? depth : place->depth;
    depth = depth < DEEPEST ? depth : (floats)DEEPEST;
    // by this cell's gradient: the cell before may be a sliver with an inexact one
    const floats *on_ray = record + 4 * SLOTS;
    floats scalar = scalars_at(on_ray, rays->x, rays->y, depth, rays->middle);
    const floats entered = scalars_at(on_ray, rays->x, rays->y, place->depth, rays->middle);
    const floats from = place->fresh ? entered : place->scalar;
#ifdef SURFACES
    Meeting meeting;
    const ints rank = place->rank == NO_RANK ? rank_of(&integral->surfaces, entered) : place->rank;
    meet_surface(&integral->surfaces, active, rank, from, scalar, &meeting);
    scalar = meeting.scalar;
    depth = meeting.met ? place->depth + (depth - place->depth) * meeting.share : depth;
#endif
    const ints interval = interval_of(&integral->transfer, scalar);
    const ints began = interval_of(&integral->transfer, entered);
    const Segment segment = {from, scalar, place->fresh ? began : place->interval, interval};
    const floats distance = (depth - place->depth) * rays->length;
    floats share;
    ints goes_on = add_piece(light, integral, &segment, active ? distance : (floats)0,
                             &place->scalar, &place->interval, &share);
    depth = goes_on ? place->depth + (depth - place->depth) * share : depth;
#ifdef SURFACES
    const ints met = meeting.met & (goes_on == 0);
    if (ANY(met))
        add_surfaces(light, &integral->surfaces, met, meeting.number, place->cell, rays->x, rays->y);
    place->rank = met ? meeting.rank : rank;
    goes_on = goes_on | met;
#endif
    place->still = (moves | goes_on) ? (ints)0 : place->still + 1;
    place->fresh = !goes_on;
    place->depth = active ? depth : place->depth;
    place->cell = goes_on ? place->cell : beyond;
    place->cell = (active & (place->still < MAX_STILL)) ? place->cell : (ints)NO_CELL;
}

// End the rays that are opaque: they leave their cells and have no more entries.
void end_opaque(Place *place, Entries *e, const Light *light)
{
    const ints opaque = light->transmittance < LEAST_TRANSMITTANCE;
    if (!ANY(opaque))
        return;
    int done[LANES];
    store(opaque, done);
    for (uint lane = 0; lane < LANES; ++lane)
        e->next[lane] = done[lane] ? e->end[lane] : e->next[lane];
    place->cell = opaque ? (ints)NO_CELL : place->cell;
}

// One work-item LANES pixels.
__kernel void cast(INTEGRAL, PICTURE, __global const float *records, __global const uint *ends,
                   __global const uint *entries, __global const uint *eye_cells,
                   const uint eye_count)
{
    const Integral integral = THE_INTEGRAL;
    const Frame frame = THE_FRAME;
    const uint tiles = (width + 3) / 4, first = LANES * (uint)get_global_id(0);
    const int tile_x = 4 * (first / 16 % tiles), tile_y = 4 * (first / 16 / tiles);
    if (tile_y >= height)
        return;
    int2 pixels[LANES];
    for (uint lane = 0; lane < LANES; ++lane)
        pixels[lane] = (int2)(tile_x + (first + lane) % 4, tile_y + (first + lane) / 4 % 4);
    Rays rays;
    rays_of(pixels, &frame, &rays);
    const float edge_slack = ON_PLANE / sqrt(right_square);
    Entries to_enter;
    entries_of(&rays, ends, entries, eye_cells, eye_count, &to_enter);
    Place place = {NO_CELL, EYE_DEPTH(middle), 0, 0, 0, 0};
    Light light = {0, 0, 0, 1};
#ifdef SURFACES
    place.rank = NO_RANK;
#endif
    for (;;) {
        if (ANY(place.cell == NO_CELL))
            enter(&place, &to_enter);
        const ints active = place.cell != NO_CELL;
        if (!ANY(active))
            break;
        floats record[WORDS], nearness;
        gather(records, active ? place.cell : (ints)0, WORDS / 16, record);
        const ints beyond = exits_of(record, &rays, active, edge_slack, &nearness);
        step(&place, &light, &integral, &rays, record, active, beyond, nearness);
        end_opaque(&place, &to_enter, &light);
    }
    write_light(&light, &rays, picture);
}
