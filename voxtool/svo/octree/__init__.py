"""The octree as data: nodes and bricks, their layout and links, how it is built, pruned and
validated, and the attributes of its voxels."""
