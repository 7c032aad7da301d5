"""A mesh in another unit of length, and the part of it that lies beyond a grid."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from voxtool.errors import MeshError, VoxtoolError
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import Mesh
from voxtool.units import factor
from voxtool.vector import cross, length

FARTHEST = 2.0**40  # voxels from a grid; vertices beyond count as there


def in_units(mesh: Mesh, units: str) -> Mesh:
    """Return a mesh in a unit of length, scaled if its own is known and another one.

    Raises
    ------
    MeshError
        If a unit is none of length.
    """
    try:
        ratio = factor(mesh.units, units)
    except VoxtoolError as error:
        raise MeshError(f"{mesh.name or 'mesh'}: {error}") from None
    if ratio == 1:
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
    steps = 1 << FIXED_POINT_BITS
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.rint((mesh.vertices - grid.origin) / grid.pitch * steps) / steps
    corners = np.clip(points, -FARTHEST, FARTHEST)[mesh.faces]
    low, high, shape = corners.min(axis=1), corners.max(axis=1), np.array(grid.shape)
    outside = ((high < 0) | (low > shape)).any(axis=1)
    cut = ~outside & ((low < 0) | (high > shape)).any(axis=1)
    if not (outside | cut).any():
        return 0.0
    sides = np.array(grid.pitch) / max(grid.pitch)
    whole = _area(corners, sides)
    if whole == 0:
        return float(outside.mean())
    pieces = corners[cut]
    beyond = _area(corners[outside], sides) + _area(pieces, sides)
    for axis in range(3):
        for sign, place in ((1.0, 0.0), (-1.0, -float(shape[axis]))):
            pieces = _clipped(pieces, axis, sign, place)
    return min(max((beyond - _area(pieces, sides)) / whole, 0.0), 1.0)


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
