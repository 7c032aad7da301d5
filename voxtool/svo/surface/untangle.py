"""A dual surface without self-intersections, as far as that can be had.

The two triangles of a quad fold onto each other where the quad is not convex and its diagonal runs
outside, and triangles about features pass through others. So quads with such triangles get their
other diagonal where it leaves fewer of them, and then the corners of what is left move towards
their homes, places where surfaces intersect less often: a quarter of the way, then half, then all
of it. A round is of all such quads and corners at once, so that no order shows. The
surface stays closed and manifold: the vertices of a diagonal lie in cells that share an edge of the
grid only, and no other quad links them.

A triangle that changed is tested against all others. A pair of which neither changed is as it was,
so it need not be tested again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from voxtool.spatial.bvh import build_tree
from voxtool.spatial.self_intersections import UNDECIDED, find_self_intersections, rounds

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.opencl import Device
    from voxtool.svo.surface.isosurface import Isosurface

FLAT = 3  # of wrong_faces, beside the states of find_self_intersections


@dataclass(frozen=True)
class Untangled:
    """A surface, (V,) bool which of its vertices moved, and the numbers of faces that others pass
    through, and of those where that is undecided."""

    surface: Isosurface
    moved: np.ndarray
    crossed: int
    undecided: int


def untangle(surface: Isosurface, homes: Sequence[np.ndarray], device: Device) -> Untangled:
    """Return the surface with the diagonals and the vertices that keep its faces apart.

    homes : places of the vertices, in the order in which they are tried, each (V, 3) int32 as
    Isosurface.points. Triangles 2 i and 2 i + 1 of the surface are those of a quad.
    """
    moved = np.zeros(len(surface.points), bool)
    wrong = wrong_faces(surface, device)
    for home, step in rounds(homes):
        surface, wrong = _split_anew(surface, wrong, device)
        back = np.zeros(len(moved), bool)
        back[surface.faces[wrong > 0]] = True
        back &= (surface.points != home).any(axis=1)
        if not back.any():
            continue
        moved |= back
        towards = surface.points + (home - surface.points) // step
        surface = replace(surface, points=np.where(back[:, None], towards, surface.points))
        changed = back[surface.faces].any(axis=1)
        wrong = wrong_faces(surface, device, (wrong > 0) | changed)
    if wrong.any():  # faces that did not change may meet those
        wrong = wrong_faces(surface, device)
    crossed, undecided = (int(np.count_nonzero(wrong == state)) for state in (1, UNDECIDED))
    return Untangled(surface, moved, crossed, undecided)


def wrong_faces(surface: Isosurface, device: Device, some: np.ndarray | None = None) -> np.ndarray:
    """Return what is wrong with each face, (F,) uint8: as find_self_intersections, or FLAT if it
    has no area or a corner in the place of another vertex; `some` are the faces that are tested,
    (F,) bool."""
    mesh = surface.mesh()
    flat = flat_faces(surface)
    tree = build_tree(device, mesh, flat.astype(np.uint8))
    found = find_self_intersections(device, mesh, tree, some=some)
    doubled = np.bincount(mesh.positions)[mesh.positions] > 1
    if doubled.any():
        flat |= doubled[surface.faces].any(axis=1)
    found[flat & (found == 0)] = FLAT
    return found


def flat_faces(surface: Isosurface) -> np.ndarray:
    """Return which faces have no area, (F,) bool, exactly: corners are a few cells apart."""
    a, b, c = (surface.points[surface.faces[:, i]].astype(np.int64) for i in range(3))
    return (np.cross(b - a, c - a) == 0).all(axis=1)


def _split_anew(
    surface: Isosurface, wrong: np.ndarray, device: Device
) -> tuple[Isosurface, np.ndarray]:
    """Return the surface with the other diagonals of the quads that have wrong faces, where these
    are fewer then; and what is wrong with its faces."""
    number = _wrong_of_quads(wrong)
    tangled = number > 0
    if not tangled.any():
        return surface, wrong
    some, faces = np.repeat(tangled, 2), surface.faces.reshape(-1, 2, 3)
    (a, b, c), d = faces[:, 0].T, faces[:, 1, 2]
    other = np.stack([b, c, d, b, d, a], axis=1).reshape(-1, 2, 3)

    def split(quads: np.ndarray) -> tuple[Isosurface, np.ndarray]:
        chosen = np.where(quads[:, None, None], other, faces).reshape(-1, 3)
        again = replace(surface, faces=chosen)
        return again, wrong_faces(again, device, some)

    _, after = split(tangled)
    return split(tangled & (_wrong_of_quads(after) < number))


def _wrong_of_quads(wrong: np.ndarray) -> np.ndarray:
    """Return the number of wrong faces of each quad, (F / 2,) uint8."""
    return (wrong[::2] > 0).astype(np.uint8) + (wrong[1::2] > 0)
