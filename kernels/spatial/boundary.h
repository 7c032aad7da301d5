// Bounds on the change of the winding number beside a mesh. Host side: voxtool/spatial/boundary.py.

#include "spatial/arctangent.h"

#define NUMBER_ERRORS 0x1p-6 // exceeds the error of two winding numbers

// An upper bound on the gradient of the winding number within `reach` of a point, apart from where
// a face is passed. Spheres are those of boundary_spheres.
double steepest(double x, double y, double z, double reach, __global const double *spheres, uint count)
{
    double sum = 0;
    for (uint i = 0; i < count; ++i) {
        __global const double *sphere = spheres + 5 * i;
        const double dx = x - sphere[0], dy = y - sphere[1], dz = z - sphere[2];
        const double gap = sqrt(dx * dx + dy * dy + dz * dz) - sphere[3] - reach;
        if (!(gap > 0))
            return INFINITY;
        sum += sphere[4] / (4 * PI * gap * gap);
    }
    return sum;
}
