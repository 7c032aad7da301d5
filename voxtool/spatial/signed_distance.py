"""The signed distance from points to a triangle mesh: negative inside.

By angle-weighted pseudo-normals (pseudonormals.py), which are right for every mesh that is closed
and consistently wound, or by the generalized winding number (winding.py), which holds also where a
mesh is open, overlaps itself or is wound inconsistently in places. The sign changes no distance: on
the surface it is 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import SIGNS
from voxtool.errors import VoxtoolError
from voxtool.mesh.topology import collinear, watertight
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.pseudonormals import pseudonormals
from voxtool.spatial.winding_number import WindingNumber

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device


def default_sign(mesh: Mesh) -> str:
    """What suits a mesh: "pseudonormal" if every edge has two faces that run along it in opposite
    directions and no face is without area, and "winding" otherwise."""
    smooth = watertight(mesh) and not collinear(mesh.vertices[mesh.faces]).any()
    return "pseudonormal" if smooth else "winding"


class SignedDistance:
    """The signed distance to a mesh, whose tree is built once and asked many times.

    sign : how the sign is found, one of SIGNS.
    """

    def __init__(self, mesh: Mesh, device: Device | None = None, sign: str | None = None) -> None:
        """Build the tree and what the sign needs.

        Parameters
        ----------
        sign : "pseudonormal", "winding", "none" (no distance is negative), or by default what
            suits the mesh (default_sign).

        Raises
        ------
        MeshError, DeviceError : as TriangleDistance.
        VoxtoolError : no such sign.
        """
        if sign is not None and sign not in SIGNS:
            raise VoxtoolError(f"sign {sign!r}: choose one of {', '.join(SIGNS)}")
        self.sign = sign or default_sign(mesh)
        normals = pseudonormals(mesh) if self.sign == "pseudonormal" else None
        self._distance = TriangleDistance(mesh, device, normals=normals)
        self.device, tree = self._distance.device, self._distance.tree
        self._winding = None
        if self.sign == "winding":
            self._winding = WindingNumber(mesh, self.device, tree=tree)

    def __call__(self, points: Any) -> np.ndarray:
        """The distance from each point to the nearest triangle, negative inside.

        Parameters
        ----------
        points : (N, 3) numbers, world units.

        Returns
        -------
        (N,) float64, world units; never -0.0.

        Raises
        ------
        VoxtoolError : as TriangleDistance.
        """
        distances = self._distance(points)
        if self._winding is None:
            return distances
        return np.where((self._winding(points) > 0.5) & (distances > 0), -distances, distances)
