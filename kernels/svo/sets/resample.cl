// The coverage of the voxels of a grid by the set voxels of an octree of another grid. Host side:
// voxtool/svo/sets/resample.py.
//
// The octree: words, the `child` words of its nodes above level 0, root first; starts[l], the place of
// the first node of level l; bricks. The grid: planes[axis * stride + j] is where voxel j begins, in
// units of 1 / unit[axis] of the octree's voxels; firsts and ends are the octree's voxels that the
// plane lies in, or beside, seen from its right and from its left.

#include "svo/octree/octree.h"
#include "svo/sets/resample.h"
#include "svo/voxelization/morton.h"

// A walk over the leaves of the octree that a box of its voxels touches.
typedef struct {
    uint indices[STACK]; // of nodes in their levels
    ushort4 cells[STACK]; // their places among those of their level, and the level
    int size;
    int low[3], high[3]; // the box
} walk_t;

void begin_walk(walk_t *walk, uint top)
{
    walk->indices[0] = 0;
    walk->cells[0] = (ushort4)(0, 0, 0, (ushort)top);
    walk->size = 1;
}

// Put the children of a node on the stack, `first` and those behind it, that the box touches.
void push_children(walk_t *walk, ushort4 cell, uint first)
{
    const int side = 2 << cell.w;
    for (uint child = 0; child < 8; ++child) {
        const int x = 2 * cell.x + (child & 1), y = 2 * cell.y + (child >> 1 & 1),
                  z = 2 * cell.z + (child >> 2);
        if (x * side >= walk->high[0] || (x + 1) * side <= walk->low[0] || y * side >= walk->high[1] ||
            (y + 1) * side <= walk->low[1] || z * side >= walk->high[2] || (z + 1) * side <= walk->low[2])
            continue;
        walk->indices[walk->size] = first + child;
        walk->cells[walk->size++] = (ushort4)((ushort)x, (ushort)y, (ushort)z, (ushort)(cell.w - 1));
    }
}

// The voxels of a brick from `low` to before `high` along an axis.
ulong layers(uint axis, int low, int high)
{
    const ulong layer = axis == 0   ? 0x0055005500550055ul
                        : axis == 1 ? 0x0000333300003333ul
                                    : 0x000000000F0F0F0Ful;
    ulong held = 0;
    for (int i = max(low, 0); i < min(high, 4); ++i)
        held |= layer << (((i & 1) | (i >> 1) << 3) << axis);
    return held;
}

// states[i] = EMPTY or FULL if the voxels of node i, `width` voxels a side, cover only unset or only
// set voxels of the octree; REFINED if they may cover both, or lie partly beyond the grid's shape.
__kernel void cover_nodes(const uint n, __global const ulong *codes, const int width, const int3 shape,
                          __global const int *firsts, __global const int *ends, const uint stride,
                          __global const uint *words, __global const uint *starts,
                          __global const ulong *bricks, const uint top, __global uchar *states)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint3 place = morton_decode(codes[gid]);
    const int node[3] = {(int)place.x * width, (int)place.y * width, (int)place.z * width};
    const int sides[3] = {shape.x, shape.y, shape.z};
    bool within = true, beyond = false, held = false, empty = false;
    walk_t walk;
    begin_walk(&walk, top);
    for (uint axis = 0; axis < 3; ++axis) {
        beyond = beyond || node[axis] >= sides[axis];
        within = within && node[axis] + width <= sides[axis];
        const uint at = axis * stride;
        walk.low[axis] = firsts[at + min(node[axis], sides[axis])];
        walk.high[axis] = ends[at + min(node[axis] + width, sides[axis])];
        empty = empty || walk.low[axis] < 0 || walk.high[axis] > 4 << top;
    }
    empty = empty || beyond;
    while (walk.size && !beyond && !(held && empty)) {
        const ushort4 cell = walk.cells[--walk.size];
        const uint index = walk.indices[walk.size];
        const int side = 4 << cell.w, corner[3] = {cell.x * side, cell.y * side, cell.z * side};
        if (cell.w == 0) {
            ulong box = ~0ul;
            for (uint axis = 0; axis < 3; ++axis)
                box &= layers(axis, walk.low[axis] - corner[axis], walk.high[axis] - corner[axis]);
            held = held || (bricks[index] & box);
            empty = empty || (~bricks[index] & box);
            continue;
        }
        const uint word = words[starts[cell.w] + index];
        if (word & VALID) {
            push_children(&walk, cell, word & LINK);
        } else {
            held = held || (word & INSIDE);
            empty = empty || !(word & INSIDE);
        }
    }
    states[gid] = !held ? EMPTY : empty || !within ? REFINED : FULL;
}

// The length of the interval from `low` to `high` that lies between two planes.
long overlap(long low, long high, long from, long to) { return max(min(high, to) - max(low, from), 0l); }

