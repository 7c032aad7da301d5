// Blocks of voxels near holes, walks through trees, and the crossings of rows; for the programs of
// svo/voxelization/fill/winding.

#include "svo/octree/octree.h"
#include "svo/voxelization/fill/crossings.h"
#include "svo/voxelization/fill/winding.h"
#include "svo/voxelization/morton.h"
#include "svo/voxelization/overlap.h"
#include "spatial/bvh.h"
#include "spatial/winding_number.h"

#define STACK ((ARITY - 1) * MAX_LEVELS + 1)

// The box of the voxel centres of a block of 2^level voxels.
typedef struct {
    int3 low, high; // 1/256 voxel
} centres;

centres centres_of(ulong code, uint level)
{
    const int3 corner = convert_int3(morton_decode(code) << level);
    const centres c = {corner * VOXEL + HALF, (corner + (1 << level)) * VOXEL - HALF};
    return c;
}

// The centre of the voxel beyond the middle of a block, about which its winding number is expanded.
int3 middle_of(centres c) { return ((c.low + c.high) >> 1) + HALF; }

// A point in the frame of a tree: (units - frame.xyz) frame.w, with units of 1/256 voxel.
double3 to_local(int3 units, double4 frame)
{
    return (convert_double3(units) - frame.xyz) * frame.w;
}

double total(double8 v)
{
    const double4 halves = v.lo + v.hi;
    const double2 quarters = halves.lo + halves.hi;
    return quarters.x + quarters.y;
}

// A walk through the nodes of a tree, over the children of each.
typedef struct {
    uint ids[STACK], top; // inner nodes that are still to be visited
    uint id, i, child;    // child i of node `id`, and its own number
} walk;

void start(walk *w)
{
    w->ids[0] = 0;
    w->top = 1;
    w->i = ARITY - 1;
}

// Steps to the next child; returns whether there is one.
bool next_child(walk *w)
{
    if (++w->i == ARITY) {
        if (w->top == 0)
            return false;
        w->id = w->ids[--w->top];
        w->i = 0;
    }
    w->child = ARITY * w->id + 1 + w->i;
    return true;
}

// Returns whether the child is an inner node, whose children are then visited later.
bool descend(walk *w, uint first_leaf)
{
    if (w->child < first_leaf)
        w->ids[w->top++] = w->child;
    return w->child < first_leaf;
}

// Parameter group: the caps, and the tree over them.
#define CAPS                                                                                           \
    __global const uint *cap_names, const uint cap_count, const uint cap_first_leaf,                   \
        __global const int *vertices, __global const int *faces, const uint first_cap

// Parameter group: the sorted crossings of the rows of the grid.
#define CROSSINGS                                                                                      \
    const int3 shape, __global const ulong *crossings, const uint count, const uint x_bits

// The first crossing of row (j, k), or of a later one.
uint first_crossing(CROSSINGS, int j, int k)
{
    const ulong row = (ulong)k * shape.y + j;
    uint low = 0, high = count;
    while (low < high) {
        const uint middle = low + (high - low) / 2;
        if (crossings[middle] >> x_bits < row)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

// Sum the crossings of a row up to voxel (i, j, k), from crossing *at on, which is moved to the first
// one beyond: +1 where the row enters, -1 where it leaves.
int number_until(CROSSINGS, int i, int j, int k, uint *at)
{
    const ulong end = (((ulong)k * shape.y + j) << x_bits) + ((ulong)(i + 2) << 2);
    int number = 0;
    for (; *at < count && crossings[*at] < end; ++*at)
        number += crossings[*at] & ENTERS ? 1 : -1;
    return number;
}
