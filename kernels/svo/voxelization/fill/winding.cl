// Winding numbers near holes. Host side: voxtool/svo/voxelization/fill/winding.py. Options: CODE=ulong, WIDE. One
// program, because three compile a quarter longer: they have much in common.

#include "svo/voxelization/fill/winding/blocks.cl"
#include "svo/voxelization/fill/winding/voxels.cl"
#include "svo/voxelization/fill/winding/bricks.cl"
