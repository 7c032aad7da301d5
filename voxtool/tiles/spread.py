"""Voxelization in windows by the workers of a Dask cluster: the same octree as by one process.

The grid is halved until each worker has several windows. A worker plans its window, and one that
does not fit comes back, to be halved again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import VoxtoolError, count_of, human
from voxtool.files.windows import Key, Window
from voxtool.grid import Grid
from voxtool.job import Cost
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import shared_device
from voxtool.svo.layout import BRICK_BYTES, NODE_BYTES
from voxtool.svo.voxelize import VoxelizeJob, plan_voxelize
from voxtool.tiles.cluster import results, threads_of
from voxtool.tiles.subtree import Subtree
from voxtool.tiles.windows import (
    LEAST,
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
SHARE = 8  # windows of a worker, at least, so that all of them end at about the same time


@dataclass(frozen=True)
class SpreadPlan(WindowsPlan):
    """The windows of a voxelization that workers make and plan."""

    workers: int = 1

    @property
    def stages(self) -> list[str]:
        """The stages that will run, in order."""
        return self.whole.stages

    @property
    def cost(self) -> Cost:
        """The predicted bytes of the states of all nodes; workers plan for themselves."""
        return Cost(device=0, host=2 * (self.whole.nodes - self.whole.bricks))

    @property
    def disk(self) -> int:
        """Predicted bytes of the file, and at most of the windows that wait for it."""
        return NODE_BYTES * self.whole.nodes + BRICK_BYTES * self.whole.bricks

    def as_dict(self) -> dict[str, Any]:
        """All of the plan in JSON types."""
        return {**super().as_dict(), "workers": self.workers}

    def rows(self) -> list[tuple[str, str]]:
        """Names and texts, which `--plan` prints before the stages."""
        count = count_of(self.count, "window")
        return [
            *(row for row in self.whole.rows() if row[0] not in ("octree", "work")),
            ("windows", f"{count}, made by {count_of(self.workers, 'worker')} of Dask"),
            ("disk", f"about {human(self.disk)}, of the file and of windows that wait for it"),
        ]


class SpreadJob(WindowsJob):
    """A voxelization whose windows the workers of a Dask cluster make.

    Parameters
    ----------
    whole : the voxelization; its max_memory is what each worker may take.
    client : of the cluster.
    device_name : the device of a worker, as --device takes it.
    """

    def __init__(self, whole: VoxelizeJob, client: Client, device_name: str | None = None) -> None:
        if whole.plan.fill == "flood":
            raise VoxtoolError("a flood is not divided among workers: choose another fill rule")
        self.client, self.device_name = client, device_name
        self._divided: dict[Key, Part] = {}
        super().__init__(whole)

    def _plan(self) -> SpreadPlan:
        workers = threads_of(self.client)
        parts = self._touched(self.root, self.all_faces)
        side = self.grid.side
        while 0 < len(parts) < SHARE * workers and side > LEAST:
            side //= 2
            parts = [
                found for key, faces in parts for half in halves_of(key)
                for found in self._touched(half, faces)
            ]  # fmt: skip
        self._windows = parts
        windows = {key for key, _ in parts}

        def part_of(key: Key) -> Part:
            if key[3] == side:
                return Part(key, window=key in windows)
            return Part(key, parts=tuple(map(part_of, halves_of(key))))

        return SpreadPlan(self.whole.plan, part_of(self.root), workers)

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
        whole: Any = None

        def submit(wanted: Wanted) -> Any:
            nonlocal whole
            key, faces = wanted
            mesh = whole
            if self._ranges is not None:
                mesh = self._mesh_of(faces)
            elif whole is None or whole.cancelled():  # it is lost with a scheduler
                mesh = whole = self.client.scatter(self.mesh)
            given = (mesh, self.grid, key, self._options, self.device_name)
            return self.client.submit(make_window, *given, pure=False)

        while True:
            smaller: list[Wanted] = []
            for (key, faces), made in results(self.client, submit, missing):
                if made:
                    self._report()
                    self.store.put(key, made)
                    continue
                found = [each for half in halves_of(key) for each in self._touched(half, faces)]
                windows = {half for half, _ in found}
                halves = tuple(Part(half, window=half in windows) for half in halves_of(key))
                self._divided[key] = Part(key, parts=halves)
                smaller += found
            if not smaller:
                return
            missing = smaller

    def _made(self, part: Part) -> Subtree:
        return super()._made(self._divided.get(part.key, part))


def make_window(
    mesh: Mesh, grid: Grid, key: Key, options: dict[str, Any], device_name: str | None
) -> Window | None:
    """Return a window, made in a worker; None if it does not fit in the memory that the worker may
    take."""
    from distributed import get_worker

    if options["max_memory"] is None:
        limit = get_worker().memory_manager.memory_limit  # None if it has none
        options = {**options, "max_memory": limit and limit // 2}  # half is for results
    window = key[:3], shape_of(key, grid)
    job = plan_voxelize(mesh, grid, window=window, device=shared_device(device_name), **options)
    if job.fits:
        return Window.of(*content_of(job, key[3]))
    refuse_smallest(key, job.shortage)
    return None
