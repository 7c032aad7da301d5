"""Octree to triangle mesh: smooth isosurfaces, blocks and surface nets.

The thesis, chapter 4 and sections 5.1 and 6.3. The stages, on the device:

1. tiles, samples: which cubes the surface may pass, and the scalars at their corners (tiles.py).
2. classify: the case of every cube that is cut.
3. vertices: smooth surfaces have one on each cut edge, dual ones one a loop (dual.py).
4. histopyramid, triangles: a 5:1 histogram pyramid over the triangle counts of the cut cubes, and
   one work-item a triangle, which finds its cube through it.

All of it is integer arithmetic: points lie on a lattice of 2**-14 of a sample's side, to which the
crossing of an edge is rounded once, so the mesh is the same on every device.

Kernels: kernels/svo/surface/marching_cubes.cl.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import operator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from voxtool.choices import STYLES
from voxtool.errors import VoxtoolError
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Array, Device, default_device, program
from voxtool.opencl.primitives import build_histopyramid
from voxtool.svo.octree import Octree
from voxtool.svo.surface.cut_cells import (
    MAX_LEVEL,
    VOXEL,
    CutCubes,
    Field,
    Lost,
    Tiles,
    Tree,
    classify_cubes,
    count_lost,
    find_tiles,
    grow,
)
from voxtool.svo.surface.dual import dual_surface, split_quads
from voxtool.svo.surface.greedy_meshing import join_rectangles
from voxtool.svo.surface.plan import ExtractionPlan
from voxtool.vector import unit

if TYPE_CHECKING:
    from collections.abc import Iterator

SOURCE = "svo/surface/marching_cubes.cl"
LATTICE_BITS = 14
LATTICE = 1 << LATTICE_BITS  # points count this often a sample's side
NEAREST = LATTICE // 256  # that a point comes to a sample, or a net's to the sides of its cube
HEADERS = {
    "svo/surface/lattice.h": program.c_constants(
        LATTICE_BITS=LATTICE_BITS, LATTICE=LATTICE, NEAREST=NEAREST
    )
}


@dataclass(frozen=True, eq=False)
class Isosurface:
    """A closed, manifold surface around the inside of an octree.

    grid : the octree's; units : name of the world unit if known, or "".
    style : "smooth", "blocks" or "nets".
    level : of the octree's nodes that are samples, or "voxel"; side : voxels along a sample's side.
    isovalue : a sample is inside where at least this share of it is set.
    points : (V, 3) int32: the vertices, in 2**-14 of a sample's side from the grid's corner.
    faces : (F, 3) int32: triangles, counter-clockwise seen from outside.
    tiles, cubes : tiles of 4 x 4 x 4 cubes that were looked at, and cubes that are cut.
    lost : set voxels that samples do not show.
    merged : coplanar quads of blocks are joined; sides of faces may have vertices on them.
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

    @cached_property
    def vertices(self) -> np.ndarray:
        """(V, 3) float64: the vertices, in world units."""
        voxels = self.points * (self.side / LATTICE)  # exact
        return voxels * np.array(self.grid.pitch) + np.array(self.grid.origin)

    @cached_property
    def normals(self) -> np.ndarray:
        """(V, 3) float64: unit normals of the vertices, pointing outside: the mean of the faces'
        around them, by area. Sums are of whole numbers, so their order does not show."""
        corners = self.points[self.faces].astype(np.int64)
        p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        areas = [p[:, i] * q[:, j] - p[:, j] * q[:, i] for i, j in ((1, 2), (2, 0), (0, 1))]
        sums = np.zeros((len(self.points), 3))
        for axis, area in enumerate(areas):
            for corner in self.faces.T:
                sums[:, axis] += np.bincount(corner, area, len(self.points))
        opposed = (sums == 0).all(axis=1)  # the faces' cancel: any one's will do
        for corner in self.faces.T:
            chosen = opposed[corner]
            sums[corner[chosen]] = np.stack(areas, axis=1)[chosen]
        sums /= np.array(self.grid.pitch)
        return unit(sums)

    def mesh(self) -> Mesh:
        """The surface as a triangle mesh in world units."""
        return Mesh(self.vertices, self.faces, name=f"{self.style} surface", units=self.units)

    def digest(self) -> str:
        """SHA-256 of the canonical content: grid, style, level, isovalue, points and faces, little-
        endian. Equal content has an equal digest on every device and platform."""
        head = {
            "shape": list(self.grid.shape),
            "origin": [v.hex() for v in self.grid.origin],
            "pitch": [v.hex() for v in self.grid.pitch],
            "style": self.style,
            "level": self.level,
            "isovalue": self.isovalue.hex(),
            "merged": self.merged,
        }
        sha = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
        for array in (self.points, self.faces):
            sha.update(np.ascontiguousarray(array, "<i4").data)
        return sha.hexdigest()


