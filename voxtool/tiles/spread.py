"""Voxelization in windows by the workers of a Dask cluster: the same octree as by one process.

The grid is halved until each worker has several windows. A worker plans its window, and one that
does not fit comes back, to be halved again. With `--dag` workers merge the windows that they make.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import COLOURS
from voxtool.errors import count_of
from voxtool.files.windows import Key, Window, Windows
from voxtool.job import Cost
from voxtool.mesh.mesh import Mesh
from voxtool.svo.attribution.labels_window import PartsOfWindows
from voxtool.svo.fill.pieces import Shared
from voxtool.svo.merge import Subtrees
from voxtool.tiles.attributed import (
    AttributeWindowsJob,
    FloodAttributeWindowsJob,
    LabelAttributeWindowsJob,
)
from voxtool.tiles.cluster import results, sent_once, threads_of
from voxtool.tiles.flooding import OUTSIDE, FloodWindowsJob
from voxtool.tiles.labelled import LabelWindowsJob
from voxtool.tiles.merging import MergingJob
from voxtool.tiles.windows import (
    MARGIN,
    Part,
    WindowsJob,
    WindowsPlan,
    disk_row,
    halves_of,
    mesh_of,
    shape_of,
    stored_bytes,
)
from voxtool.tiles.workers import Described, Made, Place, flood_window, label_window, make_window

if TYPE_CHECKING:
    from distributed import Client

Wanted = tuple[Key, np.ndarray]  # a window, and the faces that can change it
SHARE = 8  # windows of a worker, at least, so that all of them end at about the same time


@dataclass(frozen=True)
class SpreadPlan(WindowsPlan):
    """The windows of a voxelization that workers make and plan."""

    workers: int = 1
    merged: bool = False

    @property
    def stages(self) -> list[str]:
        return [*self.whole.stages, *["merge subtrees"] * self.merged]

    @property
    def cost(self) -> Cost:
        """The predicted bytes of the states of all nodes; workers plan for themselves."""
        return Cost(device=0, host=2 * (self.whole.nodes - self.whole.bricks))

    @property
    def nodes(self) -> int:
        """Predicted number of nodes of the octree; plans of windows are not known here."""
        return self.whole.nodes

    @property
    def disk(self) -> int:
        """Predicted bytes of the file, and at most of the windows that wait for it; 0 of merged
        subtrees, whose number is not known."""
        return stored_bytes(self.whole) * (not self.merged)

    def as_dict(self) -> dict[str, Any]:
        return {**super().as_dict(), "workers": self.workers}

    def rows(self) -> list[tuple[str, str]]:
        count = count_of(self.count, "window")
        rows = [
            *self._rows_of_whole(),
            ("windows", f"{count}, made by {count_of(self.workers, 'worker')} of Dask"),
        ]
        return rows if self.merged else [*rows, disk_row(self.disk)]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Merged subtrees have links of 32 bits, whose number is not known; workers plan for
        themselves."""
        if not self.merged:
            super().refuse_beyond(max_memory, max_allocation)


class SpreadJob(WindowsJob):
    """A voxelization whose windows the workers of a Dask cluster make.

    Parameters
    ----------
    whole : the voxelization in one piece; its max_memory is what each worker may take.
    client : the cluster's.
    device_name : the device of a worker, as --device takes it.
    """

    merged = False

    def __init__(self, whole: Any, client: Client, device_name: str | None = None) -> None:
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
        return SpreadPlan(self._whole_plan, root, threads_of(self.client), self.merged)

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
        submit = self._submitter()
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

    def _submitter(self) -> Callable[[Wanted], Any]:
        """Return a function that submits a window, to be made."""
        send, describe = self._sender(), self._describer()

        def submit(wanted: Wanted) -> Any:
            key, faces = wanted
            given = (send(faces), self.grid, key, self._options, self.device_name)
            of = (self.merged, self._place, describe(key, faces))
            return self.client.submit(make_window, *given, *of, pure=False)

        return submit

    def _sender(self) -> Callable[[np.ndarray], Any]:
        """Return a function that returns the mesh of some faces, or what stands for it in a
        call."""
        return mesh_sender(self.client, self.mesh, whole=self._is_wound)

    def _describer(self) -> Callable[[Key, np.ndarray], Described | None]:
        """Return a function that returns what a worker needs for the attributes of a window."""
        return lambda key, faces: None

    def _divided_part(self, part: Part) -> Part:
        return self._divided.get(part.key, part)


