// The relaxation of surface nets [Gibson 1998]: each vertex moves halfway to the mean of its
// neighbours, but stays in its cube. Host side: voxtool/svo/surface/dual.py. Options: LANES, BATCH.

#include "svo/surface/lattice.h"
#include "svo/surface/relaxation.h"
#include "lanes.h"

// The low and high halves of 64-bit numbers, and the numbers from these.
#if LANES == 1
#define LOW(v) as_uint2(v).x
#define HIGH(v) as_uint2(v).y
#define WHOLE(low, high) as_ulong((uint2)(low, high))
#else
#define LOW(v) (uints)(as_uint16((v).lo).even, as_uint16((v).hi).even)
#define HIGH(v) (uints)(as_uint16((v).lo).odd, as_uint16((v).hi).odd)
#define MERGED(a, b)                                                                               \
    as_ulong8((uint16)(a.s0, b.s0, a.s1, b.s1, a.s2, b.s2, a.s3, b.s3, a.s4, b.s4, a.s5, b.s5,     \
                       a.s6, b.s6, a.s7, b.s7))
#define WHOLE(low, high) (ulongs)(MERGED((low).lo, (high).lo), MERGED((low).hi, (high).hi))
#endif

// The three fields of BITS bits of packed vertices, or of their sums.
void separate(ulongs packed, ints *field)
{
    const uints low = LOW(packed), high = HIGH(packed);
    field[0] = as_ints(low) & COORDINATE;
    field[1] = as_ints(low >> BITS | high << (32 - BITS)) & COORDINATE;
    field[2] = as_ints(high >> (2 * BITS - 32)) & COORDINATE;
}

ulongs joined(const ints *field)
{
    const uints x = as_uints(field[0]), y = as_uints(field[1]), z = as_uints(field[2]);
    const uints low = x | y << BITS, high = y >> (32 - BITS) | z << (2 * BITS - 32);
    return WHOLE(low, high);
}

// LANES vertices halfway to the mean of their neighbours, given the sums of these.
ulongs moved(ulongs packed, ulongs sums, ints about)
{
    ints here[3], sum[3];
    separate(packed, here);
    separate(sums, sum);
    const ints count = about & 15;
    const floats inverse = 0.5f / to_floats(count);
    for (uint axis = 0; axis < 3; ++axis) {
        const ints above = (about >> (int)(4 + 4 * axis) & 15) - 8;
        const ints at = here[axis], apart = sum[axis] + above * LATTICE - max(count, 4) * at;
        const ints sign = apart >> 31, size = (apart ^ sign) - sign;
        // the product is below 2^15, and with the half at least 1 / 48 away from any integer
        const ints step = (to_ints((to_floats(size) + 0.5f) * inverse) ^ sign) - sign;
        here[axis] = clamp(at + step, NEAREST, LATTICE - NEAREST);
    }
    return joined(here);
}

// BATCH vertices, LANES at a time; those beyond the last are unused.
__kernel void relax(__global const ulong *packed, RELAXATION, const uint n, __global ulong *relaxed)
{
    const size_t first = BATCH * get_global_id(0);
    if (get_global_id(0) >= n)
        return;
    ulong sums[BATCH];
    for (uint i = 0; i < BATCH; ++i) {
        __global const uint *link = links + 4 * (first + i);
        sums[i] = packed[link[0]] + packed[link[1]] + packed[link[2]] + packed[link[3]];
    }
    const uint end = beyond_start[get_global_id(0) + 1];
    for (uint i = beyond_start[get_global_id(0)]; i < end; ++i)
        sums[beyond[i].x - first] += packed[beyond[i].y];
    for (uint i = 0; i < BATCH; i += LANES)
        store(moved(load(packed + first + i), load(sums + i), to_ints(load(around + first + i))),
              relaxed + first + i);
}
