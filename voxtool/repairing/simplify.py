"""Simplification: fewer triangles within a stated distance, by the library Manifold.

Manifold collapses edges whose surroundings are flat to a tolerance, and keeps the surface closed
and manifold, but leaves out shells that are completely flat to the tolerance: these keep all of
their faces. The distance between the result and the surface, both ways, is then bounded
(spatial/hausdorff.py), and its faces are tested for self-intersections. If it is too far away, it
is simplified again to a tolerance smaller by as much, and a tenth more; if its faces intersect, to
half the tolerance.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.mesh.topology import components
from voxtool.repairing.fit import Fitted
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.hausdorff import bound
from voxtool.spatial.self_intersections import UNDECIDED
from voxtool.svo.surface.isosurface import LATTICE, Isosurface
from voxtool.svo.surface.untangle import Untangled, wrong_faces

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

TRIES = 6  # at most
LESS = 0.9  # of the tolerance that would do if distances were in proportion to it
APART = 1 / 16  # of the length: between the bounds of the deviation


def check_library() -> None:
    """Raise VoxtoolError if the library is not installed."""
    try:
        import_module("manifold3d")
    except ImportError as error:
        raise VoxtoolError(
            "simplification needs the package manifold3d: pip install 'voxtool[simplify]'"
        ) from error


def simplify(fitted: Fitted, length: float, device: Device) -> tuple[Fitted, dict[str, Any]]:
    """Return a surface with fewer triangles, at most `length` in world units away both ways, of
    which no more faces pass through others, or the surface itself if there is none; and the facts
    of the report."""
    surface, found, tolerance = fitted.surface, fitted.found, length
    given, facts = surface.mesh(), {"wanted": length, "triangles_before": len(surface.faces)}
    shells = _shells(surface)
    whole = np.zeros(len(surface.points), bool)
    for _ in range(TRIES):
        smaller, kept = _collapsed(surface, whole, tolerance)
        lost = np.isin(shells, shells[kept], invert=True)
        while lost.any():
            whole |= lost
            smaller, kept = _collapsed(surface, whole, tolerance)
            lost = np.isin(shells, shells[kept], invert=True)
        far = _largest(smaller.mesh(), given, device, APART * length)
        wrong = wrong_faces(smaller, device)
        crossed, undecided = (int(np.count_nonzero(wrong == state)) for state in (1, UNDECIDED))
        if far <= length and crossed <= found.crossed and undecided <= found.undecided:
            left = Untangled(smaller, found.moved[kept], crossed, undecided)
            return Fitted(left, fitted.targets[kept]), {**facts, "deviation": far}
        tolerance *= LESS * length / far if far > length else 0.5
    return fitted, {**facts, "deviation": 0.0}


def _shells(surface: Isosurface) -> np.ndarray:
    """Return the (V,) int64 label of each vertex's shell."""
    faces = surface.faces
    return components(faces[:, [0, 0]].ravel(), faces[:, 1:].ravel(), len(surface.points))


def _collapsed(
    surface: Isosurface, whole: np.ndarray, tolerance: float
) -> tuple[Isosurface, np.ndarray]:
    """Return what the library makes of a surface, with the shells of some vertices as they are, and
    which of its vertices are left."""
    library: Any = import_module("manifold3d")
    stays = whole[surface.faces[:, 0]]
    # in steps of the lattice, which float64 holds exactly; the library keeps a subset of them
    points = surface.points.astype(np.float64)
    step = surface.grid.pitch[0] * surface.side / LATTICE
    solid = library.Manifold(library.Mesh64(points, surface.faces[~stays].astype(np.uint64)))
    made = solid.simplify(tolerance / step).to_mesh64()
    left = np.array(made.vert_properties)[:, :3].astype(np.int32)
    faces = np.array(made.tri_verts).astype(np.int32)
    kept = np.concatenate([_places(left, surface.points), np.flatnonzero(whole)])
    number = np.cumsum(whole, dtype=np.int32) + np.int32(len(left) - 1)
    faces = np.concatenate([faces, number[surface.faces[stays]]])
    return replace(surface, points=surface.points[kept], faces=faces), kept


def _places(some: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the (n,) int64 index of each of (n, 3) points among others, the first of equal
    ones."""
    both = np.concatenate([points, some])
    _, first, place = np.unique(both, axis=0, return_index=True, return_inverse=True)
    return first[place.ravel()[len(points) :]]


def _largest(one: Mesh, other: Mesh, device: Device, apart: float) -> float:
    """Return a bound, at most `apart` too large, of the largest distance from points of either mesh
    to the other."""
    ways = ((one, other), (other, one))
    return max(bound(a, a.faces, TriangleDistance(b, device), apart).upper for a, b in ways)
