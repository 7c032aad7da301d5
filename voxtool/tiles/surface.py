"""Surfaces of octrees that are larger than the memory that they may take, window by window.

A window is a cell of the octree (svo/cells/subtrees.py) with a margin, from which the surface is
extracted as from any octree. Tiles of samples, and with them vertices and triangles, are in Morton
order; so are the windows, and what the tiles of a window hold is a part of the whole, as it is.
Only the numbers of vertices are those of the window. Triangles at its sides have vertices of other
windows; these are found by their tile, and by their place among the vertices of the tile. Points
and triangles wait on disk until the last window is done.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from voxtool.choices import MARCHING_CUBES, SHARP
from voxtool.errors import MemoryLimitError, VoxtoolError, count_of
from voxtool.files.storage.spool import Piece, Spool
from voxtool.job import Cost, Job, Plan
from voxtool.morton import morton_decode, morton_encode
from voxtool.opencl import Device
from voxtool.svo.cells.subtrees import AROUND, Cells
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.layout import BRICK_BYTES, NODE_BYTES
from voxtool.svo.surface.blocks import BlockSurface
from voxtool.svo.surface.cut_cells import find_tiles, lost_of
from voxtool.svo.surface.extract import (
    fits_whole,
    is_much,
    losses,
    plan_of,
    plan_unread,
    surface_of,
)
from voxtool.svo.surface.isosurface import LATTICE, Lost, six_volumes
from voxtool.svo.surface.plan import ExtractionPlan
from voxtool.svo.surface.samples import Sampling, tree_of

TILE = 4  # samples along a side
# Tiles beside a window on which its part of the surface depends: vertices are numbered in adjacent
# tiles, whose cubes have corners in the next ones, as has the second diagonal of a pinched face.
NUMBERED = 3
MOST = 4  # times the mean number of nodes, for its area, that a window is predicted to have
MAX_VERTICES = 1 << 31  # numbers of vertices are int32


@dataclass(frozen=True)
class SurfacePlan(Plan):
    """The windows of an extraction."""

    whole: ExtractionPlan
    window: ExtractionPlan  # as predicted
    side: int  # voxels along a side of a window
    margin: int  # voxels around it
    count: int

    @property
    def stages(self) -> list[str]:
        return self.window.stages

    @property
    def reasons(self) -> dict[str, str]:
        return self.window.left_out

    @property
    def cost(self) -> Cost:
        """The predicted bytes of a window."""
        read = NODE_BYTES * sum(self.window.nodes) + BRICK_BYTES * self.window.nodes[0]
        return replace(self.window.cost, host=3 * read)

    def as_dict(self) -> dict[str, Any]:
        whole = self.whole.as_dict() | {"predicted_device_bytes": self.cost.device}
        return {**whole, "windows": self.count, "window_side": self.side}

    def rows(self) -> list[tuple[str, str]]:
        count = count_of(self.count, "window")
        text = f"{count} of {self.side} voxels a side, one after the other"
        return [*self.whole.rows(), ("windows", text)]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Windows that do not fit are halved when they run."""


@dataclass(frozen=True)
class Part:
    """The part of a window.

    points, faces : where they wait; in faces, the vertices of other windows follow its own ones.
    outer : the window of each vertex of other windows, the tile in it, and the place in the tile.
    border : Morton codes of its tiles at its sides, and the first vertex of each.
    """

    points: Piece
    faces: Piece
    outer: tuple[np.ndarray, np.ndarray, np.ndarray]
    border: tuple[np.ndarray, np.ndarray]

    @property
    def vertices(self) -> int:
        """Number of its vertices."""
        return self.points.shape[0]


