"""Triangle meshes: the data, its topology, boundary loops and shells."""
