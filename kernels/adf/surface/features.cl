// Vertices of a field's surface on its features: dual contouring [Ju 2002], as svo/surface/sharp.cl
// does for octrees. Host side: voxtool/adf/surface/sharp.py.

#include "adf/surface/features.h"
#include "qef.h"

// Places the vertex of each loop in its leaf, or up to REACH beside it if the minimum is there.
// first[i] is the first of a loop's planes, which have a point and a unit normal each, 0 for a point
// alone, relative to the low corner of the leaf and in its edges. errors[i] is their sum.
__kernel void place_on_planes(__global const uint *first, const uint n, __global const double *on,
                              __global const double *normals, __global double *points,
                              __global qef *errors)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    qef sum = empty_qef();
    for (uint i = first[gid]; i < first[gid + 1]; ++i) {
        const double3 at = vload3(i, on), normal = vload3(i, normals);
        if (any(normal != 0))
            add_plane(&sum, at, normal);
        add_point(&sum, at);
    }
    const double3 low = MARGIN, high = 1 - MARGIN;
    bool inside, near;
    const double3 within_leaf = minimum_of_qef(&sum, low, high, &inside);
    const double3 beside = minimum_of_qef(&sum, low - REACH, high + REACH, &near);
    vstore3(near ? beside : within_leaf, gid, points);
    errors[gid] = sum;
}
