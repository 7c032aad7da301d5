// Winding numbers near holes. Host side: voxtool/svo/fill/winding.py. Options: CODE=ulong, WIDE. One
// program, because three compile a quarter longer: they have much in common.

#include "svo/fill/winding/blocks.cl"
#include "svo/fill/winding/voxels.cl"
#include "svo/fill/winding/bricks.cl"
