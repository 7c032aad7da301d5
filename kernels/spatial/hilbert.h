// The bits of a number below 2^21, three places apart.
ulong spread_bits(ulong x)
{
    x = (x | x << 32) & 0x001F00000000FFFFul;
    x = (x | x << 16) & 0x001F0000FF0000FFul;
    x = (x | x << 8) & 0x100F00F00F00F00Ful;
    x = (x | x << 4) & 0x10C30C30C30C30C3ul;
    return (x | x << 2) & 0x1249249249249249ul;
}

// The index of a cell along the Hilbert curve of 2^bits cells per axis, 21 bits at most [Skilling
// 2004]. Consecutive cells are neighbours.
ulong hilbert_index(uint3 cell, uint bits)
{
    uint x = cell.x, y = cell.y, z = cell.z;
    for (uint bit = 1u << (bits - 1); bit > 1; bit >>= 1) {
        const uint below = bit - 1;
        x ^= x & bit ? below : 0;
        const uint swapped_y = y & bit ? 0 : (x ^ y) & below;
        x ^= y & bit ? below : swapped_y;
        y ^= swapped_y;
        const uint swapped_z = z & bit ? 0 : (x ^ z) & below;
        x ^= z & bit ? below : swapped_z;
        z ^= swapped_z;
    }
    y ^= x;
    z ^= y;
    uint flipped = z >> 1; // each bit is flipped by those of z above it
    for (uint shift = 1; shift < 32; shift <<= 1)
        flipped ^= flipped >> shift;
    return spread_bits(x ^ flipped) << 2 | spread_bits(y ^ flipped) << 1 | spread_bits(z ^ flipped);
}

// The cell, of 2^bits, of a coordinate in [-1, 1]; other coordinates are clamped.
uint cell_of(double x, uint bits)
{
    const double cells = 1u << (bits - 1), last = 2 * cells - 1, at = (x + 1.0) * cells;
    return (uint)(int)(at < 0.0 ? 0.0 : at > last ? last : at); // int: uint takes twice the time
}
