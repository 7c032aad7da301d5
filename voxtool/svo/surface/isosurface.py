"""The surface of an octree: its data."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.arrays import Data, digest_of, read_only
from voxtool.choices import STYLE_ALIASES, VOXEL_FACES
from voxtool.grid import Grid
from voxtool.mesh import srgb
from voxtool.mesh.appearance import Appearance
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import check_surface, closed_chain
from voxtool.mesh.topology import volume as volume_of
from voxtool.opencl import program
from voxtool.svo.octree.exact_sums import whole_sum
from voxtool.vector import unit

if TYPE_CHECKING:
    import trimesh

LATTICE_BITS = 14
LATTICE = 1 << LATTICE_BITS  # steps of the lattice of points along a sample's side
NEAREST = LATTICE // 256  # steps that a point keeps from a sample or from the sides of its cube
HEADERS = {
    "svo/surface/lattice.h": program.c_constants(
        LATTICE_BITS=LATTICE_BITS, LATTICE=LATTICE, NEAREST=NEAREST
    )
}


@dataclass(frozen=True)
class Lost:
    """Numbers of set voxels that the samples do not show."""

    below: int  # in samples that are not inside
    vanished: int  # those of them in samples that no cut cube touches


@dataclass(frozen=True)
class Features:
    """Numbers of vertices of a sharp surface that are not where the planes of their crossings meet
    best, and of its faces that others pass through; how far the source's sharp edges are."""

    constrained: int  # that would lie far outside their cell, and are at the best place within it
    open: int  # whose links the source does not cross: placed as those of surface nets
    moved: int = 0  # towards their cell or the mean of their crossings, for faces not to intersect
    crossed: int = 0  # faces that others pass through
    undecided: int = 0  # faces too near to too many others to tell
    # the largest distance of the source's sharp edges from the surface, and where, world units;
    # None without such edges
    farthest: tuple[float, tuple[float, ...]] | None = None


@dataclass(frozen=True)
class Adaptive:
    """Triangles saved by cells of different size, and the distance by which they move a surface."""

    tolerance: float  # world units: of the distance from the uniform surface and back
    uniform: int  # triangles of the uniform surface
    furthest: float  # the largest distance that was found, world units: at most the tolerance
    rounds: int  # in which cells were merged, each with fewer of them


@dataclass(frozen=True, eq=False, repr=False)
class Isosurface(Data):
    """A closed, manifold triangle surface around the inside of an octree.

    Attributes
    ----------
    grid
        Grid of the octree.
    units
        name of the world unit if known, or "".
    style
        a name in `choices.STYLES`.
    level
        level of the octree's nodes that are samples, or "voxel".
    side
        voxels along a sample's side.
    isovalue
        least share of set voxels of a sample that is inside.
    points
        (V, 3) int32, vertices in 2**-14 of a sample's side from the grid's corner.
    faces
        (F, 3) int32, triangles, counter-clockwise seen from outside.
    tiles, cubes
        tiles of 4 x 4 x 4 cubes that were examined, and cubes that are cut.
    lost
        set voxels that the samples do not show.
    merged
        coplanar squares are joined (greedy meshing), which leaves T-junctions.
    features
        numbers of vertices of a sharp surface, or None.
    adaptive
        what its cells of different size save, or None.
    colours
        (V, 4) uint8, sRGB and opacity of the vertices, or (F, 4) of the triangles of voxel faces;
        None if the octree has no colours, or they were not requested.
    """

    grid: Grid
    units: str
    style: str
    level: int | str
    side: int
    isovalue: float
    points: np.ndarray
    faces: np.ndarray
    tiles: int
    cubes: int
    lost: Lost
    merged: bool = False
    features: Features | None = None
    adaptive: Adaptive | None = None
    colours: np.ndarray | None = None

    def __repr__(self) -> str:
        return (
            f"Isosurface({self.style}, level {self.level}, {len(self.points):,} vertices, "
            f"{len(self.faces):,} triangles)"
        )

    @property
    def pitch(self) -> float:
        """The longest side of a voxel, world units."""
        return max(self.grid.pitch)

    @property
    def text(self) -> str:
        """The kind of surface, in words."""
        return f"{self.style}, level {self.level}, isovalue {self.isovalue:g}"

    @cached_property
    def vertices(self) -> np.ndarray:
        """(V, 3) float64: the vertices, in world units."""
        return read_only(in_world(self.points, self.side, self.grid))

    @cached_property
    def volume(self) -> float:
        """The volume that the surface encloses, in cubic world units: exact and rounded once, but
        rounded for each triangle if the surface is merged or adaptive."""
        if self.merged or self.adaptive:
            return volume_of(self.mesh())
        return enclosed(six_volumes(self.points, self.faces), self.side, self.grid)

    @cached_property
    def normals(self) -> np.ndarray:
        """(V, 3) float64: unit normals of the vertices, pointing outside: the mean of the normals
        of the faces around each, weighted by area.

        The sums are of whole numbers, so their order does not matter.
        """
        corners = self.points[self.faces].astype(np.int64)
        p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        areas = [p[:, i] * q[:, j] - p[:, j] * q[:, i] for i, j in ((1, 2), (2, 0), (0, 1))]
        sums = np.zeros((len(self.points), 3))
        for axis, area in enumerate(areas):
            for corner in self.faces.T:
                sums[:, axis] += np.bincount(corner, area, len(self.points))
        opposed = (sums == 0).all(axis=1)  # the faces cancel: use any one of them
        for corner in self.faces.T:
            chosen = opposed[corner]
            sums[corner[chosen]] = np.stack(areas, axis=1)[chosen]
        sums /= np.array(self.grid.pitch)
        return read_only(unit(sums))

    def mesh(self) -> Mesh:
        """Return the surface as a triangle mesh in world units."""
        return Mesh(self.vertices, self.faces, name=f"{self.style} surface", units=self.units)

    def coloured(self) -> tuple[Mesh, np.ndarray]:
        """Return the mesh with its colours, and the vertex of the surface that each of its vertices
        is, (n,) int. A vertex of voxel faces is repeated for each colour around it."""
        if self.colours is None or len(self.colours) == 0:
            return self.mesh(), np.arange(len(self.points))
        return painted(self.mesh(), self.colours, self.style)

    def check(self) -> dict[str, Any]:
        """Return whether the surface is closed, its volume in cubic world units, and the counts of
        check_surface; a merged surface, whose edges end within others, has no counts. A sharp
        surface also has the numbers of faces that others pass through, and of undecided ones."""
        mesh = self.mesh()
        if self.merged:
            return {"closed": closed_chain(mesh), "t_junctions": True, "volume": self.volume}
        found = check_surface(mesh, weld=False)
        closed = found.watertight and found.manifold
        apart = {}
        if self.features is not None:
            apart["self_intersecting_faces"] = self.features.crossed
            apart["undecided_faces"] = self.features.undecided
        return {**found.as_dict(), "closed": closed, "volume": self.volume, **apart}

    def to_trimesh(self) -> trimesh.Trimesh:
        """Return the surface as a `trimesh.Trimesh` in world units, in the same order."""
        import trimesh

        return trimesh.Trimesh(
            self.vertices.copy(), self.faces.copy(), process=False, maintain_order=True
        )

    def digest(self) -> str:
        """Return the SHA-256 of grid, style, level, isovalue, points and faces, and of the adaptive
        tolerance and colours if there are any, in little-endian order. Equal content has an equal
        digest on every device and platform."""
        head = head_of(self.grid, self.style, self.level, self.isovalue, self.merged)
        if self.adaptive:
            head["adaptive"] = self.adaptive.tolerance.hex()
        colours = [] if self.colours is None else [self.colours]
        return digest_of(head, self.points, self.faces, *colours)


