"""Spatial queries over triangle meshes: bounding volumes, distances, winding numbers."""
