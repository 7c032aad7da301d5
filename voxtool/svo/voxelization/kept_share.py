"""The share of a mesh's outer surface that a fill rule keeps, counted in voxels.

The outer surface consists of the voxels that touch a triangle and lie within sqrt(3) voxels of what
a flood reaches from outside: they share a face, an edge or a corner with it. A result keeps
those within a voxel and a half of its boundary: from centres to the nearest voxel on the other side
of the boundary that is the ball of radius 2 around a voxel's centre. Areas count by the voxels that
they touch: an oblique one up to sqrt(3) times as much as one across an axis.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

from voxtool.errors import MeshWarning
from voxtool.opencl import Device
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.morphology import plan_morph

BOUNDARY_REACH = 2  # voxels between centres: one and a half to the side of the nearest other voxel
ENOUGH = 98  # percent


class Share(NamedTuple):
    """Voxels of the outer surface: those that are kept, and all."""

    kept: int
    outer: int

    @property
    def enough(self) -> bool:
        """True for at least ENOUGH percent."""
        return 100 * self.kept >= ENOUGH * self.outer

    @property
    def permille(self) -> int:
        """The share in thousandths, rounded down; 1000 if there is no outer surface."""
        return 1000 * self.kept // self.outer if self.outer else 1000

    def __str__(self) -> str:
        return f"{self.permille / 10:.1f} %"


def outer_surface(surface: Octree, flooded: Octree, device: Device) -> Octree:
    """Return the voxels of the outer surface, of those that touch a triangle and of the result of
    a flood."""
    return surface - _changed(flooded, "erode", 1, "cube", device)


def share_of(outer: Octree, result: Octree, device: Device) -> Share:
    """Return the share of the outer surface that the result of a fill rule keeps."""
    within = share_within(outer, result, device)
    deep = _changed(result, "erode", BOUNDARY_REACH, "ball", device)
    return within._replace(kept=within.kept - (outer & deep).count)


def share_within(outer: Octree, result: Octree, device: Device) -> Share:
    """Return the share of the outer surface that a result keeps or has inside."""
    if not result.count:
        return Share(0, outer.count)
    near = _changed(result, "dilate", BOUNDARY_REACH, "ball", device)
    return Share((outer & near).count, outer.count)


def _changed(octree: Octree, operation: str, radius: int, shape: str, device: Device) -> Octree:
    """Return the result of an operation of morphology, which may be empty."""
    with warnings.catch_warnings(action="ignore", category=MeshWarning):
        return plan_morph(octree, operation, radius, shape=shape, device=device).run()
