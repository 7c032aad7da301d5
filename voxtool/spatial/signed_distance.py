"""The signed distance from points to a triangle mesh: negative inside.

The sign comes from angle-weighted pseudo-normals (pseudonormals.py), which are right where winding
numbers are 0 and 1 (fill_rule.py); from the generalized winding number (winding_number.py), which
also works where a mesh is open, its parts overlap or it is wound inconsistently in places; or from
the faces that the row along x crosses before a point (crossings.py), as of voxels that parity or
nonzero fill. The sign changes no magnitude. On the surface the distance is 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple, overload

import numpy as np

from voxtool.choices import SIGNS
from voxtool.errors import VoxtoolError
from voxtool.opencl import Device, default_device
from voxtool.opencl.builder import Request
from voxtool.opencl.primitives import COMPACTION
from voxtool.spatial.boundary import boundary_spheres
from voxtool.spatial.bvh import build_tree, tree_bytes
from voxtool.spatial.crossings import row_crossings
from voxtool.spatial.distance import (
    PACKETS,
    POINTS,
    TriangleDistance,
    checked_points,
    rounded_bytes,
)
from voxtool.spatial.distance import SOURCE as DISTANCE
from voxtool.spatial.insides import SOURCE as INSIDES
from voxtool.spatial.insides import insides
from voxtool.spatial.pseudonormals import Pseudonormals, normal_bytes, pseudonormals
from voxtool.spatial.winding_number import WindingNumber, moment_bytes

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.spatial.bvh import TriangleTree
    from voxtool.spatial.distance import PointBlock

NUMBERED = 1 << 12  # points: of fewer, each has a winding number of its own
FACES_PER_POINT = 16  # whose boundary is found in the time of the winding number of a point


class DistanceResult(NamedTuple):
    """The result of `distance` or `SignedDistance`; None where not requested.

    For one point the arrays lack their first axis.

    Attributes
    ----------
    distance : (N,) float64
        World units, negative inside.
    gradient : (N, 3) float64
        The direction, of length 1, in which the distance grows fastest: away from the nearest point
        outside, towards it inside. On the surface it is the normal of the nearest face, or 0 if
        that face has no area.
    nearest : (N, 3) float64
        The nearest point of the mesh, world units.
    face : (N,) int64
        The nearest face; the lowest index where several are equally near.
    """

    distance: Any
    gradient: Any = None
    nearest: Any = None
    face: Any = None


def programs(device: Device, sign: str) -> list[Request]:
    """Return the programs that distances of many points near a mesh use, beyond those of its tree
    and its winding number, in order."""
    found: list[Request] = [(DISTANCE, {"BOX": "float"})]
    if device.lanes == POINTS:
        found.append((PACKETS, {}))
        if sign == "pseudonormal":
            found.append((PACKETS, {"RANKED": 1}))
    return found + ([(INSIDES, {}), (COMPACTION, {"KEY": "uint"})] if sign == "winding" else [])


def distance_bytes(faces: int, sign: str) -> int:
    """Return the bytes on the device for the distance to a mesh, without points."""
    more = {
        "pseudonormal": normal_bytes, "winding": moment_bytes,
        "parity": tree_bytes, "nonzero": tree_bytes,
    }.get(sign)  # fmt: skip
    return tree_bytes(faces) + rounded_bytes(faces) + (more(faces) if more else 0)


class SignedDistance:
    """The signed distance to a mesh, for many calls. `sign` is one of voxtool.choices.SIGNS;
    `normals` are the mesh's pseudo-normals, if they are known."""

    def __init__(
        self,
        mesh: Mesh,
        sign: str,
        device: Device | None = None,
        normals: Pseudonormals | None = None,
    ) -> None:
        if sign not in SIGNS:
            raise VoxtoolError(f"sign {sign!r}: choose one of {', '.join(SIGNS)}")
        self.device = device or default_device()
        self.mesh = mesh
        self.sign = sign
        name, size = f"distance, sign {self.sign}", distance_bytes(len(mesh.faces), self.sign)
        self._distance, self._winding, self._rows = self.device.keep(
            mesh, name, size, lambda: _measures(mesh, self.sign, self.device, normals)
        )

    @overload
    def __call__(
        self,
        points: Any,
        *,
        gradient: Literal[False] = False,
        nearest: Literal[False] = False,
        face: Literal[False] = False,
    ) -> np.ndarray: ...
    @overload
    def __call__(
        self, points: Any, *, gradient: bool = False, nearest: bool = False, face: bool = False
    ) -> DistanceResult: ...
    def __call__(
        self, points: Any, *, gradient: bool = False, nearest: bool = False, face: bool = False
    ) -> np.ndarray | DistanceResult:
        """Return the distance from each point to the nearest triangle, negative inside.

        Parameters
        ----------
        points : (N, 3) or (3,) array_like
            World units; (3,) is one point.
        gradient, nearest, face : bool
            Whether these are returned as well, in a DistanceResult.

        Returns
        -------
        (N,) float64 or DistanceResult
            World units, never -0.0.

        Raises
        ------
        VoxtoolError
            If the shape is wrong, or a point is not finite or 2^500 extents away.
        """
        one = np.ndim(points) == 1
        world = checked_points([points] if one else points)
        located = gradient or nearest or face
        parts = [self._at_block(block, located) for block in self._distance.blocks(world)]
        if not parts:
            parts = [(np.empty(0), np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.int64))]
        all_or_one = 0 if one else slice(None)
        columns: list[Any] = [
            np.concatenate(column)[all_or_one] if asked else None
            for asked, *column in zip((True, gradient, nearest, face), *parts, strict=True)
        ]
        return DistanceResult(*columns) if located else columns[0]

    def _at_block(self, block: Any, located: bool) -> tuple[Any, ...]:
        """Return the columns of a DistanceResult for the points of a block."""
        distances, faces, nearest, directions = self._distance.at_block(block, located)
        if self._winding is not None:
            inside = self._inside(self._winding, block, distances) & (distances > 0)
            distances = np.where(inside, -distances, distances)
        elif self._rows is not None:
            counts, numbers = row_crossings(self.device, self.mesh, self._rows, block)
            inside = counts % 2 == 1 if self.sign == "parity" else numbers != 0
            distances = np.where(inside & (distances > 0), -distances, distances)
        if directions is not None:
            directions = np.where(distances[:, None] < 0, -directions, directions)
        return distances, directions, nearest, faces

    def _inside(
        self, winding: WindingNumber, block: PointBlock, distances: np.ndarray
    ) -> np.ndarray:
        """Return which points of a block have a winding number above 1/2, (n,) bool."""
        if block.n < max(NUMBERED, len(self.mesh.faces) // FACES_PER_POINT):
            return winding.at_block(block) > 0.5
        some, frame = winding.counted, winding.tree.frame
        spheres = self.device.keep(
            self.mesh, "boundary", 0,
            lambda: self.device.put(boundary_spheres(self.mesh, some, frame)),
        )  # fmt: skip
        return insides(winding, spheres, block, np.ldexp(distances, -frame.exponent))

    def __reduce__(self) -> tuple[Any, ...]:
        return SignedDistance, (self.mesh, self.sign)

    def __repr__(self) -> str:
        faces = len(self.mesh.faces)
        return f"SignedDistance({self.mesh.name or 'mesh'}, {faces} faces, sign {self.sign!r})"


def _measures(
    mesh: Mesh, sign: str, device: Device, normals: Pseudonormals | None
) -> tuple[TriangleDistance, WindingNumber | None, TriangleTree | None]:
    """Return the tree and what else a sign needs: moments, or the tree of all faces that rows
    cross; without a reference to the mesh."""
    if sign == "pseudonormal":
        with device.stage("pseudo-normals"):
            normals = normals or pseudonormals(mesh)
        return TriangleDistance(mesh, device, normals=normals), None, None
    distance = TriangleDistance(mesh, device)
    moments = WindingNumber(mesh, device, tree=distance.tree) if sign == "winding" else None
    rows = build_tree(device, mesh) if sign in ("parity", "nonzero") else None
    return distance, moments, rows
