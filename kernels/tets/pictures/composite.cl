// Pictures of projected cells. Host side: voxtool/tets/pictures/project.py, which says why the order is right.
//
// A work-item processes its tile's list for LANES pixels, side by side. A fragment is the segment of a ray
// in a cell. It is inserted into a sorted buffer, and fragments that no later cell can precede are
// composited.
// Options: those of record.h, integrate.h and rays.h, and
//   PENDING   fragments of a ray that may wait

#include "tets/pictures/integrators.h"
#include "tets/pictures/project.h"
#include "tets/pictures/record.h"
#include "tets/pictures/depth.h"
#include "tets/pictures/integrate.h"
#include "tets/pictures/rays.h"

// The buffer of fragments of LANES rays, sorted by (begin, cell); FARTHEST marks a free place. The last
// place, beyond PENDING, holds the first fragment that did not fit: it and all behind it are left for
// the next pass.
typedef struct {
    float begin[LANES * (PENDING + 1)], end[LANES * (PENDING + 1)];
    int cell[LANES * (PENDING + 1)];
    uint count; // of places in use, of the ray that has the most
} Pending;

// Rays, and how far they have been followed.
typedef struct {
    Rays rays;
    ints open; // whether more fragments may follow
    Light light;
    floats depth; // where the last fragment ended
    floats begin; // where it began, and its cell
    ints cell;
    ints fragments; // how many
#ifdef SURFACES
    ints rank;      // as in surfaces.h, or NO_RANK
#endif
} Followed;

// Whether a fragment comes before another.
#define BEFORE(begin, cell, other_begin, other_cell) \
    (((begin) < (other_begin)) | (((begin) == (other_begin)) & ((cell) < (other_cell))))

// Insert fragments of some lanes in order; those behind move by one place.
void insert(Pending *p, const ints lanes, const floats begin, const floats end, const int cell)
{
    ints looking = lanes;
    for (uint place = p->count;; --place) {
        floats before_begin = -FARTHEST, before_end = 0;
        ints before_cell = 0;
        if (place > 0) {
            before_begin = load(p->begin + LANES * (place - 1));
            before_end = load(p->end + LANES * (place - 1));
            before_cell = load(p->cell + LANES * (place - 1));
        }
        const ints further = looking & BEFORE(begin, (ints)cell, before_begin, before_cell);
        const ints here = looking & (further == 0), moves = further & (before_begin < FARTHEST);
        const floats own_begin = load(p->begin + LANES * place);
        const floats own_end = load(p->end + LANES * place);
        const ints own_cell = load(p->cell + LANES * place);
        store(moves ? before_begin : here ? begin : own_begin, p->begin + LANES * place);
        store(moves ? before_end : here ? end : own_end, p->end + LANES * place);
        store(moves ? before_cell : here ? (ints)cell : own_cell, p->cell + LANES * place);
        looking = further;
        if (!ANY(looking))
            break;
    }
    p->count = min(p->count + 1, (uint)PENDING);
}

// Load the scalars on the rays, each of its own cell.
void scalars_on_rays(__global const float *records, const ints cells, floats *on_ray)
{
    int cell[LANES];
    float parts[4][LANES];
    store(cells, cell);
    for (uint lane = 0; lane < LANES; ++lane) {
        const float4 s = vload4(PARTS * (size_t)cell[lane] + FACES, records);
        parts[0][lane] = s.x;
        parts[1][lane] = s.y;
        parts[2][lane] = s.z;
        parts[3][lane] = s.w;
    }
    for (uint i = 0; i < 4; ++i)
        on_ray[i] = load(parts[i]);
}

