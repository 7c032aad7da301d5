// Rounds triangles to single precision; see narrow.h. Host side: voxtool/adf/construction.py.

#include "adf/construction/level.h"
#include "spatial/bvh.h"

#define SHORT 0x1p-40 // in the frame; the inverse squares of longer sides are in the range of floats
#define THIN 0x1p-26  // height over longest side
#define ROUNDED 0x1p-24 // exceeds the error of a corner in single precision

// narrow[NARROW s + i] = the numbers of slot s. A side shorter than SHORT counts as a point, a height
// shorter than that, or of a thinner triangle, as none; no point moves by more than `moved`.
__kernel void narrow_triangles(const uint n, __global const double *leaves, __global float *narrow)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    __global const double *leaf = leaves + (size_t)(gid / LEAF) * (FIELDS * LEAF) + gid % LEAF;
    double t[NARROW], moved = ROUNDED;
    for (uint i = 0; i < FIELDS; ++i)
        t[i] = leaf[i * LEAF];
    const double ee = t[3] * t[3] + t[4] * t[4] + t[5] * t[5];
    const double gg = t[6] * t[6] + t[7] * t[7] + t[8] * t[8];
    const bool point = ee < SHORT * SHORT, flat = gg < SHORT * SHORT || gg < THIN * THIN * ee;
    moved += (point ? sqrt(ee) : 0) + (point || flat ? sqrt(gg) : 0);
    for (uint i = 3; i < FIELDS; ++i) {
        const bool of_edge = i < 6 || i == 10 || i == 11;
        if (point || (flat && !of_edge))
            t[i] = 0;
    }
    t[FIELDS] = moved;
    for (uint i = 0; i < NARROW; ++i)
        narrow[NARROW * (size_t)gid + i] = (float)t[i];
}
