"""Fractions in windows: whole rows at a time, as what lies inside is summed along rows.

A bar takes all of the grid along an axis, and as much across as fits in memory; its voxels are
exactly those of the whole. It is cut into cubes, which are the windows that wait on disk. Faces of
voxels are summed along all three axes: bars along y and along z give the shares of their faces,
which wait, too, until the bars along x are made.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from voxtool.arrays import digest_of
from voxtool.errors import MemoryLimitError, count_of
from voxtool.files.octrees.windows import Key, Store, Window
from voxtool.grid import Grid
from voxtool.job import Cost
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.attribution.fraction import (
    LATTICE_BITS,
    MODE,
    FractionJob,
    Volumes,
    attributes_of,
    plan_fractions,
    without_values,
)
from voxtool.svo.attribution.fraction_rows import Shares
from voxtool.svo.attribution.labels import fill_of
from voxtool.svo.attribution.labels_window import PartsOfWindows
from voxtool.svo.attribution.part_fractions import PartFractionsJob
from voxtool.svo.octree.attributes import BITS, Attribute
from voxtool.svo.octree.stored_volume import WHOLE
from voxtool.svo.voxelization.voxelize import Window as Box
from voxtool.tiles.bars import Cube, attributes_within, cubes_along
from voxtool.tiles.labelled import LabelWindowsJob
from voxtool.tiles.octree import BlockOctree
from voxtool.tiles.subtree import LEAST, MARGIN, halves_of, shape_of
from voxtool.tiles.windows import SHARE, Part, Wanted, WindowsJob, WindowsPlan, sets_nothing

AXES = "xyz"


@dataclass(frozen=True)
class Bar:
    """A bar of the grid, whose low corner is that of its first cube; plan : of its job."""

    axis: int
    key: Key
    plan: Any

    def cubes(self, shape: Sequence[int]) -> list[Key]:
        """Return its cubes, in a grid of this shape."""
        side = self.key[3]
        corners = np.tile(self.key, (-(-shape[self.axis] // side), 1))
        corners[:, self.axis] = np.arange(len(corners)) * side
        return [(x, y, z, side) for x, y, z, _ in corners.tolist()]

    def box(self, grid: Grid) -> Box:
        """Return its low corner and its voxels along each axis of a grid."""
        shape = list(shape_of(self.key, grid))
        shape[self.axis] = grid.shape[self.axis]
        return self.key[:3], (shape[0], shape[1], shape[2])


@dataclass(frozen=True)
class BarsPlan(WindowsPlan):
    """The windows of an octree with fractions: the cubes of bars."""

    bars: tuple[Bar, ...] = ()
    shares: int = 0  # predicted bytes of shares of faces that wait
    unplanned = False  # pyright: ignore[reportAssignmentType]

    @property
    def count(self) -> int:
        """Number of bars."""
        return len(self.bars)

    @property
    def cost(self) -> Cost:
        """The predicted bytes of the largest bar, and of the states of all nodes."""
        cost = Cost.most(bar.plan.cost for bar in self.bars)
        return replace(cost, host=cost.host + super().cost.host)

    @property
    def disk(self) -> int:
        """Predicted bytes of the file, and at most of what waits for it."""
        return super().disk + self.shares

    def rows(self) -> list[tuple[str, str]]:
        axes = ", ".join(AXES[axis] for axis in sorted({bar.axis for bar in self.bars}))
        side = self.bars[0].key[3] if self.bars else 0
        text = f"{count_of(self.count, 'bar')} along {axes}, {side} x {side} voxels across"
        text += f", {self.makers}"
        return [("windows", text) if row[0] == "windows" else row for row in super().rows()]


class BarsJob(WindowsJob):
    """A voxelization that runs bar by bar. This process plans the bars.

    Subclasses say how a bar is planned and made, and from what.
    """

    plan: BarsPlan
    axes: tuple[int, ...] = (0,)  # along which there are bars; x is the last
    bar_planner: Callable[..., Any]  # returns the job of a bar, None if it is empty
    bar_maker: Callable[..., Iterator[tuple[Key, Window]]]  # yields its cubes

    @abstractmethod
    def _given_for(self, bar: Bar) -> tuple[Any, ...]:
        """Return what a bar is planned from."""

    def _needs_of(self, bar: Bar) -> tuple[Any, ...]:
        """Return what a bar is made from."""
        return replace(bar, plan=None), *self._given_for(bar)

    @abstractmethod
    def _everywhere(self) -> np.ndarray:
        """Return the faces that can change every bar, as those of winding numbers."""

    # ---- the plan

    def _plan(self) -> BarsPlan:
        side = self._widest_bar()
        while (bars := self._bars(side)) is None:
            side //= 2
        along_x = {bar.key[1:3]: bar.plan for bar in bars if not bar.axis}

        def part_of(key: Key) -> Part:
            if min(shape_of(key, self.grid)) <= 0:
                return Part(key)
            if key[3] > side:
                return Part(key, parts=tuple(map(part_of, halves_of(key))))
            plan = along_x.get(key[1:3])
            return Part(key, window=plan is not None, plan=None if key[0] else plan)

        shares = sum(8 * bar.plan.touched for bar in bars if bar.axis)
        workers = self.executor.workers
        return BarsPlan(
            self.asked.plan, part_of(self.root), workers, bars=tuple(bars), shares=shares
        )

    def _widest_bar(self) -> int:
        """Return a width at which there are enough bars for the workers."""
        side, (_, y, z) = self.grid.side, self.grid.shape
        while side > LEAST and -(-y // side) * -(-z // side) < SHARE * self.executor.workers:
            side //= 2
        return side

    def _bars(self, side: int) -> list[Bar] | None:
        """Return the bars that are not empty, or None if one does not fit."""
        found = []
        for axis in self.axes:
            p, q = (other for other in range(3) if other != axis)
            for j in range(0, self.grid.shape[q], side):
                for i in range(0, self.grid.shape[p], side):
                    corner = [0, 0, 0]
                    corner[p], corner[q] = i, j
                    bar = Bar(axis, (*corner, side), None)  # pyright: ignore[reportArgumentType]
                    job = self._job_of(bar)
                    if job is None:
                        continue
                    if shortage := self._shortage(job):
                        if side > LEAST:
                            return None
                        raise MemoryLimitError(
                            f"a bar of {side} x {side} voxels along {AXES[axis]} {shortage}: "
                            "allow more, or choose a smaller dim"
                        )
                    found.append(replace(bar, plan=job.plan))
        return found

    def _job_of(self, bar: Bar) -> Any:
        """Return the job of a bar, or None if it is empty."""
        if not len(self._faces_of_bar(bar)):
            return None
        return self.here.call(self.bar_planner, (bar, *self._given_for(bar)))

    def _faces_of_bar(self, bar: Bar) -> np.ndarray:
        """Return the faces that can change a bar: those near it, and those before it along x."""
        low, high = self._ranges
        corner, side = np.array(bar.key[:3]), bar.key[3]
        first, last = high >= corner - MARGIN, low <= corner + side + MARGIN
        first[:, [0, bar.axis]] = last[:, bar.axis] = True
        near = np.flatnonzero((first & last).all(axis=1))
        everywhere = self._everywhere()
        return np.union1d(near, everywhere) if len(everywhere) else near

    # ---- the work

    def _make(self, missing: Iterable[Wanted]) -> None:
        """Make the bars along x; their cubes wait on disk."""
        along_x = [bar for bar in self.plan.bars if not bar.axis]
        self._done = len(self.plan.bars) - len(along_x)
        self._make_bars(self._not_in(self.store, along_x), self.store)

    def _not_in(self, store: Store, bars: Sequence[Bar]) -> list[Bar]:
        """Return those of some bars whose cubes are not all in a store; the others are done."""
        shape = self.grid.shape
        missing = [bar for bar in bars if any(key not in store for key in bar.cubes(shape))]
        self._done += len(bars) - len(missing)
        return missing

    def _make_bars(self, bars: Sequence[Bar], store: Store) -> None:
        """Have bars along one axis made; their cubes wait in a store."""
        left = self.executor.make(self.bar_maker, self._needs_of, bars, store, self._report)
        assert not list(left)  # they were planned

    def _report(self, what: str = "bar") -> None:
        super()._report(what)


def plan_bar(
    device: Device,
    max_memory: int | None,
    bar: Bar,
    mesh: Mesh,
    grid: Grid,
    volumes: Volumes,
    options: dict[str, Any],
) -> FractionJob | None:
    """Return the job of a bar, given the faces that can change it and the volumes of the whole
    mesh; None if it is empty."""
    place: dict[str, Any] = {"window": bar.box(grid), "device": device, "max_memory": max_memory}
    job = plan_fractions(mesh, grid, **place, **options)
    job.volumes = volumes
    return None if sets_nothing(job.solid.plan) else job


def make_bar(
    device: Device,
    max_memory: int | None,
    pairs: list[list[np.ndarray]],
    bar: Bar,
    mesh: Mesh,
    grid: Grid,
    *given: Any,
) -> Iterator[tuple[Key, Window]]:
    """Yield the cubes of a bar with their keys: with shares of faces of a bar along y or z, with
    fractions of one along x, given the shares of the faces of its cubes."""
    job = plan_bar(device, max_memory, bar, mesh, grid, *given)
    assert job is not None  # it was planned
    cubes = face_cubes(job, bar) if bar.axis else fraction_cubes(job, bar, pairs)
    return zip(bar.cubes(grid.shape), cubes, strict=True)


def face_cubes(job: FractionJob, bar: Bar) -> Iterator[Window]:
    """Make a bar along y or z; yield its cubes, with the two shares of each touched voxel as one
    number of 64 bits."""
    octree, found = job.shares(bar.axis)
    assert found.faces is not None
    pairs = np.ascontiguousarray(found.faces[:, 2 * bar.axis : 2 * bar.axis + 2])
    firsts, wrong = starts_of(found.touched), found.disagreements
    for cube in cubes_along(octree, bar.key[3], bar.axis):
        own = pairs[firsts[cube.first] : firsts[cube.last]]
        yield Window((), own.view(np.uint64).ravel(), 0, (), wrong)
        wrong = 0


def fraction_cubes(
    job: FractionJob, bar: Bar, pairs: Iterable[Sequence[np.ndarray]]
) -> Iterator[Window]:
    """Make a bar along x; yield its cubes, given the shares of their faces across y and z, if faces
    have shares."""
    octree, found = job.shares(0 if job.plan.faces else None)
    firsts, wrong = starts_of(found.touched), found.disagreements
    for cube, own_pairs in zip(cubes_along(octree, bar.key[3], 0), pairs, strict=True):
        own = _within(found, cube, firsts, own_pairs)
        yield cube.window(own.bricks, list(attributes_of(own, job.plan.kind)), wrong)
        wrong = 0


def _within(found: Shares, cube: Cube, firsts: np.ndarray, pairs: Sequence[np.ndarray]) -> Shares:
    """Return the shares of a cube, with those of all its faces."""
    bricks, voxels = slice(cube.first, cube.last), slice(firsts[cube.first], firsts[cube.last])
    touched, shares = found.touched[bricks], found.voxels[voxels]
    faces = cut = None
    if found.faces is not None:
        across = [one.view(np.uint32).reshape(-1, 2) for one in pairs]
        faces = np.concatenate([found.faces[voxels, :2], *across], axis=1)
        cut = _cut(touched, (shares > 0) & (faces != WHOLE).any(axis=1))
    return Shares(touched, found.bricks[bricks], found.partial[bricks], shares, faces, cut, 0)


def starts_of(masks: np.ndarray) -> np.ndarray:
    """Return how many voxels of some masks come before each, and their number."""
    return np.concatenate([[0], np.cumsum(np.bitwise_count(masks), dtype=np.int64)])


def _cut(touched: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the masks of the touched voxels that are chosen."""
    bits = (touched[:, None] & BITS) != 0
    bits[bits] = chosen
    return np.packbits(bits, axis=1, bitorder="little").view(np.uint64).ravel()


