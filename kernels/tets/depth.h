// Depths and scalars on rays, by what view.h makes of a cell. Options: PERSPECTIVE, CONSTANT

#include "tets/ray.h"
#include "tets/vector.h"

// The depth of a nearness; in perspective that is more than -1, for what is in front of the eye.
floats depths_of(const floats nearness, const float middle)
{
#ifdef PERSPECTIVE
    return -middle * nearness / (1 + nearness);
#else
    return -nearness;
#endif
}

// The scalars at depths on the rays of (x, y), in [0, 1], also where a lane has no cell and its numbers
// are any: NaN becomes 0.
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
