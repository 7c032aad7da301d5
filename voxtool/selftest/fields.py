"""Distances, and fields of them, of stiff and extreme meshes."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.construction.build import build_adf
from voxtool.adf.construction.stages import CROSSED
from voxtool.adf.field.cells import MAX_KEY, cell_of
from voxtool.adf.field.hashing import build_hash
from voxtool.adf.field.spatial_hash import SpatialHash
from voxtool.adf.pictures.scene import FieldScene
from voxtool.adf.queries.query import query_adf
from voxtool.adf.surface.extract import extract_field_surface
from voxtool.errors import DeviceError
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.opencl import Device
from voxtool.opencl.images import FILTER_STEP, check_filter
from voxtool.selftest import crowds, oracles, shapes
from voxtool.selftest.case import case
from voxtool.selftest.voxels import SCALES
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.hausdorff import hausdorff
from voxtool.spatial.sampling import sample_cube
from voxtool.spatial.signed_distance import SignedDistance
from voxtool.spatial.winding_number import WindingNumber

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.adf.field.field import DistanceField

    Exact = Callable[[np.ndarray], np.ndarray]

EXACT = 1e-15  # extents: the largest error of a distance (voxtool/spatial/distance.py)
WINDING = 1e-3  # of a winding number (voxtool/spatial/winding_number.py: 8e-4 at 8,550 points)
POINTS = 20_000
ROUNDED_PLACE = 2.0**-13  # of a texel: places of up to 2048 texels in float32
DEEPEST = 12  # first level whose identifiers have 64 bits


def to_box(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the distance of each point to a box, (N,), negative inside."""
    beyond = np.maximum(low - points, points - high)
    outside = np.sqrt((np.maximum(beyond, 0) ** 2).sum(axis=1))
    return outside + np.minimum(beyond.max(axis=1), 0)


def over_bound(field: DistanceField, exact: Exact, points: np.ndarray, device: Device) -> float:
    """Return the largest error of a field at points, in bounds of their leaves; infinite if a leaf
    has no bound."""
    answer = query_adf(field, points, bounds=True, device=device)
    assert answer.bound is not None
    if not np.isfinite(answer.bound).all():
        return math.inf
    error = np.abs(answer.distance - exact(points)) - EXACT * field.side
    return float((error / answer.bound).max())


