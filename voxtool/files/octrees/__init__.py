"""Octrees as HDF5 and XML, and windows that wait on the disk."""
