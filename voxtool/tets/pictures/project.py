"""Cell projection of tetrahedral volumes: each cell is drawn to the pixels that it covers.

Cells are projected as in [TetVol, sections 3.1 and 4.1.1], but each ray is clipped by all planes of
a cell. A fragment is the segment of a ray in a cell: from the greatest depth of the planes by which
the ray enters to the least depth of those by which it leaves.

No order of cells is right for all rays, because three long cells may overlap in a cycle. So each
ray sorts its fragments by where they begin, and by the number of the cell where two begin together.
The cells of a tile are processed by the depth of their nearest vertex, and no fragment begins
before that of its cell. So a fragment is composited once the next cell's nearest vertex is behind
its beginning; until then it waits in a small sorted buffer. If the buffer overflows, it keeps the
nearest fragments and records the first that did not fit. Nothing from there on is composited in
this pass; another pass begins behind the last fragment that was. Each pass composites at least as
many fragments as the buffer holds, and all passes compute the same numbers. So each fragment is
composited once and in order, also in cycles, whatever the size of the buffer.

Depths are those of the ray caster: of two cells that share a face, one ends and the other begins at
the same depth. Where cells overlap in space, the later one begins where the earlier one ended. The
pictures of both methods differ by the rounding of depths and scalars at entries: colours by at most
1e-5 where the extinction is up to 24 per half of the mesh's size; beyond, both are by walk.py. This
excludes cells that overlap in space, and constant cells on rays in the plane of a face between
them, where either cell is right.

Kernels: kernels/tets/pictures/project.cl lists the cells, and is the same for every integrator;
kernels/tets/pictures/composite.cl draws them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.opencl import program
from voxtool.opencl.primitives import exclusive_scan, radix_sort

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.opencl import Array
    from voxtool.tets.pictures.integrate import Integral
    from voxtool.tets.pictures.view import DeviceVolume, ShownCells, Viewpoint

LISTS = "tets/pictures/project.cl"
PICTURES = "tets/pictures/composite.cl"
TILE = 8  # pixels along the side of a tile; a multiple of 4
PENDING = 32  # fragments of a ray that the buffer holds
MAX_PAIRS = (1 << 31) - 1  # pairs of a cell and a tile

HEADERS = {"tets/pictures/project.h": program.c_constants(TILE=TILE)}


@dataclass(frozen=True)
class Projection:
    """A picture by cell projection, and the work that it took.

    picture : (H, W, 4) float32: premultiplied red, green, blue, and opacity.
    cells : cells that may be in the picture; pairs : pairs of such a cell and a tile.
    fragments : fragments that were composited.
    passes : passes over the list of cells, of the tile that took the most.
    """

    picture: np.ndarray
    cells: int
    pairs: int
    fragments: int
    passes: int


class CellProjection:
    """The projection of the cells that a transfer function shows, for one viewpoint.

    pending : fragments of a ray that the buffer holds.
    max_pairs : pairs of a cell and a tile, beyond which the picture is refused.
    """

    def __init__(
        self,
        volume: DeviceVolume,
        shown: ShownCells,
        view: Viewpoint,
        integral: Integral,
        *,
        pending: int = PENDING,
        max_pairs: int = MAX_PAIRS,
    ) -> None:
        self.volume, self.shown, self.view, self.integral = volume, shown, view, integral
        self.device, self.max_pairs = volume.device, max_pairs
        width, height = view.rays.size
        self.tiles_across, self.tiles_down = -(-width // TILE), -(-height // TILE)
        self.pending = pending

    def run(self) -> Projection:
        """Project the cells, list them by tile, and composite each ray's fragments.

        Raises
        ------
        MemoryLimitError : the device has no memory for a frame, or there are more than max_pairs
            pairs of a cell and a tile.
        """
        with self.device.stage("cell projection"):
            records, cells = self._project_cells()
        with self.device.stage("tile lists"):
            pair_cells, ends = self._list_tiles(records, cells)
        with self.device.stage("compositing"):
            picture, tallies = self._composite(records, pair_cells, ends)
        fragments, passes = tallies.reshape(-1, 2).T
        total = int(fragments.sum(dtype=np.uint64))
        return Projection(picture, cells.size, pair_cells.size, total, int(passes.max()))

    def _kernel(self, name: str) -> Callable[..., None]:
        """Return a kernel that lists cells."""
        return self.device.kernel(LISTS, name, **self.volume.options, **self.view.options)

    def _project_cells(self) -> tuple[Array, Array]:
        """Return the cells' records, and the cells that may be in the picture, by depth."""
        device, count = self.device, self.volume.cells
        records = device.empty(4 * (self.volume.faces + 2) * count, np.float32)
        starts = device.empty(count + 1, np.uint32)
        # writes: records, starts
        self._kernel("project_cells")(
            count,
            **self.volume.arguments,
            **self.view.arguments,
            kept=self.shown.flags,
            projected=self.volume.project_vertices(self.view),
            records=records,
            flags=starts,
        )
        seen = exclusive_scan(starts, count)
        depths, listed = device.empty(seen, np.uint32), device.empty(seen, np.uint32)
        self._kernel("list_cells")(
            count, records=records, starts=starts, depths=depths, listed=listed
        )
        return records, radix_sort(depths, seen, 32, listed)[1]

    def _list_tiles(self, records: Array, cells: Array) -> tuple[Array, Array]:
        """Return the cells of all tiles, each tile's by depth, and where tiles begin and end: tile
        i has the cells from ends[2 i] to ends[2 i + 1]."""
        device, seen = self.device, cells.size
        starts = device.empty(seen + 1, np.uint32)
        listed = {"records": records, "listed": cells}
        self._kernel("count_tiles")(seen, **listed, counts=starts)
        pairs = int(starts.get(0, seen).sum(dtype=np.uint64))
        if pairs > self.max_pairs:
            raise MemoryLimitError(
                f"{seen} cells in {pairs} pairs of a cell and a tile: choose a smaller picture, or "
                "the method raycast"
            )
        exclusive_scan(starts, seen)
        pair_tiles, pair_cells = device.empty(pairs, np.uint32), device.empty(pairs, np.uint32)
        # writes: pair_tiles, pair_cells
        self._kernel("list_pairs")(
            seen,
            **listed,
            starts=starts,
            tiles_across=self.tiles_across,
            pair_tiles=pair_tiles,
            pair_cells=pair_cells,
        )
        tiles = self.tiles_across * self.tiles_down
        bits = (tiles - 1).bit_length()
        # sorting is stable, so the cells of a tile stay in the order of their depth
        pair_tiles, pair_cells = radix_sort(pair_tiles, pairs, bits, pair_cells)
        ends = device.zeros(2 * tiles, np.uint32)
        self._kernel("find_tiles")(pairs, pair_tiles=pair_tiles, ends=ends)
        return pair_cells, ends

    def _composite(
        self, records: Array, pair_cells: Array, ends: Array
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the picture, and fragments and passes of each work-item."""
        device, lanes = self.device, self.integral.lanes
        width, height = self.view.rays.size
        items = self.tiles_across * self.tiles_down * TILE * TILE // lanes
        picture = device.empty(4 * width * height, np.float32)
        tallies = device.empty(2 * items, np.uint32)
        # writes: picture, tallies
        options = {**self.integral.options, **self.view.options, "PENDING": self.pending}
        composite = device.kernel(PICTURES, "composite", FACES=self.volume.faces, **options)
        composite(
            items,
            **self.integral.arguments,
            **self.view.arguments,
            records=records,
            pair_cells=pair_cells,
            ends=ends,
            picture=picture,
            tallies=tallies,
            local=1 if lanes > 1 else TILE * TILE,
        )
        return picture.take().reshape(height, width, 4), tallies.get()