def loose(corners: np.ndarray) -> Mesh:
    """Return a mesh of (N, 3, 3) triangles that share no vertex."""
    return mesh_from_arrays(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def distance_error(device: Device, triangles: np.ndarray, points: np.ndarray) -> float:
    """Return the largest error of distances, in the mesh's extents."""
    found = TriangleDistance(loose(triangles), device)(points)
    extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    return float(np.abs(found - oracles.distances(points, triangles)).max()) / extent


@case("distances to needles", "aspect up to 1e9: rational arithmetic", "extents", EXACT)
def needles(device: Device, full: bool) -> float:
    random, error = np.random.default_rng(1), 0.0
    for _ in range(24 if full else 3):
        a, b = random.uniform(-1, 1, (2, 8, 3))
        along = random.uniform(-0.3, 1.3, (8, 1))
        off = 10.0 ** -random.uniform(2, 9, (8, 1)) * random.normal(size=(8, 3))
        triangles = np.stack([a, b, a + along * (b - a) + off], axis=1)
        triangles[0, 1] = triangles[0, 0]  # a segment
        triangles[1] = triangles[1, 0]  # a point
        points = random.uniform(-1.5, 1.5, (60, 3))
        points[::2] = triangles[np.arange(30) % 8].mean(axis=1) + 1e-6 * points[::2]
        error = max(error, distance_error(device, triangles, points))
    return error


@case("distances at 1e12, 1e-12, 1e8 off", "a ball: rational arithmetic", "extents", EXACT)
def coordinates(device: Device, full: bool) -> float:
    vertices, faces = shapes.ball(1)
    spread = 3 * sample_cube(300 if full else 30) - 1.5
    errors = [
        distance_error(device, (vertices * factor + offset)[faces], spread * factor + offset)
        for factor, offset in SCALES
    ]
    return max(errors)


@case("nearest points of slivers", "faces and ways: rational arithmetic", "extents", 4 * EXACT)
def nearest(device: Device, full: bool) -> float:
    random, error = np.random.default_rng(2), 0.0
    for _ in range(12 if full else 2):
        corners = random.uniform(-1, 1, (8, 3, 3))
        corners[:, 2] = corners[:, 0] + 10.0 ** -random.uniform(1, 9, (8, 1)) * corners[:, 2]
        mesh = loose(corners)
        points = random.uniform(-1.5, 1.5, (40, 3))
        found = SignedDistance(mesh, "none", device)(points, gradient=True, nearest=True, face=True)
        exact = oracles.distances(points, corners)
        reached = found.nearest + exact[:, None] * found.gradient
        off = [
            oracles.distances(point[None], corners[face][None])[0]
            for point, face in zip(found.nearest, found.face, strict=True)
        ]
        wrong = [np.abs(found.distance - exact), np.abs(reached - points), np.array(off)]
        extent = float(np.ptp(mesh.bounds, axis=0).max())
        error = max(error, *(float(values.max()) / extent for values in wrong))
    return error


@case("bounds between discs of slivers", "their height, 0 too; 1e12, 1e-12, 1e8 off", "extents", 0)
def bounds(device: Device, full: bool) -> float:
    """Return the most by which a known distance lies outside its bounds, or the bounds lie further
    apart than was asked for, in extents of the mesh."""
    worst, (cone, faces) = 0.0, crowds.fan(250 if full else 100)
    disc = cone * np.array([1, 1, 0])
    for (factor, offset), height in itertools.product(SCALES, (0.125, 0.0)):
        other = disc + np.array([0, 0, height])
        other[0, :2] = 0.75, 0.25  # the slivers' common corner
        a, b = (mesh_from_arrays(v * factor + offset, faces) for v in (disc, other))
        known, size = abs(b.vertices[0, 2] - a.vertices[0, 2]), 2 * abs(factor)
        apart = hausdorff(a, b, 1e-3 * size, device)
        for way in (apart.a_to_b, apart.b_to_a):
            beyond = way.lower - known, known - way.upper, way.upper - way.lower - 1e-3 * size
            worst = max(worst, *(float(x / size) for x in beyond))
    return worst


@case("winding numbers", "of a ball with a hole: solid angles one by one, numpy", "turns", WINDING)
def winding(device: Device, full: bool) -> float:
    vertices, faces = shapes.ball(5 if full else 4)
    faces = faces[faces.max(axis=1) != 4]  # no face about the pole
    points = 4 * sample_cube(2000 if full else 300) - 2
    found = WindingNumber(mesh_from_arrays(vertices, faces), device)(points)
    expected = oracles.winding_numbers(points, vertices[faces])
    return float(np.abs(found - expected).max())


def box_error(device: Device, low: np.ndarray, high: np.ndarray, level: int = 5) -> float:
    """Return the largest error of a box's field, over its bounds and over the promised limit for
    triangles between samples; at points everywhere, and near two of the sides."""
    mesh = mesh_from_arrays(*shapes.box(low, high))
    field = build_adf(mesh, device, tolerance=2e-3, max_level=level)
    spread = sample_cube(POINTS)
    around = np.minimum(2 * (high - low), field.side / 20)
    near = low - around + (high - low + 2 * around) * spread
    points = np.concatenate([np.array(field.origin) + field.side * spread, near])

    def exact(points: np.ndarray) -> np.ndarray:
        return to_box(points, low, high)

    slip = math.sqrt(3) / 2 * CROSSED * field.tolerance * field.side
    promised = np.abs(query_adf(field, points, device=device).distance - exact(points)) / slip
    return max(over_bound(field, exact, points, device), float(promised.max()))


@case("walls thinner than a cell", "boxes to 1e-9 thick: their formula", "of the bound", 1)
def walls(device: Device, full: bool) -> float:
    low = np.array([0.1, 0.2, 0.3])
    thin = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-9) if full else (1e-3, 1e-9)
    return max(box_error(device, low, low + np.array([1.0, 0.7, thickness])) for thickness in thin)


@case("fields at 1e12, 1e-12, 1e8 off", "boxes: their formula", "of the bound", 1)
def scales(device: Device, full: bool) -> float:
    ends = np.array([np.zeros(3), [1.0, 0.75, 0.5]])
    boxes = (np.sort(ends * factor + offset, axis=0) for factor, offset in SCALES)
    return max(box_error(device, low, high, 7 if full else 5) for low, high in boxes)


