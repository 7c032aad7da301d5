// Isosurfaces along rays. Host side: voxtool/tets/pictures/surfaces.py. A ray has a rank, the number of
// isovalues at or below its scalar; it meets a surface wherever the rank changes. The rank is carried
// from cell to cell, so that rounding at a face between two cells neither loses nor repeats a surface.
// Options:
//   SURFACES   how many
//   FLOATS     of a cell's gradient: 4 or 3

#include "shading.h"
#include "tets/pictures/vector.h"
#include "tets/pictures/transfer.h"
#include "tets/pictures/ray.h"

#define NO_RANK -1
#define GAP (4 * ON_PLANE) // between cells that are apart, so that a ray gets its rank anew

typedef struct {
    __global const float *isovalues; // normalised, ascending
    __global const float *tints;     // of each: red, green, blue and opacity
    __global const float *gradients; // of cells
    __global const double *viewpoint;
    float3 lamp; // the unit vector towards the light
} Surfaces;

// A kernel's parameters for them.
#define SURFACE_LIST                                                                             \
    __global const float *isovalues, __global const float *tints,                                \
        __global const float *gradients, __global const double *viewpoint, const float3 lamp
#define THE_SURFACES {isovalues, tints, gradients, viewpoint, lamp}

// Where the segments of rays in their cells meet a surface.
typedef struct {
    ints met;
    ints number;     // of the surface
    ints rank;       // of the ray behind it
    floats scalar;   // of the surface, or else at the segment's end
    floats share;    // of the segment in front of it
} Meeting;

ints rank_of(const Surfaces *s, const floats scalar)
{
    ints rank = 0;
    for (int k = 0; k < SURFACES; ++k)
        rank += scalar >= (floats)s->isovalues[k] ? (ints)1 : (ints)0;
    return rank;
}

// The first surface between two scalars, from a rank on.
void meet_surface(const Surfaces *s, const ints active, const ints rank, const floats from,
                  const floats to, Meeting *m)
{
    const ints last = rank_of(s, to);
    const ints up = last > rank;
    m->met = active & (last != rank);
    m->number = m->met ? (up ? rank : rank - 1) : (ints)0;
    m->rank = m->met ? (up ? rank + 1 : rank - 1) : rank;
    m->scalar = m->met ? lookup(s->isovalues, m->number) : to;
    const floats share = (m->scalar - from) / (to != from ? to - from : (floats)1);
    const floats positive = share > 0 ? share : (floats)0;
    m->share = m->met ? (positive < 1 ? positive : (floats)1) : (floats)1;
}

// The brightness of a surface in a cell, from both sides: its normal is the gradient, towards the viewer.
float surface_brightness(const Surfaces *s, const int cell, const float x, const float y)
{
    double3 way = vload3(1, s->viewpoint);
#ifdef PERSPECTIVE
    way = way + ((double)x * vload3(2, s->viewpoint) + (double)y * vload3(3, s->viewpoint));
#endif
    const double3 g = convert_double3(vload3(0, s->gradients + FLOATS * (size_t)cell));
    const double size = length3(g), away = dot3(g, way) > 0 ? -1.0 : 1.0;
    const double3 n = size > 0 ? g * (away / size) : -way / length3(way);
    return brightness(convert_float(n.x), convert_float(n.y), convert_float(n.z), s->lamp.x,
                      s->lamp.y, s->lamp.z);
}

// Composite the surfaces that rays of pixels (x, y) meet in their cells.
void add_surfaces(Light *light, const Surfaces *s, const ints met, const ints number,
                  const ints cell, const floats x, const floats y)
{
    int mets[LANES], numbers[LANES], cells[LANES];
    float xs[LANES], ys[LANES], r[LANES], g[LANES], b[LANES], a[LANES];
    store(met, mets), store(number, numbers), store(cell, cells);
    store(x, xs), store(y, ys);
    EACH_LANE(i)
    {
        const float4 tint = vload4(numbers[i], s->tints);
        const float bright = mets[i] ? surface_brightness(s, cells[i], xs[i], ys[i]) : 0.0f;
        a[i] = mets[i] ? tint.w : 0.0f;
        r[i] = bright * tint.x, g[i] = bright * tint.y, b[i] = bright * tint.z;
    }
    const floats opacity = load(a), weight = opacity * light->transmittance;
    light->r = light->r + weight * load(r);
    light->g = light->g + weight * load(g);
    light->b = light->b + weight * load(b);
    light->alpha = light->alpha + weight;
    light->transmittance = light->transmittance * (1 - opacity);
}
