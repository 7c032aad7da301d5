"""A tetrahedral volume: the textures of tables 4 and 5 of [TetVol, section 4.1].

Layout "raycast" is table 5: planes n . x + o, which are 0 on a face and < 0 inside, and scalars
s(x) = g . x + g3 of each cell. Layout "projection" is table 4: normals without offsets, and
s(x) = s_A + g . (x - x_A), where the anchor A is vertex 0 of the cell; the plane of face 0 goes
through the second anchor, vertex 1. Face i of a tetrahedron is opposite its vertex i. Layout
"hexahedra" is table 5 with two more planes and neighbours, for planar faces and constant cells.
All layouts have the vertices of each cell, its neighbours, and the ranges of blocks of cells.

Local coordinates are in [-1, 1], about the middle of the mesh, scaled by a power of two; scalars
are in [0, 1]. Cells are in Morton order of their centroids, vertices in the order of their first
use.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from voxtool.arrays import Data, digest_of
from voxtool.choices import LAYOUTS
from voxtool.errors import FileError
from voxtool.opencl import program
from voxtool.tets.volume.cells import HEXAHEDRON_FACES, TETRAHEDRON_FACES, repeats
from voxtool.tets.volume.packing import layers_for, rows_for, width_for
from voxtool.vector import cross, dot

BLOCK = 64  # consecutive cells that share a range of scalars
FACES = {
    "raycast": TETRAHEDRON_FACES,
    "projection": TETRAHEDRON_FACES,
    "hexahedra": HEXAHEDRON_FACES,
}
# Bytes a tetrahedron of other layouts, as [TetVol, section 4.1] gives them.
COMPARED = {
    "raycast": "table 5; 144 before it (Weiler et al. 2003), 119 and 912 for projection",
    "projection": "table 4, 119 with OpenGL's vertex attributes; 912 before it, 96 for ray casting",
    "hexahedra": "table 5 with two more faces",
}

PLANAR = 1e-5  # of a hexahedron's size: how far at most its vertices are from their plane
STEEPEST = 1e30  # gradient, normalised and local: float32 has room for products with it
FLAT = 2.0**-6  # of a tetrahedron's longest edge: where one has a smaller height, all are held
ROUNDED = 2.0**-20  # how far at most a vertex is from its plane, both in float32

PLANE_BITS = 21
ON_PLANE = 2.0**-PLANE_BITS  # local: a point this near to a plane of float32 is on it

HEADERS = {"tets/volume/volume.h": program.c_constants(BLOCK=BLOCK, PLANE_BITS=PLANE_BITS)}


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
    heights : (T, 1) float32, or None
        Height of each tetrahedron over its largest face, local, from unrounded positions; None
        where none is so flat that rounded vertices do not give it (FLAT), and of hexahedra.
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
    heights: np.ndarray | None = None
    units: str = ""
    source_sha256: str = ""
    plan: dict[str, Any] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return (
            f"TetVolume({len(self.cells):,} cells, layout={self.layout!r}, scalar={self.scalar!r}, "
            f"scalar_range={self.scalar_range})"
        )

    @property
    def faces(self) -> np.ndarray:
        """(F, 3) or (F, 4) int64: which of a cell's vertices are on each face, outward wound."""
        return np.array(FACES[self.layout])

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return len(self.cells)

    @property
    def vertex_count(self) -> int:
        """Number of vertices."""
        return len(self.vertices)

    @property
    def noun(self) -> str:
        """ "tetrahedra" or "hexahedra"."""
        return "tetrahedra" if self.cells.shape[1] == 4 else "hexahedra"

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return low and high corner, (3,) float64 each, world units."""
        points = self.points()
        return points.min(axis=0), points.max(axis=0)

    def points(self) -> np.ndarray:
        """Return (V, 3) float64: the positions of the vertices, world units."""
        return np.array(self.origin) + self.scale * self.vertices[:, :3].astype(np.float64)

    def scalars(self) -> np.ndarray:
        """(V,) float64: the scalars of the vertices; where constant, (T,) those of the cells."""
        low, high = self.scalar_range
        stored = self.gradients if self.constant else self.vertices
        return low + (high - low) * stored[:, 3].astype(np.float64)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return every texture by its name."""
        names = ("vertices", "cells", "neighbours", "normals", "gradients", "ranges", "anchors")
        found = {name: getattr(self, name) for name in (*names, "heights")}
        return {name: array for name, array in found.items() if array is not None}

    def sizes(self) -> dict[str, int]:
        """Return the bytes of each texture."""
        return {name: array.nbytes for name, array in self.arrays().items()}

    def shapes(self) -> dict[str, list[int]]:
        """Return texels along x and y of each texture, and its layers and channels."""
        counts = {"vertices": len(self.vertices), "ranges": len(self.ranges)}
        found = {}
        for name, array in self.arrays().items():
            count, split = counts.get(name, len(self.cells)), layers_for(array.shape[-1])
            layers = len(array) if array.ndim == 3 else split
            sides = [width_for(count), rows_for(count)]
            found[name] = [*sides, layers, array.shape[-1] // split]
        return found

    def bytes_a_cell(self) -> float:
        """Return the bytes a cell of the textures in the layout's table of [TetVol]."""
        table = ("normals", "gradients", "neighbours")
        if self.layout == "projection":
            table = ("vertices", "normals", "anchors", "gradients")
        sizes = self.sizes()
        return sum(sizes[name] for name in table) / len(self.cells)

    def summary(self) -> dict[str, Any]:
        """Return the facts of the volume and the counts of its build, in JSON types."""
        return {
            "layout": self.layout,
            "scalar": self.scalar,
            "scalar_range": list(self.scalar_range),
            "constant": self.constant,
            "origin": list(self.origin),
            "scale": self.scale,
            self.noun: len(self.cells),
            "vertices": len(self.vertices),
            "textures": self.sizes(),
            "shapes": self.shapes(),
            "bytes_a_cell": self.bytes_a_cell(),
            "compared": COMPARED[self.layout],
            **self.report,
            "digest": self.digest(),
        }

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
        return digest_of(head, *self.arrays().values())

    def six_volumes(self) -> np.ndarray:
        """Return six times the volume of each tetrahedron, (T,) float64, local: by its height where
        that is held, and the largest face of its vertices."""
        corners = self.vertices[self.cells, :3].astype(np.float64).swapaxes(0, 1)
        if self.heights is not None:
            return self.heights[:, 0] * np.sqrt(largest_square(corners))
        a, b, c, d = corners
        return dot(b - a, cross(c - a, d - a))

    def block_ranges(self) -> np.ndarray:
        """Return the range of normalised scalars of each block of cells, (ceil(T / 64), 2)."""
        scalars = self.vertices[:, 3][self.cells]
        if self.constant:
            scalars = self.gradients[:, 3:]
        first = np.arange(0, len(scalars), BLOCK)
        least, largest = scalars.min(axis=1), scalars.max(axis=1)
        return np.stack([np.minimum.reduceat(least, first), np.maximum.reduceat(largest, first)], 1)

    # ---- soundness

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
        if self.heights is not None and self.layout != "hexahedra":
            expected["heights"] = ((count, 1), np.float32)
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
        if not ((np.abs(self.vertices[:, :3]) <= 1).all() and _in_unit(self.vertices[:, 3])):
            raise FileError("volume vertices: positions in [-1, 1], scalars in [0, 1] are expected")
        if not (np.abs(self.normals) <= 2).all():
            raise FileError("volume normals: unit normals and offsets are expected")
        if self.heights is not None and not ((self.heights > 0) & (self.heights <= 4)).all():
            raise FileError("volume heights: positive local lengths are expected")
        if not (np.abs(self.gradients) <= STEEPEST).all():
            raise FileError(f"volume gradients: numbers up to {STEEPEST:g} are expected")
        if not (self.ranges[:, 0] <= self.ranges[:, 1]).all() or not _in_unit(self.ranges):
            raise FileError("volume ranges: pairs in [0, 1] are expected")
        vertices, cells = len(self.vertices), len(self.cells)
        if self.cells.min() < 0 or self.cells.max() >= vertices:
            raise FileError(f"volume cells: a vertex is not one of the {vertices}")
        if repeats(self.cells).any():
            raise FileError("volume cells: a cell names a vertex twice")
        if self.neighbours.min() < -1 or self.neighbours.max() >= cells:
            raise FileError(f"volume neighbours: one is not one of the {cells} cells")
        if self.anchors is not None and not np.array_equal(self.anchors, self.cells[:, :2]):
            raise FileError("volume anchors: they are not vertices 0 and 1 of their cells")

    def _check_neighbours(self) -> None:
        """Check that the cell across a face has that face too, and this cell across it."""
        cell, face = np.nonzero(self.neighbours > np.arange(len(self.cells))[:, None])
        other = self.neighbours[cell, face]
        back = self.neighbours[other] == cell[:, None]
        both = 2 * len(cell) == np.count_nonzero(self.neighbours >= 0)
        if not both or not back.any(axis=1).all():
            raise FileError("volume neighbours: a cell is not the neighbour of its neighbour")
        faces, other_face = self.faces, back.argmax(axis=1)
        ours = np.sort(self.cells[cell[:, None], faces[face]], axis=1)
        theirs = np.sort(self.cells[other[:, None], faces[other_face]], axis=1)
        if not np.array_equal(ours, theirs):
            raise FileError("volume neighbours: two cells share a face whose vertices differ")
        if (self.normals[face, cell] != -self.normals[other_face, other]).any():
            raise FileError("volume normals: those of a shared face are not each other's negation")

    def _corners(self) -> np.ndarray:
        """Return x, y, z and scalar of the cells' vertices, (4, 4 or 8, T) float64."""
        return self.vertices.T[:, self.cells.T].astype(np.float64)

    def _check_planes(self) -> None:
        """Check that normals have length 1, that a face's vertices are on its plane, and that no
        other vertex is outside it."""
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
        """Check that ranges are those of the cells, and that gradients give the scalars of the
        vertices to float32's precision."""
        if not np.array_equal(self.block_ranges(), self.ranges):
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


def largest_square(corners: np.ndarray) -> np.ndarray:
    """Return the square of twice the area of the largest face of tetrahedra, (T,), by the positions
    of their corners, (4, T, 3)."""
    found = np.zeros(corners.shape[1])
    for i, j, k in TETRAHEDRON_FACES:
        normal = cross(corners[j] - corners[i], corners[k] - corners[i])
        found = np.maximum(found, dot(normal, normal))
    return found


def _in_unit(values: np.ndarray) -> bool:
    """Return True if all values are in [0, 1]; NaN is not."""
    return bool(((values >= 0) & (values <= 1)).all())