// Composite fragments of some lanes, from where the last ones ended.
void composite_fragments(Followed *rays, __global const float *records, const Integral *integral,
                         const ints lanes, const floats begin, const floats end, const ints cell)
{
    floats depth = begin > rays->depth ? begin : rays->depth;
    ints active = lanes & (end > depth);
#ifdef SURFACES
    const ints apart = active & (begin > rays->depth + GAP);
    rays->rank = apart ? (ints)NO_RANK : rays->rank;
#endif
    rays->begin = lanes ? begin : rays->begin;
    rays->cell = lanes ? cell : rays->cell;
    rays->depth = active ? end : rays->depth;
    rays->fragments += lanes ? (ints)1 : (ints)0;
    floats on_ray[4];
    scalars_on_rays(records, lanes ? cell : (ints)0, on_ray);
    const floats first = scalars_at(on_ray, rays->rays.x, rays->rays.y, depth, rays->rays.middle);
    const floats last = scalars_at(on_ray, rays->rays.x, rays->rays.y, end, rays->rays.middle);
    Segment segment = {first, last, interval_of(&integral->transfer, first),
                       interval_of(&integral->transfer, last)};
#ifdef SURFACES
    const ints known = (active == 0) | (rays->rank != NO_RANK);
    rays->rank = known ? rays->rank : rank_of(&integral->surfaces, first);
#endif
    while (ANY(active)) {
        floats to, share, until = end;
        ints follows;
#ifdef SURFACES
        Meeting m;
        meet_surface(&integral->surfaces, active, rays->rank, segment.from, last, &m);
        until = m.met ? depth + (end - depth) * m.share : end;
        segment.to = m.scalar;
        segment.to_interval = interval_of(&integral->transfer, m.scalar);
#endif
        const floats length = active ? (until - depth) * rays->rays.length : (floats)0;
        const ints goes_on =
            add_piece(&rays->light, integral, &segment, length, &to, &follows, &share);
        segment.from = to;
        segment.from_interval = follows;
        depth = depth + (until - depth) * share;
        ints stays = goes_on;
#ifdef SURFACES
        const ints met = m.met & (goes_on == 0);
        if (ANY(met))
            add_surfaces(&rays->light, &integral->surfaces, met, m.number, cell, rays->rays.x,
                         rays->rays.y);
        rays->rank = met ? m.rank : rays->rank;
        stays = stays | met;
#endif
        active &= stays;
    }
}

// Composite the buffered fragments that begin before `bound`; the others move up.
void composite_before(Pending *p, Followed *rays, __global const float *records,
                      const Integral *integral, const float bound)
{
    ints done = 0;
    for (uint place = 0; place < p->count; ++place) {
        const floats begin = load(p->begin + LANES * place), end = load(p->end + LANES * place);
        // of an opaque ray all are removed
        const ints go = begin < (rays->open ? (floats)bound : (floats)FARTHEST);
        if (!ANY(go))
            break;
        const ints cell = load(p->cell + LANES * place);
        composite_fragments(rays, records, integral, go & rays->open, begin, end, cell);
        rays->open &= rays->light.transmittance >= LEAST_TRANSMITTANCE;
        done += go ? (ints)1 : (ints)0;
    }
    int gone[LANES];
    store(done, gone);
    for (uint lane = 0; lane < LANES; ++lane)
        for (uint place = 0; gone[lane] > 0 && place < p->count; ++place) {
            const uint to = LANES * place + lane, from = to + LANES * gone[lane];
            const bool is_there = place + gone[lane] < p->count;
            p->begin[to] = is_there ? p->begin[from] : FARTHEST;
            p->end[to] = is_there ? p->end[from] : 0;
            p->cell[to] = is_there ? p->cell[from] : 0;
        }
    while (p->count > 0 && !ANY(load(p->begin + LANES * (p->count - 1)) < FARTHEST))
        --p->count;
}

// The fragments of rays in a cell, from where they enter to where they leave. Returns the lanes that have
// one.
ints fragments_of(__global const float *record, const float nearest, const float farthest,
                  const Followed *rays, floats *begin, floats *end)
{
    floats in = FARTHEST, out = -FARTHEST; // nearnesses: the least, the greatest
    ints outside = 0;
    for (uint face = 0; face < FACES; ++face) {
        const float4 f = vload4(face, record);
        const floats n = (f.x * rays->rays.x + f.y * rays->rays.y) + f.z;
        const int side = as_int(f.w);
        if (side == LEAVES)
            out = n > out ? n : out;
        else if (side == ENTERS)
            in = n < in ? n : in;
        else
            outside |= side == BESIDE ? n > 0 : n >= 0;
    }
    ints lanes = rays->open & (outside == 0) & (in > out);
#ifdef PERSPECTIVE
    lanes &= in > -1; // the rest is behind the eye
#endif
    if (!ANY(lanes))
        return lanes;
    *begin = depths_of(lanes ? in : (floats)0, rays->rays.middle);
#ifdef PERSPECTIVE
    const ints leaves = out > -1;
    *end = leaves ? depths_of(leaves ? out : (floats)0, rays->rays.middle) : (floats)FARTHEST;
#else
    *end = depths_of(out, rays->rays.middle);
#endif
    *begin = *begin > nearest ? *begin : (floats)nearest;
    *end = *end < farthest ? *end : (floats)farthest;
    return lanes & (*begin < *end);
}