def painted(mesh: Mesh, colours: np.ndarray, style: str) -> tuple[Mesh, np.ndarray]:
    """Return a mesh with the colours of its vertices, or of voxel faces those of its triangles, and
    the vertex of the mesh that each of its vertices is, (n,) int."""
    origin, faces = np.arange(len(mesh.vertices)), mesh.faces
    if style == VOXEL_FACES:
        packed = np.repeat(np.ascontiguousarray(colours).view("<u4"), 3).astype(np.uint64)
        keys = faces.ravel().astype(np.uint64) << np.uint64(32) | packed
        _, first, corners = np.unique(keys, return_index=True, return_inverse=True)
        origin, faces = faces.ravel()[first], corners.reshape(-1, 3).astype(np.int32)
        colours = colours[first // 3]
    light = np.concatenate([srgb.to_linear(colours[:, :3]), colours[:, 3:] / 255], axis=1)
    look = Appearance((), np.full(len(faces), -1, np.int32), None, light)
    return replace(mesh, vertices=mesh.vertices[origin], faces=faces, appearance=look), origin


def head_of(
    grid: Grid, style: str, level: int | str, isovalue: float, merged: bool
) -> dict[str, Any]:
    """Return what the digest of a surface covers beside its points and faces, in JSON types."""
    old_names = {style: old for old, style in STYLE_ALIASES.items()}
    return {
        **grid.exact,
        "style": old_names.get(style, style),
        "level": level,
        "isovalue": isovalue.hex(),
        "merged": merged,
    }


def in_world(points: np.ndarray, side: int, grid: Grid) -> np.ndarray:
    """Return points, in 1 / LATTICE of a sample of `side` voxels, in world units."""
    voxels = points * (side / LATTICE)  # exact
    return voxels * np.array(grid.pitch) + np.array(grid.origin)


AT_ONCE = 1 << 18  # triangles


def six_volumes(points: np.ndarray, faces: np.ndarray) -> int:
    """Return six times the volume within a closed surface, or the share of a part of it, in cubic
    steps of the lattice. Corners of a triangle are less than 2**17 steps apart."""
    total = 0
    for first in range(0, len(faces), AT_ONCE):
        corners = points[faces[first : first + AT_ONCE]].astype(np.int64)
        p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]  # twice that of the triangle seen along z
        height = corners[:, :, 2].sum(axis=1)
        low = int(height.min())  # so that products fit 64 bits
        total += whole_sum(area * (height - low)) + low * whole_sum(area)
    return total


def enclosed(six: int, side: int, grid: Grid) -> float:
    """Return a sixth of `six` cubic steps of the lattice, of samples of `side` voxels, in cubic
    world units."""
    return float(six * Fraction(side, LATTICE) ** 3 / 6) * grid.voxel_volume
