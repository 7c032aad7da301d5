// Ray casting of a distance field. Host side: voxtool/adf/pictures/raycast.py.
//
// Rays visit the leaves whose corners are not all on the side of the surface where the ray starts.
// In a leaf, the field along a ray is a cubic polynomial; the ray meets the surface at its first
// root [Marmitt 2004]. Times along rays are float64.
//
// nodes: for each block, the first block of its children, and bits of its children: whether a child
// has a block, and from bit OUTER and INNER, whether rays that start outside or inside look into it.
// With the option SEARCH, a ray goes from leaf to leaf, and the hash says which is next
// [ADF, section 3.4]; LANES and BATCH are 1, and the options are those of search.h, too.

#define NODE uint
#define TREE __global const uint2 *nodes, const uint marks, const int root
#define THIS_TREE nodes, marks, root
#include "adf/pictures/raycast.h"
#include "lanes.h"
#ifdef SEARCH
#include "adf/queries/query.h"
#include "adf/queries/search.h"
#define TABLES                                                                                     \
    __global const uint *cells, __global const OFFSET *offsets, __global const float *inverses,    \
        const uint m, const uint r, const int deepest, const int top, __global const uint2 *tops
#define PLACES TREE, TABLES
#define THESE_PLACES THIS_TREE, cells, offsets, inverses, m, r, deepest, top, tops
#define NEXT_LEAF next_by_search
#else
#define PLACES TREE
#define THESE_PLACES THIS_TREE
#define NEXT_LEAF next_leaf
#endif
#include "shading.h"

#define INSIDE 8         // of a kind of rays, beside the axes along which they are mirrored
#define PARALLEL 0x1p-40 // the least speed along an axis
#define HALVINGS 20      // of a ray's segment in a leaf, at most sqrt(3) of its edges long

// ---- the tree

uint occupied(TREE, const uint block, const int k)
{
    return nodes[block].y >> marks & 0xFF;
}

uint child_block(const uint2 node, const uint octant)
{
    return node.x + popcount(node.y & ((1u << octant) - 1));
}

int enter(TREE, uint *block, const int k, const uint octant)
{
    if (k == root) {
        *block = 0;
        return 1;
    }
    const uint2 node = nodes[*block];
    *block = child_block(node, octant);
    return node.y >> octant & 1;
}

// The field at the corners of a leaf minus the offset, by x, then y, then z.
float8 corners_of(__global const float *voxels, const uint block, const uint octant,
                  const float offset)
{
    const uint first = (octant & 1) + 3 * (octant >> 1 & 1) + 9 * (octant >> 2);
    __global const float *corner = voxels + (27 * (size_t)block + first);
    return (float8)(vload2(0, corner), vload2(0, corner + 3), vload2(0, corner + 9),
                    vload2(0, corner + 12)) -
           offset;
}

// Marks the children of blocks, from `first`; those of the next level are marked.
__kernel void mark_children(__global const float *voxels, const float offset, const uint first,
                            const uint n, __global uint2 *nodes)
{
    if (get_global_id(0) >= n)
        return;
    const uint block = first + get_global_id(0);
    uint2 node = nodes[block];
    for (uint octant = 0; octant < 8; ++octant) {
        uint outer, inner;
        if (node.y >> octant & 1) {
            const uint below = nodes[child_block(node, octant)].y;
            outer = (below >> OUTER & 0xFF) != 0;
            inner = (below >> INNER & 0xFF) != 0;
        } else {
            const float8 v = corners_of(voxels, block, octant, offset);
            outer = any(v <= 0);
            inner = any(v >= 0);
        }
        node.y |= outer << (OUTER + octant) | inner << (INNER + octant);
    }
    nodes[block] = node;
}

// ---- rays

#include "packets.h"

