// The inputs of output elements, by a 5:1 histopyramid ([voCCeL], section 4.1). The host's
// Histopyramid.arguments; a group has WORK_GROUP work-items.
#include "opencl/primitives.h"

#define HISTOPYRAMID                                                                               \
    __global const uint *pyramid_counts, __global const uint4 *pyramid_levels,                     \
        __global const uint *pyramid_offsets, const uint pyramid_height
#define THIS_HISTOPYRAMID pyramid_counts, pyramid_levels, pyramid_offsets, pyramid_height

// The input that has output k of all; `r` is which of that input's outputs it is.
uint histopyramid_traverse(HISTOPYRAMID, uint k, uint *r)
{
    uint i = 0;
    for (uint level = 0; level < pyramid_height; ++level) {
        const uint4 v = pyramid_levels[pyramid_offsets[level] + i]; // intervals may be empty
        i = 5 * i + (k >= v.x) + (k >= v.y) + (k >= v.z) + (k >= v.w);
        k -= k >= v.w ? v.w : k >= v.z ? v.z : k >= v.y ? v.y : k >= v.x ? v.x : 0;
    }
    *r = k;
    return i;
}

// The same for output get_global_id(0) of n, where all work-items of a group call this: the outputs
// of a group follow each other, so the first work-item goes down the pyramid once, and on along the
// inputs. `found` has two elements a work-item.
uint histopyramid_input(HISTOPYRAMID, uint n, __local uint *found, uint *r)
{
    const uint lid = get_local_id(0), k = get_global_id(0);
    if (lid == 0) {
        uint rest, i = histopyramid_traverse(THIS_HISTOPYRAMID, k, &rest);
        uint left = pyramid_counts[i] - rest;
        for (uint item = 0; item < min((uint)WORK_GROUP, n - k); ++item) {
            while (left == 0) {
                left = pyramid_counts[++i];
                rest = 0;
            }
            found[item] = i;
            found[WORK_GROUP + item] = rest++;
            --left;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    *r = found[WORK_GROUP + lid];
    return found[lid];
}
