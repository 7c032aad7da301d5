// The voxels of bricks, and what lies around a brick, for the flood rule and its gaps.

// The voxels of coordinate 0 along an axis.
__constant ulong LOW[3] = {0x0055005500550055ul, 0x0000333300003333ul, 0x000000000F0F0F0Ful};

// The shift from the voxels of coordinate 0 along an axis to those of coordinate i.
int shift_to(int axis, int i) { return (int[]){0, 1, 8, 9}[i] << axis; }

// The voxels of the brick `step` away along an axis that touch voxels of a mask: voxels that differ in the
// other coordinates do not touch.
ulong spilled_along(int axis, ulong mask, int step)
{
    const ulong low = LOW[axis];
    const int one = 1 << axis, two = 8 << axis, three = 9 << axis;
    if (step > 0)
        return (mask >> three) & low;
    if (step < 0)
        return (mask & low) << three;
    const ulong up = (mask & (low | low << two)) << one | (mask & low << one) << (two - one);
    const ulong down = (mask >> one & (low | low << two)) | (mask >> (two - one) & low << one);
    return mask | up | down;
}

ulong spilled(ulong mask, int3 d)
{
    return spilled_along(2, spilled_along(1, spilled_along(0, mask, d.x), d.y), d.z);
}

// Direction i of 27, ascending in x, then y, then z; the middle one is none.
int3 direction(int i) { return (int3)(i / 9 - 1, i / 3 % 3 - 1, i % 3 - 1); }

// The neighbour in direction d of octant o of level-1 node `node`: as `beside` has it, and in *octant the
// brick of a refined node.
uint beside_brick(__global const uint *beside, uint node, uint o, int3 d, uint *octant)
{
    const int3 place = (int3)(o & 1, o >> 1 & 1, o >> 2) + d, away = place >> 1; // -1, 0 or 1
    *octant = (uint)((place.x & 1) | (place.y & 1) << 1 | (place.z & 1) << 2);
    return beside[27 * (size_t)node + 9 * (away.x + 1) + 3 * (away.y + 1) + away.z + 1];
}
