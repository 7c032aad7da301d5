"""Meshes of volume cells: as a file has them, as checked cells, and as cells of one kind."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from voxtool.errors import MeshError, count_of
from voxtool.tets.volume.cells import CORNERS

MAX_COUNT = (1 << 31) - 1  # points, cells and vertices: indices are int32
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
        """True if each cell has one scalar, False if each point has one."""
        return isinstance(self.scalars, list)


@dataclass(frozen=True, eq=False)
class ConformingMesh:
    """Cells of one kind, positively oriented, none flat, none twice.

    vertices : (V, 3) float64, world units; each is in a cell.
    cells : (T, 4) int32, tetrahedra; or (T, 8), hexahedra.
    scalars : (V,) float64, or (T,) where `constant`, that is, where each cell has one scalar.
    report : counts of what was found and done: JSON types only.
    """

    vertices: np.ndarray
    cells: np.ndarray
    scalars: np.ndarray
    constant: bool
    report: dict[str, Any]


@dataclass(frozen=True, eq=False)
class VolumeCells:
    """The volume cells of a mesh.

    points : (P, 3) float64.
    blocks : kinds and corners of cells, (N, k) uint32 each.
    scalars : (P,) float64; or, where `constant`, one for each cell of the blocks.
    scalar, name : names of the scalar and of the mesh, for messages.
    report : counts of what was found and done: JSON types only.
    """

    points: np.ndarray
    blocks: list[tuple[str, np.ndarray]]
    scalars: np.ndarray
    constant: bool
    scalar: str
    name: str
    report: dict[str, Any]


def volume_cells(mesh: UnstructuredMesh) -> VolumeCells:
    """Return the volume cells of a mesh, checked; the report counts what was read and ignored.

    Raises
    ------
    MeshError : there are none, one cannot be split, or an array is not as UnstructuredMesh says.
    """
    name = mesh.name or "mesh"
    points = np.asarray(mesh.points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"{name}: points of shape {points.shape}: give (P, 3)")
    if len(points) > MAX_COUNT:
        raise MeshError(f"{name}: {len(points):,} points, at most {MAX_COUNT:,} fit: split it")
    read, ignored, curved, blocks, values = Counter(), Counter(), 0, [], []
    for number, (kind, block) in enumerate(mesh.cells):
        if not is_volume(kind, block):
            ignored[kind] += len(block)
            continue
        corners = _corners(name, kind, block, len(points))
        curved += len(block) if corners.shape[1] < block.shape[1] else 0
        read[kind] += len(block)
        blocks.append((plain(kind), corners))
        if isinstance(mesh.scalars, list):
            values.append(_cell_scalars(name, kind, mesh.scalars[number], block, mesh.scalar))
    if not blocks:
        kinds = ", ".join(f"{count:,} {kind}" for kind, count in (+ignored).items())
        raise MeshError(
            f"{name}: no volume cells (it has {kinds or 'no cells'}): give a mesh of tetrahedra, "
            "hexahedra, wedges or pyramids"
        )
    scalars = np.concatenate(values) if mesh.constant else np.asarray(mesh.scalars, np.float64)
    if not mesh.constant and scalars.shape != (len(points),):
        raise MeshError(
            f"{name}: {mesh.scalar} of shape {scalars.shape} for {len(points)} points: give one "
            "a point"
        )
    report = {"cells": dict(read), "ignored": dict(+ignored), "curved": curved}
    return VolumeCells(points, blocks, scalars, mesh.constant, mesh.scalar, name, report)


def is_volume(kind: str, block: np.ndarray) -> bool:
    """Return True if a block has cells, and they are not known to be flat."""
    return len(block) > 0 and plain(kind) not in FLAT


def plain(kind: str) -> str:
    """Return the kind without its number of nodes: tetra for tetra10."""
    return kind.rstrip("0123456789")


def _corners(name: str, kind: str, block: np.ndarray, points: int) -> np.ndarray:
    """Return the corners of cells, which are the first points of each, (N, corners) uint32."""
    count = CORNERS.get(plain(kind))
    if count is None:
        raise MeshError(
            f"{name}: has {count_of(len(block), 'cell')} of kind {kind}, which cannot be "
            "split: convert them to tetrahedra, hexahedra, wedges or pyramids"
        )
    if block.ndim != 2 or block.shape[1] < count or not np.issubdtype(block.dtype, np.integer):
        raise MeshError(
            f"{name}: {kind} cells of shape {block.shape} and type {block.dtype}: give whole "
            f"numbers (N, {count})"
        )
    if int(block.min()) < 0 or int(block.max()) >= points:
        bad = (block < 0) | (block >= points)
        cell = int(np.argmax(bad.any(axis=1)))
        raise MeshError(
            f"{name}: {kind} {cell} names point {block[cell][bad[cell]][0]} where there are "
            f"{points:,}, both counted from 0: correct the index, or the file is truncated"
        )
    return block[:, :count].astype(np.uint32)


def _cell_scalars(
    name: str, kind: str, values: np.ndarray, block: np.ndarray, scalar: str
) -> np.ndarray:
    """Return the scalars of a block of cells, checked."""
    values = np.asarray(values, np.float64)
    if values.shape != (len(block),):
        raise MeshError(
            f"{name}: {scalar} of shape {values.shape} for {len(block)} {kind} cells: give one a "
            "cell"
        )
    check_finite(name, values, np.ones(len(values), bool), kind, scalar)
    return values


def check_finite(name: str, values: np.ndarray, used: np.ndarray, noun: str, what: str) -> None:
    """Raise MeshError if a value that volume cells use is not finite."""
    finite = np.isfinite(values)
    if finite.all():
        return
    finite = finite if values.ndim == 1 else finite.all(axis=1)
    bad = used & ~finite
    if bad.any():
        first = int(np.argmax(bad))
        raise MeshError(
            f"{name}: {what} is not finite at {count_of(int(np.count_nonzero(bad)), noun)}, the "
            f"first is {noun} {first} ({values[first]}): give a number, or leave the cells out"
        )
