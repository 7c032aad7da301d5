"""A mesh in another unit of length, and the part of it that lies beyond a grid."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import Mesh
from voxtool.units import factor
from voxtool.vector import cross, length

BATCH = 1 << 18  # faces at once
LEAST = 1e-12  # share that differs from rounding
FARTHEST = 2.0**40  # voxels from a grid; vertices beyond count as there


def in_units(mesh: Mesh, units: str) -> Mesh:
    """Return a mesh in a unit of length, scaled if its own is known and another one."""
    if (ratio := factor(mesh.units, units)) == 1:
        return mesh
    return replace(mesh, vertices=mesh.vertices * ratio.numerator / ratio.denominator, units=units)


def conversion(mesh: Mesh, found: Mesh, other: str) -> str:
    """Return the remark that a mesh was scaled to the unit of another thing, or "" if not."""
    if (ratio := factor(mesh.units, found.units)) == 1:
        return ""
    return (
        f"{mesh.name or 'the mesh'} is in {mesh.units}, {other} in {found.units}: scaled by "
        f"{float(ratio):.12g}"
    )


def share_beyond(mesh: Mesh, grid: Grid) -> float:
    """Return the share of a mesh that lies beyond a grid; see `voxtool.share_beyond`."""
    low, high = _rounded(mesh.bounds, grid)
    if (low >= 0).all() and (high <= grid.shape).all():
        return 0.0
    sides = np.array(grid.pitch) / max(grid.pitch)
    whole = within = 0.0
    faces = 0  # that lie wholly beyond
    for first in range(0, len(mesh.faces), BATCH):
        corners = _rounded(mesh.vertices[mesh.faces[first : first + BATCH]], grid)
        low, high = corners.min(axis=1), corners.max(axis=1)
        whole += _area(corners, sides)
        outside = ((high < 0) | (low > grid.shape)).any(axis=1)
        faces += int(np.count_nonzero(outside))
        inside = ((low >= 0) & (high <= grid.shape)).all(axis=1)
        pieces = corners[~outside & ~inside]
        for axis in range(3):
            for sign, place in ((1.0, 0.0), (-1.0, -float(grid.shape[axis]))):
                pieces = _clipped(pieces, axis, sign, place)
        within += _area(corners[inside], sides) + _area(pieces, sides)
    if whole == 0:
        return faces / len(mesh.faces)
    share = 1 - within / whole
    return min(share, 1.0) if share > LEAST else 0.0


def _rounded(points: np.ndarray, grid: Grid) -> np.ndarray:
    """Return (..., 3) points in voxels of a grid, rounded as `Grid.to_fixed` does."""
    steps = 1 << FIXED_POINT_BITS
    with np.errstate(over="ignore"):
        found = np.rint((points - grid.origin) / grid.pitch * steps) / steps
    return np.clip(found, -FARTHEST, FARTHEST)


def _area(corners: np.ndarray, sides: np.ndarray) -> float:
    """Return twice the area of (n, 3, 3) triangles in units of a length for each axis."""
    a, b, c = np.moveaxis(corners * sides, 1, 0)
    return math.fsum(length(cross(b - a, c - a)).tolist())


def _clipped(corners: np.ndarray, axis: int, sign: float, place: float) -> np.ndarray:
    """Return triangles of the parts of (n, 3, 3) triangles where `sign * x >= place`, x being the
    coordinate along an axis."""
    depth = sign * corners[..., axis] - place
    inside = depth >= 0
    count = inside.sum(axis=1)
    found = [corners[count == 3]]
    for number in (1, 2):
        some = count == number
        lone = np.argmax(inside[some] == (number == 1), axis=1)  # the corner apart from the others
        order = (lone[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(corners[some], order[..., None], axis=1), 1, 0)
        da, db, dc = np.take_along_axis(depth[some], order, axis=1).T[..., None]
        ab, ac = a + (b - a) * (da / (da - db)), a + (c - a) * (da / (da - dc))
        ab[:, axis] = ac[:, axis] = sign * place
        if number == 1:
            found.append(np.stack([a, ab, ac], axis=1))
        else:
            found += [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
    return np.concatenate(found)
