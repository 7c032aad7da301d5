"""Fill rules: which voxels are inside a mesh."""
