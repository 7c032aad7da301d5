"""The distance field as data: cells, the perfect hash, packing, values on the host."""
