// Constants of rays.

#include "tets/volume/volume.h"

#define NO_CELL -1      // the neighbour of a boundary face
#define NO_PIXEL -1     // a lane beside the picture
#define FARTHEST 1e30f  // beyond every depth
#define DEEPEST 2.0f    // of the volume: its corners are within sqrt(3) of its middle
#define ON_PLANE (1.0f / (1 << PLANE_BITS)) // local length: a point this near to a plane is on it
#define LEAST_TRANSMITTANCE 0x1p-24f // what is behind less than this does not show in float32
