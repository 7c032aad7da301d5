// Depths and scalars on rays, from the records of view.h. Options: those of rays.h

#include "tets/pictures/ray.h"
#include "lanes.h"

// The depth of a nearness; in perspective it must exceed -1: in front of the eye.
floats depths_of(const floats nearness, const float middle)
{
#ifdef PERSPECTIVE
    return -middle * nearness / (1 + nearness);
#else
    return -nearness;
#endif
}

// The scalars at depths on the rays of (x, y), clamped to [0, 1]; NaN becomes 0, so lanes without a cell
// need no test.
floats scalars_at(const floats *on_ray, const floats x, const floats y, const floats depth,
                  const float middle)
{
#ifdef CONSTANT
    const floats s = on_ray[2];
#else
    const floats across = on_ray[0] * x + on_ray[1] * y;
#ifdef PERSPECTIVE
    const floats s = (on_ray[2] + middle * across) + (on_ray[3] + across) * depth;
#else
    const floats s = (on_ray[2] + across) + on_ray[3] * depth;
#endif
#endif
    const floats positive = s > 0 ? s : (floats)0;
    return positive < 1 ? positive : (floats)1;
}