class FractionWindowsJob(BarsJob):
    """A voxelization into fractions that runs bar by bar."""

    whole: Any
    bar_planner = staticmethod(plan_bar)
    bar_maker = staticmethod(make_bar)

    def _take_over(self) -> None:
        self._volumes = self.whole.volumes  # which need the mesh on the device
        self.axes = (1, 2, 0) if self.whole.plan.faces else (0,)
        del self.whole.solid.lattice

    @property
    def _request(self) -> dict[str, Any]:
        """The content and the rule of the octree that is made, in JSON types."""
        content = digest_of(self.grid.exact, self.mesh.vertices, self.mesh.faces)
        plan = self.whole.plan
        rules = {"mode": MODE, "fill": plan.solid.rule, "kind": plan.kind, "faces": plan.faces}
        return {"content": content, **rules, LATTICE_BITS: plan.solid.bits}

    @property
    def _rule(self) -> tuple[str, str]:
        return MODE, self.whole.plan.solid.rule

    def _scene(self) -> dict[str, Any]:
        return self.whole.scene()

    def _kinds(self) -> Sequence[Attribute]:
        return without_values(self.whole.plan.kind, faces=self.whole.plan.faces)

    def _everywhere(self) -> np.ndarray:
        return self.all_faces[: None if self.whole.plan.solid.fill == "winding" else 0]

    @property
    def _is_wound(self) -> bool:
        return self.whole.plan.solid.fill == "winding"

    @property
    def _options(self) -> dict[str, Any]:
        """The options of each bar's voxelization."""
        plan = self.whole.plan
        rules = {"fill": plan.solid.fill, "kind": plan.kind, "faces": plan.faces}
        return {**rules, "bits": plan.solid.bits}

    def _given_for(self, bar: Bar) -> tuple[Any, ...]:
        mesh = self._mesh_of(self._faces_of_bar(bar))
        return mesh, self.grid, self._volumes, self._options

    def _needs_of(self, bar: Bar) -> tuple[Any, ...]:
        pairs = [] if bar.axis else [self._pairs(key) for key in bar.cubes(self.grid.shape)]
        return pairs, *super()._needs_of(bar)

    def _prepare(self) -> None:
        """Find the shares of faces across y and z."""
        self._done = 0
        self._shares = {axis: self.store.beside(AXES[axis]) for axis in self.axes[:-1]}
        for axis, store in self._shares.items():
            bars = [bar for bar in self.plan.bars if bar.axis == axis]
            self._make_bars(self._not_in(store, bars), store)

    def _pairs(self, key: Key) -> list[np.ndarray]:
        """Return what waits of the shares of faces of a cube, across y and across z."""
        found = []
        for store in self._shares.values():
            stored = store.bricks(key) if key in store else ()  # of a bar without faces
            found.append(np.concatenate([np.empty(0, np.uint64), *stored]))
        return found

    def findings(self, octree: BlockOctree) -> Iterator[str]:
        """Yield warnings, those of the octree in one piece."""
        stores = {0: self.store, **self._shares}
        self.whole.disagreements = sum(stores[bar.axis].known(bar.key) for bar in self.plan.bars)
        return self.whole.findings(octree)


