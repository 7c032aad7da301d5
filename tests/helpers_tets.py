"""Meshes of volume cells for tests."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from voxtool.tets.conforming import tetrahedra
from voxtool.tets.mesh import ConformingMesh, UnstructuredMesh, volume_cells
from voxtool.tets.textures import build_tet
from voxtool.tets.volume import TetVolume

SQUARE = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
CUBE = np.array([(x, y, z) for z in (0.0, 1.0) for x, y in SQUARE])
WEDGE = CUBE[[0, 1, 3, 4, 5, 7]]
PYRAMID = np.concatenate([CUBE[:4], [(0.5, 0.5, 0.5)]])
SOLIDS = {"hexahedron": CUBE, "wedge": WEDGE, "pyramid": PYRAMID, "tetra": CUBE[[0, 1, 3, 4]]}
VOLUMES = {"hexahedron": 6, "wedge": 3, "pyramid": 1, "tetra": 1}  # six times
QUADS = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]


def linear(points: np.ndarray) -> np.ndarray:
    """A scalar that float64 has exactly at small whole coordinates."""
    return 3 + points[:, 0] - 2 * points[:, 1] + 0.5 * points[:, 2]


def unstructured(
    points: Any, cells: list[tuple[str, Any]], scalars: Any = None, **more: Any
) -> UnstructuredMesh:
    points = np.asarray(points, float)
    blocks = [(kind, np.asarray(block, np.int64)) for kind, block in cells]
    if scalars is None:
        scalars = linear(points)
    return UnstructuredMesh(points, blocks, scalars, "s", **more)


def tet_mesh(points: Any, cells: Any, scalars: Any = None, **more: Any) -> UnstructuredMesh:
    return unstructured(points, [("tetra", cells)], scalars, **more)


def cube(pieces: int) -> UnstructuredMesh:
    """The unit cube as 5, 6 or 24 tetrahedra."""
    if pieces == 5:
        cells = [(0, 1, 2, 5), (0, 2, 7, 5), (0, 2, 3, 7), (0, 5, 7, 4), (2, 7, 5, 6)]
        return tet_mesh(CUBE, cells)
    if pieces == 6:
        cells = []
        for order in permutations(range(3)):
            corners = np.zeros((4, 3))
            for step, axis in enumerate(order):
                corners[step + 1 :, axis] = 1
            cells.append([int(np.flatnonzero((c == CUBE).all(axis=1))[0]) for c in corners])
        return tet_mesh(CUBE, oriented(CUBE, np.array(cells)))
    centres = [CUBE[list(quad)].mean(axis=0) for quad in QUADS]
    points = np.concatenate([CUBE, centres, [(0.5, 0.5, 0.5)]])
    cells = [
        (14, quad[i], quad[(i + 1) % 4], 8 + face)
        for face, quad in enumerate(QUADS)
        for i in range(4)
    ]
    return tet_mesh(points, oriented(points, np.array(cells)))


def oriented(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    cells = cells.copy()
    bad = six_volumes(points, cells) < 0
    cells[bad] = cells[bad][:, [1, 0, 2, 3]]
    return cells


def six_volumes(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    p = points[cells]
    return np.linalg.det(p[:, 1:] - p[:, :1])


def lattice(shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Points and hexahedra of a box of unit cubes."""
    nx, ny, nz = (n + 1 for n in shape)
    points = np.array([(x, y, z) for z in range(nz) for y in range(ny) for x in range(nx)], float)
    corner = CUBE.astype(int) @ (1, nx, nx * ny)
    cells = [
        x + nx * (y + ny * z) + corner
        for z in range(shape[2])
        for y in range(shape[1])
        for x in range(shape[0])
    ]
    return points, np.array(cells)


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
    points = np.concatenate([points, np.reshape(centres, (-1, 3))])
    number = random.permutation(len(points))
    shuffled = np.empty_like(points)
    shuffled[number] = points
    cells = [(kind, number[np.array(block)]) for kind, block in blocks.items() if block]
    return unstructured(shuffled, cells)


def write_vtu(path: Path) -> None:
    """A box of cells of three kinds, with density and momentum at points and region at cells."""
    import meshio

    mesh = assembly((4, 3, 3), 0)
    x, y, z = mesh.points.T
    density = 1 + x * y * (3 - z)
    momentum = np.stack([density, x - y, z * z], axis=1)
    regions = [np.arange(len(block)) % 3 for _, block in mesh.cells]
    meshio.write(
        path,
        meshio.Mesh(
            mesh.points,
            mesh.cells,  # pyright: ignore[reportArgumentType]
            point_data={"density": density, "momentum": momentum},
            cell_data={"region": regions},  # pyright: ignore[reportArgumentType]
        ),
    )


def face_sets(cells: np.ndarray) -> dict[frozenset[int], list[tuple[int, int]]]:
    """Which cells have each face of tetrahedra, and as which."""
    found: dict[frozenset[int], list[tuple[int, int]]] = {}
    for cell, vertices in enumerate(cells.tolist()):
        for face in range(4):
            key = frozenset(vertices[:face] + vertices[face + 1 :])
            found.setdefault(key, []).append((cell, face))
    return found


def assert_matched(mesh: ConformingMesh | TetVolume) -> int:
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


def split(mesh: UnstructuredMesh, *arguments: Any, **options: Any) -> ConformingMesh:
    """The cells of a mesh as tetrahedra."""
    return tetrahedra(volume_cells(mesh), *arguments, **options)


def built(mesh: UnstructuredMesh, *arguments: Any, **options: Any) -> TetVolume:
    """A volume that is sound."""
    volume = build_tet(mesh, *arguments, **options)
    volume.validate()
    return volume
