// The set voxel nearest to each point, by branch and bound. Host side: voxtool/svo/queries/query.py.
//
// The octree as in query.cl. The word of a node of size 2^k is WHOLE if all its voxels are set.
// Otherwise it is the place of its first child above bricks, and the mask of a brick, which also serves
// its octants of 2 x 2 x 2 voxels (a byte) and its voxels (a bit).
//
// Distances are between a point and centres of voxels, and rounded: sums, differences and products of
// float64 grow with their operands, so no centre in a node is nearer than its box of centres. Which
// voxel is found does not depend on the order of the search, nor on which nodes are leaves.

#include "svo/octree/octree.h"
#include "svo/queries/nearest.h"

#define BRICK 2 // k of a brick
#define WHOLE (~0ul)
#define NOTHING (~0ul) // the key of no voxel

#define OCTREE                                                                                     \
    __global const uint *words, __global const ulong *firsts, __global const ulong *bricks,        \
        const int root
#define THIS_OCTREE words, firsts, bricks, root

// The word of a node above level 0; false if it is an empty leaf.
int link_of(const uint child, ulong *word)
{
    *word = child & VALID ? child & LINK : WHOLE;
    return (child & (VALID | INSIDE)) != 0;
}

// The word of a node's child of size 2^k; false if it is empty.
int child_of(OCTREE, const ulong word, const int k, const uint octant, ulong *child)
{
    if (k >= BRICK && word == WHOLE) {
        *child = WHOLE;
        return 1;
    }
    if (k > BRICK)
        return link_of(words[firsts[root - k] + word + octant], child);
    *child = k == BRICK ? bricks[word + octant]
             : k == 1   ? word >> (8 * octant) & 0xFF
                        : word >> octant & 1;
    return *child != 0;
}

// The distance of a coordinate from the centres of voxels from `low` to before `high`.
double apart(const double coordinate, const double low, const double high)
{
    const double below = low + 0.5 - coordinate, above = coordinate - (high - 0.5);
    const double most = below > above ? below : above;
    return most > 0 ? most : 0;
}

// The square of the least distance of a node's centres from a point.
double least_square(const double3 point, const ushort4 node, const double3 sizes)
{
    const uint side = 1u << node.w;
    const double x = apart(point.x, (double)(node.x * side), (double)((node.x + 1) * side)) * sizes.x;
    const double y = apart(point.y, (double)(node.y * side), (double)((node.y + 1) * side)) * sizes.y;
    const double z = apart(point.z, (double)(node.z * side), (double)((node.z + 1) * side)) * sizes.z;
    return x * x + y * y + z * z;
}

// keys[i] = x << 32 | y << 16 | z of the set voxel whose centre is nearest to point i, the least key
// of several; NOTHING if no voxel is set. squares[i]: the square of that distance. `pitch`: the sizes
// of a voxel.
__kernel void nearest_voxels(const uint n, __global const double *points, OCTREE,
                             __global const double *pitch, __global ulong *keys,
                             __global double *squares)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const double3 point = vload3(gid, points), sizes = vload3(0, pitch);
    ulong waiting[STACK], found = NOTHING;
    ushort4 nodes[STACK];
    nodes[0] = (ushort4)(0, 0, 0, (ushort)root);
    int size = link_of(words[0], waiting);
    double best = INFINITY;
    while (size) {
        const ulong word = waiting[--size];
        const ushort4 node = nodes[size];
        const double square = least_square(point, node, sizes);
        if (square > best)
            continue;
        if (node.w == 0) {
            const ulong key = (ulong)node.x << 32 | (ulong)node.y << 16 | node.z;
            found = square < best || key < found ? key : found;
            best = square;
            continue;
        }
        const int k = node.w - 1;
        const double width = (double)(1u << k);
        const uint nearest = (uint)(point.x >= (2 * node.x + 1) * width) |
                             (uint)(point.y >= (2 * node.y + 1) * width) << 1 |
                             (uint)(point.z >= (2 * node.z + 1) * width) << 2;
        for (uint i = 8; i-- > 0;) { // the nearest octant comes last, and off the stack first
            const uint octant = i ^ nearest;
            const ushort4 child = (ushort4)((ushort)(2 * node.x + (octant & 1)),
                                            (ushort)(2 * node.y + (octant >> 1 & 1)),
                                            (ushort)(2 * node.z + (octant >> 2)), (ushort)k);
            if (child_of(THIS_OCTREE, word, k, octant, &waiting[size]) &&
                least_square(point, child, sizes) <= best)
                nodes[size++] = child;
        }
    }
    keys[gid] = found;
    squares[gid] = best;
}
