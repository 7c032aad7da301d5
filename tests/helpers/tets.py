"""Meshes of volume cells for tests, and what pictures of them should be."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from voxtool.camera import Camera, Rays
from voxtool.opencl import default_device
from voxtool.selftest.reference import reference
from voxtool.tets.construction.conforming import ConformingCells, tetrahedra
from voxtool.tets.construction.neighbours import match_faces
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.scene import VolumeScene
from voxtool.tets.pictures.transfer import TransferFunction
from voxtool.tets.volume.mesh import UnstructuredMesh, volume_cells
from voxtool.tets.volume.volume import TetVolume

SQUARE = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
CUBE = np.array([(x, y, z) for z in (0.0, 1.0) for x, y in SQUARE])
WEDGE = CUBE[[0, 1, 3, 4, 5, 7]]
PYRAMID = np.concatenate([CUBE[:4], [(0.5, 0.5, 0.5)]])
SOLIDS = {"hexahedron": CUBE, "wedge": WEDGE, "pyramid": PYRAMID, "tetra": CUBE[[0, 1, 3, 4]]}
VOLUMES = {"hexahedron": 6, "wedge": 3, "pyramid": 1, "tetra": 1}  # six times
QUADS = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
# Corners 4 x + 2 y + z of a cube: in VTK's order; in Kuhn's six tetrahedra, the ways from corner 0
# to corner 7; and in five.
VTK = [0, 4, 6, 2, 1, 5, 7, 3]
SIX = np.array([np.cumsum([0, *way]) for way in itertools.permutations((1, 2, 4))])
FIVE = np.array([(0, 1, 2, 4), (3, 1, 2, 7), (5, 1, 4, 7), (6, 2, 4, 7), (1, 2, 4, 7)])


# ---- meshes


def linear(points: np.ndarray) -> np.ndarray:
    """A scalar that float64 has exactly at small whole coordinates."""
    return 3 + points[:, 0] - 2 * points[:, 1] + 0.5 * points[:, 2]


def wavy(points: np.ndarray) -> np.ndarray:
    """A scalar from -2 to 2 or so on the box from -1 to 1."""
    return np.sin(3 * points[:, 0]) + points[:, 1] * points[:, 2]


def unstructured(
    points: Any, cells: list[tuple[str, Any]], scalars: Any = None, **more: Any
) -> UnstructuredMesh:
    points = np.asarray(points, float)
    blocks = [(kind, np.asarray(block, np.int64)) for kind, block in cells]
    scalars = linear(points) if scalars is None else scalars
    return UnstructuredMesh(points, blocks, scalars, "s", **more)


def tet_mesh(points: Any, cells: Any, scalars: Any = None, **more: Any) -> UnstructuredMesh:
    return unstructured(points, [("tetra", cells)], scalars, **more)


def grid_points(shape: tuple[int, ...]) -> np.ndarray:
    """(n, 3) float64: the corners of unit cubes."""
    axes = (np.arange(n + 1.0) for n in shape)
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def grid_corners(shape: tuple[int, ...]) -> np.ndarray:
    """(cubes, 8) int: the corners 4 x + 2 y + z of each cube."""
    numbers = np.arange(np.prod(np.add(shape, 1))).reshape(np.add(shape, 1))
    ends = itertools.product(*(((0, n), (1, n + 1)) for n in shape))
    return np.stack([numbers[tuple(slice(*end) for end in e)].ravel() for e in ends], axis=1)


def lattice(shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Points and hexahedra of a box of unit cubes, x changing fastest."""
    back = shape[::-1]
    return grid_points(back)[:, ::-1], grid_corners(back)[:, [0, 1, 3, 2, 4, 5, 7, 6]]


def boxes(points: np.ndarray, shape: tuple[int, int, int], scalars: np.ndarray) -> Any:
    """A grid with a scalar each cube, as hexahedra and as six tetrahedra a cube."""
    corners = grid_corners(shape)
    cut = tet_mesh(points, corners[:, SIX].reshape(-1, 4), [np.repeat(scalars, 6)])
    return unstructured(points, [("hexahedron", corners[:, VTK])], [scalars]), cut


