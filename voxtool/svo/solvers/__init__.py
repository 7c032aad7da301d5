"""Octrees for solvers: hexahedra, and links of lattices that cross the wall."""
