"""The result of a repair."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from voxtool.arrays import Data
from voxtool.errors import count_of

if TYPE_CHECKING:
    import numpy as np

    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh
    from voxtool.svo.surface.isosurface import Isosurface


@dataclass(frozen=True, eq=False, repr=False)
class Repaired(Data):
    """A closed, consistently wound, manifold mesh.

    Attributes
    ----------
    surface
        The mesh: a net whose vertices were moved.
    fill
        Rule that decided what is inside.
    voxels, components
        Set voxels whose surface it is; their connected components before any were dropped, 0 where
        they were not counted.
    on_target
        Vertices that lie where they should, within half a step of the lattice: on the input, at the
        offset or the wall from it, or on the cylinder of a drain.
    checked
        Counts of edges and vertices, shells, genus, volume; whether it is closed; faces that
        others pass through, and those of which that is undecided.
    distances
        To the input and back, world units, before an offset or a cavity: "result_to_mesh" and
        "mesh_to_result", each with "mean" and "rms" of samples, and "max" and "max_upper",
        between which the largest distance lies; "outer_mesh_to_result", from the input's outer
        surface alone, None if it has none; "pitch", "samples", "tolerance".
    wall
        For a hollow solid: "wanted", "thinnest" (between the surface of a cavity and the outer one,
        at vertices and centres of faces), "cavities", and how many of them are "closed".
    simplified
        For a simplified result: "wanted", "deviation" (a bound of the largest distance, both ways,
        from what it was before; 0 if nothing was simplified), "triangles_before".
    """

    surface: Isosurface
    fill: str
    voxels: int
    components: int
    on_target: int
    checked: dict[str, Any]
    distances: dict[str, Any]
    wall: dict[str, Any]
    simplified: dict[str, Any]

    def __repr__(self) -> str:
        return (
            f"<Repaired mesh, {len(self.vertices):,} vertices, {len(self.faces):,} faces, "
            f"{count_of(self.checked['shells'], 'shell')}>"
        )

    @property
    def grid(self) -> Grid:
        """The grid of the voxels."""
        return self.surface.grid

    @property
    def units(self) -> str:
        """Name of the world unit if known, or ""."""
        return self.surface.units

    @cached_property
    def vertices(self) -> np.ndarray:
        """(V, 3) float64, world units."""
        return self.surface.vertices

    @property
    def faces(self) -> np.ndarray:
        """(F, 3) int32, triangles, counter-clockwise seen from outside."""
        return self.surface.faces

    @property
    def normals(self) -> np.ndarray:
        """(V, 3) float64: unit normals of the vertices."""
        return self.surface.normals

    @property
    def faults(self) -> str:
        """The reason why the result cannot be certified: "" for a closed manifold in which no face
        passes through another."""
        if not self.checked["closed"]:
            return "the result is not closed and manifold: report this mesh"
        crossed = self.checked["self_intersecting_faces"] + self.checked["undecided_faces"]
        if crossed:
            return (
                f"{count_of(crossed, 'face')} of {len(self.faces)} may pass through others: choose "
                "another dim"
            )
        return ""

    def mesh(self) -> Mesh:
        """Return the result as a triangle mesh in world units."""
        return self.surface.mesh()

    def digest(self) -> str:
        """Return the SHA-256 of the surface; see Isosurface.digest."""
        return self.surface.digest()
