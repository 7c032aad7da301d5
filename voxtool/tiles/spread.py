"""Voxelization in windows by the workers of a Dask cluster: the same octree as by one process.

The grid is halved until each worker has several windows. A worker plans its window, and one that
does not fit comes back, to be halved again. With `--dag` workers merge the windows that they make.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import count_of, human
from voxtool.files.windows import Key, Window, Windows, write_beside
from voxtool.grid import Grid
from voxtool.job import Cost
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import shared_device
from voxtool.svo.fill.pieces import Shared
from voxtool.svo.flood_window import FloodWindowJob
from voxtool.svo.layout import BRICK_BYTES, NODE_BYTES
from voxtool.svo.merge import Subtrees, merge
from voxtool.svo.plan import VoxelizePlan
from voxtool.svo.voxelize import VoxelizeJob, plan_voxelize
from voxtool.tiles.cluster import results, threads_of
from voxtool.tiles.flooding import OUTSIDE, FloodWindowsJob, filled
from voxtool.tiles.merging import MergingJob, merging_shortage, window_of
from voxtool.tiles.subtree import Subtree
from voxtool.tiles.windows import (
    Content,
    Part,
    WindowsJob,
    WindowsPlan,
    content_of,
    halves_of,
    refuse_smallest,
    shape_of,
)

if TYPE_CHECKING:
    from distributed import Client

Wanted = tuple[Key, np.ndarray]  # a window, and the faces that can change it
Made = Window | dict[str, Any]  # a window, or what the journal says of it if it is on disk
Place = tuple[str, str]  # where windows wait, and the first line of the journal there
SHARE = 8  # windows of a worker, at least, so that all of them end at about the same time


@dataclass(frozen=True)
class SpreadPlan(WindowsPlan):
    """The windows of a voxelization that workers make and plan."""

    workers: int = 1
    merged: bool = False

    @property
    def stages(self) -> list[str]:
        """The stages that will run, in order."""
        return [*self.whole.stages, *["merge subtrees"] * self.merged]

    @property
    def cost(self) -> Cost:
        """The predicted bytes of the states of all nodes; workers plan for themselves."""
        return Cost(device=0, host=2 * (self.whole.nodes - self.whole.bricks))

    @property
    def disk(self) -> int:
        """Predicted bytes of the file, and at most of the windows that wait for it; 0 of merged
        subtrees, whose number is not known."""
        return (NODE_BYTES * self.whole.nodes + BRICK_BYTES * self.whole.bricks) * (not self.merged)

    def as_dict(self) -> dict[str, Any]:
        """All of the plan in JSON types."""
        return {**super().as_dict(), "workers": self.workers}

    def rows(self) -> list[tuple[str, str]]:
        """Names and texts, which `--plan` prints before the stages."""
        count = count_of(self.count, "window")
        rows = [
            *(row for row in self.whole.rows() if row[0] not in ("octree", "work")),
            ("windows", f"{count}, made by {count_of(self.workers, 'worker')} of Dask"),
        ]
        if self.merged:
            return rows
        where = f"about {human(self.disk)}, of the file and of windows that wait for it"
        return [*rows, ("disk", where)]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Merged subtrees have links of 32 bits, whose number is not known; workers plan for
        themselves."""
        if not self.merged:
            super().refuse_beyond(max_memory, max_allocation)


