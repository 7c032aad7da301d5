// Filling the voxels of a brick between flips along x. The bits of a brick are in Morton order, so the
// voxels of x = 0, 1, 2 and 3 are at offsets 0, 1, 8 and 9 from X0.

#define X0 0x0055005500550055ul // the voxels of a brick with x = 0
#define ALL 0xFFFFFFFFFFFFFFFFul

// The voxels of a brick: prefix parity of its flips along x, from the state of its rows on entry.
ulong fill_brick(ulong flips, ulong face)
{
    ulong v = flips ^ face;
    v ^= (v & 0x5555555555555555ul) << 1;               // x = 0 to 1, 2 to 3
    const ulong middle = v & (X0 << 1);                 // x = 1 ...
    return v ^ (middle << 7) ^ (middle << 8);           // ... to 2 and 3
}

// The state of a brick's rows on exit: its voxels of x = 3.
ulong exit_face(ulong brick) { return (brick >> 9) & X0; }

// The voxels, in the low or high bricks along x of a level-1 node, that lie before the high-x side of
// the grid, if the node begins at x = first.
ulong voxels_before(int end, int first, int high)
{
    ulong kept = ALL;
    for (int i = 0; i < 4; ++i)
        if (first + 4 * high + i >= end)
            kept &= ~(X0 << ((i & 1) + 8 * (i >> 1)));
    return kept;
}
