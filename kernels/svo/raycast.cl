// Ray casting of an octree. Host side: voxtool/svo/raycast.py.
//
// A node has size 2^k voxels: k = 0 voxels, 2 bricks, 3 nodes of level 1, and so on. The word of a
// node is 0 if it is empty, and INSIDE if it is an inside leaf. Otherwise a brick's word is its
// mask, which also serves its octants of 2 x 2 x 2 voxels (a byte) and its voxels (a bit), and a
// coarser node's word is the index of its first child. Nodes are numbered from the root; bricks
// start at first_brick.
//
// Packets of rays follow packets.h. Options: LANES; DEPTHS, for depths instead of a picture.

#include "shading.h"
#include "svo/octree.h"
#include "svo/raycast.h"

#define BRICK 2        // k of a brick
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

// The occupied octants of a node of size 2^k, as bits.
uint octants_of(OCTREE, const ulong word, const int k)
{
    if (word == 0 || k == 1)
        return (uint)word;
    uint octants = 0;
    for (uint octant = 0; octant < 8; ++octant)
        octants |= (uint)(child_of(THIS_OCTREE, word, k - 1, octant) != 0) << octant;
    return octants;
}

// ---- packets of rays

#define NODE ulong
#define TREE OCTREE, const int root, const int finest
#define THIS_TREE THIS_OCTREE, root, finest

uint occupied(TREE, const ulong word, const int k) { return octants_of(THIS_OCTREE, word, k); }

int is_leaf(const ulong word, const int k, const int finest)
{
    return word && (k == finest || (k > BRICK && word == INSIDE));
}

int enter(TREE, ulong *word, const int k, const uint octant)
{
    *word = k == root ? words[0] : child_of(THIS_OCTREE, *word, k, octant);
    return !is_leaf(*word, k, finest);
}

#include "packets.h"

// The parameters of pictures. `frame`: origin, direction, right and down of rays (camera.py), in grid
// units, and the pitch, in its unit.
#define PICTURE                                                                                    \
    __global const double *frame, const uint perspective, const uint width, const uint height

// Turns the rays along an axis that decrease, and centres those that stay in a layer of voxels.
doubles set_axis(const doubles origin, const doubles direction, const int root, doubles *speed,
                 longs *down)
{
    const doubles forward = direction < 0 ? -direction : direction;
    const longs still = forward < STILL;
    *down = direction <= -STILL;
    *speed = still ? (doubles)STILL : forward;
    const doubles centred = still ? floor(origin) + 0.5 : origin;
    return *down ? (double)(1 << root) - centred : centred;
}

// The rays of a packet, in voxels; returns their mirrors. Perspective rays start at 0.
uints set_out(packet *p, const doubles3 origin, const doubles3 direction, const uint perspective,
              const int root)
{
    longs x, y, z;
    p->origin.x = set_axis(origin.x, direction.x, root, &p->speed.x, &x);
    p->origin.y = set_axis(origin.y, direction.y, root, &p->speed.y, &y);
    p->origin.z = set_axis(origin.z, direction.z, root, &p->speed.z, &z);
    p->inverse.x = 1.0 / p->speed.x, p->inverse.y = 1.0 / p->speed.y;
    p->inverse.z = 1.0 / p->speed.z;
    p->begin = perspective ? 0.0 : -INFINITY;
    return (to_ints(x) ? (uints)1 : (uints)0) + (to_ints(y) ? (uints)2 : (uints)0) +
           (to_ints(z) ? (uints)4 : (uints)0);
}

// ---- hits

// A ray and its hit: the node at `low` of size 2^k. All fields except `direction` are mirrored.
typedef struct {
    double3 origin, direction, speed, inverse;
    double t;
    int3 low;
    int k;
    uint mirror; // one bit per axis
} ray_state;

// The rays of a packet, by lane.
typedef struct {
    double values[12][LANES];
} lane_rays;

void by_lane(const packet *p, const doubles3 direction, lane_rays *rays)
{
    const doubles3 vectors[4] = {p->origin, direction, p->speed, p->inverse};
    for (uint i = 0; i < 4; ++i) {
        store(vectors[i].x, rays->values[3 * i]);
        store(vectors[i].y, rays->values[3 * i + 1]);
        store(vectors[i].z, rays->values[3 * i + 2]);
    }
}

