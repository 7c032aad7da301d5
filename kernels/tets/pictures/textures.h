// The textures of a volume [TetVol, tables 4 and 5], and the cells' vertices.
// Host side: voxtool/tets/volume/volume.py. Options:
//   FACES      of a cell: 4 or 6
//   ANCHORED   table 4: offsets and scalar terms by vertices instead of stored

#include "tets/pictures/vector.h"
#include "tets/volume/volume.h"

#define CORNERS (FACES == 4 ? 4 : 8) // of a cell
#define SIDES (FACES == 4 ? 3 : 4)   // of a face

typedef struct {
    __global const float *normals, *gradients, *vertices;
    __global const int *anchors; // ANCHORED
    uint cells; // how many
} Textures;

// A kernel's parameters for them.
#define TEXTURES                                                                                 \
    __global const float *normals, __global const float *gradients,                              \
        __global const float *vertices, __global const int *anchors, const uint cells
#define THE_TEXTURES {normals, gradients, vertices, anchors, cells}

// The plane of a face: its outward normal and offset.
double4 plane_of(const Textures *t, const uint cell, const uint face)
{
    const size_t texel = (size_t)face * t->cells + cell;
#ifdef ANCHORED
    const double3 n = convert_double3(vload3(texel, t->normals));
    // anchor 0 lies on faces 1 to 3, anchor 1 on face 0
    const uint anchor = t->anchors[2 * (size_t)cell + (face == 0)];
    const double3 v = convert_double3(vload4(anchor, t->vertices).xyz);
    return (double4)(n, -dot3(n, v));
#else
    return convert_double4(vload4(texel, t->normals));
#endif
}

// The scalar as a linear function of the position.
double4 scalar_of(const Textures *t, const uint cell)
{
#ifdef ANCHORED
    const double3 g = convert_double3(vload3(cell, t->gradients));
    const double4 v = convert_double4(vload4(t->anchors[2 * (size_t)cell], t->vertices));
    return (double4)(g, v.w - dot3(g, v.xyz));
#else
    return convert_double4(vload4(cell, t->gradients));
#endif
}
