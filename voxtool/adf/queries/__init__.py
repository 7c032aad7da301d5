"""Queries of distance fields on the device: at points and on grids."""
