// A viewpoint: the ray of every pixel. Host side: voxtool/tets/view.py.
// Option: PERSPECTIVE

#include "tets/ray.h"

#define LEAST_SCALE 1e-20 // of a plane that is not along the rays
#define AT_ONCE 1e20      // a nearness before all others, of a ray a pixel outside
#define ROUNDING 0x1p-4f  // pixels: more than float32 is off by in the largest picture
#define NEAR_LINE 0x1p-10  // pixels: as near to a line it is not outside
// A scale that is as good as 0: of a plane through the eye, or along the rays.
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
} View;

View view_of(__global const double *view)
{
    const View v = {vload3(0, view), vload3(1, view), vload3(2, view), vload3(3, view), view[12]};
    return v;
}

// A plane on the ray of (x, y), by the first three, f: f.x x + f.y y + f.z. Over the fourth, the scale,
// it is the plane's nearness: in perspective middle / t - 1, elsewhere -t. Rays leave by the plane's
// side where the scale is positive and come in where it is negative; the plane turned round has the
// exact negations, so its nearness is the same number.
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

// The nearness of a plane on the ray of (x, y): a x + b y + c, for the plane's side that rays leave
// by. Where a plane has no scale it is a line in the picture, and rays are on one side of it all along:
// those outside, by more than rounding, are sent out at once, and the others never. False: no ray
// leaves by it.
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