class SurfaceWindowsJob(Job[BlockSurface]):
    """The extraction of a surface window by window.

    Attributes
    ----------
    store : Spool
        Where the surface waits; to be set before it runs.
    """

    plan: SurfacePlan
    device: Device
    store: Spool

    def __init__(
        self, octree: OctreeContent, whole: ExtractionPlan, device: Device, max_memory: int | None
    ) -> None:
        self.octree, self.device, self.max_memory = octree, device, max_memory
        self.sampling = Sampling.of(whole.level, whole.isovalue)
        tiles = NUMBERED + -(-whole.relaxations // TILE)
        self.margin, self._whole = tiles * TILE * self.sampling.side, whole
        self.plan = self._plan(octree.grid.side // 2)

    def findings(self, result: BlockSurface) -> Iterator[str]:
        """Yield why the surface is empty, or what the samples lose."""
        lost, count = result.lost, self.octree.count
        if not result.sizes[1]:
            yield f"{count:,} voxels are set, and none lies in a sample that reaches the isovalue"
        elif is_much(lost, count):
            yield losses(lost, count)

    def details(self, result: BlockSurface) -> Iterator[str]:
        """Yield what the samples lose if that is little."""
        lost, count = result.lost, self.octree.count
        if lost.below and not is_much(lost, count):
            yield losses(lost, count)

    def _plan(self, side: int) -> SurfacePlan:
        """Return the plan of the largest windows of up to `side` voxels that are predicted to
        fit; MemoryLimitError if there are none."""
        while side >= max(self.margin, TILE * self.sampling.side):
            cells = Cells(self.octree, side)
            window = self._window_plan(self._nodes(cells))
            if window.fits(self.limit, self.device.info.max_allocation):
                return SurfacePlan(self._whole, window, side, self.margin, len(cells.mixed()))
            side //= 2
        raise MemoryLimitError(
            f"a window of {2 * side} voxels a side does not fit: allow more (see --max-memory)"
        )

    def _nodes(self, cells: Cells) -> tuple[int, ...]:
        """Return the predicted nodes of a window's levels, from the bricks up."""
        sizes = np.diff(self.octree.offsets.astype(np.int64))[::-1]
        share = MOST * (1 + 2 * self.margin / cells.side) ** 2 / max(cells.refined, 1)
        below = [int(min(n, share * n)) for n in sizes[: cells.level]]
        return (*below, AROUND**3, 8, 1)

    def _window_plan(self, nodes: tuple[int, ...]) -> ExtractionPlan:
        """Return the plan of an octree, given its nodes by level."""
        whole, solid = self._whole, "solid" in self.octree.mode
        return plan_of(nodes, False, solid, whole.style, whole.level, whole.isovalue)

    # ---- the work

    def _run(self) -> BlockSurface:
        while True:
            try:
                return self._joined()
            except MemoryLimitError:
                self.plan = self._plan(self.plan.side // 2)
                self.store.clear()

    def _joined(self) -> BlockSurface:
        """Return the surface of all windows."""
        cells = Cells(self.octree, self.plan.side)
        self._cubes, self._lost, self._six = 0, np.zeros(2, np.int64), 0
        found: dict[int, Part] = {}
        windows = cells.mixed()
        for number, cell in enumerate(windows, 1):
            if self._progress:
                self._progress(f"window {number} of {len(windows)}")
            with self.device.reporting(lambda _: None):  # not the stages within
                if part := self._part(cells, cell):
                    found[int(cells.keys(cell[None])[0])] = part
        starts = np.cumsum([0, *(part.vertices for part in found.values())])
        if starts[-1] >= MAX_VERTICES:
            raise VoxtoolError(
                f"{starts[-1]:,} vertices exceed numbers of 31 bits: choose a coarser level"
            )
        first = dict(zip(found, starts.tolist(), strict=False))
        parts = list(found.values())
        outer = [_numbers(part.outer, found, first) for part in parts]

        def points() -> Iterator[np.ndarray]:
            return (self.store.get(part.points) for part in parts)

        def faces() -> Iterator[np.ndarray]:
            for part, start, beyond in zip(parts, starts.tolist(), outer, strict=False):
                own = start + np.arange(part.vertices, dtype=np.int32)
                yield np.concatenate([own, beyond]).astype(np.int32)[self.store.get(part.faces)]

        whole, octree = self._whole, self.octree
        sizes = int(starts[-1]), sum(part.faces.shape[0] for part in parts)
        return BlockSurface(
            octree.grid, octree.units, whole.style, whole.level, self.sampling.side,
            whole.isovalue, sizes, points, faces, self._cubes, Lost(*self._lost.tolist()),
            self._six,
        )  # fmt: skip

    def _part(self, cells: Cells, cell: np.ndarray) -> Part | None:
        """Return the part of a window, or None if it is empty."""
        local, device = cells.around(cell, self.margin), self.device
        tree = tree_of(local)
        plan = self._window_plan(tuple(tree.count(number) for number in range(tree.top + 1)))

        known: dict[str, int] = {}

        def counted(**numbers: int) -> None:
            known.update(numbers)
            replace(plan, **known).refuse_beyond(self.limit, device.info.max_allocation)

        counted()
        along = cells.side // (TILE * self.sampling.side)  # tiles
        core = 7 * along**3, 8 * along**3
        tiles = find_tiles(device, local, tree, self.sampling, counted, core)
        begin, end = tiles.core
        if begin == end:
            return None
        codes = tiles.arguments["codes"].get(0, tiles.n)
        found = surface_of(tiles, plan, counted)
        runs = found.first.get().astype(np.int64)
        vertices = runs[: tiles.n + 1]
        low, high = vertices[[begin, end]].tolist()
        per = 3 if plan.style == MARCHING_CUBES else 6  # numbers of a triangle, or of two
        ends = per * (runs[[tiles.n + begin, tiles.n + end]] - runs[tiles.n])
        self._cubes += int(np.subtract(*runs[[-1 - tiles.n + end, -1 - tiles.n + begin]]))
        lost = lost_of(found.lost)
        self._lost += lost.below, lost.vanished
        shift = (cell - 1) * (cells.side // self.sampling.side) * LATTICE
        points = found.points.get().reshape(-1, 3) + shift.astype(np.int32)
        faces = found.triangles.get(*map(int, ends)).astype(np.int64)
        self._six += six_volumes(points, faces.reshape(-1, 3))
        faces -= low
        outer, places = np.unique(faces[(faces < 0) | (faces >= high - low)], return_inverse=True)
        faces[(faces < 0) | (faces >= high - low)] = high - low + places
        own = slice(begin, end)
        inner = morton_decode(codes[own]) % along
        sides = ((inner == 0) | (inner == along - 1)).any(axis=1)
        return Part(
            self.store.put(points[low:high]),
            self.store.put(faces.reshape(-1, 3).astype(np.uint32)),
            _places(cells, cell, outer + low, vertices, codes, along),
            (codes[own][sides] - np.uint64(core[0]), vertices[own][sides] - low),
        )


def plan_windows(
    octree: OctreeContent, device: Device, max_memory: int | None = None, **request: Any
) -> SurfaceWindowsJob | None:
    """Return the job of an extraction in windows, or None if it fits in memory, or if
    its style or its windows do not allow it."""
    whole = plan_unread(octree, **request)
    if whole.style == SHARP or whole.merge or fits_whole(octree, whole, device, max_memory):
        return None
    with suppress(MemoryLimitError):
        return SurfaceWindowsJob(octree, whole, device, max_memory)
    return None


def _places(
    cells: Cells,
    cell: np.ndarray,
    numbers: np.ndarray,
    vertices: np.ndarray,
    codes: np.ndarray,
    along: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the window, the tile in it and the place in the tile of vertices that a window numbers
    so; `vertices` are the first ones of its tiles."""
    slots = np.searchsorted(vertices[:-1], numbers, side="right") - 1
    tile = morton_decode(codes[slots])
    keys = cells.keys(cell - 1 + tile // along)
    return keys, morton_encode(tile % along), numbers - vertices[slots]


def _numbers(
    places: tuple[np.ndarray, ...], parts: dict[int, Part], first: dict[int, int]
) -> np.ndarray:
    """Return the numbers in the whole surface of vertices at places of other windows."""
    keys, tiles, ranks = places
    numbers = np.empty(len(keys), np.int64)
    for key in np.unique(keys).tolist():
        own = keys == key
        codes, starts = parts[key].border
        found = np.searchsorted(codes, tiles[own])
        assert np.array_equal(codes[found], tiles[own])
        numbers[own] = first[key] + starts[found] + ranks[own]
    return numbers
