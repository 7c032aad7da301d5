// Computes exact distances at the vertices of a level's blocks, and the triangles that their children
// need. Host side: voxtool/adf/construction.py.

#include "adf/construction/bundles.h"

// The vertices of a block; upper bounds of the distances of its rivals, the triangles with a side nearest
// to the centres of the children, at the vertices, and which rival is which child's; upper bounds of the
// least distances at the vertices: with FLAT, to triangles with a side; and whether the list is long.
typedef struct {
    narrow_vertices at;
    float rivals[8][POINTS], least[POINTS];
    uint rival_of[8], count;
    bool bundled;
} block_vertices;

// Sixteen triangles of a list, with their distances and ways to the centres of the children.
typedef struct {
    narrow_triangles triangles;
    float16 distances[8];
    narrow_ways ways[8];
} about_middles;

float quarter(uint child, uint axis, float edge)
{
    return child >> axis & 1 ? 0.25f * edge : -0.25f * edge;
}

// Computes distances and ways from sixteen triangles of a list to the centres of some children; bit k
// of `children` is set for child k.
void see_middles(const scene_of_lists *scene, uint place, uint end, float3 centre, float edge,
                 uint children, about_middles *seen)
{
    seen->triangles = sixteen_at(scene, place, end, centre, edge);
    for (uint k = 0; k < 8; ++k) {
        int16 feature;
        if (children >> k & 1)
            seen->distances[k] = sqrt(narrow_squares(&seen->triangles, quarter(k, 0, edge),
                                                     quarter(k, 1, edge), quarter(k, 2, edge),
                                                     &seen->ways[k], &feature));
    }
}

ball_ways ball_ways_to_middle(const bundles *all, uint bundle, uint child, float edge)
{
    return ball_ways_to(all, bundle, quarter(child, 0, edge), quarter(child, 1, edge),
                        quarter(child, 2, edge));
}

// Puts balls about the bundles of a list; most[k] = an upper bound of the least distance to the centre
// of child k.
void set_bundles(const bundles *all, const scene_of_lists *scene, uint begin, uint end, float3 centre,
                 float edge, float *most)
{
    for (uint i = 0; i < all->count; ++i) {
        const narrow_triangles n = sixteen_at(scene, begin + 16 * i, end, centre, edge);
        enclose(all, i, &n);
    }
    for (uint k = 0; k < 8; ++k) {
        float16 least = INFINITY;
        for (uint i = 0; i < all->count; i += 16) {
            const ball_ways to = ball_ways_to_middle(all, i, k, edge);
            least = lesser(least, to.exist ? to.length + to.radius : INFINITY);
        }
        most[k] = lowest_narrow(least);
    }
}

// open[i] = the children, a bit each, to whose centres a triangle of the i-th of sixteen bundles may be
// as near as `most`.
void bundles_near_middles(const bundles *all, uint bundle, float edge, const float *most, int *open)
{
    int16 bits = 0;
    for (uint k = 0; k < 8; ++k) {
        const ball_ways to = ball_ways_to_middle(all, bundle, k, edge);
        bits |= to.exist & (to.length - to.radius <= most[k]) & 1 << k;
    }
    vstore16(bits, 0, open);
}

// Which of sixteen triangles of a list have a side.
int16 sided_at(const scene_of_lists *scene, uint place, uint end)
{
#ifdef FLAT
    int sides[16];
    for (uint i = 0; i < 16; ++i)
        sides[i] = has_side(scene, scene->items[min(place + i, end - 1)]) ? -1 : 0;
    return vload16(0, sides);
#else
    return -1;
#endif
}

