"""Surfaces with cells of different size around thin and long boxes and touching voxels, on tiny,
huge and far grids: their topology, and how far they are from a formula."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from voxtool.choices import SURFACE_NETS, VOXEL_FACES
from voxtool.selftest.case import case
from voxtool.selftest.fields import to_box
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.extract import extract

if TYPE_CHECKING:
    from voxtool.opencl import Device
    from voxtool.svo.surface.isosurface import Isosurface

LOW = 3  # voxels below the boxes
BOXES = ((20, 17, 14), (30, 30, 1), (60, 1, 1), (1, 1, 1))
GRIDS = ((1.0, 0.0), (1e-12, 0.0), (1e12, 0.0), (1.0, 1e8))  # pitch and origin
TOLERANCES = (1e-3, 0.75, 8.0)  # voxels
ROUNDED = 2.0**-24  # voxels, by which the formula and world coordinates may be off


@case("adaptive surfaces", "plates, rods, single and touching voxels at 1e-12, 1e12, 1e8 off: "
      "topology as before; a formula", "tolerances", 1.0)  # fmt: skip
def surfaces(device: Device, full: bool) -> float:
    """The largest distance from the sides of boxes, beside the tolerance; infinite if a surface is
    not closed, or has other shells or handles than the uniform one."""
    found = 0.0
    for size in BOXES:
        high = LOW + np.array(size)
        dense = np.zeros([64] * 3, bool)
        dense[tuple(slice(LOW, end) for end in high)] = True
        for pitch, origin in GRIDS if full else GRIDS[1:2]:
            octree = Octree.from_dense(dense, (origin, origin, origin), (pitch, pitch, pitch))
            for tolerance in TOLERANCES:
                surface = extract(
                    octree, style=VOXEL_FACES, adaptive=tolerance * pitch, device=device
                )
                corners = (surface.vertices - origin) / pitch
                middles = corners[surface.faces].mean(axis=1)
                away = to_box(np.concatenate([corners, middles]), np.full(3, LOW), high)
                found = max(found, (float(np.abs(away).max()) - ROUNDED) / tolerance)
                found = max(found, 0 if euler(surface) == 2 else math.inf)
    random = np.random.default_rng(7)
    for share in (0.5, 0.9) if full else (0.9,):
        octree = Octree.from_dense(random.random((12, 11, 10)) < share)
        expected = euler(extract(octree, style=SURFACE_NETS, device=device))
        for tolerance in TOLERANCES:
            surface = extract(octree, style=SURFACE_NETS, adaptive=tolerance, device=device)
            found = max(found, 0 if euler(surface) == expected else math.inf)
    return found


def euler(surface: Isosurface) -> float:
    """Return the Euler number of a surface, or infinity if it is not closed: an edge does not have
    one face in each direction, or the faces around a vertex are no single fan."""
    faces, vertices = surface.faces.astype(np.int64), len(surface.points)
    start, end, third = (np.roll(faces, -i, axis=1).ravel() for i in range(3))
    there, back = np.sort(start * vertices + end), np.sort(end * vertices + start)
    if not np.array_equal(there, back) or (np.diff(there) == 0).any():
        return math.inf
    turn, first = np.empty(len(there), np.int64), np.arange(len(there))
    turn[np.searchsorted(there, start * vertices + end)] = np.searchsorted(
        there, start * vertices + third
    )  # the next edge around the vertex at which an edge starts
    for _ in range(len(turn).bit_length()):
        first, turn = np.minimum(first, first[turn]), turn[turn]
    fans = len(np.unique(first))
    return vertices - len(there) // 2 + len(faces) if fans == vertices else math.inf
