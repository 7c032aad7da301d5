// Computes the errors of a level's children and marks the children to refine. Host side:
// voxtool/adf/construction.py.

#include "adf/construction/bounds.h"

// voxels = values, in units of the cube's edge.
__kernel void store_voxels(const uint n, __global const double *values, const double extent,
                           __global float *voxels)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        voxels[gid] = (float)(values[gid] / (2 * extent));
}

// ---- children

// The code of a bound, in cube edges: the smallest code whose value is at least the bound.
uchar code_of(double bound, __global const double *bounds)
{
    uint low = 1, high = JUMP; // JUMP also encodes bounds over 1
    while (low < high) {
        const uint middle = (low + high) / 2;
        if (bounds[middle] >= bound)
            high = middle;
        else
            low = middle + 1;
    }
    return (uchar)low;
}

// Whether the distances at the corners of a cell differ by more than is possible without a sign
// discontinuity, or its corners have several signs though no triangle passes: hanging corners take
// those of leaves with a discontinuity.
bool jumps(double8 field, double8 distances, double edge, bool passed)
{
    const ulong8 corner = (ulong8)(0, 1, 2, 3, 4, 5, 6, 7);
    const double *corners = (const double *)&distances;
    if (!passed && any(field < 0.0) && any(field >= 0.0))
        return true;
    for (uint i = 0; i < 8; ++i) {
        const double8 apart = distances - corners[i];
        const double8 far = edge * edge * (1 + 0x1p-20) * convert_double8(popcount(corner ^ (ulong)i));
        const long8 unlike = (distances < 0.0) != (long8)(corners[i] < 0 ? -1 : 0);
        if (any(apart * apart > (unlike ? far : 3 * far)))
            return true;
    }
    return false;
}

// The refinement parameters, in the frame: tolerance, displacement of points by rounding, and width
// of the refined band around the surface; whether children can be refined, whether they must be
// where triangles pass, and where their bounds exceed the tolerance, whether all samples are taken, and
// the error beyond which children along the medial axis are left.
#define LIMITS                                                                                         \
    const double tolerance, const double misplaced, const double band, const uint can_refine,          \
        const uint refine_coarse, const uint guarantee, const uint thorough, const double hopeless

// A child of a block and its state. corners: its distances; radius: half of its diagonal; middle:
// the distance at its centre; rounding: of bounds; gap: the growth of the error between samples;
// passed: triangles may pass through it; in_doubt: the sign of a corner is unknown; beyond: it lies
// beyond the band; may_refine: it may have children; unlike: the sign of a sample is not the mesh's;
// entered: a point of the mesh is in the cell; thin: sheets pass that face away from each other, whose
// signs it does not have; left: refinement is vain. error: the largest error known; stray: that at a corner; bound: the error
// bound.
typedef struct {
    uint3 cell;
    uint level;
    child_corners at;
    rivals known; // by which its list is pruned
    double corners[8], extent, edge, slope, radius, middle, rounding, gap, error, stray, bound;
    bool in_doubt, passed, beyond, may_refine, unlike, entered, thin, left;
} child_cell;

// Whether refining a child cannot reach the tolerance: it is more than BESIDE edges from the mesh, and
// either a corner takes the value of a leaf that was left, or its error is larger than where one point of
// the mesh is nearest, so that it lies along the medial axis, and would exceed the tolerance at the last
// level, too.
bool is_vain(const child_cell *c, double error, double tolerance, double hopeless)
{
    const double near = lowest(absolute(vload8(0, c->corners))) - c->radius;
    const double single = sqrt(near * near + c->radius * c->radius) - near;
    return near > BESIDE * c->edge && hopeless < INFINITY &&
           ((error > hopeless && error > single) || c->stray > tolerance);
}

ways samples_of(const child_cell *c, uint k)
{
    return lattice_points(4 * c->cell, SAMPLES, k, c->level + 2, c->extent);
}

double8 interpolated_at(const child_cell *c, uint k)
{
    double8 sum = 0;
    for (uint i = 0; i < 8; ++i)
        sum += c->corners[i] * vload8(k, WEIGHTS + i * POINTS);
    return sum;
}