// The triangles of a list with a side that are nearest to the centres of the children, by distances in
// single precision, and upper bounds of the least distances to all. Puts balls about the bundles of a
// long list; leaves the triangles of a list of up to sixteen in `seen`.
NOINLINE void nearest_to_middles(const scene_of_lists *scene, uint begin, uint end, float3 centre, float edge,
                        const bundles *all, about_middles *seen, uint *nearest_of, float *least_of)
{
    float16 least[8], least_sided[8];
    int16 places[8];
    float most[8];
    for (uint i = 0; i < 8; ++i) {
        least[i] = least_sided[i] = INFINITY;
        places[i] = (int16)(int)NO_TRIANGLE;
    }
    set_bundles(all, scene, begin, end, centre, edge, most);
    int open[16];
    for (uint j = begin; j < end; j += 16) {
        const uint bundle = (j - begin) / 16;
        if (all->count && bundle % 16 == 0)
            bundles_near_middles(all, bundle, edge, most, open);
        const uint children = all->count ? (uint)open[bundle % 16] : 255u;
        if (children == 0)
            continue;
        see_middles(scene, j, end, centre, edge, children, seen);
        const int16 sided = sided_at(scene, j, end);
        for (uint i = 0; i < 8; ++i)
            if (children >> i & 1) {
                const float16 d = seen->distances[i] + seen->triangles.doubt;
                const int16 nearer = sided & (d < least_sided[i]);
                least[i] = lesser(least[i], d);
                least_sided[i] = nearer ? d : least_sided[i];
                places[i] = nearer ? (int16)(int)j + SIXTEEN : places[i];
            }
    }
    for (uint i = 0; i < 8; ++i) {
        float distances[16];
        int place[16];
        vstore16(least_sided[i], 0, distances);
        vstore16(places[i], 0, place);
        uint best = 0;
        for (uint lane = 1; lane < 16; ++lane)
            best = distances[lane] < distances[best] ? lane : best;
        least_of[i] = lowest_narrow(least[i]);
        nearest_of[i] = (uint)place[best] == NO_TRIANGLE ? NO_TRIANGLE : min((uint)place[best], end - 1);
    }
}

float16 distances_to_vertices(const narrow_triangles *n, const block_vertices *block, uint half_of)
{
    narrow_ways way;
    int16 feature;
    return sqrt(narrow_squares(n, vload16(half_of, block->at.x), vload16(half_of, block->at.y),
                               vload16(half_of, block->at.z), &way, &feature));
}

// Sets the rivals, each triangle once.
NOINLINE void set_rivals(const scene_of_lists *scene, const uint *nearest_of, float3 centre, float edge,
                block_vertices *block)
{
    block->count = 0;
    for (uint i = 0; i < POINTS; ++i)
        block->least[i] = INFINITY;
    for (uint k = 0; k < 8; ++k) {
        uint same = 0;
        while (nearest_of[same] != nearest_of[k])
            ++same;
        block->rival_of[k] = same < k ? block->rival_of[same] : block->count;
        if (same < k)
            continue;
        if (nearest_of[k] == NO_TRIANGLE) {
            for (uint i = 0; i < POINTS; ++i)
                block->rivals[block->count][i] = INFINITY;
            ++block->count;
            continue;
        }
        const uint slot = scene->items[nearest_of[k]];
        const narrow_triangles n = one_narrow(scene, slot, centre, edge);
        for (uint i = 0; i < 2; ++i) {
            const float16 most = distances_to_vertices(&n, block, i) + n.doubt;
            vstore16(most, i, block->rivals[block->count]);
            vstore16(lesser(most, vload16(i, block->least)), i, block->least);
        }
        ++block->count;
    }
}

// The tangents of sixteen triangles' distances at the centre of a child: lower bounds of the values
// there, and the changes along half of the child's edge. The direction of a way is off by 2 doubt / d,
// and a corner is less than half of the block's edge away. A triangle through the centre is needed
// whatever its tangent.
typedef struct {
    float16 base, x, y, z;
} tangents;

tangents tangents_at(float16 d, const narrow_ways *way, float16 doubt, float edge)
{
    const int16 apart = d > 0x1p-10f * edge;
    const float16 share = apart ? edge / d : 0.0f, slope = 0.25f * share;
    const tangents at = {apart ? d - doubt * (3 + share) : -INFINITY, slope * way->x, slope * way->y,
                         slope * way->z};
    return at;
}

// The triangles that a child needs; in a short list also those that may be nearest to one of its corners.
NOINLINE int16 needed_by(uint child, const tangents *at, const block_vertices *block, int16 *near)
{
    float16 corners[8];
    int16 open = 0;
    for (uint i = 0; i < 8; ++i) {
        corners[i] = at->base + (i & 1 ? at->x : -at->x) + (i & 2 ? at->y : -at->y) +
                     (i & 4 ? at->z : -at->z);
        open |= corners[i] <= block->rivals[block->rival_of[child]][CORNERS[8 * child + i]];
    }
    if (block->bundled) // rivals.h prunes long lists further
        return open;
    int16 nearest_to_one = 0;
    for (uint i = 0; i < 8; ++i)
        nearest_to_one |= corners[i] <= block->least[CORNERS[8 * child + i]];
    *near |= nearest_to_one;
    open &= ~nearest_to_one; // which is below all rivals there
    for (uint rival = 0; rival < block->count && any(open); ++rival) {
        int16 some = 0;
        for (uint i = 0; i < 8; ++i)
            some |= corners[i] <= block->rivals[rival][CORNERS[8 * child + i]];
        open &= some;
    }
    return nearest_to_one | open;
}

