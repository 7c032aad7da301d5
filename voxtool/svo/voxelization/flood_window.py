"""A window of a grid that is flooded in windows (fill/flood.py).

Its job is run twice: for the pieces of free space that it shares with others, and, once it is known
which of them are outside, for its voxels.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.octree.prune import prune_levels
from voxtool.svo.voxelization.fill.flood import flooded_window, shared_pieces, window_frame
from voxtool.svo.voxelization.fill.flood_pieces import Shared
from voxtool.svo.voxelization.plan import VoxelizePlan
from voxtool.svo.voxelization.voxelize import VoxelizeJob, Window


class FloodWindowJob(VoxelizeJob):
    """The flood of a cube of a grid, which reaches to its end at most, with what lies around it.

    Parameters
    ----------
    mesh : the faces that reach the cube and what lies around it.
    grid, whole : the grid that is flooded, and its plan.
    key : the low corner of the cube, and its side.
    """

    def __init__(
        self,
        mesh: Mesh,
        grid: Grid,
        whole: VoxelizePlan,
        key: tuple[int, int, int, int],
        device: Device,
        max_memory: int | None,
    ) -> None:
        self.frame = window_frame(grid.shape, key, whole.gap)
        window = key[:3], tuple((self.frame.high - self.frame.low).tolist())
        super().__init__(mesh, grid, window, device, max_memory)
        self.place(whole.mode, "flood", whole.gap)
        seeds = len(np.unique(self.frame.seeds(self.frame.regions[0])))
        self.plan = replace(self.plan, slabs=1, seeds=seeds)

    @property
    def _flooded(self) -> Window:
        low, high = self.frame.box(self.frame.regions[0])
        shape = tuple((high - low).tolist())
        return tuple((low - self.frame.corner).tolist()), shape

    def shared(self) -> Shared:
        """Return the pieces of free space that other windows may have, too."""
        self.device.prepare(*self.programs)
        return shared_pieces(self.device, self._walls, self.frame)

    def fill(self, outside: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
        """Return the states of the nodes of the cube by level, from the root down, and its bricks;
        `outside` has the roots of its pieces that are outside."""
        self.device.prepare(*self.programs)
        return prune_levels(*flooded_window(self.device, self._walls, self.frame, outside))