def tet_grid(
    shape: tuple[int, int, int], seed: int | None = None, holes: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Cubes cut in six; with a seed, the points moved at random and a share of the cells gone.

    Returns points (P, 3) float64 in [-1, 1] or so, and cells (T, 4) int.
    """
    points = grid_points(shape)
    cells = grid_corners(shape)[:, SIX].reshape(-1, 4)
    if seed is not None:
        random = np.random.default_rng(seed)
        points += random.uniform(-0.2, 0.2, points.shape)
        cells = cells[random.random(len(cells)) >= holes]
    return points / (np.array(shape) / 2) - 1, cells


def cube(pieces: int) -> UnstructuredMesh:
    """The unit cube as 5, 6 or 24 tetrahedra."""
    points, cells = CUBE, np.argsort(VTK)[FIVE if pieces == 5 else SIX]
    if pieces == 24:
        centres = [CUBE[list(quad)].mean(axis=0) for quad in QUADS]
        points = np.concatenate([CUBE, centres, [(0.5, 0.5, 0.5)]])
        sides = itertools.product(enumerate(QUADS), range(4))
        cells = np.array([(14, q[i], q[(i + 1) % 4], 8 + face) for (face, q), i in sides])
    return tet_mesh(points, oriented(points, cells))


def oriented(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    cells = cells.copy()
    bad = six_volumes(points, cells) < 0
    cells[bad] = cells[bad][:, [1, 0, 2, 3]]
    return cells


def six_volumes(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    p = points[cells]
    return np.linalg.det(p[:, 1:] - p[:, :1])


def shuffled(points: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The points in another order, and the new number of each."""
    number = random.permutation(len(points))
    return points[np.argsort(number)], number


def assembly(shape: tuple[int, int, int], seed: int) -> UnstructuredMesh:
    """A box of unit cubes, its points numbered at random and the inner ones moved; each cube a
    hexahedron, two wedges or six pyramids."""
    random = np.random.default_rng(seed)
    points, hexes = lattice(shape)
    inside = ((points > 0) & (points < shape)).all(axis=1)
    points[inside] += random.uniform(-0.15, 0.15, (np.count_nonzero(inside), 3))
    choice = random.choice([0, 2], size=len(hexes))
    column = hexes[:, 0] % ((shape[0] + 1) * (shape[1] + 1))
    choice[np.isin(column, random.permutation(np.unique(column))[::3])] = 1  # wedges are stacked
    blocks: dict[str, list[Any]] = {"hexahedron": [], "wedge": [], "pyramid": []}
    centres = []
    for cell, kind in zip(hexes, choice, strict=True):
        if kind == 0:
            blocks["hexahedron"].append(cell)
        elif kind == 1:
            blocks["wedge"] += [cell[[0, 1, 2, 4, 5, 6]], cell[[0, 2, 3, 4, 6, 7]]]
        else:
            apex = len(points) + len(centres)
            centres.append(points[cell].mean(axis=0))
            blocks["pyramid"] += [(*cell[list(quad)][::-1], apex) for quad in QUADS]
    points, number = shuffled(np.concatenate([points, np.reshape(centres, (-1, 3))]), random)
    cells = [(kind, number[np.array(block)]) for kind, block in blocks.items() if block]
    return unstructured(points, cells)


def write_vtu(path: Path) -> None:
    """A box of cells of three kinds, with density and momentum at points and region at cells."""
    import meshio

    mesh = assembly((4, 3, 3), 0)
    x, y, z = mesh.points.T
    density = 1 + x * y * (3 - z)
    momentum = np.stack([density, x - y, z * z], axis=1)
    regions = [np.arange(len(block)) % 3 for _, block in mesh.cells]
    data: dict[str, Any] = {
        "point_data": {"density": density, "momentum": momentum},
        "cell_data": {"region": regions},
    }
    cells: Any = mesh.cells
    meshio.write(path, meshio.Mesh(mesh.points, cells, **data))


# ---- volumes


def copy_netcdf(source: Path, path: Path, format: str) -> None:
    """Copy an Exodus file to another format of netCDF, as "NETCDF3_CLASSIC"."""
    import netCDF4

    with netCDF4.Dataset(source) as old, netCDF4.Dataset(path, "w", format=format) as new:
        for name, dimension in old.dimensions.items():
            new.createDimension(name, None if name == "time_step" else dimension.size or 1)
        for name, variable in old.variables.items():
            kind = "i4" if variable.dtype == "i8" else variable.dtype  # which CDF-1 lacks
            copy = new.createVariable(name, kind, variable.dimensions)
            copy.setncatts({key: variable.getncattr(key) for key in variable.ncattrs()})
            copy[:] = variable[:]


def face_sets(cells: np.ndarray) -> dict[frozenset[int], list[tuple[int, int]]]:
    """The cells of each face of tetrahedra, and the number of the face in each."""
    found: dict[frozenset[int], list[tuple[int, int]]] = {}
    for cell, vertices in enumerate(cells.tolist()):
        for face in range(4):
            key = frozenset(vertices[:face] + vertices[face + 1 :])
            found.setdefault(key, []).append((cell, face))
    return found


class Matched(NamedTuple):
    """A ConformingMesh, and the cell across each face, (T, F) int32."""

    vertices: np.ndarray
    cells: np.ndarray
    neighbours: np.ndarray
    scalars: np.ndarray
    report: dict[str, Any]


def matched(found: ConformingCells) -> Matched:
    """Cells and their neighbours on the host."""
    neighbours, counts = match_faces(found.cells, found.corners, found.count, len(found.vertices))
    mesh = found.on_host()
    across = neighbours.get().reshape(found.count, -1)
    return Matched(mesh.vertices, mesh.cells, across, mesh.scalars, {**mesh.report, **counts})


def assert_matched(mesh: Matched | TetVolume) -> int:
    """Neighbours are the two cells of each face; how many faces have one cell."""
    single = 0
    for sides in face_sets(mesh.cells).values():
        assert len(sides) <= 2
        if len(sides) == 1:
            single += 1
            assert mesh.neighbours[sides[0]] == -1
        else:
            assert mesh.neighbours[sides[0]] == sides[1][0]
            assert mesh.neighbours[sides[1]] == sides[0][0]
    return single


def split(mesh: UnstructuredMesh, *arguments: Any, **options: Any) -> Matched:
    """The cells of a mesh as tetrahedra."""
    return matched(tetrahedra(default_device(), volume_cells(mesh), *arguments, **options))


def built(mesh: UnstructuredMesh, *arguments: Any, **options: Any) -> TetVolume:
    """A volume that is sound."""
    volume = build_tet(mesh, *arguments, **options)
    volume.validate()
    return volume


# ---- pictures


def draw(content, rays: Rays, transfer: TransferFunction, device, *how, **decisions) -> np.ndarray:
    """The picture of a volume, or of a mesh's, by a method and an integrator."""
    volume = content if isinstance(content, TetVolume) else build_tet(content)
    return VolumeScene(volume, transfer, *how, **decisions).draw(rays, device)


def ramp(
    low: float, high: float, extinction: float, steps: int = 4, seed: int = 5
) -> TransferFunction:
    """Random colours, and random extinctions up to a largest, over a range of scalars."""
    random = np.random.default_rng(seed)
    colours = random.random((steps, 3))
    return TransferFunction(
        np.linspace(low, high, steps), colours, extinction * random.random(steps)
    )


def reference_picture(mesh: UnstructuredMesh, transfer: TransferFunction, rays: Rays) -> np.ndarray:
    """(H, W, 4) float64."""
    cells = mesh.cells[0][1]
    scalars = mesh.scalars[0] if isinstance(mesh.scalars, list) else mesh.scalars
    width, height = rays.size
    picture = reference(mesh.points, cells, scalars, transfer, rays, constant=mesh.constant)
    return picture.reshape(height, width, 4)


def rays_of(mesh: UnstructuredMesh, view: str, fov: float | None, size=(40, 32)) -> Rays:
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    return Camera.fit(low, high, view, fov=fov).rays(*size)