def extract(
    octree: Octree,
    *,
    style: str = "smooth",
    level: int | str | None = None,
    isovalue: float = 0.5,
    merge: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> Isosurface:
    """The surface between the inside and the outside of an octree, closed at the grid's border.

    Parameters
    ----------
    style : "smooth" (marching cubes), "blocks" (the samples' own faces, two triangles a square) or
        "nets" (surface nets, kept in their cubes).
    level : of the nodes that are samples, from 0 (bricks), or "voxel"; 0 for smooth, and "voxel"
        for blocks and nets by default.
    isovalue : in (0, 1): a sample is inside where at least this share of its voxels is set.
    merge : for "blocks": join coplanar squares to rectangles; then T-junctions are left.
    device : where to compute; the preferred device by default.
    max_memory : bytes that the device may use; what device and machine have by default.

    Returns
    -------
    Isosurface, the same bit for bit on every device. Without --merge each edge has two faces and
    each vertex one fan of them. On a face of a cube whose inside samples are diagonal they are kept
    apart, but where that would pinch a dual surface (cases.py).

    Raises
    ------
    VoxtoolError : an argument is out of range, or the octree is of a surface and has no inside.
    MemoryLimitError : the surface would not fit.
    DeviceError : no usable device.
    """
    device = device or default_device()
    level, field = _field(octree, style, level, isovalue, merge)
    tree = grow(octree, field)
    limits = device.max_memory if max_memory is None else max_memory, device.info.max_allocation
    plan = _plan(octree, tree, style, level, merge)
    plan.refuse_beyond(*limits)

    def counted(**numbers: int) -> None:
        replace(plan, **numbers).refuse_beyond(*limits)

    tiles = find_tiles(device, octree, tree, field, counted)
    cubes = classify_cubes(device, tiles, counted)
    lost = count_lost(device, tiles, cubes)
    if style == "smooth":
        points, triangles = _marching_cubes(device, tiles, cubes)
    else:
        points, quads, n = dual_surface(device, tiles, cubes, nets=style == "nets")
        if merge:
            with device.stage("merge"):
                points, quads, n = join_rectangles(device, points, quads, n)
        with device.stage("triangles"):
            triangles = split_quads(device, tiles, points, quads, n)
    with device.stage("read back"):
        result = Isosurface(
            grid=octree.grid,
            units=octree.units,
            style=style,
            level=level,
            side=field.side,
            isovalue=float(isovalue),
            points=points.take().reshape(-1, 3),
            faces=triangles.take().view(np.int32).reshape(-1, 3),
            tiles=tiles.n,
            cubes=cubes.n,
            lost=lost,
            merged=merge,
        )
    tiles.release()
    cubes.release()
    return result


def plan_extract(
    octree: Octree,
    *,
    style: str = "smooth",
    level: int | str | None = None,
    isovalue: float = 0.5,
    merge: bool = False,
) -> ExtractionPlan:
    """What `extract` would do with the same arguments, without doing it."""
    level, field = _field(octree, style, level, isovalue, merge)
    return _plan(octree, grow(octree, field), style, level, merge)


def _field(
    octree: Octree, style: str, level: int | str | None, isovalue: float, merge: bool
) -> tuple[int | str, Field]:
    """The level and the field that are asked for, checked."""
    if style not in STYLES:
        raise VoxtoolError(f"style {style!r} is unknown: choose one of {', '.join(STYLES)}")
    if level is None:
        level = 0 if style == "smooth" else "voxel"
    if not isinstance(level, str):
        with contextlib.suppress(TypeError):  # a numpy integer, too
            level = int(operator.index(level))
    known = isinstance(level, int) and 0 <= level <= _coarsest(octree)
    if level != "voxel" and not known:
        raise VoxtoolError(
            f"level {level!r}: choose 'voxel' or a level from 0 to {_coarsest(octree)}, those that "
            f"an octree of dim {octree.grid.dim} has"
        )
    try:
        share = float(isovalue)
    except (TypeError, ValueError):
        share = math.nan
    if not 0 < share < 1:  # NaN neither
        raise VoxtoolError(f"isovalue {isovalue!r}: choose a share of set voxels between 0 and 1")
    if merge and style != "blocks":
        raise VoxtoolError(f"only blocks have coplanar squares to merge: drop merge, or {style}")
    if "solid" not in octree.mode and (style, level) != ("blocks", "voxel"):
        raise VoxtoolError(
            f"an octree of mode {octree.mode} has no inside to extract a {style} surface from: "
            "voxelize with --mode solid, or extract --style blocks --level voxel"
        )
    return level, Field.of(VOXEL if level == "voxel" else int(level), share)


def _plan(octree: Octree, tree: Tree, style: str, level: int | str, merge: bool) -> ExtractionPlan:
    solid = "solid" in octree.mode

    def coarser() -> Iterator[ExtractionPlan]:
        first = 0 if isinstance(level, str) else level + 1
        for other in range(first, _coarsest(octree) + 1 if solid else 0):
            yield _plan(octree, grow(octree, Field.of(other, 0.5)), style, other, merge)

    return ExtractionPlan.predict(
        style,
        level,
        merge=merge,
        solid=solid,
        nodes=tuple(tree.nodes(number) for number in range(tree.top + 1)),
        rooted=tree.shift > 0,
        coarser=coarser,
    )


def _coarsest(octree: Octree) -> int:
    """The highest level whose nodes can be samples."""
    return min(octree.depth - 1, MAX_LEVEL)


def _marching_cubes(device: Device, tiles: Tiles, cubes: CutCubes) -> tuple[Array, Array]:
    """The points of the vertices, a vertex each cut edge, and the triangles."""
    options = tiles.field.options
    with device.stage("vertices"):
        points = device.empty(3 * cubes.edges, np.int32)
        place_vertices = device.kernel(SOURCE, "place_vertices", **options)
        place_vertices(
            tiles.n, tiles.codes, np.uint32(tiles.n), *tiles.arguments, *tiles.sample_arguments,
            cubes.cut_edges, cubes.first_edge, np.int32(tiles.shift), points,
        )  # fmt: skip
    with device.stage("histopyramid"):
        counts = device.empty(cubes.n, np.uint32)
        count_triangles = device.kernel(SOURCE, "count_triangles", **options)
        count_triangles(cubes.n, cubes.cases, np.uint32(cubes.n), counts)
        pyramid = build_histopyramid(counts, cubes.n)
    with device.stage("triangles"):
        triangles = device.empty(3 * pyramid.total, np.uint32)
        polygonise = device.kernel(SOURCE, "polygonise", **options)
        polygonise(
            pyramid.total, *pyramid.arguments, np.uint32(pyramid.total), tiles.codes,
            *tiles.arguments, cubes.places, cubes.cases, cubes.cut_edges, cubes.first_edge,
            triangles,
        )  # fmt: skip
    pyramid.release()
    counts.release()
    return points, triangles
