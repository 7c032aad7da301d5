// What all rays share.

#include "tets/volume.h"

#define NOWHERE -1      // the neighbour outside
#define FARTHEST 1e30f  // beyond every depth
#define DEEPEST 2.0f    // of the volume: its corners are within sqrt(3) of its middle
#define ON_PLANE (1.0f / (1 << PLANE_BITS)) // local: a point this near to a plane is on it
#define LEAST_LIGHT 0x1p-24f // less of the light than this is lost to float32
