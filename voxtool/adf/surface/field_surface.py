"""The surface of a distance field: its data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.arrays import Data, digest_of, read_only
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import check_surface, volume
from voxtool.vector import cross, unit

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False, repr=False)
class FieldSurface(Data):
    """A closed, manifold triangle surface at a distance of a field.

    Attributes
    ----------
    offset, shell : float, float or None
        The distance, world units, negative inside; and the thickness of the wall inward of it.
    units : str
        Name of the world unit if known, or "".
    pitch : float
        The edge of the field's deepest leaves, world units.
    vertices : (V, 3) float64
        World units.
    faces : (F, 3) int32
        Triangles, counter-clockwise seen from outside.
    cut : int
        Vertices in leaves at the sides of the cube: more than 0 if the surface may leave it.
    tangled : int or None
        Faces that others pass through, or may; None if edges and corners are not kept, when that
        is not tested.
    """

    offset: float
    shell: float | None
    units: str
    pitch: float
    vertices: np.ndarray
    faces: np.ndarray
    cut: int
    tangled: int | None = None

    def __repr__(self) -> str:
        return (
            f"FieldSurface(offset {self.offset:g}, {len(self.vertices):,} vertices, "
            f"{len(self.faces):,} triangles)"
        )

    @property
    def text(self) -> str:
        """The kind of surface, in words."""
        wall = "" if self.shell is None else f", a wall of {self.shell:g} inward"
        sharp = "" if self.tangled is None else "sharp "
        return f"{sharp}surface at distance {self.offset:g}{wall}"

    @property
    def facts(self) -> dict[str, Any]:
        """The kind of surface, its size and its digest, in JSON types."""
        return {
            "offset": self.offset,
            "shell": self.shell,
            "sharp": self.tangled is not None,
            "vertices": len(self.vertices),
            "triangles": len(self.faces),
            "vertices_at_sides": self.cut,
            "digest": self.digest(),
        }

    @cached_property
    def normals(self) -> np.ndarray:
        """(V, 3) float64: unit normals of the vertices, pointing outside: the mean of the normals
        of the faces around each, weighted by area, and added in the order of the faces."""
        corners = self.vertices[self.faces]
        areas = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        count = len(self.vertices)
        sums = np.zeros((count, 3))
        for corner in self.faces.T:
            sums += np.stack([np.bincount(corner, area, count) for area in areas.T], axis=1)
            opposed = (sums == 0).all(axis=1)  # the faces cancel: use any one of them
        for corner in self.faces.T:
            chosen = opposed[corner]
            sums[corner[chosen]] = areas[chosen]
        return read_only(unit(sums))

    def mesh(self) -> Mesh:
        """Return the surface as a triangle mesh in world units."""
        return Mesh(self.vertices, self.faces, name="surface of a field", units=self.units)

    def check(self) -> dict[str, Any]:
        """Return whether the surface is closed and manifold, its volume in cubic world units, and
        the counts of check_surface."""
        mesh = self.mesh()
        found = check_surface(mesh, weld=False)
        closed = found.watertight and found.manifold
        tested = {} if self.tangled is None else {"self_intersecting_faces": self.tangled}
        return {**found.as_dict(), **tested, "closed": closed, "volume": volume(mesh)}

    def to_trimesh(self) -> trimesh.Trimesh:
        """Return the surface as a `trimesh.Trimesh` in world units, in the same order."""
        import trimesh

        return trimesh.Trimesh(
            self.vertices.copy(), self.faces.copy(), process=False, maintain_order=True
        )

    def digest(self) -> str:
        """Return the SHA-256 of offset, shell, vertices and faces, in little-endian order. Equal
        content has an equal digest on every device and platform."""
        shell = None if self.shell is None else self.shell.hex()
        return digest_of({"offset": self.offset.hex(), "shell": shell}, self.vertices, self.faces)
