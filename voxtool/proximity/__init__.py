"""How far points are from a mesh; for all wings."""
