// Ray casting of an octree. Host side: voxtool/svo/raycast.py.
//
// A node has size 2^k voxels: k = 0 voxels, 2 bricks, 3 nodes of level 1, and so on. The word of a
// node is 0 if it is empty, and INSIDE if it is an inside leaf. Otherwise a brick's word is its
// mask, which also serves its octants of 2 x 2 x 2 voxels (a byte) and its voxels (a bit), and a
// coarser node's word is the index of its first child. Nodes are numbered from the root; bricks
// start at first_brick.
//
// Octants are mirrored so that every ray increases along each axis. A ray is at plane i of an axis
// at t = (i - origin) inverse, which is monotonic in i under rounding. At t it is in the cell
// between planes i and j where t(i) <= t < t(j). So all levels agree on the position of a ray, the
// ray passes from a cell to its neighbour without a gap, and each step advances it by a whole cell,
// so it terminates.

#include "shading.h"
#include "svo/octree.h"
#include "svo/raycast.h"

#define BRICK 2        // k of a brick
#define LEVELS 17      // k of a root is 16 at most
#define STILL 1e-30    // speed along an axis below which a ray stays in its layer of voxels
#define AHEAD 0.5      // distance before the hit, in cells, where the coverage is sampled
#define ALL 0xFFFFFFFFFFFFFFFFul
#define VANISHES 1e-12 // smaller gradients are rounding errors

#define OCTREE                                                                                     \
    __global const uint *words, __global const float *shares, __global const ulong *bricks,        \
        const uint first_brick
#define THIS_OCTREE words, shares, bricks, first_brick

// The word of a child of a node.
ulong child_of(OCTREE, const ulong word, const int k, const uint octant)
{
    if (k > BRICK)
        return words[(uint)word + octant];
    if (k == BRICK)
        return bricks[(uint)word - first_brick + octant];
    return k == 1 ? word >> (8 * octant) & 0xFF : word >> octant & 1;
}

// The fraction of a node's voxels that are occupied.
float coverage(__global const float *shares, const ulong word, const int k)
{
    if (k <= BRICK)
        return (float)popcount(word) * (1.0f / (1 << 3 * k));
    if (word == 0 || word == INSIDE)
        return word == 0 ? 0.0f : 1.0f;
    return shares[((uint)word - 1) >> 3];
}

// The fraction of a node's child of size 2^k; also for an inside leaf.
float share_of_child(OCTREE, const ulong word, const int k, const uint octant)
{
    if (k >= BRICK && word == INSIDE)
        return 1.0f;
    return coverage(shares, child_of(THIS_OCTREE, word, k, octant), k);
}

// The words of a level's nodes, at `first` and following, and the fractions of its refined nodes,
// from the level below, of size 2^k. An empty refined node has word 0.
__kernel void cover_level(__global const uint *children, const uint first, const uint n,
                          const int k, __global uint *words, __global float *shares,
                          __global const ulong *bricks, const uint first_brick)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint child = children[first + gid];
    uint word = child & INSIDE;
    if (child & VALID) {
        word = first + n + (child & LINK);
        float sum = 0.0f;
        for (uint octant = 0; octant < 8; ++octant)
            sum += share_of_child(THIS_OCTREE, word, k, octant);
        shares[(word - 1) >> 3] = 0.125f * sum;
        word = sum > 0.0f ? word : 0;
    }
    words[first + gid] = word;
}

// A ray and its hit: the node at `low` of size 2^k. `above` holds the words of the enclosing nodes
// and the node itself. All fields except `direction` are mirrored.
typedef struct {
    double3 origin, direction, speed, inverse;
    double t;
    int3 low;
    int k;
    uint mirror; // one bit per axis
    ulong above[LEVELS];
} ray_state;

double3 times_at(const ray_state *ray, const int3 planes)
{
    return (convert_double3(planes) - ray->origin) * ray->inverse;
}

double largest(const double3 v)
{
    const double xy = v.x > v.y ? v.x : v.y;
    return xy > v.z ? xy : v.z;
}

double least(const double3 v)
{
    const double xy = v.x < v.y ? v.x : v.y;
    return xy < v.z ? xy : v.z;
}

