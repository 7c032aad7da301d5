"""Triangle meshes: a module for each format."""
