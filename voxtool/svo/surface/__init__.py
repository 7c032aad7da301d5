"""Surfaces of octrees as triangle meshes."""
