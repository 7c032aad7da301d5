"""Pictures of octrees: ray casting, colours, upper levels."""