def plan_part_bar(
    device: Device,
    max_memory: int | None,
    bar: Bar,
    parts: PartsOfWindows,
    faces: np.ndarray,
    volumes: dict[int, Volumes],
) -> PartFractionsJob | None:
    """Return the job of a bar, given the faces that can change it and the volumes of the whole
    parts; None if it is empty."""
    own, jobs, alone = parts.own.some(faces), [], []
    plan: Any = parts.plan
    for part in own.parts.tolist():
        options = {"fill": parts.rules[part][0], "bits": plan.bits}
        given = own.alone(part, parts.mesh), parts.grid, volumes[part], options
        job = plan_bar(device, max_memory, bar, *given)
        if job is not None:
            jobs.append(job)
            alone.append((part, ""))
    if not jobs:
        return None
    plan = replace(plan, alone=tuple(alone), inner=tuple(job.plan for job in jobs))
    window = parts.grid.window(*bar.box(parts.grid))
    return PartFractionsJob(
        parts.mesh, window, own, parts.ranks, None, jobs, plan, device, max_memory
    )


def make_part_bar(
    device: Device, max_memory: int | None, bar: Bar, parts: PartsOfWindows, *given: Any
) -> Iterator[tuple[Key, Window]]:
    """Yield the cubes of a bar with labels and fractions, with their keys."""
    job = plan_part_bar(device, max_memory, bar, parts, *given)
    assert job is not None  # it was planned
    return zip(bar.cubes(parts.grid.shape), part_cubes(job, bar), strict=True)


