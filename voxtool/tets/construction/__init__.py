"""Mesh of volume cells to the textures of a volume."""
