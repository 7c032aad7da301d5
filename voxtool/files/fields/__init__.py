"""Distance fields as HDF5."""
