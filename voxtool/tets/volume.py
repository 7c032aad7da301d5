"""A tetrahedral volume: the textures of tables 4 and 5 of [TetVol, section 4.1].

A texture has one row a cell, t, or a vertex, k. In float32 and int32, for ray casting (table 5):

    normals     4 planes, of 4 floats: the outward unit normal n and the offset o of face i,
                n . x + o = 0 on the face and < 0 inside
    gradients   4 floats: the gradient g of the scalar and its term: s(x) = g . x + g3
    neighbours  4 ints: the cell across face i

and for cell projection (table 4):

    vertices    4 floats: position and scalar
    normals     4 normals, of 3 floats
    anchors     2 ints: vertex 0 of the cell, which is on faces 1, 2 and 3, and vertex 1, on face 0
    gradients   3 floats: s(x) = s_A + g . (x - x_A), A the first anchor

with the vertices of each cell, its neighbours and the ranges of blocks of cells in both. Face i of
a tetrahedron is opposite its vertex i. Hexahedra with planar faces and one scalar a cell, also in
[TetVol], have table 5 with two more planes and neighbours.

Positions are local, in [-1, 1], and world = origin + scale * local. Scalars are normalised to
[0, 1]. Cells are in Morton order of their centroids, vertices in the order of their first use.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from voxtool.arrays import Data
from voxtool.choices import LAYOUTS
from voxtool.errors import FileError
from voxtool.opencl import program

BLOCK = 64  # consecutive cells that share a range of scalars

# The vertices of each face, so that the normal by the right-hand rule points out.
TETRAHEDRON_FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))
HEXAHEDRON_FACES = (
    (0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 3, 2, 1), (4, 5, 6, 7),
)  # fmt: skip
FACES = {
    "raycast": TETRAHEDRON_FACES,
    "projection": TETRAHEDRON_FACES,
    "hexahedra": HEXAHEDRON_FACES,
}

PLANAR = 1e-5  # of a hexahedron's size: how far at most its vertices are from their plane
STEEPEST = 1e30  # gradient, normalised and local: float32 has room for products with it
ROUNDED = 2.0**-20  # how far at most a vertex is from its plane, both in float32

PLANE_BITS = 21
ON_PLANE = 2.0**-PLANE_BITS  # local: a point this near to a plane of float32 is on it

HEADERS = {"tets/volume.h": program.c_constants(BLOCK=BLOCK, PLANE_BITS=PLANE_BITS)}


@dataclass(frozen=True, eq=False)
class TetVolume(Data):
    """A mesh of cells with a scalar field, as textures.

    Attributes
    ----------
    layout : str
        "raycast", "projection" or "hexahedra".
    vertices : (V, 4) float32
        Local position, and normalised scalar (0 where the scalar is constant).
    cells : (T, 4) int32, or (T, 8) for hexahedra
        Vertices of each cell, positively oriented.
    neighbours : (T, F) int32
        The cell across each of the F faces (4, or 6), -1 outside.
    normals : (F, T, 4) float32, or (4, T, 3) for projection
        Outward unit normal and offset. Those of the two cells at a face are exact negations.
    gradients : (T, 4) float32, or (T, 3) for projection
        Gradient of the normalised scalar in local coordinates, and scalar term.
    anchors : (T, 2) int32 for projection, else None
        Vertices 0 and 1 of the cell.
    ranges : (ceil(T / 64), 2) float32
        Least and largest normalised scalar of each block of 64 consecutive cells.
    origin : (float, float, float)
        World = origin + scale * local.
    scale : float
        A power of two.
    scalar_range : (float, float)
        Normalised = (scalar - low) / (high - low), or 0 where low and high are equal.
    scalar : str
        Name of the array, with its component.
    constant : bool
        Whether a cell has one scalar; otherwise it is linear between vertices.
    units : str
        Name of the world unit, or "".
    source_sha256 : str
        Hex digest of the mesh's file, or "".
    plan, report : dict
        The plan's account of the mesh, and counts and errors of the build; JSON types only.
    """

    layout: str
    vertices: np.ndarray
    cells: np.ndarray
    neighbours: np.ndarray
    normals: np.ndarray
    gradients: np.ndarray
    anchors: np.ndarray | None
    ranges: np.ndarray
    origin: tuple[float, float, float]
    scale: float
    scalar_range: tuple[float, float]
    scalar: str
    constant: bool
    units: str = ""
    source_sha256: str = ""
    plan: dict[str, Any] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return (
            f"TetVolume({len(self.cells):,} cells, layout={self.layout!r}, scalar={self.scalar!r}, "
            f"scalar_range={self.scalar_range})"
        )

    # ---- structure

    @property
    def faces(self) -> np.ndarray:
        """(F, 3) or (F, 4) int64: which of a cell's vertices are on each face, outward wound."""
        return np.array(FACES[self.layout])

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Low and high corner, (3,) float64 each, world units."""
        low, high = (
            np.array(self.origin) + self.scale * corner.astype(np.float64)
            for corner in (self.vertices[:, :3].min(axis=0), self.vertices[:, :3].max(axis=0))
        )
        return low, high

    def arrays(self) -> dict[str, np.ndarray]:
        """Every texture by its name."""
        arrays = {
            "vertices": self.vertices,
            "cells": self.cells,
            "neighbours": self.neighbours,
            "normals": self.normals,
            "gradients": self.gradients,
            "ranges": self.ranges,
        }
        return arrays if self.anchors is None else {**arrays, "anchors": self.anchors}

    # ---- sizes, identity, soundness

    def sizes(self) -> dict[str, int]:
        """Bytes of each texture."""
        return {name: array.nbytes for name, array in self.arrays().items()}

    def bytes_a_cell(self) -> float:
        """Return the bytes a cell of the textures in the layout's table of [TetVol]."""
        table = ("normals", "gradients", "neighbours")
        if self.layout == "projection":
            table = ("vertices", "normals", "anchors", "gradients")
        sizes = self.sizes()
        return sum(sizes[name] for name in table) / len(self.cells)

    def digest(self) -> str:
        """Return the SHA-256 of the content without units, source, plan and report.

        Equal content has an equal digest on every platform.
        """
        head = {
            "layout": self.layout,
            "origin": [v.hex() for v in self.origin],
            "scale": self.scale.hex(),
            "scalar_range": [v.hex() for v in self.scalar_range],
            "scalar": self.scalar,
            "constant": self.constant,
            "shapes": {name: array.shape for name, array in self.arrays().items()},
        }
        sha = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
        for array in self.arrays().values():
            sha.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
        return sha.hexdigest()

    def validate(self) -> None:
        """Check every invariant of the structure.

        Raises
        ------
        FileError
            names the first that fails.
        """
        self._check_frame()
        self._check_shapes()
        self._check_numbers()
        self._check_neighbours()
        self._check_planes()
        self._check_scalars()

    def _check_frame(self) -> None:
        if self.layout not in LAYOUTS:
            raise FileError(f"volume layout {self.layout!r}: {', '.join(LAYOUTS)} are known")
        low, high = self.scalar_range
        if not (math.isfinite(high - low) and low <= high):
            raise FileError(f"volume scalar_range {low:g} to {high:g}: no finite range")
        if not (0 < self.scale < math.inf and math.frexp(self.scale)[0] == 0.5):
            raise FileError(f"volume scale {self.scale:g}: a power of two is expected")
        corners = np.array(self.origin) + np.array([[-self.scale], [self.scale]])
        if not np.isfinite(corners).all():
            raise FileError(f"volume: scale {self.scale:g} at {self.origin}: float64 ends before")
        if self.layout == "projection" and self.constant:
            raise FileError("volume: table 4 holds no constant cells")
        if self.layout == "hexahedra" and not self.constant:
            raise FileError("volume: hexahedra have constant scalars")

    def _check_shapes(self) -> None:
        count, faces = len(self.cells), len(FACES[self.layout])
        floats = 3 if self.layout == "projection" else 4
        expected: dict[str, tuple[tuple[int, ...], type]] = {
            "vertices": ((len(self.vertices), 4), np.float32),
            "cells": ((count, 8 if self.layout == "hexahedra" else 4), np.int32),
            "neighbours": ((count, faces), np.int32),
            "normals": ((faces, count, floats), np.float32),
            "gradients": ((count, floats), np.float32),
            "ranges": ((-(-count // BLOCK), 2), np.float32),
        }
        if self.layout == "projection":
            expected["anchors"] = ((count, 2), np.int32)
        arrays = self.arrays()
        if arrays.keys() != expected.keys() or count == 0:
            raise FileError(f"volume: {count} cells with {', '.join(arrays)}")
        for name, (shape, kind) in expected.items():
            if arrays[name].shape != shape or arrays[name].dtype != kind:
                raise FileError(
                    f"volume {name}: {arrays[name].dtype} of shape {arrays[name].shape} where "
                    f"{np.dtype(kind)} of shape {shape} is expected"
                )

    def _check_numbers(self) -> None:
        if not ((np.abs(self.vertices[:, :3]) <= 1).all() and in_unit(self.vertices[:, 3])):
            raise FileError("volume vertices: positions in [-1, 1], scalars in [0, 1] are expected")
        if not (np.abs(self.normals) <= 2).all():
            raise FileError("volume normals: unit normals and offsets are expected")
        if not (np.abs(self.gradients) <= STEEPEST).all():
            raise FileError(f"volume gradients: numbers up to {STEEPEST:g} are expected")
        if not (self.ranges[:, 0] <= self.ranges[:, 1]).all() or not in_unit(self.ranges):
            raise FileError("volume ranges: pairs in [0, 1] are expected")
        vertices, cells = len(self.vertices), len(self.cells)
        if self.cells.min() < 0 or self.cells.max() >= vertices:
            raise FileError(f"volume cells: a vertex is not one of the {vertices}")
        ordered = np.sort(self.cells, axis=1)
        if (ordered[:, 1:] == ordered[:, :-1]).any():
            raise FileError("volume cells: a cell names a vertex twice")
        if self.neighbours.min() < -1 or self.neighbours.max() >= cells:
            raise FileError(f"volume neighbours: one is not one of the {cells} cells")
        if self.anchors is not None and not np.array_equal(self.anchors, self.cells[:, :2]):
            raise FileError("volume anchors: they are not vertices 0 and 1 of their cells")

    def _check_neighbours(self) -> None:
        """The cell across a face has that face too, and this cell across it."""
        cell, face, other, other_face = self._shared()
        if (self.neighbours[other, other_face] != cell).any():
            raise FileError("volume neighbours: a cell is not the neighbour of its neighbour")
        faces = self.faces
        ours = np.sort(self.cells[cell[:, None], faces[face]], axis=1)
        theirs = np.sort(self.cells[other[:, None], faces[other_face]], axis=1)
        if not np.array_equal(ours, theirs):
            raise FileError("volume neighbours: two cells share a face whose vertices differ")
        if (self.normals[face, cell] != -self.normals[other_face, other]).any():
            raise FileError("volume normals: those of a shared face are not each other's negation")

    def _shared(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Every face that has a neighbour, from one side: its cell and number, and the
        neighbour's; a number of 0 where this has no such face."""
        cell, face = np.nonzero(self.neighbours > np.arange(len(self.cells))[:, None])
        other = self.neighbours[cell, face]
        other_face = (self.neighbours[other] == cell[:, None]).argmax(axis=1)
        if 2 * len(cell) != np.count_nonzero(self.neighbours >= 0):
            raise FileError("volume neighbours: a cell is not the neighbour of its neighbour")
        return cell, face, other, other_face

    def _corners(self) -> np.ndarray:
        """(4, 4 or 8, T) float64: x, y, z and scalar of the cells' vertices."""
        return self.vertices.T[:, self.cells.T].astype(np.float64)

    def _check_planes(self) -> None:
        """Normals are of length 1; a face's vertices are on its plane, no other is outside."""
        # a hexahedron's edges are at most 2 sqrt(3) long, local, and its faces nearly planar
        x, y, z, _ = self._corners()
        tolerance = ROUNDED + (4 * PLANAR if self.layout == "hexahedra" else 0)
        for plane, face in zip(self.normals, FACES[self.layout], strict=True):
            a, b, c = plane[:, :3].T.astype(np.float64)
            if not (np.abs(a * a + b * b + c * c - 1) <= 1e-5).all():
                raise FileError("volume normals: one is not of length 1")
            heights = a * x + b * y + c * z
            heights += -heights[face[0]] if self.layout == "projection" else plane[:, 3]
            if (heights > tolerance).any() or (heights[list(face)] < -tolerance).any():
                raise FileError("volume normals: one is not that of its face")

    def _check_scalars(self) -> None:
        """Ranges are those of the cells; gradients give the scalars of the vertices, as nearly as
        float32 can."""
        if not np.array_equal(block_ranges(*self.cell_ranges()), self.ranges):
            raise FileError("volume ranges: they are not those of the cells")
        if self.constant:
            if self.gradients[:, :3].any() or self.vertices[:, 3].any():
                raise FileError("volume gradients: those of constant cells are 0")
            return
        x, y, z, s = self._corners()
        a, b, c = self.gradients[:, :3].T.astype(np.float64)
        value = a * x + b * y + c * z
        value += s[0] - value[0] if self.layout == "projection" else self.gradients[:, 3]
        steep = np.abs(a) + np.abs(b) + np.abs(c)
        if (np.abs(value - s) > ROUNDED * (1 + steep)).any():
            raise FileError("volume gradients: they do not give the scalars of the vertices")

    def cell_ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest normalised scalar of each cell, (T,) float32 each."""
        if self.constant:
            return self.gradients[:, 3], self.gradients[:, 3]
        scalars = self.vertices[:, 3][self.cells]
        return scalars.min(axis=1), scalars.max(axis=1)


def block_ranges(least: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """(ceil(T / BLOCK), 2) float32: the ranges of blocks of cells whose ranges these are."""
    first = np.arange(0, len(least), BLOCK)
    return np.stack([np.minimum.reduceat(least, first), np.maximum.reduceat(largest, first)], 1)


def in_unit(values: np.ndarray) -> bool:
    """Whether all are in [0, 1]; NaN is not."""
    return bool(((values >= 0) & (values <= 1)).all())
