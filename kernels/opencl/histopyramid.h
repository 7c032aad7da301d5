// Walks through a histogram pyramid [Dyken 2008]; [voCCeL, figures 4.2 and 4.3]. Host side:
// voxtool/opencl/histopyramid.py. Option: ARITY, the values of a level that one value above sums.

#define STORED (ARITY < 4 ? ARITY : 4) // of ARITY values: the walk needs no fifth

// The arguments for a pyramid over `runs` runs of `inputs` values; for each level from the lowest,
// `levels` has the place of its first value and the number of groups of one run.
#define PYRAMID                                                                                    \
    __global const uint *pyramid, __global const uint2 *levels, const uint height,                 \
        const uint inputs, const uint runs
#define THIS_PYRAMID pyramid, levels, height, inputs, runs

__global const uint *group_of(PYRAMID, uint level, uint run, uint group)
{
    const uint2 at = levels[level];
    return pyramid + at.x + STORED * ((size_t)run * at.y + group);
}

// The value of a run that an output below the run's sum belongs to, and the output's number among
// those of the value: down the pyramid.
uint2 input_of(PYRAMID, uint run, uint output)
{
    uint at = 0;
    for (uint level = height; level--;) {
        __global const uint *counts = group_of(THIS_PYRAMID, level, run, at);
        uint child = 0;
        for (; child < ARITY - 1 && output >= counts[child]; ++child)
            output -= counts[child];
        at = ARITY * at + child;
    }
    return (uint2)(at, output);
}

// The sum of the values of a run before one of them: up the pyramid.
uint sum_before(PYRAMID, uint run, uint at)
{
    uint sum = 0;
    for (uint level = 0; level < height; ++level) {
        __global const uint *counts = group_of(THIS_PYRAMID, level, run, at / ARITY);
        for (uint child = 0; child < at % ARITY; ++child)
            sum += counts[child];
        at /= ARITY;
    }
    return sum;
}
