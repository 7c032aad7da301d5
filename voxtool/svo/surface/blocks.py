"""A surface of an octree that comes in blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from voxtool.arrays import Blocks, digest_of_blocks
from voxtool.grid import Grid
from voxtool.svo.surface.isosurface import Lost, enclosed, head_of, in_world


@dataclass(frozen=True)
class BlockSurface:
    """A surface as an Isosurface has it, whose points and faces come in blocks, each time that they
    are asked for.

    read_points, read_faces : return (n, 3) int32 blocks; sizes : the numbers of points and faces;
    six : six times its volume, as of six_volumes.
    """

    grid: Grid
    units: str
    style: str
    level: int | str
    side: int
    isovalue: float
    sizes: tuple[int, int]
    read_points: Callable[[], Iterator[np.ndarray]]
    read_faces: Callable[[], Iterator[np.ndarray]]
    cubes: int
    lost: Lost
    six: int
    features = None

    @property
    def text(self) -> str:
        """The kind of surface, in words."""
        return f"{self.style}, level {self.level}, isovalue {self.isovalue:g}"

    @property
    def points(self) -> Blocks:
        """(V, 3) int32, as of an Isosurface."""
        return Blocks(self.sizes[0], np.dtype(np.int32), self.read_points())

    @property
    def faces(self) -> Blocks:
        """(F, 3) int32, as of an Isosurface."""
        return Blocks(self.sizes[1], np.dtype(np.int32), self.read_faces())

    @property
    def vertices(self) -> Blocks:
        """(V, 3) float64: the vertices, in world units."""
        placed = (in_world(points, self.side, self.grid) for points in self.read_points())
        return Blocks(self.sizes[0], np.dtype(np.float64), placed)

    @property
    def volume(self) -> float:
        """The volume that the surface encloses, in cubic world units."""
        return enclosed(self.six, self.side, self.grid)

    def digest(self) -> str:
        """Return the digest of the Isosurface."""
        head = head_of(self.grid, self.style, self.level, self.isovalue, False)
        return digest_of_blocks(head, chain(self.read_points(), self.read_faces()))
