"""Legends, slices and charts."""
