"""Cell projection of tetrahedral volumes: every cell goes to the pixels that it covers.

Cells are projected as in sections 3.1 and 4.1.1 of the text, with the ray's way through all planes
of a cell worked out for each pixel. A ray's way through a cell, from the greatest depth of the
planes that it comes in by to the least of those that it leaves by, is a fragment.

Why the order is right. Cells cannot be sorted so that all rays meet them in that order: three long
ones may overlap in a cycle. So the order is decided on each ray, by where its fragments begin (by
the number of the cell, where two begin together). The cells of a tile of the picture come by the
depth of their nearest vertex. No fragment begins before its cell's nearest vertex; so once a cell
comes whose nearest vertex is beyond the beginning of a fragment, no cell that is yet to come can
have anything before it, and it is composited. The others wait in a small sorted buffer. Where that
overflows the nearest are kept, and the first that found no room is remembered: nothing from there
on is composited in this pass, and another pass over the tile's list begins behind the last fragment
that was. Each pass composites at least as many as the buffer holds, and all passes see the same
numbers, so every fragment is composited once and in order, cycles or not, whatever the size of the
buffer.

Depths are those of the ray caster, by the same functions and roundings, so two cells that share a
face end and begin on it at the same depth. Where cells overlap in space, the later begins where the
earlier ended. The two methods' pictures are the same but for the rounding of depths and scalars
where rays come in: colours differ by at most 1e-5 where the extinction is up to 20 per half of the
mesh's size, and in proportion beyond. Cells that overlap in space are no part of that, nor are
constant cells on rays in the very plane of a face between them: there either cell is right.

Kernels: kernels/tets/project.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.opencl import program
from voxtool.opencl.primitives import exclusive_scan, radix_sort
from voxtool.tets.volume import FACES

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.opencl import Array
    from voxtool.tets.integrate import Integral
    from voxtool.tets.view import Viewpoint, VisibleCells

SOURCE = "tets/project.cl"
TILE = 8  # pixels along the side of a tile; a multiple of 4
PENDING = 32  # fragments of a ray that may wait
MOST_PAIRS = (1 << 31) - 1  # of a cell and a tile

HEADERS = {"tets/project.h": program.c_constants(TILE=TILE)}


@dataclass(frozen=True)
class Projection:
    """A picture, and what it took.

    picture : (H, W, 4) float32: red, green and blue, premultiplied, and alpha.
    cells : how many may be in the picture; pairs : of one of these and a tile; fragments : ways of
    rays through cells; passes : over the list of the tile that took the most.
    """

    picture: np.ndarray
    cells: int
    pairs: int
    fragments: int
    passes: int


@dataclass(frozen=True)
class _Tiles:
    """The cells of each tile by depth: those of tile i are cells[ends[2 i]] to
    cells[ends[2 i + 1]]."""

    cells: Array
    ends: Array
    pairs: int


class CellProjection:
    """Pictures of what a transfer function shows of a volume, by one integrator."""

    def __init__(self, visible: VisibleCells, integral: Integral) -> None:
        self.visible = visible
        self.integral = integral
        self.options: dict[str, int | str] = {
            **visible.textures.options,
            **integral.options,
            "PENDING": PENDING,
        }

    def __call__(self, view: Viewpoint) -> Projection:
        """The picture from a viewpoint.

        Raises
        ------
        MemoryLimitError : the device has no memory for a frame, or there are more than MOST_PAIRS
            pairs of a cell and a tile.
        """
        device = self.visible.textures.device
        with device.stage("project"):
            records, cells, seen = self._project(view)
        with device.stage("tiles"):
            tiles = self._bin(view, records, cells, seen)
        with device.stage("composite"):
            return self._composite(view, records, seen, tiles)

    def _kernel(self, view: Viewpoint, name: str) -> Callable[..., None]:
        return self.visible.textures.device.kernel(SOURCE, name, **self.options, **view.options)

    def _project(self, view: Viewpoint) -> tuple[Array, Array, int]:
        """The cells' records, the cells that may be in the picture by depth, and their number."""
        textures, device = self.visible.textures, self.visible.textures.device
        volume = textures.volume
        width, height = view.rays.size
        vertices, cells = len(volume.vertices), len(volume.cells)
        projected = device.empty(4 * vertices, np.float32)
        project = textures.kernel("project_vertices", **view.options)
        project(vertices, textures.vertices, np.uint32(vertices), view.on_device, projected)
        records = device.empty(4 * (len(FACES[volume.layout]) + 2) * cells, np.float32)
        starts = device.empty(cells + 1, np.uint32)
        # writes: records, starts
        self._kernel(view, "project_cells")(
            cells,
            *textures.arguments,
            self.visible.on_device,
            textures.cells,
            projected,
            view.on_device,
            np.int32(width),
            np.int32(height),
            records,
            starts,
        )
        seen = exclusive_scan(starts, cells)
        depths, listed = device.empty(seen, np.uint32), device.empty(seen, np.uint32)
        self._kernel(view, "list_cells")(cells, records, starts, np.uint32(cells), depths, listed)
        return records, radix_sort(depths, seen, 32, listed)[1], seen

    def _bin(self, view: Viewpoint, records: Array, cells: Array, seen: int) -> _Tiles:
        """The cells of each tile; sorting keeps their order."""
        device = self.visible.textures.device
        across, down = tiles_of(view)
        n = np.uint32(seen)
        starts = device.empty(seen + 1, np.uint32)
        self._kernel(view, "count_tiles")(seen, records, cells, n, starts)
        pairs = int(starts.get(0, seen).sum(dtype=np.uint64))
        if pairs > MOST_PAIRS:
            raise MemoryLimitError(
                f"{seen} cells in {pairs} pairs of a cell and a tile: choose a smaller picture, or "
                "--method raycast"
            )
        exclusive_scan(starts, seen)
        pair_tiles, pair_cells = device.empty(pairs, np.uint32), device.empty(pairs, np.uint32)
        # writes: pair_tiles, pair_cells
        self._kernel(view, "list_pairs")(
            seen, records, cells, n, starts, np.uint32(across), pair_tiles, pair_cells
        )
        bits = (across * down - 1).bit_length()
        pair_tiles, pair_cells = radix_sort(pair_tiles, pairs, bits, pair_cells)
        ends = device.zeros(2 * across * down, np.uint32)
        self._kernel(view, "find_tiles")(pairs, pair_tiles, np.uint32(pairs), ends)
        return _Tiles(pair_cells, ends, pairs)

    def _composite(self, view: Viewpoint, records: Array, seen: int, tiles: _Tiles) -> Projection:
        device, lanes = self.visible.textures.device, self.integral.lanes
        width, height = view.rays.size
        across, down = tiles_of(view)
        items = across * down * TILE * TILE // lanes
        picture = device.empty(4 * width * height, np.float32)
        tallies = device.empty(2 * items, np.uint32)
        # writes: picture, tallies
        self._kernel(view, "composite")(
            items,
            records,
            tiles.cells,
            tiles.ends,
            *self.integral.arguments,
            *view.arguments(),
            np.int32(width),
            np.int32(height),
            picture,
            tallies,
            local=1 if lanes > 1 else TILE * TILE,
        )
        pixels = picture.take().reshape(height, width, 4)
        fragments, passes = tallies.get().reshape(-1, 2).T
        return Projection(
            pixels, seen, tiles.pairs, int(fragments.sum(dtype=np.uint64)), int(passes.max())
        )


def tiles_of(view: Viewpoint) -> tuple[int, int]:
    """How many tiles the picture of a viewpoint is across and down."""
    width, height = view.rays.size
    return -(-width // TILE), -(-height // TILE)
