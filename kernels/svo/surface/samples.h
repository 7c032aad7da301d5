// The arguments for the coverage of a sample: the host's Tiles.arguments. The unit of `isovalue` is
// 2^-16 of a voxel's coverage.
#ifdef VOXELS
#define SAMPLES const ulong isovalue
#define THESE_SAMPLES isovalue
#else
#define SAMPLES                                                                                    \
    __global const uint *source, __global const SAMPLE *samples, const uint full,                  \
        const ulong isovalue
#define THESE_SAMPLES source, samples, full, isovalue

// The number of occupied voxels in a sample; `slot` is its tile's slot, or NOWHERE.
uint coverage_of(TILES, SAMPLES, ulong cell, uint slot)
{
    const ulong tile = cell >> 6;
    if (slot == NOWHERE)
        return tile >> 6 < words && (inside[tile >> 6] >> (tile & 63) & 1) ? full : 0;
    if (source[slot] == NOWHERE)
        return masks[slot] & 1 ? full : 0;
    return samples[64 * (size_t)source[slot] + (cell & 63)];
}
#endif
