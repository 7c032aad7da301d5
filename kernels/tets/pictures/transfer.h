// The transfer function along a segment: cut at its control points, colours between them.
// Host side: voxtool/tets/pictures/transfer.py (LocalTransfer).

#include "tets/pictures/gather.h"
#include "tets/pictures/segment.h"

#define ROW 16 // floats of an interval: s0, 1 / width, r g b τ at s0, and how they change; padding

typedef struct {
    __global const float *points, *rows;
    int count;                   // of points
    __global const float *below; // with BUCKETS, an option: points below each equal part of [0, 1]
} Transfer;

// Colour and extinction of each lane.
typedef struct {
    floats r, g, b, tau;
} Sample;

// The light of a ray, composited front to back.
typedef struct {
    floats r, g, b;       // so far, premultiplied
    floats transmittance; // 1 - alpha, and exact where it is small
    floats alpha;         // the sum of the weights, and exact where it is small
} Light;

// A segment along which the scalar is linear: the scalars at its ends, and their intervals.
typedef struct {
    floats from, to;
    ints from_interval, to_interval;
} Segment;

// The interval that holds s: the number of control points at or below it. With BUCKETS the search begins
// at the points below the part of s. It is exact, as s does not fall where its part rises.
ints interval_of(const Transfer *t, const floats s)
{
#ifdef BUCKETS
    floats part = s * BUCKETS;
    part = part > 0 ? part : (floats)0;
    part = part < BUCKETS - 1 ? part : (floats)(BUCKETS - 1);
    ints interval = to_ints(lookup(t->below, to_ints(part)));
    ints more;
    do {
        const ints left = interval < t->count;
        more = left & (s >= lookup(t->points, left ? interval : (ints)0));
        interval += more ? (ints)1 : (ints)0;
    } while (ANY(more));
#else
    ints interval = 0;
    for (int k = 0; k < t->count; ++k)
        interval += s >= (floats)t->points[k] ? (ints)1 : (ints)0;
#endif
    return interval;
}

// The rows of the lanes' intervals, which are usually the same one.
void rows_of(const Transfer *t, const ints interval, floats *row)
{
#if LANES > 1
    if (!any(interval != (ints)interval.s0)) {
        for (uint i = 0; i < ROW; ++i)
            row[i] = t->rows[ROW * interval.s0 + i];
        return;
    }
#endif
    gather(t->rows, interval, ROW / 16, row);
}

Sample sample_of(const floats *row, const floats s)
{
    floats w = (s - row[0]) * row[1];
    w = w > 0 ? w : (floats)0;
    w = w < 1 ? w : (floats)1;
    const Sample sample = {row[2] + row[6] * w, row[3] + row[7] * w, row[4] + row[8] * w,
                           row[5] + row[9] * w};
    return sample;
}

// The colour and extinction of scalars in these intervals.
Sample sample_at(const Transfer *t, const ints interval, const floats s)
{
    floats row[ROW];
    rows_of(t, interval, row);
    return sample_of(row, s);
}

// Cut the segment at the first control point that it crosses: lines 1 to 13 of the listing in [TetVol,
// section 4.2]. There a table of (s_f, s_b) holds this point and the next; here they are the ends of the
// first interval, see interval_of. Returns whether the lane's segment was cut: then it continues at `end`
// in the interval `next`. The piece up to `end` is within the interval `own`.
ints cut(const Transfer *t, const Segment *segment, floats *end, ints *own, ints *next)
{
    *end = segment->to;
    *own = segment->from_interval;
    *next = segment->to_interval;
    ints crosses = *own != *next;
    if (!ANY(crosses))
        return crosses;
    const ints up = *next > *own;
    floats first = lookup(t->points, crosses ? *own - (up ? (ints)0 : (ints)1) : (ints)0);
    const ints at_once = crosses & !up & (segment->from == first); // already crossed
    if (ANY(at_once)) {
        *own = at_once ? *own - 1 : *own;
        crosses = *own != *next;
        first = lookup(t->points, crosses ? *own - (up ? (ints)0 : (ints)1) : (ints)0);
    }
    const ints is_cut = crosses & (up ? segment->to > first : segment->to < first);
    *end = is_cut ? first : *end;
    *next = is_cut ? *own + (up ? (ints)1 : (ints)-1) : *next;
    return is_cut;
}

// Composite a segment within one interval behind what there is (lines 15 and 16 of the listing).
void add_segment(Light *light, const Sample *front, const Sample *back, const floats length)
{
    floats w_f, w_b, transmittance;
    segment_weights(front->tau * length, back->tau * length, &w_f, &w_b, &transmittance);
    w_f = w_f * light->transmittance;
    w_b = w_b * light->transmittance;
    light->r = light->r + (w_f * front->r + w_b * back->r);
    light->g = light->g + (w_f * front->g + w_b * back->g);
    light->b = light->b + (w_f * front->b + w_b * back->b);
    light->transmittance = light->transmittance * transmittance;
    light->alpha = light->alpha + (w_f + w_b);
}

// Composite a segment of one colour and one extinction.
void add_homogeneous(Light *light, const Sample *s, const floats length)
{
    floats alpha, transmittance;
    attenuate(s->tau * length, 0.0f, &alpha, &transmittance);
    alpha = alpha * light->transmittance;
    light->r = light->r + alpha * s->r;
    light->g = light->g + alpha * s->g;
    light->b = light->b + alpha * s->b;
    light->transmittance = light->transmittance * transmittance;
    light->alpha = light->alpha + alpha;
}

// The opacity so far.
floats alpha_of(const Light *light)
{
    return light->transmittance < 0.5f ? 1 - light->transmittance : light->alpha;
}
