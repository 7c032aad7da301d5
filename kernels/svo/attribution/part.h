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

// Keep what lies where f is not negative. If nothing does, the corner where f is largest stays, so that
// a part that only touches has a place.
void cut(part *p, linear f)
{
    double side[MOST_CORNERS];
    int best = 0, outside = 0;
    for (int i = 0; i < p->n; ++i) {
        side[i] = at_corner(f, p, i);
        outside += side[i] < 0;
        best = side[i] > side[best] ? i : best;
    }
    if (outside == 0)
        return;
    if (outside == p->n) {
        p->u[0] = p->u[best];
        p->v[0] = p->v[best];
        p->n = 1;
        return;
    }
    part kept;
    kept.n = 0;
    for (int i = 0; i < p->n; ++i) {
        const int j = i + 1 < p->n ? i + 1 : 0;
        if (side[i] >= 0 && kept.n < MOST_CORNERS) {
            kept.u[kept.n] = p->u[i];
            kept.v[kept.n++] = p->v[i];
        }
        if (((side[i] < 0 && side[j] > 0) || (side[i] > 0 && side[j] < 0)) &&
            kept.n < MOST_CORNERS) {
            const double t = side[i] / (side[i] - side[j]);
            kept.u[kept.n] = p->u[i] + (p->u[j] - p->u[i]) * t;
            kept.v[kept.n++] = p->v[i] + (p->v[j] - p->v[i]) * t;
        }
    }
    for (int i = 0; i < kept.n; ++i) {
        p->u[i] = kept.u[i];
        p->v[i] = kept.v[i];
    }
    p->n = kept.n;
}

// The part of a triangle in the closed cube of a voxel.
part part_of(const triangle *t, uint3 voxel)
{
    part p;
    p.n = 3;
    p.u[0] = 0;
    p.u[1] = 1;
    p.u[2] = 0;
    p.v[0] = 0;
    p.v[1] = 0;
    p.v[2] = 1;
    const int3 low = as_int3(voxel) * VOXEL;
    const int3 least = min(min(t->v[0], t->v[1]), t->v[2]) - low,
               most = max(max(t->v[0], t->v[1]), t->v[2]) - low;
    const double3 a = convert_double3(t->v[0] - low), b = convert_double3(t->v[1] - low),
                  c = convert_double3(t->v[2] - low);
    if (least.x < 0)
        cut(&p, linear_of(a.x, b.x, c.x));
    if (most.x > VOXEL)
        cut(&p, linear_of(VOXEL - a.x, VOXEL - b.x, VOXEL - c.x));
    if (least.y < 0)
        cut(&p, linear_of(a.y, b.y, c.y));
    if (most.y > VOXEL)
        cut(&p, linear_of(VOXEL - a.y, VOXEL - b.y, VOXEL - c.y));
    if (least.z < 0)
        cut(&p, linear_of(a.z, b.z, c.z));
    if (most.z > VOXEL)
        cut(&p, linear_of(VOXEL - a.z, VOXEL - b.z, VOXEL - c.z));
    return p;
}

// Twice the area of corners 0, i - 1 and i; the triangle itself has 1.
double fan_area(const part *p, int i)
{
    const double area = (p->u[i - 1] - p->u[0]) * (p->v[i] - p->v[0]) -
                        (p->u[i] - p->u[0]) * (p->v[i - 1] - p->v[0]);
    return area > 0 ? area : 0;
}

// Twice the area, and the centre: the centroid, or without an area the mean of the corners.
double find_centre(const part *p, double *u, double *v)
{
    double area = 0, su = 0, sv = 0;
    for (int i = 2; i < p->n; ++i) {
        const double a = fan_area(p, i);
        area += a;
        su += a * (p->u[0] + p->u[i - 1] + p->u[i]);
        sv += a * (p->v[0] + p->v[i - 1] + p->v[i]);
    }
    if (area > 0) {
        *u = su / (3 * area);
        *v = sv / (3 * area);
        return area;
    }
    for (int i = 0; i < p->n; ++i) {
        su += p->u[i];
        sv += p->v[i];
    }
    *u = su / p->n;
    *v = sv / p->n;
    return 0;
}

// The cross product of two edges of a triangle, twice its area long, in world units up to a common
// factor: `scale` has what each component is multiplied by.
double3 normal_of(const triangle *t, double3 scale)
{
    const long3 n = cross_of(t->v[1] - t->v[0], t->v[2] - t->v[0]);
    return (double3)((double)n.x, (double)n.y, (double)n.z) * scale;
}

double length_of(double3 n) { return sqrt(n.x * n.x + n.y * n.y + n.z * n.z); }
