// The index of a cell along the Hilbert curve of 2^bits cells per axis [Skilling 2004]. Consecutive
// cells are neighbours.
ulong hilbert_index(uint3 cell, uint bits)
{
    uint x[3] = {cell.x, cell.y, cell.z};
    for (uint bit = 1u << (bits - 1); bit > 1; bit >>= 1)
        for (uint axis = 0; axis < 3; ++axis) {
            const uint swapped = x[axis] & bit ? 0 : (x[0] ^ x[axis]) & (bit - 1);
            x[0] ^= x[axis] & bit ? bit - 1 : swapped;
            x[axis] ^= swapped;
        }
    x[1] ^= x[0];
    x[2] ^= x[1];
    uint flipped = 0;
    for (uint bit = 1u << (bits - 1); bit > 1; bit >>= 1)
        flipped ^= x[2] & bit ? bit - 1 : 0;
    ulong index = 0;
    for (uint i = bits; i-- > 0;)
        for (uint axis = 0; axis < 3; ++axis)
            index = index << 1 | ((x[axis] ^ flipped) >> i & 1);
    return index;
}

// The cell, of 2^bits, of a coordinate in [-1, 1]; other coordinates are clamped.
uint cell_of(double x, uint bits)
{
    const double inside = x < -1.0 ? -1.0 : x > 1.0 ? 1.0 : x;
    return min((uint)((inside + 1.0) * (1u << (bits - 1))), (1u << bits) - 1);
}