double product(const double3 a, const double3 b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

// The octant given by one bit of a position along each axis.
uint octant_at(const int3 place, const int k)
{
    const int3 bit = place >> k & 1;
    return (uint)(bit.x | bit.y << 1 | bit.z << 2);
}

// The number of low bits in which two positions differ.
int differing_bits(const int3 a, const int3 b)
{
    const int3 changed = a ^ b;
    return 32 - (int)clz(changed.x | changed.y | changed.z);
}

// The parameters of pictures. `frame`: origin, direction, right and down of rays (camera.py), in grid
// units, and the pitch, in its unit.
#define PICTURE                                                                                    \
    __global const double *frame, const int perspective, const uint width, const uint height,      \
        const int root, const int finest
#define THIS_PICTURE frame, perspective, width, height, root, finest

// The ray of a work-item and the place of its pixel; returns whether it exists. Work-groups are tiles.
int set_out(PICTURE, ray_state *ray, size_t *pixel)
{
    const uint tiles = (width + TILE - 1) / TILE, tile = get_group_id(0), place = get_local_id(0);
    const uint column = tile % tiles * TILE + place % TILE, row = tile / tiles * TILE + place / TILE;
    if (column >= width || row >= height)
        return 0;
    *pixel = (size_t)row * width + column;
    const double x = column + 0.5 - 0.5 * width, y = row + 0.5 - 0.5 * height;
    const double3 step = x * vload3(2, frame) + y * vload3(3, frame);
    double3 origin = vload3(0, frame), direction = vload3(1, frame);
    if (perspective)
        direction += step;
    else
        origin += step;
    const double3 forward = direction < 0 ? -direction : direction;
    const long3 still = forward < STILL, down = (direction < 0) & ~still;
    ray->speed = still ? STILL : forward;
    origin = still ? floor(origin) + 0.5 : origin;
    ray->origin = down ? (1 << root) - origin : origin;
    ray->direction = direction;
    ray->inverse = 1.0 / ray->speed;
    ray->mirror = octant_at(convert_int3(down), 0);
    return 1;
}

// Finds the first node of size 2^finest that is not empty, or inside leaf, on a ray; returns
// whether there is one. Perspective rays start at 0.
int meet(ray_state *ray, OCTREE, const int root, const int finest, const int perspective)
{
    const int side = 1 << root;
    const double enter = largest(times_at(ray, 0));
    ray->t = perspective && enter < 0.0 ? 0.0 : enter;
    if (ray->t >= least(times_at(ray, side)))
        return 0;
    int k = root;
    int3 low = 0;
    ulong word = words[0];
    for (;;) {
        ray->above[k] = word;
        if (word && (k == finest || (k > BRICK && word == INSIDE))) {
            ray->low = low;
            ray->k = k;
            return 1;
        }
        if (word) {
            --k;
            const int3 middle = low + (1 << k);
            low = convert_int3(ray->t >= times_at(ray, middle)) ? middle : low;
        } else {
            const double3 ends = times_at(ray, low + (1 << k));
            ray->t = least(ends);
            const int3 next = low + (convert_int3(ends <= ray->t) & (1 << k));
            if (any(next >= side))
                return 0;
            k = differing_bits(low, next) - 1;
            low = next & ~((1 << k) - 1);
        }
        word = child_of(THIS_OCTREE, ray->above[k + 1], k, octant_at(low, k) ^ ray->mirror);
    }
}

// The word of the node of size 2^k at a position in units of such nodes, or its word within a
// larger leaf.
ulong word_at(const ray_state *ray, OCTREE, const int root, const int k, const int3 node)
{
    if (any(node < 0) || any(node >= 1 << (root - k)))
        return 0;
    int at = max(k + differing_bits(node, ray->low >> k), ray->k);
    ulong word = ray->above[at];
    while (at > k && word && word != INSIDE) {
        --at;
        word = child_of(THIS_OCTREE, word, at, octant_at(node, at - k) ^ ray->mirror);
    }
    return at > k && word && k == BRICK ? ALL : word;
}

// The weights of four cells along each axis, and their derivatives, at f in [0, 1] between the
// centres of the two middle cells: a quadratic B-spline of the means of adjacent cells.
void spline(const double3 f, double3 *weight, double3 *slope)
{
    const double3 first = 0.5 * (1.0 - f) * (1.0 - f), last = 0.5 * f * f;
    weight[0] = 0.5 * first;
    weight[1] = 0.5 - 0.5 * last;
    weight[2] = 0.5 - 0.5 * first;
    weight[3] = 0.5 * last;
    slope[0] = 0.5 * f - 0.5;
    slope[1] = -0.5 * f;
    slope[2] = 0.5 - 0.5 * f;
    slope[3] = 0.5 * f;
}

// The gradient of the coverage of cells of size 2^k at a position: smooth, and nearly constant on
// planes.
double3 coverage_gradient(const ray_state *ray, OCTREE, const int root, const int k,
                          const double3 place)
{
    const double3 cells = place * (1.0 / (1 << k)) - 0.5, before = floor(cells);
    const int3 first = convert_int3(before) - 1, low = first >> 1, high = (first + 3) >> 1;
    double3 weight[4], slope[4], gradient = 0.0;
    spline(cells - before, weight, slope);
    int3 node;
    for (node.z = low.z; node.z <= high.z; ++node.z)
        for (node.y = low.y; node.y <= high.y; ++node.y)
            for (node.x = low.x; node.x <= high.x; ++node.x) {
                const ulong word = word_at(ray, THIS_OCTREE, root, k + 1, node);
                if (word == 0)
                    continue;
                // the node's cells among the four along each axis
                const int3 begin = 2 * node - first;
                const int3 from = max(begin, (int3)0), to = min(begin + 1, (int3)3);
                int3 i;
                for (i.z = from.z; i.z <= to.z; ++i.z)
                    for (i.y = from.y; i.y <= to.y; ++i.y) {
                        double mean = 0.0, change = 0.0;
                        for (i.x = from.x; i.x <= to.x; ++i.x) {
                            const uint octant = octant_at(first + i, 0) ^ ray->mirror;
                            const double share = share_of_child(THIS_OCTREE, word, k, octant);
                            mean += share * weight[i.x].x;
                            change += share * slope[i.x].x;
                        }
                        gradient.x += change * (weight[i.y].y * weight[i.z].z);
                        gradient.y += mean * (slope[i.y].y * weight[i.z].z);
                        gradient.z += mean * (weight[i.y].y * slope[i.z].z);
                    }
            }
    return gradient;
}

// v in the original, unmirrored axes.
double3 unmirrored(const double3 v, const uint mirror)
{
    return (double3)(mirror & 1 ? -v.x : v.x, mirror & 2 ? -v.y : v.y, mirror & 4 ? -v.z : v.z);
}

// The unit normal at the hit in world space, towards the viewer: opposite to the gradient of the
// coverage. A normal that points away from the viewer is rotated until it is perpendicular to the
// view direction. Where the gradient vanishes, the face's normal is used.
double3 normal_at(const ray_state *ray, OCTREE, const int root, const int k, const double3 pitch)
{
    const double3 view = ray->direction * pitch;
    const double ahead = AHEAD * (1 << k) / sqrt(product(ray->speed, ray->speed));
    const double3 place = clamp(ray->origin + ray->t * ray->speed, convert_double3(ray->low),
                                convert_double3(ray->low + (1 << ray->k)));
    double3 into = coverage_gradient(ray, THIS_OCTREE, root, k, place - ahead * ray->speed);
    into = unmirrored(into, ray->mirror) / pitch;
    const double along = product(into, view);
    if (along < 0.0)
        into -= along / product(view, view) * view;
    double square = product(into, into);
    if (square < VANISHES * VANISHES) {
        const double3 begins = times_at(ray, ray->low);
        const double last = largest(begins);
        into = begins.x == last   ? (double3)(1.0, 0.0, 0.0)
               : begins.y == last ? (double3)(0.0, 1.0, 0.0)
                                  : (double3)(0.0, 0.0, 1.0);
        into = unmirrored(into, ray->mirror);
        square = 1.0;
    }
    return into / -sqrt(square);
}

// The depth of each pixel's hit, in the frame's unit; infinite without a hit.
__kernel void find_depths(OCTREE, PICTURE, __global double *depths)
{
    ray_state ray;
    size_t pixel;
    if (set_out(THIS_PICTURE, &ray, &pixel))
        depths[pixel] = meet(&ray, THIS_OCTREE, root, finest, perspective) ? ray.t : INFINITY;
}

// The premultiplied colour of each pixel. `paint` holds the light direction and the colour.
__kernel void paint_picture(OCTREE, PICTURE, __global const float *paint, __global float *picture)
{
    ray_state ray;
    size_t pixel;
    if (!set_out(THIS_PICTURE, &ray, &pixel))
        return;
    float4 rgba = 0.0f;
    if (meet(&ray, THIS_OCTREE, root, finest, perspective)) {
        const int k = min(max(finest, 1), root - 1);
        const double3 n = normal_at(&ray, THIS_OCTREE, root, k, vload3(4, frame));
        const float light = brightness((float)n.x, (float)n.y, (float)n.z, paint[0], paint[1],
                                       paint[2]);
        rgba = (float4)(light * vload3(1, paint), 1.0f);
    }
    vstore4(rgba, pixel, picture);
}
