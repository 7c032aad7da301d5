// Sums over the voxels inside of rows, by which a check tells whether parity fills what winding numbers
// do: in each bundle of 8 x 8 rows the number of voxels and the sum of 2 x, times weights of the bundle
// that mix its bits. Numbers wrap around. Host side: voxtool/svo/voxelization/fill/rows.py.

// Sums of `rows` rows over voxels first <= x < end.
uint2 row_sums(uint rows, int first, int end)
{
    const uint voxels = rows * (uint)(end - first);
    return (uint2)(voxels, voxels * (uint)(end + first - 1));
}

// Sums of a bundle, weighed.
uint2 weighed(uint2 sums, uint bundle)
{
    uint h = (bundle + 1) * 0x9E3779B1u;
    h = (h ^ h >> 15) * 0x85EBCA77u;
    h ^= h >> 13;
    return sums * (uint2)(h | 1, h * 0xC2B2AE3Du | 1);
}
