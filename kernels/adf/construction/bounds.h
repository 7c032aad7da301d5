// Bounds on the error of a field in the child of a block, from the triangles that may be nearest there.

#include "adf/construction/rivals.h"

// Upper bounds on the error of the interpolated unsigned corner distances in a cell, above and
// below the distance to the mesh; and the corner distances to the triangle with the best bound from
// above.
//
// The distance is the minimum of convex functions d_t. So it never exceeds the interpolation of any
// d_t, or of the mean of two. Interpolation is a weighted mean over corners v. With q the nearest
// point to p, n the direction from q to p, and u, w the components of v - p along and across n:
// d_t(v) <= |v - q| <= d_t(p) + u + w^2 / (2 (d_t(p) + u)). The mean of u is 0. The mean of w^2 is
// at most edge^2 / 2; it is at most edge^2 / 4 beside an edge, along which q may slide, and 0 on
// one side of a face. The mean of |v - q| is also at most the root of its mean square.
typedef struct {
    double above, below;
    double8 best;
} bounds_apart;

// Updates the bounds with a triangle, from its corner distances.
void bound_by(bounds_apart *bounds, double8 d, const ways *way, MASKS feature, double8 size,
              double edge)
{
    const double excess = highest(d - size);
    bounds->best = excess < bounds->above ? d : bounds->best;
    bounds->above = excess < bounds->above ? excess : bounds->above;
    const bool one = all(feature == (MASKS)feature.s0), edge_alone = one && feature.s0 < A;
    double bend = 0;
    const bool aside = all(way->x * way->x.s0 + way->y * way->y.s0 + way->z * way->z.s0 > 0);
    if (!(one && feature.s0 == FACE && aside)) {
        const double squares = edge * edge, low = lowest(d) - edge * HALF_DIAGONAL;
        const double near = low > 0 ? low : 0, across = edge_alone ? 0.25 : 0.5;
        bend = sqrt(near * near + (across + 0.25) * squares) - near;
        const double ahead = low - 2 * edge * HALF_DIAGONAL; // lower bound of d_t(p) + u
        const double curved = across * squares / (2 * ahead);
        bend = ahead > 0 && curved < bend ? curved : bend;
    }
    const double shortfall = highest(size - d) + bend;
    bounds->below = shortfall > bounds->below ? shortfall : bounds->below;
}

NOINLINE double bound_apart(const child_list *list, const ways *at, double8 size, double edge)
{
    bounds_apart bounds = {INFINITY, 0, 0};
    double8 distances[KEPT];
    uint count = 0;
    for (uint j = from(list, list->begin); j < list->end; j = from(list, j + 1)) {
        const triangle t = triangle_at(&list->scene, j);
        ways way;
        MASKS feature;
        const double8 d = sqrt(triangle_ways(&t, at->x, at->y, at->z, &way, &feature));
        bound_by(&bounds, d, &way, feature, size, edge);
        if (count < KEPT)
            distances[count++] = d;
    }
    for (uint i = 0; i < count && bounds.above > bounds.below; ++i) {
        const double excess = highest(0.5 * (bounds.best + distances[i]) - size);
        bounds.above = excess < bounds.above ? excess : bounds.above;
    }
    return bounds.above > bounds.below ? bounds.above : bounds.below;
}

// The growth of the distances to triangles over a cell, as of bound_by, from the least at a corner.
float16 narrow_bend(float16 least, float16 across, float edge)
{
    const float squares = edge * edge, radius = edge * (float)HALF_DIAGONAL;
    const float16 low = least - radius, near = low > 0.0f ? low : 0.0f, ahead = low - 2 * radius;
    const float16 bend = sqrt(near * near + (across + 0.25f) * squares) - near;
    const float16 curved = across * squares / (2 * ahead);
    return ahead > 0.0f && curved < bend ? curved : bend;
}

// An upper bound of the error above, from the excesses of sixteen triangles' distances over the sizes at
// eight corners: those of each triangle, and those of the mean of each and the best.
float narrow_above(const float16 *excess_at[8])
{
    float16 excess = *excess_at[0];
    for (uint i = 1; i < 8; ++i)
        excess = greater(excess, *excess_at[i]);
    const float above = lowest_narrow(excess);
    float excesses[16];
    vstore16(excess, 0, excesses);
    uint lane = 0;
    while (lane < 15 && excesses[lane] != above)
        ++lane;
    float16 means = -INFINITY;
    for (uint i = 0; i < 8; ++i)
        means = greater(means, 0.5f * (((const float *)excess_at[i])[lane] + *excess_at[i]));
    return fmin(above, lowest_narrow(means));
}