// The rays of a packet, in the finest cells of a field, from where they enter the cube; times are
// in the edge of such a cell. `mirrors`: the axes along which each ray is mirrored.
void set_out(packet *p, const doubles3 origin, const doubles3 direction, const uint perspective,
             const int root, uint *mirrors)
{
    const double side = 1 << root;
    const doubles size = sqrt(direction.x * direction.x + direction.y * direction.y +
                              direction.z * direction.z);
    const doubles3 way = {direction.x / size, direction.y / size, direction.z / size};
    const ints x = to_ints(way.x < 0), y = to_ints(way.y < 0), z = to_ints(way.z < 0);
    store((x ? (uints)1 : (uints)0) + (y ? (uints)2 : (uints)0) + (z ? (uints)4 : (uints)0),
          mirrors);
    p->speed.x = larger(way.x < 0 ? -way.x : way.x, (doubles)PARALLEL);
    p->speed.y = larger(way.y < 0 ? -way.y : way.y, (doubles)PARALLEL);
    p->speed.z = larger(way.z < 0 ? -way.z : way.z, (doubles)PARALLEL);
    p->inverse.x = 1.0 / p->speed.x, p->inverse.y = 1.0 / p->speed.y, p->inverse.z = 1.0 / p->speed.z;
    p->origin.x = side * (way.x < 0 ? 1.0 - origin.x : origin.x);
    p->origin.y = side * (way.y < 0 ? 1.0 - origin.y : origin.y);
    p->origin.z = side * (way.z < 0 ? 1.0 - origin.z : origin.z);
    doubles begin = larger(larger(-p->origin.x * p->inverse.x, -p->origin.y * p->inverse.y),
                           -p->origin.z * p->inverse.z);
    begin = perspective ? larger(begin, (doubles)0) : begin;
    p->origin.x += begin * p->speed.x;
    p->origin.y += begin * p->speed.y;
    p->origin.z += begin * p->speed.z;
    p->begin = larger(larger(larger(-p->origin.x * p->inverse.x, -p->origin.y * p->inverse.y),
                             -p->origin.z * p->inverse.z),
                      (doubles)0);
    p->end = smaller(smaller((side - p->origin.x) * p->inverse.x, (side - p->origin.y) * p->inverse.y),
                     (side - p->origin.z) * p->inverse.z);
}

#ifdef SEARCH

