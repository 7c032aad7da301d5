// A viewpoint: the ray of every pixel, and the pixels that projected corners may cover.
// Host side: voxtool/tets/pictures/view.py. Option: PERSPECTIVE

#include "tets/pictures/ray.h"

#define LEAST_SCALE 1e-20 // of a plane that is not along the rays
#define AT_ONCE 1e20      // a nearness greater than all others, for a ray one pixel outside
#define ROUNDING 0x1p-4f  // pixels: more than the error of float32 in the largest picture
#define NEAR_LINE 0x1p-10  // pixels: a ray this near to a line is not outside
// A smaller scale counts as 0: that of a plane through the eye, or parallel to the rays.
#ifdef PERSPECTIVE
#define NO_SCALE ON_PLANE
#else
#define NO_SCALE 0x1p-40
#endif

// Pixel (x, y) from the middle of the picture; the ray is origin + t (direction + x right + y down)
// in perspective, and (origin + x right + y down) + t direction where it is orthographic. Its depth is
// t - middle: small numbers, for float32.
typedef struct {
    double3 origin, direction, right, down;
    double middle; // 0 where it is orthographic
    double3 across[3]; // the dual basis of right, down, direction
} View;

View view_of(__global const double *view)
{
    const View v = {vload3(0, view), vload3(1, view), vload3(2, view), vload3(3, view), view[12],
                    {vload3(0, view + 13), vload3(1, view + 13), vload3(2, view + 13)}};
    return v;
}

// A plane as a function f of the pixel (x, y): (f.x x + f.y y + f.z) / f.w is the nearness at which the
// ray meets it, in perspective middle / t - 1, orthographic -t. Rays leave by the plane where the scale
// f.w is positive and enter where it is negative. The reversed plane has the exact negations, so its
// nearness is the same number.
double4 on_rays(const View *v, const double4 plane)
{
    const double3 n = plane.xyz;
    const double away = dot3(n, v->origin) + plane.w, along = dot3(n, v->direction);
#ifdef PERSPECTIVE
    return (double4)(v->middle * dot3(n, v->right), v->middle * dot3(n, v->down),
                     v->middle * along + away, -away);
#else
    return (double4)(dot3(n, v->right), dot3(n, v->down), away, along);
#endif
}

// The nearness a x + b y + c of a plane by which rays leave; returns false if none do. A plane without a
// scale is a line in the picture, and each ray is on one side of it: those outside by more than rounding
// leave at once, the others never do.
bool nearness(const View *v, const double4 plane, float3 *abc)
{
    double4 f = on_rays(v, plane);
    if (!(f.w > -NO_SCALE))
        return false;
    if (f.w < NO_SCALE) {
        const double across = fabs(f.x) > fabs(f.y) ? fabs(f.x) : fabs(f.y);
        const double pixel = across > 0 ? across : fabs(f.z);
        f.z -= pixel * NEAR_LINE;
        f.w = pixel / AT_ONCE;
    }
    *abc = convert_float3(f.xyz / f.w);
    return f.w > 0;
}

// The scalar on the rays, as scalars_at of ray.h takes it.
float4 scalar_on_rays(const View *v, const double4 s)
{
    const double3 at = v->origin + v->middle * v->direction;
    return convert_float4((double4)(dot3(s.xyz, v->right), dot3(s.xyz, v->down),
                                    dot3(s.xyz, at) + s.w, dot3(s.xyz, v->direction)));
}

// --- pixels of projected corners (X, Y, Z, depth), with x = X / Z and y = Y / Z ------------------

typedef struct {
    float least, most; // in pixels from the middle
} Extent;

void extend(Extent *e, const float from, const float to)
{
    e->least = from < e->least ? from : e->least;
    e->most = to > e->most ? to : e->most;
}

// Extend by an edge from a vertex in front of the eye to one behind it: to infinity on one side, or on
// both where float32 does not decide.
void extend_by_edge(Extent *e, const float front, const float front_depth, const float behind,
                    const float behind_depth)
{
    const float a = behind * front_depth, b = front * behind_depth, crossing = a - b;
    const float doubt = 1e-5f * (fabs(a) + fabs(b));
    extend(e, crossing <= doubt ? -FARTHEST : FARTHEST, crossing >= -doubt ? FARTHEST : -FARTHEST);
}

// The first and the last of `count` pixels whose centres are in the extent; last < first if there are none.
int2 pixels_of(const Extent *e, const int count)
{
    const float middle = 0.5f * count - 0.5f;
    const float first = ceil(e->least + middle - ROUNDING), last = floor(e->most + middle + ROUNDING);
    return (int2)(first < 0 ? 0 : first > count ? count : convert_int(first),
                  last < -1 ? -1 : last > count - 1 ? count - 1 : convert_int(last));
}

// The columns and the rows of pixels that the hull of corners may cover; what is behind the eye covers
// no pixel.
void cover(const float4 *corners, const uint count, const int2 size, int2 *columns, int2 *rows)
{
    Extent across = {FARTHEST, -FARTHEST}, down = {FARTHEST, -FARTHEST};
    for (uint i = 0; i < count; ++i) {
        const float4 p = corners[i];
        if (p.z <= 0)
            continue;
        extend(&across, p.x / p.z, p.x / p.z);
        extend(&down, p.y / p.z, p.y / p.z);
#ifdef PERSPECTIVE
        for (uint j = 0; j < count; ++j)
            if (corners[j].z <= 0) {
                extend_by_edge(&across, p.x, p.z, corners[j].x, corners[j].z);
                extend_by_edge(&down, p.y, p.z, corners[j].y, corners[j].z);
            }
#endif
    }
    *columns = pixels_of(&across, size.x);
    *rows = pixels_of(&down, size.y);
}
