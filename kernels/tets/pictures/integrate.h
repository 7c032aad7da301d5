// The light of a segment of a ray within a cell, by each integrator. Options:
//   INTEGRATOR   LINEAR, AVERAGE, SAMPLED or PREINTEGRATED
//   SURFACES     isosurfaces that rays meet, with the options of surfaces.h

#include "tets/pictures/transfer.h"
#ifdef SURFACES
#include "tets/pictures/surfaces.h"
#endif

typedef struct {
    Transfer transfer;
    uint samples;                // SAMPLED: points in a cell
    __global const float *table; // PREINTEGRATED: of segments up to `longest`
    float longest;
#ifdef SURFACES
    Surfaces surfaces;
#endif
} Integral;

// A kernel's parameters for it, of voxtool/tets/pictures/integrate.py.
#define THE_LIGHT                                                                                \
    __global const float *points, __global const float *rows, __global const float *below,       \
        const int count, __global const float *table, const float longest, const uint samples
#ifdef SURFACES
#define INTEGRAL THE_LIGHT, SURFACE_LIST
#define THE_INTEGRAL {{points, rows, count, below}, samples, table, longest, THE_SURFACES}
#else
#define INTEGRAL THE_LIGHT
#define THE_INTEGRAL {{points, rows, count, below}, samples, table, longest}
#endif

#if INTEGRATOR == PREINTEGRATED
// Composite a segment by linear interpolation in the pre-integrated table [Roettger 2000].
void add_preintegrated(Light *light, const Integral *integral, const floats from, const floats to,
                       const floats length)
{
    float fs[LANES], ts[LANES], ls[LANES], r[LANES], g[LANES], b[LANES], a[LANES];
    store(from * (SCALARS - 1), fs);
    store(to * (SCALARS - 1), ts);
    const floats share = length / integral->longest;
    store((share < 1 ? share : (floats)1) * (LENGTHS - 1), ls);
    for (uint lane = 0; lane < LANES; ++lane) {
        const int f = min(convert_int(fs[lane]), SCALARS - 2);
        const int t = min(convert_int(ts[lane]), SCALARS - 2);
        const int l = min(convert_int(ls[lane]), LENGTHS - 2);
        float4 corners[4];
        for (uint corner = 0; corner < 4; ++corner) {
            const int entry = ((f + (corner >> 1)) * SCALARS + t + (corner & 1)) * LENGTHS + l;
            const float4 shorter = vload4(entry, integral->table);
            const float4 longer = vload4(entry + 1, integral->table);
            corners[corner] = shorter + (ls[lane] - l) * (longer - shorter);
        }
        const float4 from_f = corners[0] + (ts[lane] - t) * (corners[1] - corners[0]);
        const float4 from_next = corners[2] + (ts[lane] - t) * (corners[3] - corners[2]);
        const float4 sum = from_f + (fs[lane] - f) * (from_next - from_f);
        r[lane] = sum.x;
        g[lane] = sum.y;
        b[lane] = sum.z;
        a[lane] = sum.w;
    }
    light->r = light->r + light->transmittance * load(r);
    light->g = light->g + light->transmittance * load(g);
    light->b = light->b + light->transmittance * load(b);
    light->alpha = light->alpha + light->transmittance * load(a);
    light->transmittance = light->transmittance * (1 - load(a));
}
#endif

// Composite the first piece of a segment of this length. With LINEAR it ends at the first control point
// that the segment crosses; otherwise it is the whole segment. Returns the lanes that have more pieces;
// the next one begins at `share` of the length with the scalar `to`, in the interval `follows`.
ints add_piece(Light *light, const Integral *integral, const Segment *segment, const floats length,
               floats *to, ints *follows, floats *share)
{
    const Transfer *transfer = &integral->transfer;
    const floats whole = segment->to - segment->from;
    ints goes_on = 0;
    *to = segment->to;
    *follows = segment->to_interval;
    *share = 1;
#if INTEGRATOR == LINEAR
    ints own;
    goes_on = cut(transfer, segment, to, &own, follows);
    *share = goes_on ? (*to - segment->from) / (goes_on ? whole : (floats)1) : (floats)1;
    floats row[ROW];
    rows_of(transfer, own, row);
    const Sample front = sample_of(row, segment->from), back = sample_of(row, *to);
    add_segment(light, &front, &back, length * *share);
#elif INTEGRATOR == AVERAGE
    const Sample front = sample_at(transfer, segment->from_interval, segment->from);
    const Sample back = sample_at(transfer, segment->to_interval, segment->to);
    const Sample mean = {0.5f * (front.r + back.r), 0.5f * (front.g + back.g),
                         0.5f * (front.b + back.b), 0.5f * (front.tau + back.tau)};
    add_homogeneous(light, &mean, length);
#elif INTEGRATOR == PREINTEGRATED
    add_preintegrated(light, integral, segment->from, segment->to, length);
#elif INTEGRATOR == SAMPLED
    const floats step = length / (float)integral->samples;
    for (uint i = 0; i < integral->samples; ++i) {
        const float w = (i + 0.5f) / integral->samples;
        const floats s = segment->from + whole * w;
        const Sample sample = sample_at(transfer, interval_of(transfer, s), s);
        add_homogeneous(light, &sample, step);
    }
#endif
    return goes_on;
}
