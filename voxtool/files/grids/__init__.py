"""Voxels and images of other programs: a module for each format."""
