"""Targets that vertices are moved onto: the points at a distance from a mesh, and cylinders.

A target is called with (n, 3) points in world units and returns, for each, the nearest point of the
target, and the unit normal there: its tangent plane is where the search goes on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, Self

import numpy as np

from voxtool.vector import dot, length

if TYPE_CHECKING:
    from voxtool.spatial.distance import TriangleDistance

Onto = tuple[np.ndarray, np.ndarray]


class Target(Protocol):
    """A surface onto which vertices are laid."""

    def __call__(self, points: np.ndarray) -> Onto: ...


@dataclass(frozen=True)
class Level:
    """The points at a distance from a mesh, world units: on the side of the point that is laid."""

    distance: TriangleDistance
    reach: float = 0.0

    def __call__(self, points: np.ndarray) -> Onto:
        near = self.distance.nearest(points)
        assert near.points is not None
        assert near.directions is not None
        return near.points + self.reach * near.directions, near.directions


@dataclass(frozen=True)
class Cylinder:
    """A cylinder without caps; `axis` has length 1, `low` and `high` bound it along the axis from
    the centre. World units."""

    centre: np.ndarray
    axis: np.ndarray
    radius: float
    low: float
    high: float

    def along(self, points: np.ndarray) -> np.ndarray:
        """Return the places of points along the axis, (n,)."""
        return dot(points - self.centre, self.axis)

    def _beside(self, points: np.ndarray) -> np.ndarray:
        """Return how points lie beside the axis, (n, 3)."""
        return points - self.centre - self.along(points)[:, None] * self.axis

    def __call__(self, points: np.ndarray) -> Onto:
        beside = self._beside(points)
        from_axis = length(beside)[:, None]
        normals = beside / np.where(from_axis > 0, from_axis, 1.0)
        return points + (self.radius - from_axis) * normals, normals

    def grown(self, by: float) -> Self:
        """Return the cylinder that is larger by this distance on all sides."""
        return replace(self, radius=self.radius + by, low=self.low - by, high=self.high + by)

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return which points lie in the cylinder, (n,) bool."""
        along = self.along(points)
        between = (along >= self.low) & (along <= self.high)
        return between & (length(self._beside(points)) <= self.radius)