@case("tolerance 0", "distances that a field of a ball stores: rational arithmetic", "ulp", 0.501)
def nothing_allowed(device: Device, full: bool) -> float:
    vertices, faces = shapes.ball(1)
    level = 5 if full else 4
    mesh = mesh_from_arrays(vertices, faces)
    field = build_adf(mesh, device, tolerance=0, max_level=level, sign="none", continuous=False)
    levels, cells = cell_of(field.blocks)
    random, count = np.random.default_rng(3), 1000 if full else 100
    block, (x, y, z) = random.integers(0, len(cells), count), random.integers(0, 3, (3, count))
    at = np.ldexp(2 * cells[block] + np.stack([x, y, z], axis=1), -levels[block, None] - 1)
    points = np.array(field.origin) + field.side * at
    exact = oracles.distances(points, vertices[faces]) / field.side
    error = np.abs(field.voxels[block, z, y, x] - exact)
    return float((error / np.spacing(exact.astype(np.float32))).max())


@case("level 12", "two specks at opposite corners: rational arithmetic", "of the bound", 1)
def deepest(device: Device, full: bool) -> float:
    speck = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.5**11
    faces = shapes.TETRAHEDRON_FACES
    vertices, faces = shapes.join((speck, faces), (np.ones(3) - speck, faces))
    field = build_adf(
        mesh_from_arrays(vertices, faces), device, tolerance=1e-6, max_level=DEEPEST, band=1e-3,
        sign="none",
    )  # fmt: skip
    if field.depth != DEEPEST:
        return math.inf
    spread = sample_cube(300 if full else 50)
    near = (2 * spread - 1) * 0.5**10
    points = np.concatenate([spread, near, 1 - near])

    def exact(points: np.ndarray) -> np.ndarray:
        return oracles.distances(points, vertices[faces])

    return over_bound(field, exact, points, device)


@case("adversarial hash keys", "lines, planes, lattices, equal remainders: a slot each",
      "keys wrong", 0)  # fmt: skip
def hashes(device: Device, full: bool) -> int:
    random = np.random.default_rng(4)
    lattices = [(2000, 1, 1, 50), (1, 1, 900, 1024), (90, 90, 1, 512), (20, 20, 20, 17),
                (10, 10, 10, 1, 2 * 3 * 4 * 5 * 7)]  # fmt: skip
    ranges = [(MAX_KEY + 1, 20_000), (100, 20_000)]
    if full:
        lattices += [(120, 120, 1, 512), (1, 90, 90, 333), (31, 32, 33, 1024)]
        ranges.append((1 << 13, 500_000))
    sets = [
        *(_lattice(*numbers) for numbers in lattices),
        np.concatenate([_lattice(n, n, n, n) for n in (1, 2, 4, 8, 16, 32)]),
        np.concatenate([_lattice(10, 10, 5)[:-1], [[41, 1, 1]]]),  # two equal modulo m and r
        *(np.unique(random.integers(1, end, (count, 3)), axis=0) for end, count in ranges),
    ]
    return sum(len(keys) - len(set(slots(build_hash(keys, device), keys))) for keys in sets)


def _lattice(nx: int, ny: int, nz: int, low: int = 1, step: int = 1) -> np.ndarray:
    return low + step * np.indices((nx, ny, nz)).reshape(3, -1).T


def slots(table: SpatialHash, keys: np.ndarray) -> list[int]:
    """Return the slots, from the definition, one key at a time."""
    found = []
    for key in keys.tolist():
        i, j, k = (p % table.r for p in key)
        offset = table.offsets[k, j, i].tolist()
        w = offset[3] if len(offset) == 4 else table.m
        x, y, z = ((p % w + t) % table.m for p, t in zip(key, offset[:3], strict=True))
        found.append(x + table.m * (y + table.m * z))
    return found


@case("rays along faces of leaves", "a box, except rays beside its outline: which hit",
      "rays wrong", 0)  # fmt: skip