// sums[16 k + 4 j + i] += the volume of voxel (i, j, k) that a cube of set voxels covers. The ends of
// the cube are from[axis] and to[axis], those of the voxel planes[axis][i] and planes[axis][i + 1].
void add_cube(long sums[64], long planes[3][5], const long from[3], const long to[3])
{
    for (uint k = 0; k < 4; ++k) {
        const long z = overlap(planes[2][k], planes[2][k + 1], from[2], to[2]);
        for (uint j = 0; z && j < 4; ++j) {
            const long yz = z * overlap(planes[1][j], planes[1][j + 1], from[1], to[1]);
            for (uint i = 0; yz && i < 4; ++i)
                sums[16 * k + 4 * j + i] += yz * overlap(planes[0][i], planes[0][i + 1], from[0], to[0]);
        }
    }
}

// Adds the voxels of a brick whose low corner is at `from`, row by row.
void add_brick(long sums[64], long planes[3][5], ulong brick, const long from[3], const long unit[3])
{
    long weights[3][4][4]; // of the brick's voxels by those of the grid
    for (uint axis = 0; axis < 3; ++axis)
        for (uint v = 0; v < 4; ++v)
            for (uint i = 0; i < 4; ++i)
                weights[axis][v][i] = overlap(planes[axis][i], planes[axis][i + 1],
                                              from[axis] + v * unit[axis], from[axis] + (v + 1) * unit[axis]);
    for (uint row = 0; row < 16; ++row) {
        const uint y = row & 3, z = row >> 2;
        const uint four = (uint)(brick >> ((y & 1) << 1 | (z & 1) << 2 | (y & 2) << 3 | (z & 2) << 4)) & 0x303;
        if (!four)
            continue;
        long lengths[4];
        for (uint i = 0; i < 4; ++i)
            lengths[i] = (four & 1 ? weights[0][0][i] : 0) + (four & 2 ? weights[0][1][i] : 0) +
                         (four & 0x100 ? weights[0][2][i] : 0) + (four & 0x200 ? weights[0][3][i] : 0);
        for (uint k = 0; k < 4; ++k)
            for (uint j = 0; weights[2][z][k] && j < 4; ++j) {
                const long yz = weights[2][z][k] * weights[1][y][j];
                for (uint i = 0; yz && i < 4; ++i)
                    sums[16 * k + 4 * j + i] += yz * lengths[i];
            }
    }
}

// covered[i] = the voxels of brick i of the grid whose covered volume is at least needed[s]. A voxel
// is as long along each axis as `least` says, or longer by one: bit a of s is set if it is along axis a.
__kernel void cover_bricks(const uint n, __global const ulong *codes, __global const long *planes,
                           __global const int *firsts, __global const int *ends, const uint stride,
                           const long3 unit, const long3 least, __global const long *needed,
                           __global const uint *words, __global const uint *starts,
                           __global const ulong *bricks, const uint top, __global ulong *covered)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint3 place = 4 * morton_decode(codes[gid]);
    const uint node[3] = {place.x, place.y, place.z};
    const long units[3] = {unit.x, unit.y, unit.z}, lengths[3] = {least.x, least.y, least.z};
    long near[3][5], sums[64];
    walk_t walk;
    begin_walk(&walk, top);
    for (uint axis = 0; axis < 3; ++axis) {
        const uint at = axis * stride + node[axis];
        for (uint i = 0; i < 5; ++i)
            near[axis][i] = planes[at + i];
        walk.low[axis] = firsts[at];
        walk.high[axis] = ends[at + 4];
    }
    for (uint i = 0; i < 64; ++i)
        sums[i] = 0;
    while (walk.size) {
        const ushort4 cell = walk.cells[--walk.size];
        const uint index = walk.indices[walk.size];
        const uint word = cell.w ? words[starts[cell.w] + index] : 0;
        const ulong brick = cell.w ? 0 : bricks[index];
        if (word & VALID) {
            push_children(&walk, cell, word & LINK);
            continue;
        }
        const long side = 4 << cell.w;
        const long from[3] = {cell.x * side * units[0], cell.y * side * units[1], cell.z * side * units[2]};
        if (word & INSIDE || brick == ~0ul) {
            const long to[3] = {from[0] + side * units[0], from[1] + side * units[1], from[2] + side * units[2]};
            add_cube(sums, near, from, to);
        } else if (brick) {
            add_brick(sums, near, brick, from, units);
        }
    }
    ulong found = 0;
    for (uint bit = 0; bit < 64; ++bit) {
        const uint voxel[3] = {(bit & 1) | (bit >> 2 & 2), (bit >> 1 & 1) | (bit >> 3 & 2),
                               (bit >> 2 & 1) | (bit >> 4 & 2)};
        uint size = 0;
        for (uint axis = 0; axis < 3; ++axis)
            size |= (uint)(near[axis][voxel[axis] + 1] - near[axis][voxel[axis]] > lengths[axis]) << axis;
        if (sums[16 * voxel[2] + 4 * voxel[1] + voxel[0]] >= needed[size])
            found |= 1ul << bit;
    }
    covered[gid] = found;
}
