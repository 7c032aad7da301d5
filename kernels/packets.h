// Packets of LANES rays through neighbouring pixels, and the leaves of an octree that they pass.
//
// All rays of a packet visit the same nodes, so that a node is read once for all. Octants are
// mirrored so that every ray increases along each axis: then the order of the octants is that along
// each ray. A ray is at plane i of an axis at t = (i - origin) inverse, which is monotonic in i
// under rounding. At t it is in the cell between planes i and j where t(i) <= t < t(j). So all
// levels agree on the position of a ray, and it passes from a cell to its neighbour without a gap:
// what a ray meets depends neither on the other rays of its packet nor on LANES.
//
// Coordinates are in units of the finest cells. A node of size 2^k spans 2^k of them; the root has
// size 2^root. The includer defines LANES; NODE, the type of a reference to a node; TREE and
// THIS_TREE, parameters and arguments of the functions
//
//   uint occupied(TREE, NODE node, int k)   the octants of a node that rays visit, bit x + 2 y + 4 z
//   int enter(TREE, NODE *node, int k, uint octant)   goes to the octant, of size 2^k, of a node, or
//                                                     for k = root to the root; false for a leaf
//
// One of the parameters is `root`.

#include "lanes.h"

#define ACROSS (LANES == 16 ? 4 : 1) // pixels along a side of a packet
#define LEVELS 23                    // of the stack: the k of a root is 21 at most

typedef struct {
    doubles x, y, z;
} doubles3;

typedef struct {
    floats x, y, z;
} floats3;

doubles larger(const doubles a, const doubles b)
{
    return a > b ? a : b;
}

doubles smaller(const doubles a, const doubles b)
{
    return a < b ? a : b;
}

// ---- pixels

// The pixels of a packet: the first, and whether each is in the picture.
typedef struct {
    uint column, row;
    int exists[LANES];
} pixel_block;

// The pixels of this work-item. A work-group draws TILE x TILE packets.
pixel_block pixels_of_packet(const uint width, const uint height)
{
    const uint side = TILE * ACROSS, tiles = (width + side - 1) / side;
    const uint tile = get_group_id(0), place = get_local_id(0);
    pixel_block block;
    block.column = tile % tiles * side + place % TILE * ACROSS;
    block.row = tile / tiles * side + place / TILE * ACROSS;
    EACH_LANE(i)
        block.exists[i] =
            block.column + i % ACROSS < width && block.row + i / ACROSS < height ? -1 : 0;
    return block;
}

size_t pixel_of_lane(const pixel_block *block, const uint i, const uint width)
{
    return (size_t)(block->row + i / ACROSS) * width + block->column + i % ACROSS;
}

// The rays through pixels. `camera`: origin, direction, right and down of camera.py.
void rays_through(const pixel_block *block, __global const double *camera, const uint perspective,
                  const uint width, const uint height, doubles3 *origin, doubles3 *direction)
{
    double columns[LANES], rows[LANES];
    EACH_LANE(i)
    {
        columns[i] = block->column + i % ACROSS + 0.5 - 0.5 * width;
        rows[i] = block->row + i / ACROSS + 0.5 - 0.5 * height;
    }
    const doubles x = load(columns), y = load(rows);
    const doubles3 aside = {x * camera[6] + y * camera[9], x * camera[7] + y * camera[10],
                            x * camera[8] + y * camera[11]};
    const doubles none = 0;
    origin->x = camera[0] + (perspective ? none : aside.x);
    origin->y = camera[1] + (perspective ? none : aside.y);
    origin->z = camera[2] + (perspective ? none : aside.z);
    direction->x = camera[3] + (perspective ? aside.x : none);
    direction->y = camera[4] + (perspective ? aside.y : none);
    direction->z = camera[5] + (perspective ? aside.z : none);
}

// ---- the walk

// Rays are at origin + t speed between their times begin and end; all are mirrored alike, along the
// axes of the bits of `mirror`. The walk is in an octant of the node of size 2^k at x, y, z.
typedef struct {
    doubles3 origin, speed, inverse;
    doubles begin, end;
    uint mirror, octant;
    int k, x, y, z;
    NODE nodes[LEVELS];
    uint left[LEVELS];   // by k: octants that are still to be visited, mirrored
    doubles times[3][3]; // at the planes of the octants, by axis
} packet;

void find_times(packet *p)
{
    for (int i = 0; i < 3; ++i) {
        const int ahead = i << (p->k - 1);
        p->times[0][i] = ((double)(p->x + ahead) - p->origin.x) * p->inverse.x;
        p->times[1][i] = ((double)(p->y + ahead) - p->origin.y) * p->inverse.y;
        p->times[2][i] = ((double)(p->z + ahead) - p->origin.z) * p->inverse.z;
    }
}

// The rays that turn to the first waiting ray's `kind`; they no longer wait. The first three bits of
// a kind are the axes along which rays are mirrored.
ints next_kind(int *waiting, const uint *kinds, uint *kind)
{
    uint first = 0;
    while (first < LANES && !waiting[first])
        ++first;
    if (first == LANES)
        return 0;
    *kind = kinds[first];
    const ints alike = load(waiting) & (load(kinds) == *kind);
    store(load(waiting) & !alike, waiting);
    return alike;
}

// Starts before the root, as if it were the first octant of a larger node.
void start_walk(packet *p, const uint mirror, const int root)
{
    p->mirror = mirror;
    p->k = root + 1;
    p->x = p->y = p->z = 0;
    p->left[root + 1] = 1;
    find_times(p);
}

uint mirrored(uint octants, const uint mirror)
{
    octants = mirror & 1 ? (octants & 0x55) << 1 | (octants >> 1 & 0x55) : octants;
    octants = mirror & 2 ? (octants & 0x33) << 2 | (octants >> 2 & 0x33) : octants;
    return mirror & 4 ? (octants & 0x0F) << 4 | octants >> 4 : octants;
}

// Goes to the next leaf that a ray passes, from t = in to t = out where in < out; false if there is
// none. The leaf is octant `octant` ^ mirror of nodes[k].
int next_leaf(packet *p, TREE, doubles *in, doubles *out)
{
    for (;;) {
        const int k = p->k;
        while (p->left[p->k] == 0)
            if (++p->k > root + 1)
                return 0;
        if (p->k > k) {
            if (!ANY(p->begin < p->end))
                return 0;
            const int within = (1 << p->k) - 1;
            p->x &= ~within, p->y &= ~within, p->z &= ~within;
            find_times(p);
        }
        const uint left = p->left[p->k], octant = 31 - clz(left & -left);
        const uint x = octant & 1, y = octant >> 1 & 1, z = octant >> 2;
        p->left[p->k] = left & (left - 1);
        const doubles begin = larger(larger(p->times[0][x], p->times[1][y]), p->times[2][z]);
        const doubles end =
            smaller(smaller(p->times[0][x + 1], p->times[1][y + 1]), p->times[2][z + 1]);
        *in = larger(begin, p->begin), *out = smaller(end, p->end);
        if (!ANY(*in < *out))
            continue;
        NODE node = p->nodes[p->k];
        p->octant = octant;
        if (!enter(THIS_TREE, &node, p->k - 1, octant ^ p->mirror))
            return 1;
        --p->k;
        p->nodes[p->k] = node;
        p->left[p->k] = mirrored(occupied(THIS_TREE, node, p->k), p->mirror);
        p->x += x << p->k, p->y += y << p->k, p->z += z << p->k;
        find_times(p);
    }
}
