"""What readers and writers share: atomic files, streams, HDF5 records, numbers of text,
unpacking."""