class SpreadJob(WindowsJob):
    """A voxelization whose windows the workers of a Dask cluster make.

    Parameters
    ----------
    whole : the voxelization; its max_memory is what each worker may take.
    client : of the cluster.
    device_name : the device of a worker, as --device takes it.
    """

    merged = False

    def __init__(self, whole: VoxelizeJob, client: Client, device_name: str | None = None) -> None:
        self.client, self.device_name = client, device_name
        self._divided: dict[Key, Part] = {}
        super().__init__(whole)

    def _prepare(self) -> None:
        self._place: Place | None = self.store.place  # None if workers do not see it
        super()._prepare()

    def _plan(self) -> SpreadPlan:
        side, self._windows = self._halved()
        windows = {key for key, _ in self._windows}

        def part_of(key: Key) -> Part:
            if key[3] == side:
                return Part(key, window=key in windows)
            return Part(key, parts=tuple(map(part_of, halves_of(key))))

        return self._planned(part_of(self.root))

    def _planned(self, root: Part) -> SpreadPlan:
        return SpreadPlan(self.whole.plan, root, threads_of(self.client), self.merged)

    def _halved(self) -> tuple[int, list[Wanted]]:
        """Return the windows of one side that are enough for the workers, and the side."""
        parts, side = self._touched(self.root, self.all_faces), self.grid.side
        while 0 < len(parts) < SHARE * threads_of(self.client) and side > self.least:
            side //= 2
            parts = [
                found for key, faces in parts for half in halves_of(key)
                for found in self._touched(half, faces)
            ]  # fmt: skip
        return side, parts

    def _touched(self, key: Key, faces: np.ndarray) -> list[Wanted]:
        """Return a cube and its faces as a list, which is empty if no face can change it."""
        if min(shape_of(key, self.grid)) <= 0:
            return []
        faces = self._faces_of(key, faces)
        return [(key, faces)] if len(faces) else []

    def _missing(self, part: Part, faces: np.ndarray) -> Iterator[Wanted]:
        missing = [window for window in self._windows if window[0] not in self.store]
        self._done = len(self._windows) - len(missing)
        return iter(missing)

    def _make(self, missing: Iterable[Wanted]) -> None:
        """Have windows made; they wait on disk."""
        send = self._sender()

        def submit(wanted: Wanted) -> Any:
            key, faces = wanted
            given = (send(faces), self.grid, key, self._options, self.device_name)
            return self.client.submit(make_window, *given, self.merged, self._place, pure=False)

        while True:
            smaller: list[Wanted] = []
            for (key, faces), made in results(self.client, submit, missing):
                if made:
                    smaller += self._take(key, faces, made)
                    continue
                found = [each for half in halves_of(key) for each in self._touched(half, faces)]
                windows = {half for half, _ in found}
                halves = tuple(Part(half, window=half in windows) for half in halves_of(key))
                self._divided[key] = Part(key, parts=halves)
                smaller += found
            if not smaller:
                return
            missing = smaller

    def _take(self, key: Key, faces: np.ndarray, made: Made) -> list[Wanted]:
        """Store a window; return it if the worker wrote it into another folder of the same name, so
        that it has to be sent."""
        if isinstance(made, Window):
            self.store.put(key, made)
        elif not self.store.take_note(made):
            self._place = None
            return [(key, faces)]
        self._report()
        return []

    def _sender(self) -> Callable[[np.ndarray], Any]:
        """Return a function that returns the mesh of some faces, or what stands for it in a call:
        the whole mesh is sent once."""
        whole: Any = None

        def send(faces: np.ndarray) -> Any:
            nonlocal whole
            if self.whole.plan.fill != "winding":
                return self._mesh_of(faces)
            if whole is None or whole.cancelled():  # it is lost with a scheduler
                whole = self.client.scatter(self.mesh)
            return whole

        return send

    def _made(self, part: Part) -> Subtree:
        return super()._made(self._divided.get(part.key, part))


class SpreadMergingJob(SpreadJob, MergingJob):
    """A voxelization whose windows the workers of a Dask cluster make and merge."""

    merged = True
    store: Windows

    def _prepare(self) -> None:
        super()._prepare()
        self._make(self._missing(self.plan.root, self.all_faces))

    def _merged(self, part: Part, faces: np.ndarray) -> Subtrees:
        return super()._merged(self._divided.get(part.key, part), faces)


