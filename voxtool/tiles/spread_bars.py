"""Fractions by the workers of a Dask cluster, bar by bar: the same octree as by one process.

This process plans the bars. With shares of faces, those along y and z are made first, and their
shares are sent with the bars along x.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from voxtool.errors import count_of
from voxtool.files.windows import Store, Window
from voxtool.tiles.cluster import results, threads_of
from voxtool.tiles.fractions import (
    Bar,
    BarsJob,
    BarsPlan,
    FractionWindowsJob,
    PartFractionWindowsJob,
)
from voxtool.tiles.spread import SHARE, mesh_sender, parts_sender
from voxtool.tiles.windows import LEAST
from voxtool.tiles.workers import Made, Place, fraction_bar, part_fraction_bar

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class SpreadBarsPlan(BarsPlan):
    """The bars of an octree with fractions that workers make."""

    workers: int = 1

    @property
    def makers(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The words of the rows that say who makes the bars."""
        return f"made by {count_of(self.workers, 'worker')} of Dask"

    def as_dict(self) -> dict[str, Any]:
        return {**super().as_dict(), "workers": self.workers}


class SpreadBarsJob(BarsJob):
    """A voxelization whose bars the workers of a Dask cluster make.

    Parameters
    ----------
    whole : the voxelization in one piece; its max_memory is what each worker may take.
    client : the cluster's.
    device_name : the device of a worker, as --device takes it.
    """

    def __init__(self, whole: Any, client: Client, device_name: str | None = None) -> None:
        self.client, self.device_name = client, device_name
        super().__init__(whole)

    def _plan(self) -> SpreadBarsPlan:
        plan = super()._plan()
        workers = threads_of(self.client)
        return SpreadBarsPlan(plan.whole, plan.root, plan.bars, plan.shares, workers)

    def _widest(self) -> int:
        """Return a width at which there are enough bars for the workers."""
        side, (_, y, z) = self.grid.side, self.grid.shape
        while side > LEAST and -(-y // side) * -(-z // side) < SHARE * threads_of(self.client):
            side //= 2
        return side

    @abstractmethod
    def _submitter(self) -> Callable[..., Any]:
        """Return a function that submits a bar, whose cubes wait in `place` if workers see it."""

    def _make_bars(self, bars: Sequence[Bar], store: Store) -> None:
        submit, place = self._submitter(), store.place
        while bars:
            again = []
            for bar, made in results(self.client, partial(submit, place=place), bars):
                if self._take(bar, made, store):
                    self._report()
                else:
                    again.append(bar)
            bars, place = again, None

    def _take(self, bar: Bar, made: Sequence[Made], store: Store) -> bool:
        """Store the cubes of a bar; return whether all are there: not if the worker wrote them into
        another folder of the same name, so that they have to be sent."""
        for key, cube in zip(bar.cubes(self.grid.shape), made, strict=True):
            if isinstance(cube, Window):
                store.put(key, cube)
            elif not store.take_note(cube):
                return False
        return True


class SpreadFractionJob(SpreadBarsJob, FractionWindowsJob):
    """A voxelization into fractions whose bars workers make."""

    def _submitter(self) -> Callable[..., Any]:
        whole = self.whole.plan.solid.fill == "winding"
        send = mesh_sender(self.client, self.mesh, whole=whole)

        def submit(bar: Bar, place: Place | None) -> Any:
            pairs = [] if bar.axis else [self._pairs(key) for key in bar.cubes(self.grid.shape)]
            given = (send(self._faces_of_bar(bar)), self.grid, replace(bar, plan=None))
            of = (self._volumes, self._options, pairs, self.device_name, place)
            return self.client.submit(fraction_bar, *given, *of, pure=False)

        return submit


class SpreadPartFractionJob(SpreadBarsJob, PartFractionWindowsJob):
    """A voxelization with labels and fractions whose bars workers make."""

    def _submitter(self) -> Callable[..., Any]:
        send = parts_sender(self.client, self._parts, self._wound)

        def submit(bar: Bar, place: Place | None) -> Any:
            given = (*send(self._faces_of_bar(bar)), replace(bar, plan=None), self._volumes)
            of = (self.max_memory, self.device_name, place)
            return self.client.submit(part_fraction_bar, *given, *of, pure=False)

        return submit
