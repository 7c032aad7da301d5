// Ray casting of an octree. Host side: voxtool/svo/pictures/raycast.py.
//
// A node has size 2^k voxels: k = 0 voxels, 2 bricks, 3 nodes of level 1, and so on. The word of a
// node is 0 if it is empty, and INSIDE if it is an inside leaf. Otherwise a brick's word is its
// mask, which also serves its octants of 2 x 2 x 2 voxels (a byte) and its voxels (a bit), and a
// coarser node's word is the index of its first child. Nodes are numbered from the root; bricks
// start at first_brick. Nodes of size 2^finest are drawn if at least the share `least` of their
// voxels is set.
//
// Packets of rays follow packets.h. Options: LANES; DEPTHS, for depths instead of a picture;
// CELLS, for the cells that are met, too.

#include "shading.h"
#include "svo/octree/octree.h"
#include "svo/pictures/raycast.h"

#define BRICK 2        // k of a brick
#define STILL 1e-30    // speed along an axis below which a ray stays in its layer of voxels

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
#define TREE OCTREE, const int root, const int finest, const float least
#define THIS_TREE THIS_OCTREE, root, finest, least

uint occupied(TREE, const ulong word, const int k) { return octants_of(THIS_OCTREE, word, k); }

int is_leaf(const ulong word, const int k, const int finest)
{
    return word && (k == finest || (k > BRICK && word == INSIDE));
}

int enter(TREE, ulong *word, const int k, const uint octant)
{
    *word = k == root ? words[0] : child_of(THIS_OCTREE, *word, k, octant);
    if (k == finest && coverage(shares, *word, k) < least)
        *word = 0; // nothing is in it
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

#include "svo/pictures/normals.h"

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

// The low corner and k of the hit's node, in voxels.
int4 cell_of(const ray_state *ray, const int root)
{
    const int3 flipped = (1 << root) - (1 << ray->k) - ray->low;
    return (int4)(ray->mirror & 1 ? flipped.x : ray->low.x, ray->mirror & 2 ? flipped.y : ray->low.y,
                  ray->mirror & 4 ? flipped.z : ray->low.z, ray->k);
}

// The premultiplied colour of each pixel. `paint` holds the light direction and the colour.
__kernel void paint_picture(TREE, PICTURE, __global const float *paint, __global float *picture
#ifdef CELLS
                            , __global int *cells // of each pixel a low corner and k; -1 without a hit
#endif
)
{
    packet p;
    lane_rays rays;
    uint mirrors[LANES], mirror;
    int met[LANES];
    double times[LANES];
    pixel_block block = pixels_and_rays(&p, frame, perspective, width, height, root, mirrors, &rays);
    EACH_LANE(i)
    if (block.exists[i]) {
        vstore4((float4)0, pixel_of_lane(&block, i, width), picture);
#ifdef CELLS
        vstore4((int4)-1, pixel_of_lane(&block, i, width), cells);
#endif
    }
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
#ifdef CELLS
                vstore4(cell_of(&ray, root), pixel_of_lane(&block, i, width), cells);
#endif
            }
        }
    }
}

#endif