#ifdef SIGNED
// Notes whether the interpolation at eight samples has another sign than the mesh, and whether their
// nearest points are in the cell.
void compare_signs(child_cell *c, double8 interpolated, double8 outward, const ways *points, const ways *way)
{
    const double reach = 0.5 * c->edge;
    const child_corners *at = &c->at;
    c->unlike |= any((interpolated < 0.0) != (outward < 0.0));
    c->entered |= any(absolute(points->x - way->x - at->exact.x.s0 - reach) < reach &
                      absolute(points->y - way->y - at->exact.y.s0 - reach) < reach &
                      absolute(points->z - way->z - at->exact.z.s0 - reach) < reach);
}
#endif

// The largest interpolation error at eight of a cell's samples, computed from the triangles of a
// child's list. The interpolation supplies the sign where it is uncertain, or where the distance is
// so large that the whole cell is on one side.
NOINLINE double sample_error(const child_list *list, child_cell *c, uint k)
{
    const scene_of_lists *scene = &list->scene;
    const ways points = samples_of(c, k);
    nearest found = nothing_found();
    for (uint j = from(list, list->begin); j < list->end; j = from(list, j + 1)) {
        const triangle t = triangle_at(scene, j);
        look_at(scene, j, squares_to(&t, &points), &found);
    }
    const double8 distance = sqrt(found.square), interpolated = interpolated_at(c, k);
    double8 outward = interpolated;
#ifdef SIGNED
    if (!c->in_doubt && c->passed) {
        ways way;
        const double8 number = numbers_beside(scene, found.SIDED, &points, &way);
        outward = number == number ? 0.5 - number : interpolated;
        compare_signs(c, interpolated, outward, &points, &way);
    }
#endif
    return highest(absolute(interpolated - (outward < 0.0 ? -distance : distance)));
}

// The largest gradient of the interpolation in a cell.
double slope_of(double8 field, double edge)
{
    const double dx = highest(absolute(field.s11335577 - field.s00224466));
    const double dy = highest(absolute(field.s23672367 - field.s01450145));
    const double dz = highest(absolute(field.s45674567 - field.s01230123));
    return sqrt(dx * dx + dy * dy + dz * dz) / edge;
}

// Lowers the bound of a cell to that between the samples and corners, given one of the errors at the
// samples.
void bound_between(child_cell *c, double error)
{
    const double most = error > c->stray ? error : c->stray, bound = most + c->rounding + c->gap;
    c->bound = bound < c->bound ? bound : c->bound;
}

// Computes the errors at the samples, until the error exceeds the tolerance and the child may be
// refined or, if thorough, at all of them; then the bound between samples.
void sample_all(const child_list *list, child_cell *c, double tolerance, uint thorough)
{
    for (uint k = 0; k < POINTS / 8; ++k) {
        const double miss = sample_error(list, c, k);
        c->error = miss > c->error ? miss : c->error;
        if (c->may_refine && c->error > tolerance && !thorough)
            return;
    }
    const double unsure = c->in_doubt && c->passed ? 2 * (c->middle + c->radius) : 0;
    bound_between(c, c->error + unsure);
}

// Does what sample_all does for a child that no triangle passes, from distances in single precision.
// Returns false if these do not decide whether the error exceeds the tolerance.
NOINLINE bool samples_decide(const child_list *list, child_cell *c, double tolerance)
{
    const float3 centre = c->at.centre;
    const float edge = (float)c->edge;
    float16 x[2], y[2], z[2];
    for (uint k = 0; k < 2; ++k) {
        const ways low = samples_of(c, 2 * k), high = samples_of(c, 2 * k + 1);
        x[k] = (float16)(convert_float8(low.x - centre.x), convert_float8(high.x - centre.x));
        y[k] = (float16)(convert_float8(low.y - centre.y), convert_float8(high.y - centre.y));
        z[k] = (float16)(convert_float8(low.z - centre.z), convert_float8(high.z - centre.z));
    }
    float16 least[2] = {INFINITY, INFINITY};
    float doubt = 0;
    for (uint j = from(list, list->begin); j < list->end; j = from(list, j + 1)) {
        const narrow_triangles n = one_narrow(&list->scene, list->scene.items[j], centre, edge);
        narrow_ways way;
        int16 feature;
        for (uint k = 0; k < 2; ++k)
            least[k] = lesser(least[k], narrow_squares(&n, x[k], y[k], z[k], &way, &feature));
        doubt = n.doubt.s0 > doubt ? n.doubt.s0 : doubt;
    }
    double error = 0;
    for (uint k = 0; k < POINTS / 8; ++k) {
        const float8 square = k & 1 ? least[k / 2].hi : least[k / 2].lo;
        const double8 field = absolute(interpolated_at(c, k));
        const double miss = highest(absolute(field - convert_double8(sqrt(square))));
        error = miss > error ? miss : error;
    }
    if (!(error + doubt <= tolerance || error - doubt > tolerance))
        return false;
    c->error = error;
    bound_between(c, error + doubt);
    return true;
}

