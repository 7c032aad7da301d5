// What all rays share.

#define NOWHERE -1      // the neighbour outside
#define FARTHEST 1e30f  // beyond every depth
#define DEEPEST 2.0f    // of the volume: its corners are within sqrt(3) of its middle
#define ON_PLANE 0x1p-21f // what is as near is on a plane, as near as float32 planes are
#define LEAST_LIGHT 0x1p-24f // less of the light than this is lost to float32
