"""Vertices on the features of the mesh that an octree was made from: dual contouring [Ju 2002].

Each cut edge is a link between the centres of a set and an unset voxel. The source crosses a link
of a solid an odd number of times, by the integers and the tie rule that voxelized it: crossings are
listed for the rows along each axis, of a mesh and a grid whose coordinates are rotated. The plane
of a crossing is that of the face, in double precision and not rounded to the lattice. The vertex of
a loop minimises the squared distances to the planes of its crossings, in its cell or up to REACH
beside it: a corner or an edge may pass a cell whose voxels are all alike.

A link without a crossing (of a hole that a fill rule closed, or of a changed octree) has no plane,
and its middle counts for the mean. Loops without any plane relax as in surface nets, between the
vertices that have planes.

Kernels: kernels/svo/surface/sharp.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from voxtool.grid import Grid
from voxtool.mesh.lengths import in_units
from voxtool.mesh.mesh import Mesh, check_source
from voxtool.mesh.watertight import watertight
from voxtool.opencl import Array, Device, program
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.cut_cells import Tiles
from voxtool.svo.surface.isosurface import Features
from voxtool.svo.voxelization.fill.rows import list_crossings
from voxtool.svo.voxelization.lattice import place_mesh
from voxtool.svo.voxelization.plan import plan_of
from voxtool.svo.voxelization.scan_conversion import Scan

SOURCE = "svo/surface/sharp.cl"
OPEN, FREE, CONSTRAINED = range(3)  # vertices without a plane, at a minimum, and beside one
CROSSED = ("parity", "nonzero")  # fill rules whose voxels differ only across a closed mesh
REACH = 1  # cells beyond its own that a vertex may be
QEF_NUMBERS = 14  # of float64 in a `qef` of kernels/qef.h
HEADERS = {
    "svo/surface/sharp.h": program.c_constants(
        OPEN=OPEN, FREE=FREE, CONSTRAINED=CONSTRAINED, REACH=REACH
    )
    + """
#define LEAST_SQUARE 0x1p-200 // of a normal, in voxels: a face with less has no plane
#define NEAR_PLANES 0x1p-20   // mean squared distance, in voxels, up to which a diagonal is near"""
}


@dataclass(frozen=True)
class Vertices:
    """Vertices on features, on the device.

    points : (3 V,) int32; held, means : (V,) uint64, packed: the best places in their cells, and
    the means of their crossings; kinds : (V,) uint8; errors : (14 V,) float64, the squared
    distances to the planes of each.
    """

    points: Array
    held: Array
    means: Array
    kinds: Array
    errors: Array
    count: int
    found: Features


def source_of(octree: OctreeContent, mesh: Mesh) -> Mesh:
    """Return the mesh in the place where the octree was made from it, and in its unit; raise
    MeshError if the octree was not made from it."""
    check_source(mesh, octree.source_sha256, "octree")
    mesh = in_units(mesh, octree.units)
    if not octree.transform or mesh.transform:
        return mesh
    scale, *offset = octree.transform
    return Mesh(mesh.vertices * scale + np.array(offset), mesh.faces, mesh.source_sha256, mesh.name)


def crosses_all(octree: Octree, source: Mesh, device: Device) -> bool:
    """Return whether the source is known to cross every link, so that all vertices have planes: it
    is closed and in the grid, and the octree is what a rule for closed meshes made from it."""
    if not source.source_sha256 or octree.source_sha256 != source.source_sha256:
        return False
    low, high = (source.bounds - np.array(octree.grid.origin)) / np.array(octree.grid.pitch)
    inside = bool((low >= 0).all() and (high <= octree.grid.shape).all())
    return octree.fill in CROSSED and inside and watertight(source, device)


def find_crossings(device: Device, mesh: Mesh, grid: Grid) -> dict[str, Any]:
    """Return the arguments of kernels, by name, that describe a mesh in a grid's coordinates and
    the faces that links cross: a face for each key, as in `rows.Crossings`, along x, y and z."""
    device.require_float64("sharp surfaces")
    corners = (mesh.vertices - np.array(grid.origin)) / np.array(grid.pitch)
    found: dict[str, Any] = {
        "corners": device.put(corners),
        "faces": device.put(mesh.faces),
        "sides": grid.shape,
    }
    counts, bits = [], []
    for axis, name in enumerate("xyz"):
        crossings = list_crossings(
            _scan_along(device, mesh, grid, axis), axis=axis, with_faces=True
        )
        found |= {f"keys_{name}": crossings.keys, f"crossed_{name}": crossings.faces}
        counts.append(crossings.n)
        bits.append(crossings.x_bits)
    return {**found, "counts": (*counts, 0), "key_bits": (*bits, 0)}


def _scan_along(device: Device, mesh: Mesh, grid: Grid, axis: int) -> Scan:
    """Return the scan of a mesh whose coordinates are rotated so that an axis comes first, of a
    voxel more along it: the last link ends beyond the grid, which may have no larger side."""
    order = [(axis + i) % 3 for i in range(3)]
    nx, ny, nz = (grid.shape[i] for i in order)
    origin, pitch = (tuple(values[i] for i in order) for values in (grid.origin, grid.pitch))
    rotated = Grid((nx, ny, nz), origin, pitch)  # pyright: ignore[reportArgumentType]
    turned = Mesh(np.ascontiguousarray(mesh.vertices[:, order]), mesh.faces)
    lattice = place_mesh(turned, rotated, None, None, None, device)
    request: dict[str, Any] = {"mode": "solid", "fill": "nonzero", "gap": 0, "holes": 0, "caps": 0}
    return Scan(lattice, plan_of(lattice.survey(), (nx + 1, ny, nz), **request))


def place_features(
    tiles: Tiles, crossings: dict[str, Any], count: int, cubes: dict[str, Any]
) -> Vertices:
    """Return the `count` vertices of the cut cubes."""
    device = tiles.device
    points = device.empty(3 * count, np.int32)
    held, means = (device.empty(count, np.uint64) for _ in range(2))
    kinds = device.empty(count, np.uint8)
    errors = device.empty(QEF_NUMBERS * count, np.float64)
    tiles.kernel(SOURCE, "place_features")(
        tiles.n,
        points=points,
        packed=held,
        means=means,
        kinds=kinds,
        errors=errors,
        **cubes,
        **crossings,
    )
    number = np.bincount(kinds.get(), minlength=3)
    found = Features(constrained=int(number[CONSTRAINED]), open=int(number[OPEN]))
    return Vertices(points, held, means, kinds, errors, count, found)


def hold_features(tiles: Tiles, vertices: Vertices, packed: Array) -> None:
    """Put the vertices that have planes back to their places."""
    hold = tiles.kernel(SOURCE, "hold_features")
    hold(vertices.count, held=vertices.held, kinds=vertices.kinds, packed=packed)


def put_open(tiles: Tiles, vertices: Vertices, relaxed: Array) -> None:
    """Put the vertices that have no planes where they relaxed to."""
    put = tiles.kernel(SOURCE, "put_open")
    put(vertices.count, relaxed=relaxed, kinds=vertices.kinds, points=vertices.points)


def split_along_features(tiles: Tiles, vertices: Vertices, places: Array, quads: Array) -> Array:
    """Return two triangles for each of (4 Q,) quads, (6 Q,) uint32, split along features; places :
    (3 V,) int32, of vertices in their cells."""
    n = quads.size // 4
    triangles = tiles.device.empty(6 * n, np.uint32)
    split = tiles.kernel(SOURCE, "split_along_features")
    split(n, quads, vertices.points, places, vertices.errors, triangles)
    return triangles