// An upper bound of what bound_apart returns, and the largest doubt: from the block's list or, if that
// is long, from the child's rivals.
NOINLINE float2 narrow_bound(const child_list *list, const child_cell *c, bounded_block *block)
{
    const float edge = (float)c->edge;
    if (list->end - list->begin >= LONG) {
        float sizes[8];
        vstore8(convert_float8(absolute(vload8(0, c->corners))), 0, sizes);
        const float3 found = bounds_by_rivals(&c->known, &c->at, sizes, edge);
        return (float2)(fmax(found.x, found.y) + 4 * found.z, found.z);
    }
    if (!block->known) {
        ways points[POINTS / 8];
        for (uint k = 0; k < POINTS / 8; ++k)
            points[k] = lattice_points(c->cell / 2 * 2, VERTICES, k, c->level, c->extent);
        block->at = narrow_vertices_of(points);
        bound_children(list, edge, block);
    }
    return (float2)(block->of[list->child] + 4 * block->doubt, block->doubt);
}

// Computes the error bound of a child that no triangle passes. If it exceeds the tolerance, prunes the
// list and samples the error, unless the child lies beyond the band and samples cannot lower the bound.
void examine_apart(child_list *list, child_cell *c, bounded_block *block, double tolerance,
                   uint thorough)
{
    const double8 size = absolute(vload8(0, c->corners));
    const float edge = (float)c->edge;
    const float2 narrow = narrow_bound(list, c, block);
    c->bound = narrow.x > 16 * narrow.y ? narrow.x + c->rounding : INFINITY;
    if (c->bound > tolerance)
        prune(list, &c->at, &c->known, edge);
    if (c->bound == INFINITY)
        c->bound = bound_apart(list, &c->at.exact, size, c->edge) + c->rounding;
    if (c->bound <= tolerance || (c->beyond && c->bound <= c->stray + c->rounding + c->gap))
        return;
    if (thorough || !samples_decide(list, c, tolerance))
        sample_all(list, c, tolerance, thorough);
}

#ifdef SIGNED
// Computes the error bound of a child that triangles pass, and its error if that bound exceeds the
// tolerance.
void examine_passed(const child_list *list, child_cell *c, double tolerance, uint thorough)
{
    const double8 field = vload8(0, c->corners);
    const double bound = bound_passed(list, &c->at.exact, field, c->middle + 2 * c->radius) + c->rounding;
    const bool parted = bound == INFINITY; // triangles may be of several sheets
#ifdef CLOSED
    c->bound = bound;
    if (c->bound <= tolerance)
        return;
#endif
    sample_all(list, c, tolerance, thorough);
    c->unlike |= c->entered && (lowest(field) >= 0 || highest(field) < 0);
    c->thin = parted && c->unlike && opposed(list);
}
#endif

// Whether a child is to be refined: its error exceeds the tolerance, triangles pass a coarse child
// whose bound does, or it is thin and its edge exceeds the tolerance; unless that is vain. Computes what is needed for that,
// and prunes the list.
bool examined(child_list *list, child_cell *c, bounded_block *block, double tolerance,
              uint refine_coarse, uint guarantee, uint thorough, double hopeless)
{
    const double miss = fabs(fabs(interpolated_at(c, 0).s0) - c->middle); // whatever the sign
    c->left = c->may_refine && miss > tolerance && is_vain(c, miss, tolerance, hopeless);
    c->may_refine &= !c->left;
    const bool misses = c->may_refine && !thorough && miss > tolerance; // at the centre
    if (misses || c->passed)
        prune(list, &c->at, &c->known, (float)c->edge);
    if (misses)
        return true;
#ifdef SIGNED
    if (c->passed)
        examine_passed(list, c, tolerance, thorough);
    else
#endif
        examine_apart(list, c, block, tolerance, thorough);
    const bool unsure = (guarantee || (c->passed && refine_coarse)) && c->bound > tolerance;
    const bool over = c->error > tolerance || unsure || (c->thin && c->edge > tolerance);
    c->left |= c->may_refine && over && is_vain(c, c->error, tolerance, hopeless);
    return c->may_refine && over && !c->left;
}