def rays(device: Device, full: bool) -> int:
    low, high = np.zeros(3), np.array([1.0, 0.75, 0.5])
    mesh = mesh_from_arrays(*shapes.box(low, high))
    level = 7 if full else 5
    field = build_adf(mesh, device, tolerance=2e-3, max_level=level)
    size, wrong = 2 << level, 0
    step = field.side / size
    # wholes and halves of the edge of the smallest leaf, from the cube's corner
    middle = np.array(field.origin) + step * (size // 2 + 0.5)
    places = middle[:, None] + step * (np.arange(size) + 0.5 - size / 2)
    # (3, size): outside the box along each axis, negative inside
    beyond = np.maximum(low[:, None] - places, places - high[:, None])
    for axis in range(3):
        origin = middle + 2 * field.side * np.eye(3)[axis]
        picture = FieldScene(field).draw(shapes.rays_along(axis, origin, step, size), device)
        apart = np.maximum(beyond[axis - 2], beyond[axis - 1][:, None])
        clear = np.abs(apart) > 2 * step  # an edge of the smallest leaf
        wrong += int(np.count_nonzero((picture[..., 3] == 1)[clear] != (apart < 0)[clear]))
    return wrong


@case("surfaces of fields", "around a sheet at 1e12, 1e-12, 1e8 off: its formula; closed",
      "tolerances", 1)  # fmt: skip
def surfaces(device: Device, full: bool) -> float:
    """The largest distance of vertices from the surface around a box of slivers; infinite if it is
    not closed and of one piece without handles, or sharp with faces that pass through others."""
    worst = 0.0
    for factor, offset in SCALES:
        ends = np.array([np.zeros(3), [1.0, 0.75, 1e-3]])
        low, high = np.sort(ends * factor + offset, axis=0)
        mesh, tolerance = mesh_from_arrays(*shapes.box(low, high)), 2e-3 if full else 4e-3
        field = build_adf(mesh, device, tolerance=tolerance, max_level=8 if full else 7)
        for far in (0.03, 0.05):
            for source in (mesh, None):  # sharp, and rounded off
                surface = extract_field_surface(field, offset=far * field.side, source=source)
                found = surface.check()
                whole = found["closed"] and (found["shells"], found["genus"]) == (1, 0)
                if not whole or found.get("self_intersecting_faces"):
                    return math.inf
            error = np.abs(to_box(surface.vertices, low, high) - far * field.side).max()
            worst = max(worst, float(error) / (tolerance * field.side))
    return worst


@case("hardware sampler", "exact values; 2^-9 of corners' range an axis; 0 if none", "of the bound",
      1)  # fmt: skip
def sampler(device: Device, full: bool) -> float:
    try:
        check_filter(device)
    except DeviceError:
        return 0.0  # it has no such images, and the sampler is refused
    error = 0.0
    for level, tolerance in ((3, 1e-2), (9, 1e-6)) if full else ((3, 1e-2), (7, 1e-5)):
        mesh = mesh_from_arrays(*shapes.octahedron(np.zeros(3), 1))
        field = build_adf(mesh, device, tolerance=tolerance, max_level=level, band=0.01)
        spread = sample_cube(POINTS)
        near = np.eye(3)[0] + (2 * spread - 1) * 0.5**level  # a vertex, where leaves are small
        points = np.concatenate([np.array(field.origin) + field.side * spread, near])
        exact = query_adf(field, points, cell=True, device=device)
        found = query_adf(field, points, sampler="hardware", device=device)
        assert exact.level is not None
        assert exact.cell is not None
        off = np.abs(found.distance - exact.distance)[~exact.outside]
        bound = _filter_bound(field, exact.level, exact.cell, device)[~exact.outside]
        error = max(error, float((off / bound).max()))
    return error


def _filter_bound(
    field: DistanceField, levels: np.ndarray, cells: np.ndarray, device: Device
) -> np.ndarray:
    """Return the largest correct error of a filter in leaves, world units: FILTER_STEP of the range
    of the corners an axis, and the rounding of the place in the texture to float32."""
    edge = field.side * 0.5 ** levels.astype(float)[:, None, None]
    within = 5e-10 + (1 - 1e-9) * np.indices((2, 2, 2)).reshape(3, 8).T  # of the leaf
    corners = np.array(field.origin) + edge * (cells[:, None] + within)
    values = query_adf(field, corners.reshape(-1, 3), device=device).distance.reshape(-1, 2, 2, 2)
    ranges = sum(np.abs(np.diff(values, axis=axis)).max(axis=(1, 2, 3)) for axis in (1, 2, 3))
    return (FILTER_STEP + ROUNDED_PLACE) * ranges + 1e-6 * np.abs(values).max(axis=(1, 2, 3))


CASES = (needles, coordinates, nearest, bounds, winding, walls, scales, nothing_allowed, deepest,
         hashes, rays, surfaces, sampler)  # fmt: skip