// Upper bounds of the same errors, above and below, in a child that has many triangles, and the largest
// doubt of a distance: from its rivals, of which one is nearest to each corner. The bound below is
// general.
NOINLINE float3 bounds_by_rivals(const rivals *known, const child_corners *c, const float *sizes, float edge)
{
    const narrow_triangles *n = &known->triangles;
    float16 excess[8], least = INFINITY;
    const float16 *excess_at[8];
    float below = -INFINITY;
    for (uint i = 0; i < 8; ++i) {
        narrow_ways way;
        int16 feature;
        const float16 d =
            sqrt(narrow_squares(n, c->at[0][i], c->at[1][i], c->at[2][i], &way, &feature));
        least = lesser(least, d);
        below = fmax(below, sizes[i] - lowest_narrow(d));
        excess[i] = d - sizes[i];
        excess_at[i] = &excess[i];
    }
    const float16 low = lowest_narrow(least) - n->doubt;
    below += highest_narrow(narrow_bend(low, 0.5f, edge));
    return (float3)(narrow_above(excess_at), below, highest_narrow(n->doubt));
}

// out[k] = the values at the corners of child k of a block, combined, from those at its 27 vertices.
#define IN_CHILDREN(name, type, combine)                                                               \
    void name(const type *at, type *out)                                                               \
    {                                                                                                  \
        type x[18], y[12];                                                                             \
        for (uint i = 0; i < 18; ++i)                                                                  \
            x[i] = combine(at[i / 2 * 3 + i % 2], at[i / 2 * 3 + i % 2 + 1]);                          \
        for (uint i = 0; i < 12; ++i)                                                                  \
            y[i] = combine(x[i / 4 * 6 + i % 4], x[i / 4 * 6 + i % 4 + 2]);                            \
        for (uint i = 0; i < 8; ++i)                                                                   \
            out[i] = combine(y[i], y[i + 4]);                                                          \
    }

int16 common(int16 a, int16 b)
{
    return a & b;
}

IN_CHILDREN(least_in_children, float16, lesser)
IN_CHILDREN(greatest_in_children, float16, greater)
IN_CHILDREN(common_in_children, int16, common)

// A block's vertices, the magnitudes of the field there and, once `known`, upper bounds of what
// bound_apart returns for its children, without the largest doubt of a distance.
typedef struct {
    bool known;
    narrow_vertices at;
    float sizes[27], of[8], doubt;
} bounded_block;

// Lowers the upper bounds of the errors above in the children of a block, and raises those below, by
// sixteen triangles; bits: which children need each of them.
//
// A triangle is no nearer than its plane. So on one side of it, the distance to the triangle grows by
// no more than its largest excess over that to the plane at a corner: by 0 over the face.
NOINLINE void bound_children_by(const narrow_triangles *n, int16 bits, const bounded_block *block,
                       float edge, float *above, float *below)
{
    float16 distance[27], excess[27], height[27], beyond[27];
    int16 edges[27];
    const float16 *t = n->t, scale = sqrt(t[11]) * sqrt(t[12]);
    const float16 nx = (t[4] * t[8] - t[5] * t[7]) * scale;
    const float16 ny = (t[5] * t[6] - t[3] * t[8]) * scale;
    const float16 nz = (t[3] * t[7] - t[4] * t[6]) * scale;
    for (uint i = 0; i < 27; ++i) {
        const float x = block->at.x[i], y = block->at.y[i], z = block->at.z[i];
        narrow_ways way;
        int16 feature;
        distance[i] = sqrt(narrow_squares(n, x, y, z, &way, &feature));
        excess[i] = distance[i] - block->sizes[i];
        height[i] = nx * (x - t[0]) + ny * (y - t[1]) + nz * (z - t[2]);
        beyond[i] = distance[i] - fabs(height[i]);
        edges[i] = feature < A ? (int16)1 << feature : 0;
    }
    float16 least[8], lowest_excess[8], low[8], high[8], farthest[8];
    int16 edge_alone[8];
    least_in_children(distance, least);
    least_in_children(excess, lowest_excess);
    least_in_children(height, low);
    greatest_in_children(height, high);
    greatest_in_children(beyond, farthest);
    common_in_children(edges, edge_alone);
    for (uint k = 0; k < 8; ++k) {
        const float16 across = edge_alone[k] != 0 ? (float16)0.25f : (float16)0.5f;
        const float16 flat =
            (low[k] > -n->doubt | high[k] < n->doubt) ? farthest[k] : (float16)INFINITY;
        const float16 bend = lesser(narrow_bend(least[k] - n->doubt, across, edge), flat);
        const int16 needed = (bits >> (int)k & 1) != 0;
        below[k] = fmax(below[k], highest_narrow(needed ? bend - lowest_excess[k] : -INFINITY));
        const float16 *excess_at[8];
        for (uint i = 0; i < 8; ++i)
            excess_at[i] = &excess[CORNERS[8 * k + i]];
        above[k] = fmin(above[k], narrow_above(excess_at));
    }
}