class SpreadFloodJob(SpreadJob, FloodWindowsJob):
    """A flood whose windows the workers of a Dask cluster make. This process plans the windows, and
    decides which pieces of free space are outside."""

    def _plan(self) -> SpreadPlan:
        self._side, _ = self._halved()
        root = self._divide(self.root, self.all_faces)
        self._windows = list(self._every(root, self.all_faces))
        return self._planned(root)

    def _divide(self, key: Key, faces: np.ndarray) -> Part:
        faces = self._faces_of(key, faces)
        if key[3] <= self._side or not len(faces):
            return super()._divide(key, faces)
        return Part(key, parts=tuple(self._divide(half, faces) for half in halves_of(key)))

    def _shares(self) -> Iterator[tuple[Key, Shared]]:
        found = {}
        for (key, _), shared in results(self.client, self._submitter(), self._windows):
            self._report(OUTSIDE)
            found[key] = shared
        for key, _ in self._windows:
            yield key, found.pop(key)

    def _make(self, missing: Iterable[Wanted]) -> None:
        while missing:
            again: list[Wanted] = []
            for (key, faces), made in results(self.client, self._submitter(self._outside), missing):
                again += self._take(key, faces, made)
            missing = again

    def _submitter(self, outside: Mapping[Key, np.ndarray] | None = None) -> Any:
        """Return a function that submits a window: for what it shares, or to be filled."""
        send = self._sender()

        def submit(wanted: Wanted) -> Any:
            key, faces = wanted
            given = (send(faces), self.grid, self.whole.plan, key, self.max_memory)
            roots = None if outside is None else outside[key]
            of = (self.device_name, roots, self.merged, self._place)
            return self.client.submit(flood_window, *given, *of, pure=False)

        return submit


class SpreadFloodMergingJob(SpreadFloodJob, SpreadMergingJob):
    """A flood whose windows the workers of a Dask cluster make and merge."""


def spread(
    whole: VoxelizeJob, client: Client, device_name: str | None = None, *, merged: bool = False
) -> SpreadJob:
    """Return the job of a voxelization by the workers of a cluster, with `merged` one that merges
    subtrees."""
    if whole.plan.fill == "flood":
        kind = SpreadFloodMergingJob if merged else SpreadFloodJob
    else:
        kind = SpreadMergingJob if merged else SpreadJob
    return kind(whole, client, device_name)


def make_window(
    mesh: Mesh,
    grid: Grid,
    key: Key,
    options: dict[str, Any],
    device_name: str | None,
    merged: bool,
    place: Place | None,
) -> Made | None:
    """Return a window, made in a worker and with `merged` merged there; what a journal says of it
    if it was written in `place`; None if it does not fit in the memory that the worker may take."""
    from distributed import get_worker

    if options["max_memory"] is None:
        limit = get_worker().memory_manager.memory_limit  # None if it has none
        options = {**options, "max_memory": limit and limit // 2}  # half is for results
    window = key[:3], shape_of(key, grid)
    job = plan_voxelize(mesh, grid, window=window, device=shared_device(device_name), **options)
    shortage = merging_shortage(job) if merged else job.shortage
    if not shortage:
        return _made(key, content_of(job, key[3]), merged, place)
    refuse_smallest(key, shortage)
    return None


def flood_window(
    mesh: Mesh,
    grid: Grid,
    whole: VoxelizePlan,
    key: Key,
    max_memory: int | None,
    device_name: str | None,
    outside: np.ndarray | None,
    merged: bool,
    place: Place | None,
) -> Shared | Made:
    """Return the pieces of free space that a window shares with others or, given the roots of its
    pieces that are outside, the window as `make_window` does."""
    job = FloodWindowJob(mesh, grid, whole, key, shared_device(device_name), max_memory)
    return job.shared() if outside is None else _made(key, filled(job, outside), merged, place)


def _made(key: Key, content: Content, merged: bool, place: Place | None) -> Made:
    """Return a window, or what a journal says of it if this worker sees the place."""
    levels, bricks, _ = content
    window = window_of(merge(levels[::-1], bricks)) if merged else Window.of(*content)
    return (place and write_beside(place, key, window)) or window
