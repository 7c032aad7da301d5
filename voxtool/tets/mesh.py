"""Meshes of volume cells: as a file has them, as checked cells, and as cells of one kind."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from voxtool.errors import MeshError, count_of
from voxtool.tets.volume import HEXAHEDRON_FACES, TETRAHEDRON_FACES

# The faces of each kind of cell, wound outward, with vertices as VTK numbers them.
CELL_FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "tetra": TETRAHEDRON_FACES,
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": HEXAHEDRON_FACES,
}
CORNERS = {"tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
FLAT = ("vertex", "line", "triangle", "quad", "polygon", "pixel")  # and their curved forms


@dataclass(frozen=True, eq=False)
class UnstructuredMesh:
    """A mesh of volume cells of several kinds, with a scalar.

    Attributes
    ----------
    points : (P, 3) float64
        World units.
    cells : list of (str, (N, k) int64)
        Blocks of cells: the kind in meshio's names (tetra, hexahedron, wedge, pyramid, tetra10,
        ...), and the points of each cell in VTK's order.
    scalars : (P,) float64, or list of (N,) float64
        One scalar for each point, or an array for each block with one for each of its cells.
    scalar : str
        Name of the scalar, with its component ("momentum magnitude").
    source_sha256, name, units : str
        Hex digest of the file, its name for messages, and the world unit; "" if unknown.
    """

    points: np.ndarray
    cells: list[tuple[str, np.ndarray]]
    scalars: np.ndarray | list[np.ndarray]
    scalar: str
    source_sha256: str = ""
    name: str = ""
    units: str = ""

    @property
    def constant(self) -> bool:
        """Whether each cell has one scalar; otherwise each point has one."""
        return isinstance(self.scalars, list)


@dataclass(frozen=True, eq=False)
class ConformingMesh:
    """Cells of one kind, positively oriented, none flat, none twice, matched across their faces.

    vertices : (V, 3) float64, world units; each is in a cell.
    cells : (T, 4) int32, tetrahedra; or (T, 8), hexahedra.
    neighbours : (T, 4 or 6) int32: the cell across each face, -1 where there is none.
    scalars : (V,) float64, or (T,) where the mesh is constant.
    constant : whether the scalar is one a cell.
    scalar, source_sha256, name, units : as in UnstructuredMesh.
    report : counts of what was found and done: JSON types only.
    """

    vertices: np.ndarray
    cells: np.ndarray
    neighbours: np.ndarray
    scalars: np.ndarray
    constant: bool
    scalar: str
    source_sha256: str = ""
    name: str = ""
    units: str = ""
    report: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class VolumeCells:
    """The volume cells of a mesh.

    points : (P, 3) float64.
    blocks : of each kind in turn, (N, k) int64, corners.
    scalars : (P,) float64; or, where the mesh is constant, one for each cell of the blocks.
    report : counts of what was found and done: JSON types only.
    """

    points: np.ndarray
    blocks: list[tuple[str, np.ndarray]]
    scalars: np.ndarray
    report: dict[str, Any]


def volume_cells(mesh: UnstructuredMesh) -> VolumeCells:
    """The volume cells of a mesh, checked; the report counts what was read and ignored.

    Raises
    ------
    MeshError : there are none, of a kind that cannot be split, or arrays that are not as
        UnstructuredMesh says.
    """
    where = mesh.name or "mesh"
    points = np.asarray(mesh.points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"{where}: points of shape {points.shape}: give (P, 3)")
    read, ignored, curved, blocks, values = {}, {}, 0, [], []
    for number, (kind, block) in enumerate(mesh.cells):
        if not len(block) or kind.rstrip("0123456789") in FLAT:
            ignored[kind] = ignored.get(kind, 0) + len(block)
            continue
        plain = kind.rstrip("0123456789")
        if plain not in CORNERS:
            raise MeshError(
                f"{where}: has {count_of(len(block), 'cell')} of kind {kind}, which cannot be "
                "split: convert them to tetrahedra, hexahedra, wedges or pyramids"
            )
        corners = _corners(where, kind, block, CORNERS[plain])
        curved += len(block) if corners.shape[1] < block.shape[1] else 0
        _check_indices(where, kind, block, len(points))
        read[kind] = read.get(kind, 0) + len(block)
        blocks.append((plain, corners))
        if isinstance(mesh.scalars, list):
            values.append(_cell_scalars(where, kind, mesh.scalars[number], block, mesh.scalar))
    if not blocks:
        kinds = ", ".join(f"{count:,} {kind}" for kind, count in ignored.items() if count)
        raise MeshError(
            f"{where}: no volume cells (it has {kinds or 'no cells'}): give a mesh of tetrahedra, "
            "hexahedra, wedges or pyramids"
        )
    scalars = np.concatenate(values) if mesh.constant else np.asarray(mesh.scalars, np.float64)
    if not mesh.constant and scalars.shape != (len(points),):
        raise MeshError(
            f"{where}: {mesh.scalar} of shape {scalars.shape} for {len(points)} points: give one "
            "a point"
        )
    report = {"cells": read, "ignored": {k: n for k, n in ignored.items() if n}, "curved": curved}
    return VolumeCells(points, blocks, scalars, report)


def _corners(where: str, kind: str, block: np.ndarray, count: int) -> np.ndarray:
    """(N, count) int64: the corners of cells, which come first."""
    if block.ndim != 2 or block.shape[1] < count or not np.issubdtype(block.dtype, np.integer):
        raise MeshError(
            f"{where}: {kind} cells of shape {block.shape} and type {block.dtype}: give whole "
            f"numbers (N, {count})"
        )
    return block[:, :count].astype(np.int64)


def _check_indices(where: str, kind: str, block: np.ndarray, points: int) -> None:
    if block.min() < 0 or block.max() >= points:
        bad = (block < 0) | (block >= points)
        cell = int(np.argmax(bad.any(axis=1)))
        raise MeshError(
            f"{where}: {kind} {cell} names point {block[cell][bad[cell]][0]} where there are "
            f"{points}, both counted from 0: correct the index, or the file is truncated"
        )


def _cell_scalars(
    where: str, kind: str, values: np.ndarray, block: np.ndarray, scalar: str
) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if values.shape != (len(block),):
        raise MeshError(
            f"{where}: {scalar} of shape {values.shape} for {len(block)} {kind} cells: give one a "
            "cell"
        )
    check_finite(where, values, np.ones(len(values), bool), kind, scalar)
    return values


def check_finite(where: str, values: np.ndarray, used: np.ndarray, noun: str, what: str) -> None:
    """Raise MeshError if a value that volume cells use is not finite."""
    finite = np.isfinite(values) if values.ndim == 1 else np.isfinite(values).all(axis=1)
    bad = used & ~finite
    if bad.any():
        first = int(np.argmax(bad))
        raise MeshError(
            f"{where}: {what} is not finite at {count_of(int(np.count_nonzero(bad)), noun)}, the "
            f"first is {noun} {first} ({values[first]}): give a number, or leave the cells out"
        )
