"""Meshes of volume cells, and tetrahedral volumes."""