double3 vector_of(const lane_rays *rays, const uint first, const uint lane)
{
    return (double3)(rays->values[first][lane], rays->values[first + 1][lane],
                     rays->values[first + 2][lane]);
}

// The ray of a lane that meets the walk's leaf at t.
ray_state ray_at(const lane_rays *rays, const packet *p, const double t, const uint lane)
{
    ray_state ray;
    ray.origin = vector_of(rays, 0, lane), ray.direction = vector_of(rays, 3, lane);
    ray.speed = vector_of(rays, 6, lane), ray.inverse = vector_of(rays, 9, lane);
    ray.t = t;
    ray.k = p->k - 1;
    ray.low = (int3)(p->x, p->y, p->z) +
              (int3)(p->octant & 1, p->octant >> 1 & 1, p->octant >> 2) * (1 << ray.k);
    ray.mirror = p->mirror;
    return ray;
}

double3 times_at(const ray_state *ray, const int3 planes)
{
    return (convert_double3(planes) - ray->origin) * ray->inverse;
}

double largest(const double3 v)
{
    const double xy = v.x > v.y ? v.x : v.y;
    return xy > v.z ? xy : v.z;
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

// The word of the node of size 2^k at a position in units of such nodes, or of a larger leaf around
// it. `above`: by k, the words of the nodes around the hit, and its own.
ulong word_at(const ray_state *ray, const ulong *above, OCTREE, const int root, const int k,
              const int3 node)
{
    if (any(node < 0) || any(node >= 1 << (root - k)))
        return 0;
    int at = max(k + differing_bits(node, ray->low >> k), ray->k);
    ulong word = above[at];
    while (at > k && word && word != INSIDE) {
        --at;
        word = child_of(THIS_OCTREE, word, at, octant_at(node, at - k) ^ ray->mirror);
    }
    return word;
}

// The shares of the children, of size 2^k, of a node and the 26 around it, by mirrored octant; rays
// that meet the same node use them again.
typedef struct {
    int3 centre;   // in units of the node
    uint held;     // the nodes that are not empty, as bits
    float8 of[27]; // by x, then y, then z
} near_shares;

// Swaps the bytes of octants.
ulong mirrored_bytes(ulong v, const uint mirror)
{
    const ulong x = 0x00FF00FF00FF00FFul, y = 0x0000FFFF0000FFFFul;
    v = mirror & 1 ? (v & x) << 8 | (v >> 8 & x) : v;
    v = mirror & 2 ? (v & y) << 16 | (v >> 16 & y) : v;
    return mirror & 4 ? as_ulong(as_uint2(v).yx) : v; // Oclgrind has no rotation
}

float8 shares_of(OCTREE, const ulong word, const int k, const uint mirror)
{
    if (word == INSIDE && k >= BRICK)
        return 1.0f;
    if (k != 1) {
        float share[8];
        for (uint octant = 0; octant < 8; ++octant)
            share[octant] = share_of_child(THIS_OCTREE, word, k, octant ^ mirror);
        return vload8(0, share);
    }
    // a byte for each octant of a brick: the voxels in it
    ulong count = word - (word >> 1 & 0x5555555555555555ul);
    count = (count & 0x3333333333333333ul) + (count >> 2 & 0x3333333333333333ul);
    count = mirrored_bytes((count + (count >> 4)) & 0x0F0F0F0F0F0F0F0Ful, mirror);
    const ulong8 bytes = (ulong8)count >> (ulong8)(0, 8, 16, 24, 32, 40, 48, 56) & 0xFF;
    return convert_float8(convert_int8(bytes)) * 0.125f;
}

// Sets the shares around a node near the hit, from the words of the eight nodes that hold it and
// those around it, unless it is the root.
void find_shares(near_shares *near, const int3 centre, const ray_state *ray, const ulong *above,
                 OCTREE, const int root, const int k)
{
    near->centre = centre;
    near->held = 0;
    if (k + 1 == root) {
        near->held = 1 << 13;
        near->of[13] = shares_of(THIS_OCTREE, above[root], k, ray->mirror);
        return;
    }
    const int3 first = centre - 1, holder = first >> 1;
    ulong holders[8];
    for (int i = 0; i < 8; ++i)
        holders[i] = word_at(ray, above, THIS_OCTREE, root, k + 2,
                             holder + (int3)(i & 1, i >> 1 & 1, i >> 2));
    for (int i = 0; i < 27; ++i) {
        const int3 node = first + (int3)(i % 3, i / 3 % 3, i / 9), in = (node >> 1) - holder;
        ulong word = holders[in.x | in.y << 1 | in.z << 2];
        if (word && word != INSIDE)
            word = child_of(THIS_OCTREE, word, k + 1, octant_at(node, 0) ^ ray->mirror);
        else if (word && k + 1 == BRICK)
            word = ALL;
        if (word) {
            near->of[i] = shares_of(THIS_OCTREE, word, k, ray->mirror);
            near->held |= 1u << i;
        }
    }
}

// The weights of four cells along an axis, and their derivatives, at f in [0, 1] between the centres
// of the two middle cells: a quadratic B-spline of the means of adjacent cells. The first is at
// `begin`, 0 or 1, of six; the others are 0.
void spline(const double f, const int begin, double *weight, double *slope)
{
    const double first = 0.5 * (1.0 - f) * (1.0 - f), last = 0.5 * f * f;
    weight[0] = slope[0] = weight[4] = slope[4] = weight[5] = slope[5] = 0.0;
    weight[begin] = 0.5 * first, slope[begin] = 0.5 * f - 0.5;
    weight[begin + 1] = 0.5 - 0.5 * last, slope[begin + 1] = -0.5 * f;
    weight[begin + 2] = 0.5 - 0.5 * first, slope[begin + 2] = 0.5 - 0.5 * f;
    weight[begin + 3] = 0.5 * last, slope[begin + 3] = 0.5 * f;
}

double sum_of(const double sum, const double4 v) { return sum + v.x + v.y + v.z + v.w; }

// The gradient of the coverage of cells at a position, in units of cells from the first of the
// nodes: smooth, and nearly constant on planes.
double3 coverage_gradient(const near_shares *near, const double3 place)
{
    const double3 before = floor(place - 0.5), f = place - 0.5 - before;
    const int3 first = convert_int3(before) - 1, low = first >> 1, odd = first & 1;
    double weight[3][6], slope[3][6];
    spline(f.x, odd.x, weight[0], slope[0]);
    spline(f.y, odd.y, weight[1], slope[1]);
    spline(f.z, odd.z, weight[2], slope[2]);
    double3 gradient = 0.0;
    for (int z = 0; z < 4 + odd.z; z += 2) // nodes, of two cells along each axis
        for (int y = 0; y < 4 + odd.y; y += 2) {
            const double4 wy = vload2(0, weight[1] + y).xyxy, wz = vload2(0, weight[2] + z).xxyy;
            const double4 sy = vload2(0, slope[1] + y).xyxy, sz = vload2(0, slope[2] + z).xxyy;
            const double4 ww = wy * wz, sw = sy * wz, ws = wy * sz;
            for (int x = 0; x < 4 + odd.x; x += 2) {
                const int i = low.x + x / 2 + 3 * (low.y + y / 2) + 9 * (low.z + z / 2);
                if (!(near->held >> i & 1))
                    continue;
                const double4 even = convert_double4(near->of[i].even);
                const double4 next = convert_double4(near->of[i].odd);
                const double4 mean = even * weight[0][x] + next * weight[0][x + 1];
                const double4 change = even * slope[0][x] + next * slope[0][x + 1];
                gradient.x = sum_of(gradient.x, change * ww);
                gradient.y = sum_of(gradient.y, mean * sw);
                gradient.z = sum_of(gradient.z, mean * ws);
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
// coverage of cells of size 2^k. A normal that points away from the viewer is rotated until it is
// perpendicular to the view direction. Where the gradient vanishes, the face's normal is used.
double3 normal_at(const ray_state *ray, near_shares *near, const ulong *above, OCTREE,
                  const int root, const int k, const double3 pitch)
{
    const double3 view = ray->direction * pitch;
    const double ahead = AHEAD * (1 << k) / sqrt(product(ray->speed, ray->speed));
    const double3 hit = clamp(ray->origin + ray->t * ray->speed, convert_double3(ray->low),
                              convert_double3(ray->low + (1 << ray->k)));
    const int3 centre = convert_int3(hit) >> (k + 1);
    if (any(centre != near->centre))
        find_shares(near, centre, ray, above, THIS_OCTREE, root, k);
    const double3 place = (hit - ahead * ray->speed) * (1.0 / (1 << k));
    double3 into = coverage_gradient(near, place - convert_double3(2 * (centre - 1)));
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

// The pixels and rays of this work-item; `p` holds the rays, before their walks.
pixel_block pixels_and_rays(packet *p, PICTURE, const int root, uint *mirrors, lane_rays *rays)
{
    const pixel_block block = pixels_of_packet(width, height);
    doubles3 origin, direction;
    rays_through(&block, frame, perspective, width, height, &origin, &direction);
    store(set_out(p, origin, direction, perspective, root), mirrors);
    by_lane(p, direction, rays);
    return block;
}

// The rays that meet the walk's leaf, and when; their way ends.
int next_hits(packet *p, TREE, int *met, double *times)
{
    doubles in, out;
    if (!next_leaf(p, THIS_TREE, &in, &out))
        return 0;
    const longs hit = in < out;
    store(to_ints(hit), met);
    store(in, times);
    p->end = hit ? (doubles)-INFINITY : p->end;
    return 1;
}

#ifdef DEPTHS

// The depth of each pixel's hit, in the frame's unit; infinite without a hit.
__kernel void find_depths(TREE, PICTURE, __global double *depths)
{
    packet p;
    lane_rays rays;
    uint mirrors[LANES], mirror;
    int met[LANES];
    double times[LANES];
    pixel_block block = pixels_and_rays(&p, frame, perspective, width, height, root, mirrors, &rays);
    EACH_LANE(i)
    if (block.exists[i])
        depths[pixel_of_lane(&block, i, width)] = INFINITY;
    for (ints way = next_kind(block.exists, mirrors, &mirror); ANY(way);
         way = next_kind(block.exists, mirrors, &mirror)) {
        p.end = to_longs(way) ? (doubles)INFINITY : (doubles)-INFINITY;
        start_walk(&p, mirror, root);
        while (next_hits(&p, THIS_TREE, met, times))
            EACH_LANE(i)
            if (met[i])
                depths[pixel_of_lane(&block, i, width)] = times[i];
    }
}

#else

// The premultiplied colour of each pixel. `paint` holds the light direction and the colour.
__kernel void paint_picture(TREE, PICTURE, __global const float *paint, __global float *picture)
{
    packet p;
    lane_rays rays;
    uint mirrors[LANES], mirror;
    int met[LANES];
    double times[LANES];
    pixel_block block = pixels_and_rays(&p, frame, perspective, width, height, root, mirrors, &rays);
    EACH_LANE(i)
    if (block.exists[i])
        vstore4((float4)0, pixel_of_lane(&block, i, width), picture);
    const int shaded = min(max(finest, 1), root - 1);
    const double3 pitch = vload3(4, frame);
    near_shares near;
    for (ints way = next_kind(block.exists, mirrors, &mirror); ANY(way);
         way = next_kind(block.exists, mirrors, &mirror)) {
        p.end = to_longs(way) ? (doubles)INFINITY : (doubles)-INFINITY;
        start_walk(&p, mirror, root);
        near.centre = -1; // none
        while (next_hits(&p, THIS_TREE, met, times)) {
            ulong word = p.nodes[p.k]; // of the node around the leaf, then of the leaf
            enter(THIS_TREE, &word, p.k - 1, p.octant ^ mirror);
            p.nodes[p.k - 1] = word;
            EACH_LANE(i)
            if (met[i]) {
                const ray_state ray = ray_at(&rays, &p, times[i], i);
                const double3 n = normal_at(&ray, &near, p.nodes, THIS_OCTREE, root, shaded, pitch);
                const float light = brightness((float)n.x, (float)n.y, (float)n.z, paint[0],
                                               paint[1], paint[2]);
                vstore4((float4)(light * vload3(1, paint), 1.0f), pixel_of_lane(&block, i, width),
                        picture);
            }
        }
    }
}

#endif