// For each child c of block c / 8, with the distance centres[c] at its centre: flags[c] = 1 if it is
// to be refined. errors[c] = the sampled error of a leaf, in cube edges, if it exceeds the
// tolerance; otherwise anything up to that; 0 beyond the band and -1 at a sign discontinuity.
// codes[c] = the code of its bound. kinds[c] = THIN_LEAF or LEFT_LEAF
// if it is such a leaf, otherwise 0.
__kernel void examine_children(const uint n, LISTS SIDES, LIMITS,
#ifdef WINDING
                               __global const uint *doubts,
#endif
                               __global const float *voxels, __global const double *centres,
                               __global const float *strays, __global const double *bounds,
                               __global const uint *places,
#ifdef FLAT
                               __global const uint *sided,
#endif
                               __global uchar *masks, __global uint *needed,
                               __global uint *flags, __global float *errors,
                               __global uchar *codes, __global uchar *kinds,
                               __global uint *steepest)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    child_list list = {{SCENE_VALUES}, masks, begins[gid], begins[gid + 1], 0, 0};
    const double side = 2 * extent;
    child_cell c;
    c.level = level + 1;
    c.extent = extent;
    c.edge = side / (2ul << level);
    c.radius = c.edge * HALF_DIAGONAL + SLACK;
    bounded_block block = {false};
    for (uint i = 0; i < 27; ++i)
        block.sizes[i] = (float)fabs(voxels[27 * (size_t)gid + i] * side);
    float slope_of_leaves = 0;
    for (uint child = 0; child < 8; ++child) {
        const size_t place = 8 * (size_t)gid + child;
        list.child = child;
        list.count = needed[place];
        c.cell = 2 * cell_of(identifiers[gid], level) + octant(child);
        c.at = corners_of(c.cell, c.level, extent);
        find_rivals(&list, &c.at, places + 27 * (size_t)gid, PLACES_OF_SIDES + 27 * (size_t)gid,
                    (float)c.edge, &c.known);
        c.in_doubt = false;
        c.stray = 0;
        double distances[8]; // the corners before they were constrained
        for (uint i = 0; i < 8; ++i) {
            const size_t vertex = 27 * (size_t)gid + CORNERS[8 * child + i];
            const double astray = strays[vertex];
            c.corners[i] = voxels[vertex] * side;
            c.stray = fabs(astray) > c.stray ? fabs(astray) : c.stray;
            distances[i] = c.corners[i] - astray;
#ifdef WINDING
            c.in_doubt |= doubts[gid] >> CORNERS[8 * child + i] & 1;
#endif
        }
        const double8 field = vload8(0, c.corners);
        c.slope = slope_of(field, c.edge);
        c.gap = (1 + c.slope) * (SAMPLE_GAP * c.edge);
        c.stray *= 1 + 0x1p-20; // as it is rounded
        c.rounding = highest(absolute(field)) * 0x1p-21 + SLACK + misplaced;
        c.middle = centres[place];
        c.passed = c.middle <= c.radius;
        c.beyond = c.middle - c.radius > band;
        c.may_refine = can_refine && !c.beyond;
        c.thin = c.unlike = c.entered = c.left = false;
        c.error = 0;
        c.bound = INFINITY;
        bool jumped = false;
#ifdef JUMPS
        jumped = jumps(field, vload8(0, distances), c.edge, c.passed);
#endif
        const bool refined = jumped ? c.may_refine && refine_coarse
                                    : examined(&list, &c, &block, tolerance, refine_coarse,
                                               guarantee, thorough, hopeless);
        needed[place] = list.count;
        flags[place] = refined;
        errors[place] = jumped ? -1 : c.beyond ? 0 : (float)(c.error / side);
        kinds[place] = refined ? 0 : c.thin ? THIN_LEAF : c.left ? LEFT_LEAF : 0;
        codes[place] = jumped ? JUMP : code_of(c.bound / side, bounds);
        if (!refined && !jumped && c.slope > slope_of_leaves)
            slope_of_leaves = (float)c.slope;
    }
    if (as_uint(slope_of_leaves) > *steepest)
        atomic_max(steepest, as_uint(slope_of_leaves));
}
