"""The nesting of the closed shells of a mesh.

A shell contains another if its box contains the other's, and its winding number is not 0 at the
other's outermost vertices, those of the least and the greatest x, y and z. Shells that intersect
mostly contain each other in neither direction; self_intersections.py finds those.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.spatial.winding_number import WindingNumber

if TYPE_CHECKING:
    from voxtool.mesh.shells import Shells
    from voxtool.opencl import Device


@dataclass(frozen=True, eq=False)
class Nesting:
    """A tree of shells.

    parents : (S,) int64: the innermost shell that contains each, or -1.
    depths : (S,) int64: how many contain each.
    """

    parents: np.ndarray
    depths: np.ndarray


def nest(mesh: Mesh, shells: Shells, device: Device) -> Nesting:
    """Return the nesting of the shells of a mesh; raises as WindingNumber."""
    count = len(shells.closed)
    by_low = np.argsort(shells.low[:, 0], kind="stable")
    lows = shells.low[by_low, 0]
    faces = np.argsort(shells.of, kind="stable")
    starts = np.searchsorted(shells.of[faces], np.arange(count + 1))
    pairs = [np.empty((0, 2), np.int64)]
    for holder in np.flatnonzero(shells.closed).tolist():
        low, high = shells.low[holder], shells.high[holder]
        near = by_low[np.searchsorted(lows, low[0]) : np.searchsorted(lows, high[0], "right")]
        within = (shells.low[near] >= low) & (shells.high[near] <= high)
        smaller = (shells.low[near] > low) | (shells.high[near] < high)
        inner = near[within.all(axis=1) & smaller.any(axis=1)]
        if len(inner):
            winding = WindingNumber(_part(mesh, faces[starts[holder] : starts[holder + 1]]), device)
            points = [_outermost(mesh, faces[starts[i] : starts[i + 1]]) for i in inner.tolist()]
            number = winding(np.concatenate(points)).reshape(-1, 6)
            held = inner[(np.abs(number) > 0.5).all(axis=1)]
            pairs.append(np.stack([np.full(len(held), holder), held], axis=1))
    holder, held = np.concatenate(pairs).T
    depths = np.bincount(held, minlength=count)
    parents = np.full(count, -1)
    order = np.argsort(depths[holder], kind="stable")  # the deepest is written last
    parents[held[order]] = holder[order]
    return Nesting(parents, depths)


def _part(mesh: Mesh, faces: np.ndarray) -> Mesh:
    used, corners = np.unique(mesh.faces[faces], return_inverse=True)
    return Mesh(mesh.vertices[used], corners.reshape(-1, 3).astype(np.int32))


def _outermost(mesh: Mesh, faces: np.ndarray) -> np.ndarray:
    """Return the (6, 3) vertices of faces: of the least and the greatest x, y and z."""
    points = mesh.vertices[mesh.faces[faces]].reshape(-1, 3)
    return points[np.concatenate([points.argmin(axis=0), points.argmax(axis=0)])]
