"""Pictures of volumes: ray casting, projection, transfer functions, isosurfaces."""