// open[i] = the children, a bit each, for which a triangle of the i-th of sixteen bundles may matter: it
// may be needed, or nearest to a corner or the centre.
void bundles_needed(const bundles *all, uint bundle, float edge, const block_vertices *block,
                    const float *least_of, int *open)
{
    int16 bits = 0;
    for (uint k = 0; k < 8; ++k) {
        ball_ways to = ball_ways_to_middle(all, bundle, k, edge);
        const float16 d = to.length - to.radius, share = d / to.length;
        to.way.x *= share, to.way.y *= share, to.way.z *= share;
        const tangents at = tangents_at(d, &to.way, DOUBT * (to.length + edge), edge);
        int16 near = 0;
        const int16 needs = needed_by(k, &at, block, &near);
        bits |= to.exist & (needs | (d <= least_of[k])) & 1 << k;
    }
    vstore16(bits, 0, open);
}

// open[i] = the vertices, a bit each, to which a triangle of the i-th of sixteen bundles may be nearest.
void bundles_near_vertices(const bundles *all, uint bundle, const block_vertices *block, int *open)
{
    int16 bits = 0;
    for (uint i = 0; i < 27; ++i) {
        const ball_ways to =
            ball_ways_to(all, bundle, block->at.x[i], block->at.y[i], block->at.z[i]);
        bits |= to.exist & (to.length - to.radius <= block->least[i]) & 1 << i;
    }
    vstore16(bits, 0, open);
}

// Updates the nearest triangles at these vertices, a bit each, with a bundle.
NOINLINE void look_at_bundle(const scene_of_lists *scene, uint place, uint end, const narrow_triangles *n,
                    uint vertices, const ways *points, block_vertices *block, nearest *found)
{
    const uint count = min(end - place, 16u);
    const int16 sided = sided_at(scene, place, end);
    int16 groups = 0;
    for (uint i = 0; i < 27; ++i) {
        if (!(vertices >> i & 1))
            continue;
        narrow_ways way;
        int16 feature;
        const float16 d =
            sqrt(narrow_squares(n, block->at.x[i], block->at.y[i], block->at.z[i], &way, &feature));
        groups |= (d - n->doubt <= block->least[i]) & 1 << i / 8;
        block->least[i] = fmin(block->least[i], lowest_narrow(sided ? d + n->doubt : (float16)INFINITY));
    }
    int near[16];
    vstore16(groups, 0, near);
    for (uint i = 0; i < count; ++i) {
        if (near[i] == 0)
            continue;
        const triangle t = triangle_at(scene, place + i);
        for (uint k = 0; k < POINTS / 8; ++k)
            if (near[i] >> k & 1)
                look_at(scene, place + i, squares_to(&t, &points[k]), &found[k]);
    }
}

// Updates the nearest triangles at the vertices with the triangle at an index of the lists, where it
// may be nearer.
NOINLINE void look_at_vertices(const scene_of_lists *scene, uint place, float3 centre, float edge,
                      const ways *points, block_vertices *block, nearest *found)
{
    const uint slot = scene->items[place];
    const narrow_triangles n = one_narrow(scene, slot, centre, edge);
    for (uint i = 0; i < 2; ++i) {
        const float16 d = distances_to_vertices(&n, block, i);
        const float16 least = vload16(i, block->least);
        const int16 nearer = d - n.doubt <= least;
        if (has_side(scene, slot))
            vstore16(lesser(d + n.doubt, least), i, block->least);
        for (uint k = 2 * i; k < 2 * i + 2; ++k)
            if (k & 1 ? any(nearer.hi) : any(nearer.lo)) {
                const triangle t = triangle_at(scene, place);
                look_at(scene, place, squares_to(&t, &points[k]), &found[k]);
            }
    }
}

uint sum_of(int16 counts)
{
    const int8 a = counts.lo + counts.hi;
    const int4 b = a.lo + a.hi;
    const int2 c = b.lo + b.hi;
    return (uint)(c.x + c.y);
}

