"""Mesh or image to distance field."""
