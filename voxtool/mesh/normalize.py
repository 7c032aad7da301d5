"""Meshes placed in a unit cube or a unit ball, as data sets for machine learning have them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from voxtool.choices import NORMALIZED
from voxtool.errors import MeshError, VoxtoolError
from voxtool.mesh.mesh import Mesh


def normalize(mesh: Mesh, into: str) -> Mesh:
    """Return a mesh scaled and moved into a unit cube or a unit ball; see voxtool.normalize.
    Vertices that no face uses are moved with it, but do not count.

    Raises
    ------
    MeshError
        If the mesh has been normalized before, or its extent is beyond 1e±150.
    VoxtoolError
        If `into` is unknown.

    References
    ----------
    [Park 2019] for "sphere", without its margin of 3 %.
    """
    if into not in NORMALIZED:
        raise VoxtoolError(f"normalize {into!r} is unknown: choose one of {', '.join(NORMALIZED)}")
    name = mesh.name or "mesh"
    if mesh.transform:
        raise MeshError(f"{name}: it has been normalized before: start from the original mesh")
    low, high = mesh.bounds
    with np.errstate(over="ignore"):
        longest = float((high - low).max())
        center = low / 2 + high / 2
    if not 1e-150 <= longest <= 1e150:  # squares of distances are in the range of float64
        raise MeshError(f"{name}: an extent of {longest:g} is not within 1e±150: scale it first")
    if into == "unit":
        scale, target = 1 / longest, 0.5
    else:
        scale, target = 1 / _radius(mesh, center), 0.0
    offset = target - center * scale
    return replace(
        mesh, vertices=mesh.vertices * scale + offset, units="",
        transform=(scale, *offset.tolist()),
    )  # fmt: skip


def _radius(mesh: Mesh, center: np.ndarray) -> float:
    """Return the largest distance of a vertex from a point."""
    x, y, z = (mesh.vertices[np.unique(mesh.faces)] - center).T
    return float(np.sqrt((x * x + y * y + z * z).max()))
