"""Attributes of cells, of parts and at points, from those of the voxels."""