class SpreadMergingJob(SpreadJob, MergingJob):
    """A voxelization whose windows the workers of a Dask cluster make and merge."""

    merged = True
    store: Windows

    def _prepare(self) -> None:
        super()._prepare()
        self._make(self._missing(self.plan.root, self.all_faces))

    def _merged(self, part: Part, faces: np.ndarray) -> Subtrees:
        return super()._merged(self._divided_part(part), faces)


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
        for (key, _), shared in results(self.client, self._flooder(), self._windows):
            self._report(OUTSIDE)
            found[key] = shared
        for key, _ in self._windows:
            yield key, found.pop(key)

    def _submitter(self) -> Callable[[Wanted], Any]:
        return self._flooder(self._outside)

    def _flooder(self, outside: Mapping[Key, np.ndarray] | None = None) -> Callable[[Wanted], Any]:
        """Return a function that submits a window: for what it shares, or to be filled."""
        send, describe = self._sender(), self._describer()

        def submit(wanted: Wanted) -> Any:
            key, faces = wanted
            given = (send(faces), self.grid, self.whole.plan, key, self.max_memory)
            filled = (None, None) if outside is None else (outside[key], describe(key, faces))
            of = (self.device_name, *filled, self.merged, self._place)
            return self.client.submit(flood_window, *given, *of, pure=False)

        return submit


class SpreadFloodMergingJob(SpreadFloodJob, SpreadMergingJob):
    """A flood whose windows the workers of a Dask cluster make and merge."""


class SpreadAttributeJob(SpreadJob, AttributeWindowsJob):
    """A voxelization with attributes of the surface whose windows workers make."""

    def _describer(self) -> Callable[[Key, np.ndarray], Described]:
        plan, whole = self._whole_job.plan, replace(self._whole_job.mesh, parts={})
        if "colour" not in plan.names:
            whole = replace(whole, appearance=None)
        materials = sent_once(self.client, whole.appearance and whole.appearance.materials)

        def describe(key: Key, faces: np.ndarray) -> Described:
            mesh = mesh_of(whole, self._faces_near(key, faces, MARGIN, rows=False))
            look = mesh.appearance and replace(mesh.appearance, materials=())
            return {
                "mesh": replace(mesh, appearance=None), "look": look,
                "materials": look and materials(), "names": plan.names,
                "colour": COLOURS[plan.nearest],
            }  # fmt: skip

        return describe


class SpreadFloodAttributeJob(SpreadFloodJob, SpreadAttributeJob, FloodAttributeWindowsJob):
    """A flood with attributes of the surface whose windows workers make."""


class SpreadLabelJob(SpreadJob, LabelWindowsJob):
    """A voxelization with labels whose windows workers make."""

    def _submitter(self) -> Callable[[Wanted], Any]:
        send, describe = parts_sender(self.client, self._parts, self._wound), self._describer()

        def submit(wanted: Wanted) -> Any:
            key, faces = wanted
            given = (*send(faces), key, self.max_memory, self.device_name, self._place)
            return self.client.submit(label_window, *given, describe(key, faces), pure=False)

        return submit


class SpreadLabelAttributeJob(SpreadLabelJob, SpreadAttributeJob, LabelAttributeWindowsJob):
    """A voxelization with labels and attributes of the surface whose windows workers make."""


def mesh_sender(client: Client, mesh: Mesh, *, whole: bool) -> Callable[[np.ndarray], Any]:
    """Return a function that returns the mesh of some faces, or what stands for it in a call; with
    `whole` all take the whole mesh, which is sent once."""
    bare = replace(mesh, parts={}, appearance=None)
    if not whole:
        return lambda faces: mesh_of(bare, faces)
    sent = sent_once(client, bare)
    return lambda _: sent()


def parts_sender(
    client: Client, parts: PartsOfWindows, wound: np.ndarray
) -> Callable[[np.ndarray], tuple[Any, np.ndarray]]:
    """Return a function that returns the parts of some faces, or what stands for them in a call,
    and the numbers of these faces there: all parts are sent once if some are filled by their
    winding number, as windows take these wholly.

    Parameters
    ----------
    wound : (F,) bool, which faces are of such parts.
    """
    if not wound.any():
        return lambda faces: (parts.sent(faces), np.arange(len(faces)))
    whole = sent_once(client, parts.sent(np.arange(len(wound))))
    return lambda faces: (whole(), faces)
