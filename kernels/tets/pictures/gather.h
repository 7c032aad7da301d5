// Loads of one record or number for each lane. Option: LANES

#include "lanes.h"

#if LANES == 1

void gather(__global const float *from, const ints index, const uint parts, floats *words)
{
    for (uint i = 0; i < 16 * parts; ++i)
        words[i] = from[16 * parts * (size_t)index + i];
}
#else

// Transpose 16 x 16 numbers: each step rotates the eight bits of row and column by one.
void transpose(floats *m)
{
    floats turned[LANES];
#pragma unroll
    for (uint step = 0; step < 4; ++step) {
#pragma unroll
        for (uint i = 0; i < LANES / 2; ++i) {
            turned[i] = (floats)(m[2 * i].even, m[2 * i + 1].even);
            turned[LANES / 2 + i] = (floats)(m[2 * i].odd, m[2 * i + 1].odd);
        }
#pragma unroll
        for (uint i = 0; i < LANES; ++i)
            m[i] = turned[i];
    }
}

// Load a record of 16 * parts floats for each lane: words[w] of a lane is word w of its record.
void gather(__global const float *from, const ints index, const uint parts, floats *words)
{
    int record[LANES];
    store(index, record);
    for (uint part = 0; part < parts; ++part) {
#pragma unroll
        for (uint lane = 0; lane < LANES; ++lane)
            words[LANES * part + lane] = vload16(parts * (size_t)record[lane] + part, from);
        transpose(words + LANES * part);
    }
}
#endif

// Load a number for each lane.
floats lookup(__global const float *from, const ints index)
{
    int at[LANES];
    float found[LANES];
    store(index, at);
    for (uint lane = 0; lane < LANES; ++lane)
        found[lane] = from[at[lane]];
    return load(found);
}
