"""Voxels of stiff and extreme meshes, compared with rational arithmetic or formulas."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import MAX_DIM
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.opencl import Device
from voxtool.selftest import oracles, shapes
from voxtool.selftest.case import case
from voxtool.selftest.crowds import CROWDS
from voxtool.spatial.orientation import orient
from voxtool.svo.pictures.raycast import depths
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from voxtool.svo.octree.octree import Octree

ORACLES = {
    "surface26": oracles.surface26,
    "surface6": oracles.surface6,
    "solid": oracles.solid,
}
UNIT = 1 << FIXED_POINT_BITS  # a voxel: vertices are in 1/256 of it
SMALL = (14, 12, 13)  # of a grid that rational arithmetic goes through
DENSE_DIM = 128  # up to which single voxels are compared with a formula
ASPECT = 1_000_000  # of needles
CLEAR = 0.01  # of a winding number from 1/2, where its series may err
MILLION = 1_000_000  # triangles in a voxel
SCALES = ((1e12, 0.0), (1e-12, 0.0), (1.0, 1e8), (-1.0, -1e8))  # factor, and then offset


def lattice_mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return a mesh of vertices in 1/256 voxel."""
    return mesh_from_arrays(np.asarray(vertices, np.float64) / UNIT, faces)


def lattice_grid(x: int, y: int, z: int) -> Grid:
    """Return a grid whose voxels are the world's units."""
    return Grid((x, y, z), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def set_voxels(device: Device, mesh: Mesh, grid: Grid, mode: str, **options: Any) -> Octree:
    """Return the octree, solids by parity; raises FileError if its structure is invalid."""
    octree = voxelize(mesh, grid, mode, device=device, **{"fill": "parity", **options})
    octree.validate()
    return octree


def wrong(octree: Octree, expected: Iterable[Sequence[int]]) -> int:
    """Return the number of voxels whose state differs from the expected one."""
    return len({tuple(cell) for cell in octree.occupied().tolist()} ^ set(map(tuple, expected)))


def wrong_by_oracles(
    device: Device,
    mesh: Mesh,
    grid: Grid,
    triangles: np.ndarray,
    window: tuple[list[int], list[int]] | None = None,
) -> int:
    """Return the number of voxels that differ from the oracles in any mode.

    triangles : those of the mesh, in 1/256 voxel from the low corner of the grid or the window.
    """
    shape = window[1] if window else grid.shape
    return sum(
        wrong(set_voxels(device, mesh, grid, mode, window=window), oracle(triangles, shape))
        for mode, oracle in ORACLES.items()
    )


def wrong_on_lattice(device: Device, vertices: np.ndarray, faces: np.ndarray) -> int:
    """Return the number of voxels that differ from the oracles, for a mesh of vertices in 1/256
    voxel in a small grid."""
    mesh = lattice_mesh(vertices, faces)
    return wrong_by_oracles(device, mesh, lattice_grid(*SMALL), vertices[faces])


@case("needles", "aspect 1e6, through and far beyond the grid: rational arithmetic",
      "voxels wrong", 0)  # fmt: skip
def needles(device: Device, full: bool) -> int:
    random, found = np.random.default_rng(1), 0
    middle = UNIT * np.array(SMALL) // 2
    for width in (1, 256):  # of which the longer ones take the wide path
        parts = []
        for _ in range(12 if full else 3):
            way = random.normal(size=3)
            way = np.rint(way / np.abs(way).max() * width * ASPECT).astype(np.int64)
            start = middle + random.integers(-3 * UNIT, 3 * UNIT, 3) - way // 3
            ends = start + np.array([[0, 0, 0], [width, 0, 0], [0, width, width]])
            corners = np.concatenate([ends, [start + way]])
            parts.append((corners, shapes.TETRAHEDRON_FACES))
        found += wrong_on_lattice(device, *shapes.join(*parts))
    return found


@case("zero-area faces", "segments, points, copies, turned copies: rational arithmetic",
      "voxels wrong", 0)  # fmt: skip
def flat_faces(device: Device, full: bool) -> int:
    random, found = np.random.default_rng(2), 0
    for _ in range(8 if full else 2):
        count = 8
        corners = random.integers(-4, 4 * (np.array(SMALL) + 1), (3 * count, 3)) * (UNIT // 4)
        faces = np.arange(3 * count).reshape(-1, 3)
        a, b, c = faces.T
        middles = (corners[a] + corners[b]) // 2 * 2 - corners[a]  # on a line, or next to it
        vertices = np.concatenate([corners, middles, 2 * corners[a] - corners[b]])
        d, e = a // 3 + len(corners), a // 3 + len(corners) + count
        degenerate = [(a, b, b), (c, c, c), (a, b, d), (e, a, b)]
        copies = [(c, b, a), (b, c, a), (a, b, c)]
        every = [np.stack(columns, axis=1) for columns in ((a, b, c), *degenerate, *copies)]
        faces = random.permutation(np.concatenate([some[::2] for some in every]))
        found += wrong_on_lattice(device, vertices, faces)
    return found


@case("crowded vertices, edges and lines", "fans, books, needles, copies: rational arithmetic",
      "voxels wrong", 0)  # fmt: skip
def crowds(device: Device, full: bool) -> int:
    found, count = 0, 64 if full else 16
    for kind in CROWDS.values():
        corners, faces = kind(count)
        low, high = corners.min(axis=0), corners.max(axis=0)
        place = (corners - low) / (high - low).max()
        vertices = np.rint(UNIT * (1 + (min(SMALL) - 2) * place)).astype(np.int64)
        found += wrong_on_lattice(device, vertices, faces)
    return found


@case("faces on voxel faces", "boxes at wholes, halves, beside: rational arithmetic",
      "voxels wrong", 0)  # fmt: skip
def boundaries(device: Device, full: bool) -> int:
    random, found = np.random.default_rng(3), 0
    places = [0, 1, UNIT // 2 - 1, UNIT // 2, UNIT // 2 + 1, UNIT - 1]
    for _ in range(24 if full else 3):
        parts = []
        for corner in np.ndindex(2, 2, 2):  # one in each octant
            low = UNIT * (16 * np.array(corner) + random.integers(2, 5, 3))
            low = low + random.choice(places, 3)
            parts.append(shapes.box(low, low + UNIT * random.integers(1, 10, 3)))
        vertices, faces = shapes.join(*parts)
        mesh = lattice_mesh(vertices, faces)
        found += wrong_by_oracles(device, mesh, lattice_grid(32, 32, 32), vertices[faces])
    return found


@case("coordinates of 1e12, 1e-12, 1e8 off", "a ball on the lattice: rational arithmetic",
      "voxels wrong", 0)  # fmt: skip
def coordinates(device: Device, full: bool) -> int:
    found = 0
    points, faces = shapes.ball(2 if full else 1)
    for factor, offset in SCALES:
        mesh = mesh_from_arrays(points * factor + offset, faces)
        grid = Grid.fit(mesh, 20)
        vertices = np.array([_on_lattice(grid, vertex) for vertex in mesh.vertices.tolist()])
        found += wrong_by_oracles(device, mesh, grid, vertices[faces])
    return found


def _on_lattice(grid: Grid, point: list[float]) -> list[int]:
    """Return round(256 (p - origin) / pitch), ties to even."""
    return [
        round(UNIT * (Fraction(p) - Fraction(o)) / Fraction(pitch))
        for p, o, pitch in zip(point, grid.origin, grid.pitch, strict=True)
    ]


@case("faces turned and doubled", "by auto, a ball in a hollow one, 1e8 off: rational arithmetic",
      "wrong", 0)  # fmt: skip
def turned(device: Device, full: bool) -> int:
    """Turned and repeated faces of a closed mesh: the faces that are not turned back, and the
    voxels that differ from those of the closed mesh."""
    random, found = np.random.default_rng(8), 0
    points, faces = shapes.ball(2 if full else 1)
    points, faces = shapes.join(
        (points, faces), (0.75 * points, faces[:, ::-1]), (0.375 * points, faces)
    )
    for factor, offset in SCALES if full else SCALES[-1:]:
        closed = mesh_from_arrays(points * factor + offset, faces)
        grid = Grid.fit(closed, 24)
        vertices = np.array([_on_lattice(grid, vertex) for vertex in closed.vertices.tolist()])
        expected = list(oracles.solid(vertices[faces], grid.shape))
        for copies in (1, 2):
            every = np.tile(faces, (copies, 1))
            wrong_way = random.random(len(every)) < 0.5
            every = np.where(wrong_way[:, None], every[:, ::-1], every)
            mesh = mesh_from_arrays(closed.vertices, every)
            found += wrong(set_voxels(device, mesh, grid, "solid", fill="auto"), expected)
            back = orient(mesh, device).reversed == (wrong_way ^ (factor < 0))
            found += int(np.count_nonzero(~back))
    return found


@case("a triangle over 65,536 voxels", "windows at corners, edges and within: rational arithmetic",
      "voxels wrong", 0)  # fmt: skip
def wide(device: Device, full: bool) -> int:
    random, found, size = np.random.default_rng(5), 0, 10
    grid = lattice_grid(MAX_DIM, MAX_DIM, MAX_DIM)
    side = UNIT * MAX_DIM
    corners = np.array([[77, 3, side // 3], [side - 501, side // 5, 1000], [9, side - 5, side - 2]])
    mesh = lattice_mesh(corners, np.array([[0, 1, 2]]))
    weights = np.concatenate(
        [np.eye(3), [[0.5, 0.5, 0], [0, 0.3, 0.7]], random.dirichlet([1, 1, 1], 20 if full else 2)]
    )
    for weight in weights:
        low = np.rint(weight @ corners / UNIT).astype(np.int64) - random.integers(2, size - 2, 3)
        low = np.clip(low, 0, MAX_DIM - size)
        window = (low.tolist(), [size] * 3)
        triangles = (corners - UNIT * low)[None]
        found += wrong_by_oracles(device, mesh, grid, triangles, window)
    return found


@case("a million triangles in a voxel", "that voxel alone, by its surface and by parity",
      "voxels wrong", 0)  # fmt: skip
def crowd(device: Device, full: bool) -> int:
    random, place = np.random.default_rng(6), (100, 37, 211)
    corners = UNIT * np.array(place) + random.integers(1, UNIT, (MILLION // 2, 3, 3))
    centre = UNIT * np.array(place) + UNIT // 2
    around = shapes.octahedron(centre + 1, 60)
    # each twice, so they cross every row an even number of times; the octahedron is there once
    soup = (corners.reshape(-1, 3), np.tile(np.arange(corners.size // 3).reshape(-1, 3), (2, 1)))
    vertices, faces = shapes.join(soup, around)
    mesh, grid = lattice_mesh(vertices, random.permutation(faces)), lattice_grid(256, 256, 256)
    return sum(
        wrong(set_voxels(device, mesh, grid, mode), {place}) for mode in ("surface26", "solid")
    )


@case("dims 8 to 4096", "octahedra by their formula: all voxels, or all of their number",
      "voxels wrong", 0)  # fmt: skip
def dims(device: Device, full: bool) -> int:
    found, near = 0, 32
    more = (27, 100, 200, 777, 1025, 1500, 3000, 4095) if full else ()
    for dim in (8, 9, 16, 50, 64, 128, 300, 512, 1024, 2048, 4096, *more):
        centre, radius = _octahedron(dim)
        octree = _solid_octahedron(device, dim, centre, radius)
        if dim <= DENSE_DIM:
            expected = _within(dim, centre, radius)
            found += int(np.count_nonzero(octree.to_dense() != expected))
        else:
            x, y, z = _away(dim, centre)
            rows = np.searchsorted(np.sort(x), (radius - y[:, None] - z).ravel())
            found += abs(octree.count - int(rows.sum()))
    centre, radius = _octahedron(near)
    expected = np.argwhere(_within(near, centre, radius))
    for dim in (1024, 2048, 4096):  # a small one in the far corner
        octree = _solid_octahedron(device, dim, centre + UNIT * (dim - near), radius)
        found += wrong(octree, (expected + dim - near).tolist())
    return found


def _octahedron(dim: int) -> tuple[np.ndarray, int]:
    """Return centre and radius in 1/256 voxel: no voxel's centre is on it, as sums of three odd
    numbers are odd."""
    return UNIT * (dim // 2) + np.array([37, 59, 101]), UNIT * (dim // 2 - 1)


def _solid_octahedron(device: Device, dim: int, centre: np.ndarray, radius: int) -> Octree:
    mesh = lattice_mesh(*shapes.octahedron(centre, radius))
    return set_voxels(device, mesh, lattice_grid(dim, dim, dim), "solid")


def _away(dim: int, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (dim,) int64 each: distances of voxel centres from an octahedron's centre along each
    axis."""
    x, y, z = (np.abs(UNIT * np.arange(dim) + UNIT // 2 - c) for c in centre.tolist())
    return x, y, z


def _within(dim: int, centre: np.ndarray, radius: int) -> np.ndarray:
    """Return (dim, dim, dim) bool: the voxels whose centre is in an octahedron."""
    x, y, z = _away(dim, centre)
    return x[:, None, None] + y[:, None] + z < radius


@case("a box without two sides", "by winding numbers: solid angles one by one, numpy",
      "voxels wrong", 0)  # fmt: skip
def open_box(device: Device, full: bool) -> int:
    found, dim = 0, 40 if full else 24
    vertices, faces = shapes.box(UNIT * np.array([4, 5, 6]) + 9, UNIT * (dim - 5) + np.arange(3))
    centres = np.indices((dim,) * 3).reshape(3, -1).T + 0.5
    # two that meet, so that what divides inside from outside is bent; each has two faces
    for one, other in combinations(range(6), 2) if full else ((0, 2), (3, 4)):
        kept = np.delete(faces, [2 * one, 2 * one + 1, 2 * other, 2 * other + 1], axis=0)
        octree = set_voxels(
            device,
            lattice_mesh(vertices, kept),
            lattice_grid(dim, dim, dim),
            "solid",
            fill="winding",
        )
        number = oracles.winding_numbers(centres, vertices[kept] / UNIT)
        clear = np.abs(number - 0.5) > CLEAR
        found += int(np.count_nonzero((octree.to_dense().ravel() != (number > 0.5))[clear]))
    return found


@case("rays along edges of voxels", "straight through edges, faces and corners: exact depths",
      "voxels", 1e-9)  # fmt: skip
def rays(device: Device, full: bool) -> float:
    low, high = np.array([3, 2, 4]), np.array([11, 13, 10])
    mesh = lattice_mesh(*shapes.box(UNIT * low, UNIT * high))
    octree = set_voxels(device, mesh, lattice_grid(16, 16, 16), "solid")
    error, size = 0.0, 64
    steps = 8.25 + 0.5 * (np.arange(size) + 0.5 - size / 2)  # wholes and halves of voxels
    for axis, sign in product(range(3), (1, -1)):
        origin = np.full(3, 8.25)
        origin[axis] = -4 if sign > 0 else 20
        found = depths(octree, shapes.rays_along(axis, origin, 0.5, size, sign), device=device)
        u, v = axis - 2, axis - 1
        across, down = ((steps >= low[a]) & (steps < high[a]) for a in (u, v))
        met = down[:, None] & across
        if not np.array_equal(np.isfinite(found), met):
            return np.inf
        depth = low[axis] + 4 if sign > 0 else 20 - high[axis]
        error = max(error, float(np.abs(found[met] - depth).max()))
    return error


CASES = (needles, flat_faces, crowds, boundaries, coordinates, turned, wide, crowd, dims,
         open_box, rays)  # fmt: skip
