"""An octree as a scene for `render`: its voxels, or the nodes of a level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from voxtool.camera import Rays, box_corners, checked_colour
from voxtool.opencl import Device
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.octree import Octree
from voxtool.svo.raycast import COLOUR, cast, size_exponent

COARSE_LEVELS = 5  # levels below the root down to which nodes bound what is shown


@dataclass(frozen=True, eq=False)
class OctreeScene:
    """The voxels of an octree, or the nodes of a level as cubes."""

    kind: ClassVar[str] = "octree"
    samples: ClassVar[int] = 2

    content: Octree
    level: int | str = "voxel"  # or a level, from 0 for bricks
    colour: Sequence[float] = COLOUR  # red, green and blue of a face towards the light, 0 to 1

    def __post_init__(self) -> None:
        size_exponent(self.content, self.level)
        checked_colour(self.colour)

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages of drawing, in order."""
        return ("coverage", "ray casting")

    @property
    def left_out(self) -> dict[str, str]:
        """The parts that are not drawn, each with the reason."""
        if self.level == "voxel":
            return {}
        return {f"voxels finer than level {self.level}": "nodes of that level are drawn as cubes"}

    @property
    def counts(self) -> dict[str, int]:
        """The sizes of the octree, by name."""
        return {"nodes": len(self.content.nodes), "bricks": len(self.content.bricks)}

    @property
    def device_bytes(self) -> int:
        """Bytes of the octree on the device."""
        return self.content.nbytes

    def points(self) -> np.ndarray:
        """Return (N, 3) float64 points in world units whose convex hull holds everything shown: the
        corners of coarse nodes, clipped to the bounding box of the voxels or cubes."""
        octree, grid = self.content, self.content.grid
        origin, pitch = np.array(grid.origin), np.array(grid.pitch)
        finest = BRICK_SIDE if self.level == "voxel" else 1 << size_exponent(octree, self.level)
        if not octree.count:
            return origin + pitch * box_corners(np.zeros((1, 3), np.int64), np.array(grid.shape))
        coarse = max(octree.depth - 1 - COARSE_LEVELS, 0)
        low, high, boxes = np.array(grid.shape), np.zeros(3, np.int64), []
        for level in octree.levels():
            held = level.inside if level.number else octree.bricks != 0
            if held.any():
                low = np.minimum(low, level.cells[held].min(axis=0))
                high = np.maximum(high, level.cells[held].max(axis=0) + level.side)
            if level.number >= coarse:
                shown = level.inside | level.refined if level.number == coarse else level.inside
                cells = level.cells[shown] // finest * finest
                boxes.append(box_corners(cells, max(level.side, finest)))
        low, high = low // finest * finest, -(-high // finest) * finest
        return origin + pitch * np.clip(np.concatenate(boxes), low, high)

    def draw(self, rays: Rays, device: Device) -> np.ndarray:
        """Return the premultiplied colour of every ray, (H, W, 4) float32."""
        return cast(self.content, rays, level=self.level, colour=self.colour, device=device)

    def why_empty(self) -> str:
        """Return why the scene is empty, or ""."""
        return "" if self.content.count else "no voxel of the octree is set"