// values[27 b + i] = distance at vertex i of block b, of cell identifiers[b]; places[27 b + i] =
// index in the lists of the nearest triangle, and sided[27 b + i] of the nearest with a side;
// centres[8 b + k] = distance at the centre of child k. Bit k of masks[j] is set if child k needs item
// j of the list. needed[8 b + k] = number of triangles that child k needs.
//
// The distance to a triangle is convex, so its tangent bounds it from below. Inside a cell, the
// trilinear interpolation of its corner values bounds it from above. So a triangle is nowhere
// nearest in a child if its tangent at the child's centre exceeds, at all corners, the distance to
// some other triangle. Only triangles with a side are compared with it, because the sign needs the
// nearest triangle with a side. The candidates are those nearest to the centres of the children.
__kernel void sample_blocks(const uint n, LISTS SIDES, __global double *values,
                            __global double *centres, __global uint *places,
#ifdef FLAT
                            __global uint *sided,
#endif
                            __global uchar *masks, __global uint *needed, __global float *balls,
                            const uint row)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const scene_of_lists scene = {SCENE_VALUES};
    const uint begin = begins[gid], end = begins[gid + 1];
    const uint3 cell = cell_of(identifiers[gid], level);
    const float edge = (float)(extent / (1ul << level) * 2);
    const ways middles = lattice_points(4 * cell, MIDDLES, 0, level + 2, extent);
    ways points[POINTS / 8];
    for (uint k = 0; k < POINTS / 8; ++k)
        points[k] = lattice_points(2 * cell, VERTICES, k, level + 1, extent);
    block_vertices block;
    block.at = narrow_vertices_of(points);
    const float3 centre = block.at.centre;
    uint nearest_of[8];
    float least_of[8];
    about_middles seen;
    const bundles all = bundles_of(balls, row, gid, begin, end);
    nearest_to_middles(&scene, begin, end, centre, edge, &all, &seen, nearest_of, least_of);
    set_rivals(&scene, nearest_of, centre, edge, &block);
    block.bundled = all.count > 0;
    nearest found[POINTS / 8], central = nothing_found();
    int16 total[8];
    for (uint k = 0; k < POINTS / 8; ++k)
        found[k] = nothing_found();
    for (uint k = 0; k < 8; ++k)
        total[k] = 0;
    int open[16], open_vertices[16];
    for (uint j = begin; j < end; j += 16) {
        const uint bundle = (j - begin) / 16;
        if (all.count && bundle % 16 == 0) {
            bundles_needed(&all, bundle, edge, &block, least_of, open);
            bundles_near_vertices(&all, bundle, &block, open_vertices);
        }
        const uint children = all.count ? (uint)open[bundle % 16] : 255u;
        const uint vertices = all.count ? (uint)open_vertices[bundle % 16] : 0;
        if ((children | vertices) && end - begin > 16) // otherwise they are seen
            see_middles(&scene, j, end, centre, edge, children, &seen);
        const float16 doubt = seen.triangles.doubt;
        int16 bits = 0, near = 0, middle = 0;
        const int16 exist = SIXTEEN < (int)(end - j);
        for (uint k = 0; k < 8; ++k) {
            if (!(children >> k & 1))
                continue;
            const float16 d = seen.distances[k];
            const tangents at = tangents_at(d, &seen.ways[k], doubt, edge);
            const int16 needs = exist & needed_by(k, &at, &block, &near);
            middle |= d - doubt <= least_of[k];
            bits |= needs & 1 << k;
            total[k] += needs & 1;
        }
        if (vertices)
            look_at_bundle(&scene, j, end, &seen.triangles, vertices, points, &block, found);
        int bit[16], nears[16], central_to[16];
        vstore16(bits, 0, bit);
        vstore16(near, 0, nears);
        vstore16(middle, 0, central_to);
        for (uint i = 0; i < min(end - j, 16u); ++i) {
            masks[j + i] = (uchar)bit[i];
            if (nears[i] && all.count == 0)
                look_at_vertices(&scene, j + i, centre, edge, points, &block, found);
            if (central_to[i]) {
                const triangle t = triangle_at(&scene, j + i);
                look_at(&scene, j + i, squares_to(&t, &middles), &central);
            }
        }
    }
    vstore8(sqrt(central.square), gid, centres);
    for (uint k = 0; k < 8; ++k)
        needed[8 * (size_t)gid + k] = sum_of(total[k]);
    for (uint k = 0; k < POINTS / 8; ++k) {
        double distances[8];
        long which[8];
        vstore8(sqrt(found[k].square), 0, distances);
        vstore8(found[k].which, 0, which);
        for (uint i = 0; i < 8 && 8 * k + i < 27; ++i) {
            values[27 * (size_t)gid + 8 * k + i] = distances[i];
            places[27 * (size_t)gid + 8 * k + i] = (uint)which[i];
        }
#ifdef FLAT
        vstore8(found[k].sided, 0, which);
        for (uint i = 0; i < 8 && 8 * k + i < 27; ++i)
            sided[27 * (size_t)gid + 8 * k + i] = (uint)which[i];
#endif
    }
}