// Composite the first fragments of rays, as many as may wait, or all: one pass over the cells of a tile,
// those of pairs `start` to `end`. `first` and `last` are the outermost pixels of the rays.
void composite_pass(Pending *pending, Followed *rays, __global const float *records,
                    const Integral *integral, __global const uint *pair_cells, const uint start,
                    const uint end, const int2 first, const int2 last)
{
    pending->count = 0;
    for (uint place = 0; place <= PENDING; ++place)
        store((floats)FARTHEST, pending->begin + LANES * place);
    for (uint i = start; i < end; ++i) {
        const int cell = pair_cells[i];
        __global const float *record = records + WORDS * (size_t)cell;
        const float4 where = vload4(FACES + 1, record);
        const int columns = as_int(where.z), rows = as_int(where.w);
        if ((columns & 0xffff) > last.x || columns >> 16 < first.x
            || (rows & 0xffff) > last.y || rows >> 16 < first.y)
            continue;
        floats from, to;
        ints lanes = fragments_of(record, where.x, where.y, rays, &from, &to);
        if (!ANY(lanes))
            continue;
        // behind the last that was composited, before the first that did not fit
        lanes &= BEFORE(rays->begin, rays->cell, from, (ints)cell)
                 & BEFORE(from, (ints)cell, load(pending->begin + LANES * PENDING),
                          load(pending->cell + LANES * PENDING));
        if (!ANY(lanes))
            continue;
        if (ANY(lanes & (load(pending->begin + LANES * (PENDING - 1)) < FARTHEST))) {
            composite_before(pending, rays, records, integral, where.x);
            if (!ANY(rays->open))
                break;
        }
        insert(pending, lanes, from, to, cell);
    }
    composite_before(pending, rays, records, integral, FARTHEST);
}

// One work-item LANES pixels of a tile, in squares of 4 x 4. Its tally: how many fragments it has
// composited, in how many passes.
__kernel void composite(INTEGRAL, PICTURE, __global const float *records,
                        __global const uint *pair_cells, __global const uint *ends,
                        __global uint *tallies)
{
    const Integral integral = THE_INTEGRAL;
    const Frame frame = THE_FRAME;
    const uint item = get_global_id(0), tile = LANES * item / (TILE * TILE);
    const uint tiles_across = (width + TILE - 1) / TILE;
    const int tile_x = TILE * (tile % tiles_across), tile_y = TILE * (tile / tiles_across);
    if (tile_y >= height)
        return;
    int2 pixels[LANES], first = (int2)(width, height), last = (int2)(-1, -1); // ends included
    for (uint lane = 0; lane < LANES; ++lane) {
        const uint i = (LANES * item + lane) % (TILE * TILE), square = i / 16;
        pixels[lane] = (int2)(tile_x + 4 * (square % (TILE / 4)) + i % 4,
                              tile_y + 4 * (square / (TILE / 4)) + i / 4 % 4);
        first = min(first, pixels[lane]);
        last = max(last, pixels[lane]);
    }
    Followed rays = {.cell = NO_CELL};
    rays_of(pixels, &frame, &rays.rays);
    rays.light.transmittance = 1;
    rays.depth = rays.begin = -FARTHEST;
#ifdef SURFACES
    rays.rank = NO_RANK;
#endif
    Pending pending;
    uint passes = 0, sum = 0;
    ints again = load(rays.rays.pixel) >= 0;
    const uint start = ends[2 * tile], end = ends[2 * tile + 1];
    for (; start < end && ANY(again); ++passes) {
        rays.open = again;
        composite_pass(&pending, &rays, records, &integral, pair_cells, start, end, first, last);
        again = rays.open & (load(pending.begin + LANES * PENDING) < FARTHEST);
    }
    write_light(&rays.light, &rays.rays, picture);
    int fragments[LANES];
    store(rays.fragments, fragments);
    for (uint lane = 0; lane < LANES; ++lane)
        sum += fragments[lane];
    vstore2((uint2)(sum, passes), item, tallies);
}