// Sets the bounds of a block's children from its list; edge: the edge of a child.
NOINLINE void bound_children(const child_list *list, float edge, bounded_block *block)
{
    float above[8], below[8];
    for (uint k = 0; k < 8; ++k)
        above[k] = INFINITY, below[k] = 0;
    block->doubt = 0;
    for (uint j = list->begin; j < list->end; j += 16) {
        const narrow_triangles n = sixteen_at(&list->scene, j, list->end, block->at.centre, 2 * edge);
        int bits[16];
        for (uint i = 0; i < 16; ++i)
            bits[i] = j + i < list->end ? list->masks[j + i] : 0;
        bound_children_by(&n, vload16(0, bits), block, edge, above, below);
        block->doubt = fmax(block->doubt, highest_narrow(n.doubt));
    }
    for (uint k = 0; k < 8; ++k)
        block->of[k] = fmax(above[k], below[k]);
    block->known = true;
}

#ifdef SIGNED
// The bounds in cells with triangles, for signed distances of a closed mesh, of magnitude at
// most `farthest`. If all normals are within an angle of the first, so is the direction to the
// nearest point. Each distance is then the distance to a triangle's plane, divided by a cosine of
// at least that of twice the angle. If they are not, the bound is infinite: the cell may have several
// sheets.
NOINLINE double bound_passed(const child_list *list, const ways *at, double8 field, double farthest)
{
    double3 axis = 0;
    double cosine = 1, apart = 0;
    const scene_of_lists *scene = &list->scene;
    for (uint j = from(list, list->begin); j < list->end && cosine > 0.75; j = from(list, j + 1)) {
        const triangle t = triangle_at(scene, j);
        const uint name = scene->names[scene->items[j]];
        if (name == NAMELESS)
            return INFINITY;
        double3 normal = normal_of(name, FACE, scene->features, scene->normals);
        const double square = normal.x * normal.x + normal.y * normal.y + normal.z * normal.z;
        if (square == 0)
            return INFINITY;
        normal /= sqrt(square);
        if (axis.x == 0 && axis.y == 0 && axis.z == 0)
            axis = normal;
        const double c = axis.x * normal.x + axis.y * normal.y + axis.z * normal.z;
        cosine = c < cosine ? c : cosine;
        const double8 plane =
            (at->x - t.ax) * normal.x + (at->y - t.ay) * normal.y + (at->z - t.az) * normal.z;
        const double misses = highest(absolute(plane - field));
        apart = misses > apart ? misses : apart;
    }
    return cosine > 0.75 ? apart + 2 * (1 - cosine * cosine) * farthest : INFINITY;
}

// Whether two sheets pass a cell that face away from each other: the normal of some triangle is 120
// degrees or more from that of the first.
bool opposed(const child_list *list)
{
    const scene_of_lists *scene = &list->scene;
    double3 first = 0;
    for (uint j = from(list, list->begin); j < list->end; j = from(list, j + 1)) {
        const uint name = scene->names[scene->items[j]];
        if (name == NAMELESS)
            continue;
        const double3 n = normal_of(name, FACE, scene->features, scene->normals);
        const double square = n.x * n.x + n.y * n.y + n.z * n.z;
        if (first.x == 0 && first.y == 0 && first.z == 0 && square > 0)
            first = n / sqrt(square);
        if (first.x * n.x + first.y * n.y + first.z * n.z < -0.5 * sqrt(square))
            return true;
    }
    return false;
}
#endif
