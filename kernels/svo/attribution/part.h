// The part of a triangle in a cube, as a convex polygon in the triangle's own coordinates (u, v): the
// point v0 + u (v1 - v0) + v (v2 - v0). Positions, texture coordinates and colours are linear in u and v,
// so each cut is by a linear function.

#define MOST_CORNERS 14 // a triangle has 3 corners, and each of 6 + 4 cuts adds one

typedef struct {
    double u[MOST_CORNERS], v[MOST_CORNERS];
    int n;
} part;

typedef struct { double d, u, v; } linear; // d + u u + v v

double at_corner(linear f, const part *p, int i) { return f.d + f.u * p->u[i] + f.v * p->v[i]; }

linear linear_of(double a, double b, double c)
{
    const linear f = {a, b - a, c - a};
    return f;
}

// The part where f is not negative: `p` itself, or in `kept`. If there is none, the corner where f is
// largest stays, so that a part that only touches has a place.
const part *cut(const part *p, linear f, part *kept)
{
    double side[MOST_CORNERS];
    int outside = 0;
    for (int i = 0; i < p->n; ++i) {
        side[i] = at_corner(f, p, i);
        outside += side[i] < 0;
    }
    if (outside == 0)
        return p;
    int n = 0;
    if (outside == p->n) {
        int best = 0;
        for (int i = 1; i < p->n; ++i)
            best = side[i] > side[best] ? i : best;
        kept->u[0] = p->u[best];
        kept->v[0] = p->v[best];
        kept->n = 1;
        return kept;
    }
    for (int i = 0, j = p->n - 1; i < p->n; j = i++) { // each corner is written: no branches
        n = min(n, MOST_CORNERS - 2);
        const double t = side[j] / (side[j] - side[i]);
        kept->u[n] = p->u[j] + (p->u[i] - p->u[j]) * t;
        kept->v[n] = p->v[j] + (p->v[i] - p->v[j]) * t;
        n += ((side[j] < 0) & (side[i] > 0)) | ((side[j] > 0) & (side[i] < 0));
        kept->u[n] = p->u[i];
        kept->v[n] = p->v[i];
        n += side[i] >= 0;
    }
    kept->n = n;
    return kept;
}

// Cuts a triangle to the closed cubes of voxels: to a slab across q, in it to a row across p, in it to
// the voxel. Slab and row are kept for the next voxel, which scan conversion takes along the third axis.
typedef struct {
    int axis;         // of the columns: p and q follow it
    linear p, q, r;   // along the axes, in units from the low side of voxel 0
    int3 least, most; // of the triangle
    int3 last;        // the voxel before
    part whole, slab, row, own, spare[3];
    const part *in_slab, *in_row;
} cutter;

void open_cutter(cutter *c, const triangle *t, int axis)
{
    const int3 v0 = swizzle(t->v[0], axis), v1 = swizzle(t->v[1], axis), v2 = swizzle(t->v[2], axis);
    c->axis = axis;
    c->p = linear_of(v0.x, v1.x, v2.x);
    c->q = linear_of(v0.y, v1.y, v2.y);
    c->r = linear_of(v0.z, v1.z, v2.z);
    c->least = min(min(v0, v1), v2);
    c->most = max(max(v0, v1), v2);
    c->last = (int3)(-1);
    c->whole.n = 3;
    c->whole.u[0] = c->whole.v[0] = c->whole.v[1] = c->whole.u[2] = 0;
    c->whole.u[1] = c->whole.v[2] = 1;
}

// The part between the sides of voxel i along an axis, where the triangle has coordinate f.
const part *between(const part *p, linear f, int i, int least, int most, part *spare, part *kept)
{
    const int low = i * VOXEL, high = low + VOXEL;
    if (least < low) {
        const linear above = {f.d - low, f.u, f.v};
        p = cut(p, above, most > high ? spare : kept);
    }
    if (most > high) {
        const linear below = {high - f.d, -f.u, -f.v};
        p = cut(p, below, kept);
    }
    return p;
}

const part *part_in(cutter *c, uint3 voxel)
{
    const int3 v = swizzle(as_int3(voxel), c->axis);
    const bool new_slab = v.y != c->last.y;
    if (new_slab)
        c->in_slab = between(&c->whole, c->q, v.y, c->least.y, c->most.y, &c->spare[0], &c->slab);
    if (new_slab || v.x != c->last.x)
        c->in_row = between(c->in_slab, c->p, v.x, c->least.x, c->most.x, &c->spare[1], &c->row);
    c->last = v;
    return between(c->in_row, c->r, v.z, c->least.z, c->most.z, &c->spare[2], &c->own);
}

// Twice the area of corners 0, i - 1 and i, and of a part; the triangle itself has 1.
double fan_area(const part *p, int i)
{
    const double area = (p->u[i - 1] - p->u[0]) * (p->v[i] - p->v[0]) -
                        (p->u[i] - p->u[0]) * (p->v[i - 1] - p->v[0]);
    return area > 0 ? area : 0;
}

double area_of(const part *p)
{
    double area = 0;
    for (int i = 2; i < p->n; ++i)
        area += fan_area(p, i);
    return area;
}

// The centroid or, without an area, the mean of the corners.
void find_centre(const part *p, double *u, double *v)
{
    double area = 0, su = 0, sv = 0;
    for (int i = 2; i < p->n; ++i) {
        const double a = fan_area(p, i);
        area += 3 * a;
        su += a * (p->u[0] + p->u[i - 1] + p->u[i]);
        sv += a * (p->v[0] + p->v[i - 1] + p->v[i]);
    }
    for (int i = 0; area == 0 && i < p->n; ++i) {
        su += p->u[i] / p->n;
        sv += p->v[i] / p->n;
    }
    *u = area > 0 ? su / area : su;
    *v = area > 0 ? sv / area : sv;
}

// The cross product of two edges of a triangle, twice its area long, in world units up to a common
// factor: `scale` has what each component is multiplied by.
double3 normal_of(const triangle *t, double3 scale)
{
    const long3 n = cross_of(t->v[1] - t->v[0], t->v[2] - t->v[0]);
    return (double3)((double)n.x, (double)n.y, (double)n.z) * scale;
}

double length_of(double3 n) { return sqrt(n.x * n.x + n.y * n.y + n.z * n.z); }
