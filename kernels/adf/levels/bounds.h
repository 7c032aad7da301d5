// Bounds on the error of a field in the child of a block, from the triangles that may be nearest there.

#include "adf/levels/rivals.h"

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

double bound_apart(const child_list *list, const ways *at, double8 size, double edge)
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

// Upper bounds of the same errors, above and below, from the distances to sixteen triangles in single
// precision, and the largest doubt of a distance. If `all`, no other triangle may be nearest in the cell;
// otherwise the triangles nearest to its corners are among the sixteen, and the bound below is general.
//
// A triangle is no nearer than its plane. So on one side of it, the distance to the triangle grows by
// no more than its largest excess over that to the plane at a corner: by 0 over the face.
float3 narrow_bounds(const narrow_triangles *n, bool all, const child_corners *c, const float *size,
                     float edge)
{
    float16 d[8], excess = -INFINITY, shortfall = -INFINITY, least = INFINITY;
    float16 low = INFINITY, high = -INFINITY, beyond = 0;
    int16 one = -1, features;
    const float16 *t = n->t, scale = sqrt(t[11]) * sqrt(t[12]);
    const float16 nx = (t[4] * t[8] - t[5] * t[7]) * scale;
    const float16 ny = (t[5] * t[6] - t[3] * t[8]) * scale;
    const float16 nz = (t[3] * t[7] - t[4] * t[6]) * scale;
    for (uint i = 0; i < 8; ++i) {
        narrow_ways way;
        int16 feature;
        d[i] = sqrt(narrow_squares(n, c->at[0][i], c->at[1][i], c->at[2][i], &way, &feature));
        features = i == 0 ? feature : features;
        const float16 height = nx * (c->at[0][i] - t[0]) + ny * (c->at[1][i] - t[1]) +
                               nz * (c->at[2][i] - t[2]);
        low = lesser(low, height);
        high = greater(high, height);
        beyond = greater(beyond, d[i] - fabs(height));
        least = lesser(least, d[i]);
        excess = greater(excess, d[i] - size[i]);
        shortfall = greater(shortfall, size[i] - (all ? d[i] : (float16)lowest_narrow(d[i])));
        one &= feature == features;
    }
    float16 across = 0.5f, flat = INFINITY;
    if (all) {
        across = (one & (features < A)) ? (float16)0.25f : (float16)0.5f;
        flat = (low > -n->doubt | high < n->doubt) ? beyond : INFINITY;
    } else {
        least = lowest_narrow(least);
    }
    shortfall += lesser(narrow_bend(least - n->doubt, across, edge), flat);
    float above = lowest_narrow(excess), excesses[16];
    vstore16(excess, 0, excesses);
    uint lane = 0;
    while (lane < 15 && excesses[lane] != above)
        ++lane;
    excess = -INFINITY;
    for (uint i = 0; i < 8; ++i)
        excess = greater(excess, 0.5f * (((float *)&d[i])[lane] + d[i]) - size[i]);
    above = fmin(above, lowest_narrow(excess));
    return (float3)(above, highest_narrow(shortfall), highest_narrow(n->doubt));
}

// An upper bound of what bound_apart returns, and the largest doubt: from the list, or if it is long
// from the child's rivals.
float2 narrow_bound_apart(const child_list *list, const child_corners *c, const rivals *known,
                          const float *size, float edge)
{
    float3 found = (float3)(INFINITY, 0, 0);
    const bool all = list->count <= WALKED;
    for (uint j = from(list, list->begin); all && j < list->end;) {
        uint slots[16];
        j = next_sixteen(list, j, slots);
        const narrow_triangles n = sixteen_narrow(&list->scene, slots, c->centre, edge);
        const float3 some = narrow_bounds(&n, true, c, size, edge);
        found = (float3)(fmin(found.x, some.x), fmax(found.yz, some.yz));
    }
    if (!all)
        found = narrow_bounds(&known->triangles, false, c, size, edge);
    return (float2)(fmax(found.x, found.y) + 4 * found.z, found.z);
}

#ifdef CLOSED
// The same bounds in cells with triangles, for signed distances of a closed mesh, of magnitude at
// most `farthest`. If all normals are within an angle of the first, so is the direction to the
// nearest point. Each distance is then the distance to a triangle's plane, divided by a cosine of
// at least that of twice the angle.
double bound_passed(const child_list *list, const ways *at, double8 field, double farthest)
{
    double3 axis = 0;
    double cosine = 1, apart = 0;
    const scene_of_lists *scene = &list->scene;
    for (uint j = from(list, list->begin); j < list->end && cosine > 0.75; j = from(list, j + 1)) {
        const triangle t = triangle_at(scene, j);
        const uint name = scene->names[scene->items[j]];
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
#endif
