// The faces of cells. Option: CORNERS, of a cell, 4 or 8.

#include "tets/volume/cells.h"

#if CORNERS == 4
#define FACES 4
#define SIDES 3 // of a face
#define CELL_FACES TETRAHEDRON_FACES
#else
#define FACES 6
#define SIDES 4
#define CELL_FACES HEXAHEDRON_FACES
#endif

// The vertices of a face in one order whichever cell has the face: the smallest vertex first, then
// the smaller of its two neighbours on the face. Returns whether the cell winds it the other way.
bool loop_of(__global const uint *cells, const size_t cell, const uint face, uint *loop)
{
    uint vertex[SIDES], start = 0;
    for (uint i = 0; i < SIDES; ++i) {
        vertex[i] = cells[CORNERS * cell + CELL_FACES[SIDES * face + i]];
        if (vertex[i] < vertex[start])
            start = i;
    }
    const bool backward = vertex[(start + 1) % SIDES] > vertex[(start + SIDES - 1) % SIDES];
    for (uint i = 0; i < SIDES; ++i)
        loop[i] = vertex[(start + (backward ? SIDES - i : i)) % SIDES];
    return backward;
}
