// The weights of segments, LANES a work-item. Host side: voxtool/selftest/volumes.py.

#include "tets/pictures/segment.h"

// The weights and the transmittances of segments with optical depths a and b at their ends.
__kernel void weigh(__global const float *a, __global const float *b, __global float *w_f,
                    __global float *w_b, __global float *zeta)
{
    const size_t i = get_global_id(0) * LANES;
    floats front, back, through;
    segment_weights(load(a + i), load(b + i), &front, &back, &through);
    store(front, w_f + i);
    store(back, w_b + i);
    store(through, zeta + i);
}
