"""The data of a mesh that the construction of its field uses: the cube, the tree of triangles, and
the data that separate inside from outside."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np

from voxtool.adf.field.host_query import POINT_BITS
from voxtool.mesh.counts import PROGRAMS as COUNTING
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import twins_of
from voxtool.opencl import Device
from voxtool.opencl.builder import Request
from voxtool.opencl.primitives import RADIX_SORT, SCAN
from voxtool.spatial.bvh import SOURCE as TREE
from voxtool.spatial.bvh import Frame, build_tree, distinct_faces
from voxtool.spatial.fill_rule import Inside, inside_as_wound
from voxtool.spatial.pseudonormals import Pseudonormals, face_normals, pseudonormals
from voxtool.spatial.self_intersections import SOURCE as SELF_INTERSECTIONS
from voxtool.spatial.self_intersections import UNDECIDED, find_self_intersections
from voxtool.spatial.sides import Sides
from voxtool.spatial.winding_number import WindingNumber

Decide = Callable[[Mesh, Device], Inside]
MARGIN = 1 / 16  # of the cube's side, on both sides of the mesh's longest side
UNSEEN = 9  # beside the states of find_self_intersections
REACH = 2.0  # of winding numbers: an error of 5e-3 is enough for signs, in half the time


class Survey:
    """A mesh on the device, ready for the construction of a field.

    mesh: with the faces turned that `decide` turns; signed: whether distances have a sign; inside:
    what `decide` returns, or None; normals: the pseudo-normals, if they have; tree: the
    triangles, in the mesh's own frame; flat: number of triangles without area; closed: True if
    pseudo-normals are certain (fill_rule.py); extent: half of the cube's side, in the frame;
    misplaced: upper bound of the distance, in sides, by which rounding moves a point.
    """

    inside: Inside | None = None

    def __init__(
        self, mesh: Mesh, device: Device, signed: bool, decide: Decide = inside_as_wound
    ) -> None:
        self.mesh, self.device, self.signed, self.decide = mesh, device, signed, decide
        self.flat, self.closed = 0, False
        self.normals: Pseudonormals | None = None
        programs: list[Request] = [(TREE, {}), (RADIX_SORT, {"KEY": "ulong"}), (SCAN, {})]
        device.prepare(*programs, *[(SELF_INTERSECTIONS, {}), *COUNTING] * signed)
        if signed:
            with ThreadPoolExecutor(1) as beside:  # numpy works beside this thread and the device
                distinct = beside.submit(distinct_faces, mesh)
                faces = face_normals(mesh)
                summed = beside.submit(pseudonormals, mesh, faces)
                inside = self.inside = decide(mesh, device)
                if inside.oriented:
                    mesh = self.mesh = inside.oriented
                    faces = face_normals(mesh)
                    summed = beside.submit(pseudonormals, mesh, faces)
                self.tree = build_tree(device, mesh, faces.flat, distinct.result())
            self.flat, self.normals = int(np.count_nonzero(faces.flat)), summed.result()
            self.closed = inside.simple
        else:
            self.tree = build_tree(device, mesh, None, distinct_faces(mesh))
        self.extent = _extent(mesh, self.tree.frame)
        self.misplaced = _misplaced(*cube_of(mesh))

    @cached_property
    def winding(self) -> WindingNumber:
        """The winding number of the mesh."""
        return WindingNumber(self.mesh, self.device, tree=self.tree, reach=REACH)

    @cached_property
    def arguments(self) -> dict[str, Any]:
        """Kernel arguments by name: the triangles, and pseudo-normals where signs are computed."""
        named = {"leaves": self.tree.leaves, "extent": self.extent}
        if self.normals:
            named["names"] = self.tree.names
            named["features"] = self.device.put(self.normals.features)
            named["normals"] = self.device.put(self.normals.normals)
        return named

    @cached_property
    def sides(self) -> Sides:
        """The winding numbers beside faces."""
        assert self.normals  # only fields with signs ask for winding numbers
        return Sides(self.mesh, self.normals, self.winding, self.tree, self.meeting)

    @cached_property
    def found(self) -> np.ndarray:
        """Faces that others intersect or repeat, (F,) uint8: the states of
        find_self_intersections, or UNSEEN where that has not been asked for."""
        if self.inside and self.inside.meeting is not None:
            return self.inside.meeting.copy()
        return np.full(len(self.mesh.faces), UNSEEN if self.signed else 0, np.uint8)

    def meeting(self, faces: np.ndarray) -> np.ndarray:
        """Return which of (n,) faces others intersect or repeat, or may, (n,) bool."""
        unseen = np.zeros(len(self.found), bool)
        unseen[faces] = self.found[faces] == UNSEEN
        if unseen.any():
            found = find_self_intersections(self.device, self.mesh, self.tree, some=unseen)
            twins = twins_of(self.mesh)
            if twins is not None:
                found = np.where(np.bincount(twins)[twins] > 1, np.uint8(1), found)
            self.found[unseen] = found[unseen]
        return self.found[faces] != 0

    @property
    def crossed(self) -> int:
        """Number of faces that are known to intersect or repeat others."""
        return int(np.count_nonzero(self.found == 1))

    @property
    def undecided(self) -> int:
        """Number of faces that may intersect others."""
        return int(np.count_nonzero(self.found == UNDECIDED))


def cube_of(mesh: Mesh) -> tuple[np.ndarray, float]:
    """Return the origin and the side of the cube of a mesh's field, in world units.

    The mesh is in the middle, with a margin of MARGIN sides along its longest side.
    """
    frame = Frame.of(mesh)
    extent = _extent(mesh, frame)
    origin = frame.centre - np.ldexp(extent, frame.exponent)
    return origin, math.ldexp(2 * extent, frame.exponent)


def _extent(mesh: Mesh, frame: Frame) -> float:
    low, high = frame.local(mesh.bounds)
    return float((high - low).max()) / (2 - 4 * MARGIN)


def _misplaced(origin: np.ndarray, side: float) -> float:
    farthest = float(np.maximum(np.abs(origin), np.abs(origin + side)).max())
    return math.sqrt(3) * (2.0**-POINT_BITS + 2 * float(np.spacing(farthest)) / side)