def part_cubes(job: PartFractionsJob, bar: Bar) -> Iterator[Window]:
    """Make a bar; yield its cubes."""
    octree = job._run()
    parts = [part for part, _ in job.plan.alone]
    wrong = [[part, one.disagreements] for part, one in zip(parts, job.jobs, strict=True)]
    for cube in cubes_along(octree, bar.key[3], 0):
        bricks = octree.bricks[cube.first : cube.last]
        yield cube.window(bricks, attributes_within(octree, cube), wrong)
        wrong = []


class PartFractionWindowsJob(BarsJob, LabelWindowsJob):
    """A voxelization with labels and fractions that runs bar by bar."""

    whole: PartFractionsJob
    bar_planner = staticmethod(plan_part_bar)
    bar_maker = staticmethod(make_part_bar)

    def _free(self) -> None:
        self._volumes = {}
        for (part, _), job in zip(self.whole.plan.alone, self.whole.jobs, strict=True):
            self._volumes[part] = job.volumes  # which need the mesh on the device
            del job.solid.lattice

    def _everywhere(self) -> np.ndarray:
        return np.flatnonzero(self._wound)

    @property
    def _request(self) -> dict[str, Any]:
        """The content and the rules of the octree that is made, in JSON types."""
        plan = self.whole.plan
        return {**super()._request, "kind": plan.kind, LATTICE_BITS: plan.bits}

    @property
    def _rule(self) -> tuple[str, str]:
        return MODE, fill_of(job.plan.solid.rule for job in self.whole.jobs)

    def _kinds(self) -> Sequence[Attribute]:
        return (*super()._kinds(), *without_values(self.whole.plan.kind, faces=False))

    def _given_for(self, bar: Bar) -> tuple[Any, ...]:
        return *self._given(self._faces_of_bar(bar)), self._volumes

    def findings(self, octree: BlockOctree) -> Iterator[str]:
        """Yield warnings, those of the octree in one piece."""
        yield from super().findings(octree)
        wrong = dict.fromkeys(self._parts.own.parts.tolist(), 0)
        for bar in self.plan.bars:
            for part, count in self.store.known(bar.key):
                wrong[part] += count
        for (part, _), job in zip(self.whole.plan.alone, self.whole.jobs, strict=True):
            job.disagreements = wrong[part]
            yield from job.wrong()