// The block of the deepest cell with one at a point, in units of 2^-32 of the cube, and its level.
// `level` is that of the cell before, where a coherent search starts.
uint deepest_block(const uint x, const uint y, const uint z, int *level, TABLES)
{
    const Hash hash = {cells, offsets, inverses, m, r};
    const uint2 known = tops[top_cell(x, y, z, top)];
    const int before = min(max(*level, top + 1), deepest);
    uint block = known.x;
    *level = (int)known.y;
    if (*level < top)
        return block;
    Wanted wanted = {{x}, {y}, {z}, {before}};
    uint slot;
    int exists;
#if SEARCH == BINARY
    for (int least = top + 1, most = deepest; least <= most;) {
        wanted.level[0] = (least + most) >> 1;
#else
    wanted.level[0] = SEARCH == LINEAR ? top + 1 : SEARCH == BOTTOM_UP ? deepest : before;
    int way = 0;
    while (top < wanted.level[0] && wanted.level[0] <= deepest) {
#endif
        find_cells(&hash, &wanted, &slot, &exists);
        if (exists) {
            block = cells[WORDS * (size_t)slot + WORDS - 1];
            *level = wanted.level[0];
        }
#if SEARCH == BINARY
        least = exists ? wanted.level[0] + 1 : least;
        most = exists ? most : wanted.level[0] - 1;
#else
        if (way == (exists ? -1 : 1))
            break;
        way = exists ? 1 : -1;
        wanted.level[0] += way;
#endif
    }
    return block;
}

// The last finest cell along an axis whose low plane a ray has reached at t; `side` beyond the cube.
int cell_at(const double t, const double origin, const double speed, const double inverse,
            const int side)
{
    int cell = (int)clamp(floor(origin + t * speed), 0.0, (double)side);
    while (cell < side && ((double)(cell + 1) - origin) * inverse <= t)
        ++cell;
    while (cell > 0 && ((double)cell - origin) * inverse > t)
        --cell;
    return cell;
}

uint point_of(const int cell, const uint down, const int root)
{
    return (uint)(down ? (1 << root) - 1 - cell : cell) << 1 << (POINT_BITS - 1 - root);
}

// As next_leaf, for one ray: the leaf at the time when it leaves the one before.
int next_by_search(packet *p, PLACES, double *in, double *out)
{
    const int side = 1 << root;
    int level = root - p->k;
    for (;;) {
        uint x = p->octant & 1, y = p->octant >> 1 & 1, z = p->octant >> 2;
        double t = p->begin;
        if (p->k <= root) // not at the start
            t = smaller(smaller(p->times[0][x + 1], p->times[1][y + 1]), p->times[2][z + 1]);
        if (!(t < p->end))
            return 0;
        p->x = cell_at(t, p->origin.x, p->speed.x, p->inverse.x, side);
        p->y = cell_at(t, p->origin.y, p->speed.y, p->inverse.y, side);
        p->z = cell_at(t, p->origin.z, p->speed.z, p->inverse.z, side);
        if (max(max(p->x, p->y), p->z) >= side)
            return 0;
        const uint block = deepest_block(
            point_of(p->x, p->mirror & 1, root), point_of(p->y, p->mirror & 2, root),
            point_of(p->z, p->mirror & 4, root), &level, cells, offsets, inverses, m, r, deepest,
            top, tops);
        p->k = root - level;
        p->nodes[p->k] = block;
        x = p->x >> (p->k - 1) & 1, y = p->y >> (p->k - 1) & 1, z = p->z >> (p->k - 1) & 1;
        p->octant = x | y << 1 | z << 2;
        const int within = (1 << p->k) - 1;
        p->x &= ~within, p->y &= ~within, p->z &= ~within;
        find_times(p);
        *in = larger(larger(larger(p->times[0][x], p->times[1][y]), p->times[2][z]), p->begin);
        *out = smaller(
            smaller(smaller(p->times[0][x + 1], p->times[1][y + 1]), p->times[2][z + 1]), p->end);
        if (nodes[block].y >> (marks + (p->octant ^ p->mirror)) & 1)
            return 1;
    }
}

#endif

// ---- leaf

// The field in a leaf along rays: c0 + c1 t + c2 t^2 + c3 t^3 at start + t step, in leaf edges.
typedef struct {
    floats3 start, step;
    floats c0, c1, c2, c3;
} segment;

floats within_0_1(const doubles t)
{
    const floats rounded = to_floats(t);
    return rounded > 0 ? rounded < 1 ? rounded : (floats)1 : (floats)0;
}

// The way of rays through the walk's leaf, from t = in to t = out.
void set_segment(segment *s, const packet *p, const doubles in, const doubles out)
{
    const int size = 1 << (p->k - 1);
    const double leaves = 1.0 / size, octant_x = p->octant & 1, octant_y = p->octant >> 1 & 1,
                 octant_z = p->octant >> 2;
    const double low_x = p->x * leaves + octant_x, low_y = p->y * leaves + octant_y,
                 low_z = p->z * leaves + octant_z;
    const doubles length = (out - in) * leaves;
    s->start.x = within_0_1((p->origin.x + in * p->speed.x) * leaves - low_x);
    s->start.y = within_0_1((p->origin.y + in * p->speed.y) * leaves - low_y);
    s->start.z = within_0_1((p->origin.z + in * p->speed.z) * leaves - low_z);
    s->step.x = to_floats(length * p->speed.x);
    s->step.y = to_floats(length * p->speed.y);
    s->step.z = to_floats(length * p->speed.z);
}

// The coefficients of a leaf with these corners, in mirrored axes: linear along x, then y, then z.
void set_cubic(segment *s, const float *v, const uint mirror)
{
    floats a[4], b[4];
    for (uint i = 0; i < 4; ++i) {
        const float low = v[2 * i ^ mirror], rise = v[(2 * i + 1) ^ mirror] - low;
        a[i] = low + rise * s->start.x;
        b[i] = rise * s->step.x;
    }
    floats c[2][3];
    for (uint i = 0; i < 2; ++i) {
        const floats da = a[2 * i + 1] - a[2 * i], db = b[2 * i + 1] - b[2 * i];
        c[i][0] = a[2 * i] + da * s->start.y;
        c[i][1] = b[2 * i] + db * s->start.y + da * s->step.y;
        c[i][2] = db * s->step.y;
    }
    const floats d0 = c[1][0] - c[0][0], d1 = c[1][1] - c[0][1], d2 = c[1][2] - c[0][2];
    s->c0 = c[0][0] + d0 * s->start.z;
    s->c1 = c[0][1] + d1 * s->start.z + d0 * s->step.z;
    s->c2 = c[0][2] + d2 * s->start.z + d1 * s->step.z;
    s->c3 = d2 * s->step.z;
}

floats value_at(const segment *s, const floats t)
{
    return s->c0 + t * (s->c1 + t * (s->c2 + t * s->c3));
}

// Rays whose cubic may be 0 or negative in [0, 1]: not all Bezier control points are positive.
ints may_have_root(const segment *s)
{
    const float third = 0x1.555556p-2f;
    const floats b1 = s->c0 + s->c1 * third, b2 = b1 + (s->c1 + s->c2) * third;
    return !((s->c0 > 0) & (b1 > 0) & (b2 > 0) & (value_at(s, (floats)1) > 0));
}

// Rays whose cubic is 0 or negative in [0, 1], and where it is monotonic around its first root.
ints bracket_root(const segment *s, floats *low, floats *high)
{
    const doubles slope = to_doubles(s->c1), half_curve = to_doubles(s->c2);
    const doubles cube = 3.0 * to_doubles(s->c3);
    const doubles discriminant = half_curve * half_curve - slope * cube;
    const doubles size = sqrt(larger(discriminant, (doubles)0));
    const doubles q = half_curve < 0 ? size - half_curve : -size - half_curve;
    const doubles r1 = q / cube, r2 = slope / q; // infinite or NaN where there is none
    const ints turns = to_ints(discriminant > 0);
    const floats first = turns ? within_0_1(r1 < r2 ? r1 : r2) : (floats)0;
    const floats second = turns ? within_0_1(r1 < r2 ? r2 : r1) : (floats)0;
    const ints at_start = s->c0 <= 0, before_first = value_at(s, first) <= 0;
    const ints before_second = value_at(s, second) <= 0;
    *low = at_start | before_first ? (floats)0 : before_second ? first : second;
    *high = at_start ? (floats)0 : before_first ? first : before_second ? second : (floats)1;
    return at_start | before_first | before_second | (value_at(s, (floats)1) <= 0);
}

// ---- hits

// Where rays meet the surface: the leaf, the segment in it, and bounds of the root.
typedef struct {
    ints found;
    uints block, octant;
    segment along;
    floats low, high;
} hits;

// Sets the hits of some rays in the walk's leaf.
void set_hits(hits *h, const ints met, const packet *p, const segment *s, const floats low,
              const floats high)
{
    h->found = h->found | met;
    h->block = met ? (uints)p->nodes[p->k] : h->block;
    h->octant = met ? (uints)(p->octant ^ p->mirror) : h->octant;
    h->low = met ? low : h->low, h->high = met ? high : h->high;
    h->along.c0 = met ? s->c0 : h->along.c0, h->along.c1 = met ? s->c1 : h->along.c1;
    h->along.c2 = met ? s->c2 : h->along.c2, h->along.c3 = met ? s->c3 : h->along.c3;
    h->along.start.x = met ? s->start.x : h->along.start.x;
    h->along.start.y = met ? s->start.y : h->along.start.y;
    h->along.start.z = met ? s->start.z : h->along.start.z;
    h->along.step.x = met ? s->step.x : h->along.step.x;
    h->along.step.y = met ? s->step.y : h->along.step.y;
    h->along.step.z = met ? s->step.z : h->along.step.z;
}

// Finds the first root of the packet's rays, which all start on one side of the surface. Returns
// the rays that start inside, if they were taken to start outside.
ints find_hits(hits *h, packet *p, __global const float *voxels, const float offset, PLACES)
{
    const float side = marks == OUTER ? 1 : -1;
    ints inside = 0;
    doubles in, out;
    while (NEXT_LEAF(p, THESE_PLACES, &in, &out)) {
        float v[8];
        vstore8(side * corners_of(voxels, p->nodes[p->k], p->octant ^ p->mirror, offset), 0, v);
        segment s;
        set_segment(&s, p, in, out);
        set_cubic(&s, v, p->mirror);
        ints met = to_ints(in < out) & may_have_root(&s);
        if (!ANY(met))
            continue;
        if (marks == OUTER) {
            const ints starts = met & to_ints(in == p->begin) & (s.c0 < 0);
            inside = inside | starts;
            met = met & !starts;
            p->end = to_longs(starts) ? p->begin : p->end;
        }
        floats low, high;
        met = met & bracket_root(&s, &low, &high);
        if (!ANY(met))
            continue;
        set_hits(h, met, p, &s, low, high);
        p->end = to_longs(met) ? p->begin : p->end;
    }
    return inside;
}

// ---- shading

floats bilinear(const floats a, const floats b, const floats c, const floats d, const floats s,
                const floats t)
{
    const floats low = a + s * (b - a), high = c + s * (d - c);
    return low + t * (high - low);
}

// The unit normals of the surface at the roots, in mirrored axes and towards the viewer. v: the
// corners of each ray's leaf.
floats3 normals_at(const hits *h, const float v[8][LANES], const packet *p)
{
    floats low = h->low, high = h->high;
    for (uint k = 0; k < HALVINGS; ++k) {
        const floats middle = 0.5f * (low + high);
        const ints before = value_at(&h->along, middle) > 0;
        low = before ? middle : low;
        high = before ? high : middle;
    }
    const floats x = h->along.start.x + high * h->along.step.x;
    const floats y = h->along.start.y + high * h->along.step.y;
    const floats z = h->along.start.z + high * h->along.step.z;
    const floats v0 = load(v[0]), v1 = load(v[1]), v2 = load(v[2]), v3 = load(v[3]);
    const floats v4 = load(v[4]), v5 = load(v[5]), v6 = load(v[6]), v7 = load(v[7]);
    const doubles gx = to_doubles(bilinear(v1 - v0, v3 - v2, v5 - v4, v7 - v6, y, z));
    const doubles gy = to_doubles(bilinear(v2 - v0, v3 - v1, v6 - v4, v7 - v5, x, z));
    const doubles gz = to_doubles(bilinear(v4 - v0, v5 - v1, v6 - v2, v7 - v3, x, y));
    const doubles size = sqrt(gx * gx + gy * gy + gz * gz);
    const doubles along = gx * p->speed.x + gy * p->speed.y + gz * p->speed.z;
    const doubles towards = (along > 0 ? (doubles)-1 : (doubles)1) / size;
    const longs steep = size > 0; // a leaf may be 0 everywhere
    const floats3 normals = {
        to_floats(steep ? gx * towards : -p->speed.x),
        to_floats(steep ? gy * towards : -p->speed.y),
        to_floats(steep ? gz * towards : -p->speed.z),
    };
    return normals;
}

// The premultiplied colours and opacities of a packet's pixels.
void draw_hits(const hits *h, const packet *p, const uint *mirrors, const pixel_block *block,
               __global const float *voxels, const float offset, const float3 light,
               const float3 colour, const uint width, __global float *pixels)
{
    float v[8][LANES], x[LANES], y[LANES], z[LANES];
    uint blocks[LANES], octants[LANES];
    int found[LANES];
    store(h->block, blocks), store(h->octant, octants), store(h->found, found);
    EACH_LANE(i)
    {
        float corners[8];
        vstore8(corners_of(voxels, blocks[i], octants[i], offset), 0, corners);
        for (uint k = 0; k < 8; ++k)
            v[k][i] = corners[k ^ mirrors[i]];
    }
    const floats3 n = normals_at(h, v, p);
    store(n.x, x), store(n.y, y), store(n.z, z);
    EACH_LANE(i)
    if (block->exists[i]) {
        const uint mirror = mirrors[i];
        const float bright = brightness(mirror & 1 ? -x[i] : x[i], mirror & 2 ? -y[i] : y[i],
                                        mirror & 4 ? -z[i] : z[i], light.x, light.y, light.z);
        vstore4(found[i] ? (float4)(bright * colour, 1) : (float4)0,
                pixel_of_lane(block, i, width), pixels);
    }
}

// A packet of rays per work-item. camera: origin, direction, right and down; root: the depth of the
// field; pixels: premultiplied colour and opacity.
__kernel void raycast(__global const float *voxels, __global const uint2 *nodes, const int root,
                      __global const double *camera, const uint perspective, const uint width,
                      const uint height, const float offset, const float3 light,
                      const float3 colour, __global float *pixels
#ifdef SEARCH
                      , TABLES
#endif
)
{
    const pixel_block block = pixels_of_packet(width, height);
    doubles3 origin, direction;
    rays_through(&block, camera, perspective, width, height, &origin, &direction);
    packet p;
    uint kinds[LANES], mirrors[LANES], kind;
    int waiting[LANES];
    set_out(&p, origin, direction, perspective, root, mirrors);
    store(load(mirrors), kinds);
    store(load(block.exists), waiting);
    const doubles end = p.end;
    hits h = {0};
    for (ints rays = next_kind(waiting, kinds, &kind); ANY(rays);
         rays = next_kind(waiting, kinds, &kind)) {
        p.end = to_longs(rays) ? end : p.begin;
        start_walk(&p, kind & 7, root);
        const uint marks = kind & INSIDE ? INNER : OUTER;
        const ints inside = find_hits(&h, &p, voxels, offset, THESE_PLACES);
        store(load(waiting) | inside, waiting);
        store(inside ? load(kinds) | INSIDE : load(kinds), kinds);
    }
    draw_hits(&h, &p, mirrors, &block, voxels, offset, light, colour, width, pixels);
}
