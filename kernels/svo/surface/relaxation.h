// Vertices of surface nets in 64 bits: their coordinates from the low corner of their cube, so that
// one addition adds all three.

#define BITS 21 // bits of a coordinate, and of the sum of up to 12
#define COORDINATE ((1 << BITS) - 1)

ulong pack(int x, int y, int z) { return (ulong)z << 2 * BITS | (ulong)y << BITS | (ulong)x; }

// The neighbours of vertex i: four links at links[4 i], to itself where it has three neighbours;
// and where it has more, in beyond: {vertex, neighbour}, of BATCH vertices from beyond_start[i /
// BATCH] on. around[i]: the number of neighbours, and from bits 4, 8 and 12 on, by how many more of
// them lie in a cube above than below along x, y and z, plus 8.
#define RELAXATION                                                                                 \
    __global uint *links, __global uint *beyond_start, __global uint2 *beyond,                     \
        __global ushort *around
