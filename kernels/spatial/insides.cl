// Points that the winding number puts inside, from the numbers of few of them. Points are in an order
// in which near ones follow each other, in groups of equal size. Host side:
// voxtool/spatial/insides.py.

#include "spatial/boundary.h"
#include "spatial/insides.h"

#define ROUNDED (1 - 0x1p-40) // for rounding errors of squared distances

__kernel void put_in_order(__global const double *points, __global const double *distances,
                           __global const uint *order, const uint n, __global double *places,
                           __global double *gaps)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    vstore3(vload3(order[gid], points), gid, places);
    gaps[gid] = distances[order[gid]];
}

// chosen[i] = the point of group i, of those whose side is unknown, that is farthest from the mesh;
// wanted[i] = 1 if there is one that is not on the mesh.
__kernel void choose(const uint n, const uint count, const uint size, __global const double *gaps,
                     __global const uchar *sides, __global uint *chosen, __global uint *wanted)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    double farthest = 0;
    uint best = 0;
    for (uint i = gid * size; i < min((gid + 1) * size, count); ++i)
        if (sides[i] == UNKNOWN && gaps[i] > farthest) {
            farthest = gaps[i];
            best = i;
        }
    chosen[gid] = best;
    wanted[gid] = farthest > 0;
}

// The squared distance of point i to a chosen one whose gap is `gap`; infinite if its side is known,
// or if a face may be between them: if neither is nearer to the other than to the mesh.
double square_between(uint i, double3 at, double gap, __global const double *places,
                      __global const double *gaps, __global const uchar *sides)
{
    if (sides[i] != UNKNOWN)
        return INFINITY;
    const double3 v = vload3(i, places) - at;
    const double square = v.x * v.x + v.y * v.y + v.z * v.z;
    const double clear = gaps[i] > gap ? gaps[i] : gap;
    return square < clear * clear * ROUNDED ? square : INFINITY;
}

// Gives each chosen point its side, and the same side to the points of its group that cannot be on
// the other.
__kernel void pass_on(const uint n, const uint count, const uint size, __global const uint *chosen,
                      __global const double *places, __global const double *gaps,
                      __global const double *spheres, const uint sphere_count,
                      __global const double *numbers, __global uchar *sides)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint own = chosen[gid], first = own / size * size, end = min(first + size, count);
    const double3 at = vload3(own, places);
    double farthest = 0;
    for (uint i = first; i < end; ++i) {
        const double square = square_between(i, at, gaps[own], places, gaps, sides);
        farthest = square < INFINITY && square > farthest ? square : farthest;
    }
    const double reach = sqrt(farthest);
    const double slope = reach > 0 ? steepest(at.x, at.y, at.z, reach, spheres, sphere_count) : 0;
    const double number = numbers[own];
    const double leeway = (number > 0.5 ? number - 0.5 : 0.5 - number) - NUMBER_ERRORS;
    const uchar side = number > 0.5 ? INSIDE : OUTSIDE;
    for (uint i = first; i < end; ++i) {
        const double square = square_between(i, at, gaps[own], places, gaps, sides);
        if (square < INFINITY && sqrt(square) * slope < leeway)
            sides[i] = side;
    }
    sides[own] = side;
}
