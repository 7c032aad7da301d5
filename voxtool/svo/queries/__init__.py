"""Queries of octrees at points."""
