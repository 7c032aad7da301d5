// Values of exposed voxels that the surface does not meet: those of the nearest point of the surface. Host
// side: voxtool/svo/attribution/nearest_surface.py. Options: those of columns.h.

#include "svo/voxelization/columns.h"
#include "svo/attribution/textures.h"
#include "svo/attribution/part.h"
#include "svo/attribution/materials.h"

double product(double3 a, double3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

double3 cross_product(double3 a, double3 b)
{
    return (double3)(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

// Where the side from `start` along `side` is nearest to a point, from 0 to 1; returns the squared distance.
double along_side(double3 start, double3 side, double3 point, double *place)
{
    const double3 way = point - start;
    const double square = product(side, side);
    const double t = square > 0 ? product(way, side) / square : 0;
    *place = t < 0 ? 0 : t > 1 ? 1 : t;
    const double3 rest = way - *place * side;
    return product(rest, rest);
}

// The nearest point of a triangle to a point, in the triangle's own coordinates.
void find_nearest(const triangle *t, int3 point, double *u, double *v)
{
    const long3 normal = cross_of(t->v[1] - t->v[0], t->v[2] - t->v[0]);
    const double3 n = (double3)((double)normal.x, (double)normal.y, (double)normal.z);
    const double3 a = convert_double3(t->v[1]) - convert_double3(t->v[0]),
                  b = convert_double3(t->v[2]) - convert_double3(t->v[0]),
                  p = convert_double3(point) - convert_double3(t->v[0]);
    const double square = product(n, n);
    if (square > 0) {
        *u = product(cross_product(p, b), n) / square;
        *v = product(cross_product(a, p), n) / square;
        if (*u >= 0 && *v >= 0 && *u + *v <= 1)
            return;
    }
    double ab, ac, bc;
    const double of_ab = along_side((double3)(0), a, p, &ab), of_ac = along_side((double3)(0), b, p, &ac),
                 of_bc = along_side(a, b - a, p, &bc);
    const bool first = of_ab <= of_ac && of_ab <= of_bc, second = !first && of_ac <= of_bc;
    *u = first ? ab : second ? 0 : 1 - bc;
    *v = first ? 0 : second ? ac : bc;
}

// The values of voxels at the points of given faces that are nearest to their centres. centres: on the
// lattice. With `nearest`, colours are those of texels and corners as they are.
__kernel void values_at_nearest(const uint n, __global const int *centres, __global const uint *faces_of,
                                __global const int *vertices, __global const int *faces, LOOK,
                                const double3 scale, const int nearest, __global uchar *colour_values,
                                __global float *normal_values)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint face = faces_of[gid];
    const triangle t = fetch_triangle(vertices, faces, face);
    if (colour_values) {
        double u, v;
        find_nearest(&t, vload3(gid, centres), &u, &v);
        const skin of = skin_of(THIS_LOOK, faces, face);
        vstore4(nearest ? nearest_colour(&of, u, v) : levels_of(colour_at(&of, u, v)), gid, colour_values);
    }
    if (normal_values) {
        const double3 normal = normal_of(&t, scale);
        const double length = length_of(normal);
        vstore3(convert_float3(length > 0 ? normal / length : normal), gid, normal_values);
    }
}
