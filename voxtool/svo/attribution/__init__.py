"""Attributes of voxels from a mesh: labels of its parts, colours, normals, and fractions."""
