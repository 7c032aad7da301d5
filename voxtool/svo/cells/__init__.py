"""Cells of an octree read one by one: subtrees with their surroundings, counts, layers of voxels,
the links that rays follow."""
