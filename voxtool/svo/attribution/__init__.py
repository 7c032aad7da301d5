"""Attributes of voxels from a mesh: labels of its parts, colours and normals."""
