"""Surfaces of distance fields as triangle meshes."""
