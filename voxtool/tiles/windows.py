"""Voxelization in windows: an octree that is larger than the memory that it may take.

A window is a subtree of the octree (subtree.py). The grid is halved along its axes until each
window's plan fits; windows without a triangle that matters to them cost nothing. They are voxelized
one after the other, in Morton order, each from the faces that can change it, and wait on disk
(files/octrees/windows.py) until the number of nodes of each level is known.

The workers of a cluster make them beside one another, in windows that are enough for all workers.
A worker plans its window, and one that does not fit comes back, to be halved again. Windows of a
merged octree are merged where they are made.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from voxtool.arrays import digest_of
from voxtool.errors import MemoryLimitError, count_of, human
from voxtool.files.octrees.windows import Key
from voxtool.grid import FIXED_POINT_BITS
from voxtool.job import Cost, Job, Plan
from voxtool.mesh.subset import mesh_of
from voxtool.opencl import Device
from voxtool.svo.attribution.colours import SurfaceAttributesJob
from voxtool.svo.dag.merge import Subtrees, join, no_subtrees
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.layout import BRICK_BYTES, MAX_LINK, NODE_BYTES
from voxtool.svo.octree.links import EMPTY
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.plan import VoxelizePlan
from voxtool.tiles.attributed import SurfaceOfWindows
from voxtool.tiles.merging import merging_bytes, merging_shortage, subtrees_of
from voxtool.tiles.octree import BlockAttribute, BlockOctree
from voxtool.tiles.spread import Executor, Here, Sent
from voxtool.tiles.subtree import (
    LEAST,
    MARGIN,
    Subtree,
    depth_of,
    disk_row,
    halves_of,
    joined,
    labels_by_level,
    leaf_subtree,
    refuse_smallest,
    shape_of,
)
from voxtool.tiles.workers import make_window, plan_plain, plan_window

SHARE = 8  # windows of a worker, at least, so that all of them end at about the same time
Wanted = tuple[Key, np.ndarray]  # a window, and the faces that can change it


@dataclass(frozen=True)
class Part:
    """A cube of the grid: a window with its plan, the eight that it consists of, or nothing."""

    key: Key
    window: bool = False
    plan: Any = None  # of the job that makes it; None if the window is planned where it is made
    parts: tuple[Part, ...] = ()

    def windows(self) -> Iterator[Part]:
        """Yield the windows, in Morton order."""
        if self.window:
            yield self
        for part in self.parts:
            yield from part.windows()


@dataclass(frozen=True)
class WindowsPlan(Plan):
    """The windows of a voxelization."""

    whole: Any  # the plan of the job in one piece
    root: Part
    workers: int = 0  # of a cluster, which make them; 0: this process
    merged: bool = False

    @property
    def unplanned(self) -> bool:
        """Whether workers plan the windows, so that predictions are those of one piece."""
        return self.workers > 0

    @property
    def makers(self) -> str:
        """The words of the rows that say who makes the windows."""
        if self.workers:
            return f"made by {count_of(self.workers, 'worker')} of Dask"
        return "one after the other"

    @property
    def count(self) -> int:
        """Number of windows."""
        return sum(1 for _ in self.root.windows())

    @functools.cached_property
    def plans(self) -> list[Any]:
        """The plans of the windows."""
        return [part.plan for part in self.root.windows() if part.plan]

    @property
    def stages(self) -> list[str]:
        plans = [self.whole] if self.unplanned else self.plans
        stages = dict.fromkeys(stage for plan in plans for stage in plan.stages)
        return [*stages, *["merge subtrees"] * self.merged]

    @property
    def reasons(self) -> dict[str, str]:
        return self.whole.left_out

    @property
    def cost(self) -> Cost:
        """The predicted bytes of the largest window, and of the states of all nodes; those of
        merged subtrees are not known."""
        if self.unplanned:
            return Cost(device=0, host=2 * (self.whole.nodes - self.whole.bricks))
        cost = Cost.most(plan.cost for plan in self.plans)
        if self.merged:
            return replace(cost, host=max(map(merging_bytes, self.plans), default=0))
        states = sum(plan.nodes - plan.bricks for plan in self.plans)
        return replace(cost, host=cost.host + 2 * states)

    @property
    def nodes(self) -> int:
        """Predicted number of nodes of the octree."""
        return self.whole.nodes if self.unplanned else sum(plan.nodes for plan in self.plans)

    @property
    def disk(self) -> int:
        """Predicted bytes of the file, and at most of the windows that wait for it; 0 of merged
        subtrees, whose number is not known."""
        plans = [self.whole] if self.unplanned else self.plans
        return 0 if self.merged else sum(map(stored_bytes, plans))

    def as_dict(self) -> dict[str, Any]:
        facts = {"windows": self.count, "predicted_disk_bytes": self.disk}
        facts |= {"workers": self.workers} if self.workers else {}
        costs = {"predicted_device_bytes": self.cost.device}
        return {**self.whole.as_dict(), **facts, **costs}

    def rows(self) -> list[tuple[str, str]]:
        sides = sorted({part.key[3] for part in self.root.windows()})
        ends = " to ".join(dict.fromkeys(map(str, sides[:1] + sides[-1:])))
        wide = "" if self.unplanned else f" of {ends} voxels a side"
        return [
            *(row for row in self.whole.rows() if row[0] not in ("octree", "work")),
            ("windows", f"{count_of(self.count, 'window')}{wide}, {self.makers}"),
            *[disk_row(self.disk)] * (not self.merged),
        ]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError if the octree has too many nodes; every window fits, and links of
        merged subtrees have 32 bits."""
        if not self.merged and self.nodes >= MAX_LINK:
            raise MemoryLimitError(
                f"an octree of about {self.nodes:,} nodes exceeds links of 30 bits: choose a "
                "smaller dim, or store equal subtrees once (--dag)"
            )


class WindowsJob(Job[Any]):
    """A voxelization that runs window by window; its result is a BlockOctree or, with `merged`, a
    MergedOctree.

    Parameters
    ----------
    whole : the voxelization in one piece.
    executor : what makes the windows; by default this process.
    merged : whether windows are merged at once.

    Attributes
    ----------
    store : Windows or None
        Where windows wait; to be set before it runs, but merged ones may do without.
    """

    device: Device
    plan: WindowsPlan
    store: Any = None
    least = LEAST
    plan_type = WindowsPlan
    planner = staticmethod(plan_plain)  # of a window's octree
    leaves_plans = True  # whether workers plan their windows

    def __init__(
        self, whole: Any, executor: Executor | None = None, *, merged: bool = False
    ) -> None:
        self.asked, self.surface = whole, None
        if isinstance(whole, SurfaceAttributesJob):
            self.surface = SurfaceOfWindows(whole)
            whole = whole.inner
        whole.settle()
        self.whole, self.device, self.max_memory = whole, whole.device, whole.max_memory
        self.here = Here(self.device, self.max_memory)
        self.executor, self.merged = executor or self.here, merged
        self._divided: dict[Key, Part] = {}  # windows that did not fit where they were made
        self.grid, self.mesh = whole.grid, whole.mesh
        self._take_over()
        self.all_faces = np.arange(len(self.mesh.faces))
        self.root = (0, 0, 0, self.grid.side)
        self.plan = self._plan()

    def _take_over(self) -> None:
        """Take what windows need of the job in one piece, and free the memory of the whole mesh on
        the device."""
        del self.whole.lattice

    def _plan(self) -> WindowsPlan:
        """Return the plan; windows that are planned here all fit."""
        self._widest = self._widest_window()
        root = self._divide(self.root, self.all_faces)
        return self.plan_type(self.asked.plan, root, self.executor.workers, self.merged)

    @property
    def request(self) -> dict[str, Any]:
        """The content and the rules of the octree that is made, in JSON types."""
        merged = {"merged": True} if self.merged else {}
        return {**self._request, **merged, **(self.surface.request if self.surface else {})}

    @property
    def _request(self) -> dict[str, Any]:
        """The content and the rules of the octree without attributes of its surface."""
        plan = self.whole.plan
        content = digest_of(self.grid.exact, self.mesh.vertices, self.mesh.faces)
        return {"content": content, "mode": plan.mode, "fill": plan.rule}

    # ---- the windows

    @functools.cached_property
    def _ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the (F, 3) least and greatest voxels of each face."""
        voxels = self.grid.to_fixed(self.mesh.vertices) >> FIXED_POINT_BITS
        corners = voxels[self.mesh.faces]
        return corners.min(axis=1), corners.max(axis=1)

    def _faces_of(self, key: Key, faces: np.ndarray) -> np.ndarray:
        """Return those of some faces that can change a window: for a solid also those before it
        along x, as their crossings decide where its rows begin, and for an open mesh's winding
        numbers all."""
        if self._is_wound:
            return faces
        return self._faces_near(key, faces, MARGIN, rows=self.whole.plan.solid)

    def _faces_near(self, key: Key, faces: np.ndarray, margin: int, *, rows: bool) -> np.ndarray:
        """Return those of some faces whose boxes reach a cube with a margin; with `rows` also those
        before it along x."""
        low, high = (ends[faces] for ends in self._ranges)
        corner, side = np.array(key[:3]), key[3]
        reached = high >= corner - margin
        if rows:
            reached[:, 0] = True
        return faces[(reached & (low <= corner + side + margin)).all(axis=1)]

    @property
    def _is_wound(self) -> bool:
        """True if far faces change a window: the mesh is filled by winding numbers, and is open."""
        return self.whole.plan.fill == "winding" and not self.whole.watertight

    @functools.cached_property
    def _sent_mesh(self) -> Sent:
        """The whole mesh, without what windows do not need of it."""
        return Sent(replace(self.mesh, parts={}, appearance=None))

    def _mesh_of(self, faces: np.ndarray) -> Any:
        """Return the mesh of some faces, or the whole one if that is what windows take."""
        return self._sent_mesh if self._is_wound else mesh_of(self._sent_mesh.value, faces)

    @property
    def _options(self) -> dict[str, Any]:
        """The options of each window's voxelization."""
        plan = self.whole.plan
        mode, _, added = plan.mode.partition("+")
        fill = plan.fill if plan.solid else "auto"
        more = {"with_surface": bool(added), "closed": not self._is_wound}
        return {"mode": mode, "fill": fill, **more}

    def _given(self, faces: np.ndarray) -> tuple[Any, ...]:
        """Return what the planner takes for a window with these faces."""
        return self._mesh_of(faces), self.grid, self._options

    def _needs(self, wanted: Wanted) -> tuple[Any, ...]:
        """Return what a window is planned from, here or by a worker."""
        key, faces = wanted
        described = None, None
        if self.surface:
            near = self._faces_near(key, faces, MARGIN, rows=False)
            described = self.surface.described(near)
        return self.planner, key, *described, *self._given(faces)

    def _needs_to_make(self, wanted: Wanted) -> tuple[Any, ...]:
        """Return what a window is made from."""
        return self.merged, self._outside_of(wanted[0]), *self._needs(wanted)

    def _outside_of(self, key: Key) -> np.ndarray | None:
        """Return which pieces of free space in a window of a flood are outside."""
        return None

    def _sets_nothing(self, job: Any) -> bool:
        """Return whether the octree of a window is empty."""
        return sets_nothing(job.plan)

    def _shortage(self, job: Any) -> str:
        """Return the memory that a window lacks, as messages say it; "" if it lacks none."""
        return merging_shortage(job) if self.merged else job.shortage

    def _widest_window(self) -> int:
        """Return the side of windows that are enough for all workers."""
        side, parts = self.grid.side, self._reached(self.root, self.all_faces)
        while 0 < len(parts) < SHARE * self.executor.workers and side > self.least:
            side //= 2
            parts = [half for part in parts for half in self._reached_halves(*part)]
        return side

    def _reached(self, key: Key, faces: np.ndarray) -> list[Wanted]:
        """Return a cube and its faces as a list, which is empty if no face can change it."""
        if min(shape_of(key, self.grid)) <= 0:
            return []
        faces = self._faces_of(key, faces)
        return [(key, faces)] if len(faces) else []

    def _reached_halves(self, key: Key, faces: np.ndarray) -> list[Wanted]:
        return [found for half in halves_of(key) for found in self._reached(half, faces)]

    def _divide(self, key: Key, faces: np.ndarray) -> Part:
        """Return a cube as a window if its plan fits, or if workers plan it; or in eight."""
        if not (reached := self._reached(key, faces)):
            return Part(key)
        _, faces = reached[0]
        if key[3] <= self._widest:
            if self.executor.workers and self.leaves_plans:
                return Part(key, window=True)
            job = self.here.call(plan_window, self._needs((key, faces)))
            if self._sets_nothing(getattr(job, "inner", job)):
                return Part(key)
            shortage = self._shortage(job)
            if not shortage:
                return Part(key, window=True, plan=job.plan)
            refuse_smallest(key, shortage, self.least)
        return Part(key, parts=tuple(self._divide(half, faces) for half in halves_of(key)))

    # ---- the work

    def _run(self) -> Any:
        self._prepare()
        self._done = 0
        if self.merged:
            return self._merged_octree()
        self._make(self._missing())
        tree = self._tree()
        if self.surface and self.surface.plan.exposed:
            self.surface.complete(self, tree)
            tree = self._tree()
        mesh = self.mesh
        origin = (mesh.source_sha256, mesh.units, mesh.transform)
        count = sum(map(self.store.voxels, self._used))
        self._attributes = tuple(
            BlockAttribute(one, leaves_of(one, tree), tree.bricks, self.store, self._used)
            for one in self._all_kinds()
        )
        result = (self.grid, *self._rule, tree, count, self._bricks)
        scene = self._scene()
        if self.surface:
            scene = self.surface.whole.scene(scene)
        return BlockOctree(*result, scene, *origin, self._attributes)

    @property
    def _rule(self) -> tuple[str, str]:
        """The mode and the fill rule of the octree."""
        return self.whole.plan.mode, self.whole.plan.rule

    def _scene(self) -> dict[str, Any]:
        """Return the plan that is stored with the octree, in JSON types."""
        return self.whole.plan.scene()

    def _kinds(self) -> Sequence[Attribute]:
        """Return the attributes of the octree but those of its surface, without values."""
        return ()

    def _all_kinds(self) -> list[Attribute]:
        """Return all attributes of the octree, without values."""
        return [*self._kinds(), *(self.surface.kinds if self.surface else ())]

    def _prepare(self) -> None:
        """Do what comes before all windows."""

    def _windows(self, part: Part, faces: np.ndarray) -> Iterator[Wanted]:
        """Yield the windows of a cube, with the faces that can change them."""
        faces = self._faces_of(part.key, faces)
        if part.window:
            yield part.key, faces
        for half in part.parts:
            yield from self._windows(half, faces)

    def _missing(self) -> Iterator[Wanted]:
        """Yield the windows that are not made yet."""
        for key, faces in self._windows(self.plan.root, self.all_faces):
            if key in self.store:
                self._done += 1
            else:
                yield key, faces

    def _make(self, missing: Iterable[Wanted]) -> None:
        """Have windows made; they wait on disk."""
        while missing:
            given = self._needs_to_make, missing, self.store, self._report
            missing = []
            for key, faces in self.executor.make(make_window, *given):
                parts = self._reached_halves(key, faces)
                windows = {half for half, _ in parts}
                halves = tuple(Part(half, window=half in windows) for half in halves_of(key))
                self._divided[key] = Part(key, parts=halves)
                missing += parts

    def _leaf(self, key: Key) -> int:
        """Return the state of a cube that is no window."""
        return EMPTY

    def _tree(self) -> Subtree:
        """Return the tree of the octree; its bricks wait on disk, in the windows that are used."""
        self._used: list[Key] = []
        return self._made(self.plan.root)

    def _divided_part(self, part: Part) -> Part:
        """Return a cube as it was divided in the end."""
        return self._divided.get(part.key, part)

    def _made(self, part: Part) -> Subtree:
        """Return the subtree of a cube; its bricks wait on disk."""
        part = self._divided_part(part)
        if part.parts:
            return joined([self._made(half) for half in part.parts])
        if part.key not in self.store:
            return leaf_subtree(part.key[3], self._leaf(part.key))
        self._used.append(part.key)
        levels, bricks = self.store.get(part.key)
        labels = ()
        if any(one.name == "label" for one in self._kinds()):
            none = np.empty(0, self.store.attribute(part.key, "label")["dtype"])
            stored = self.store.array(part.key, "label", "leaves")
            labels = labels_by_level(levels, np.concatenate([none, *stored]))
        return Subtree(levels, bricks, labels)

    def _bricks(self) -> Iterator[np.ndarray]:
        """Yield the bricks of all windows, which are then removed from the disk if they do not
        stand for masks, too."""
        masked = any(one.masked for one in self._attributes)
        for key in self._used:
            yield from self.store.bricks(key) if masked else self.store.take(key)

    def _merged_octree(self) -> MergedOctree:
        """Return the octree of windows that are merged."""
        if self.executor.workers:
            self._make(self._missing())
        subtrees = self._merged(self.plan.root, self.all_faces)
        mesh, plan = self.mesh, self.whole.plan
        described = (plan.scene(), mesh.source_sha256, mesh.units, mesh.transform)
        return MergedOctree.of_subtrees(subtrees, self.grid, plan.mode, plan.rule, *described)

    def _merged(self, part: Part, faces: np.ndarray) -> Subtrees:
        """Return the distinct subtrees of a cube."""
        part, faces = self._divided_part(part), self._faces_of(part.key, faces)
        if part.parts:
            joined = join([self._merged(half, faces) for half in part.parts])
            if joined.nbytes > self.whole.limit:
                raise MemoryLimitError(
                    f"the distinct subtrees of {part.key[3]} voxels a side take "
                    f"{human(joined.nbytes)}, of {human(self.whole.limit)} allowed: choose a "
                    "smaller dim (see --max-memory)"
                )
            return joined
        if not part.window:
            return no_subtrees(depth_of(part.key[3]), self._leaf(part.key))
        return self._merged_window(part.key, faces)

    def _merged_window(self, key: Key, faces: np.ndarray) -> Subtrees:
        """Return the distinct subtrees of a window, which is made now if none waits on disk."""
        if self.store is None:
            given = self._needs_to_make, [(key, faces)], self._report
            ((_, ((_, made),)),) = self.here.results(make_window, *given)
            return subtrees_of(made.levels, [made.bricks], made.voxels)
        if key not in self.store:
            self._make([(key, faces)])
        elif not self.executor.workers:
            self._done += 1
        if key in self._divided:
            return self._merged(self._divided[key], faces)
        tables, _ = self.store.get(key)
        return subtrees_of(tables, self.store.bricks(key), self.store.voxels(key))

    def notes(self, octree: BlockOctree) -> list[str]:
        """Return lines about the fill rule; they are not warnings."""
        return self.whole.notes(cast("Octree", octree))

    def doubts(self, octree: BlockOctree) -> Iterable[str]:
        """Return remarks on what was decided to be inside."""
        return self.whole.doubts(cast("Octree", octree))

    def findings(self, octree: BlockOctree) -> Iterator[str]:
        """Yield warnings: the fill may leak, or the octree is empty."""
        return self.whole.findings(cast("Octree", octree))

    def _report(self, what: str = "window") -> None:
        """Say which window is being made."""
        self._done += 1
        if self._progress:
            self._progress(f"{what} {self._done} of {self.plan.count}")


def sets_nothing(plan: VoxelizePlan) -> bool:
    """Return whether a window is empty: no triangle touches it, and no row enters it inside."""
    return plan.survey.triangles == plan.survey.outside and not plan.entry


def leaves_of(attribute: Attribute, tree: Subtree) -> np.ndarray:
    """Return the values of inside leaves of a tree: only labels have some."""
    own = tree.labels if attribute.name == "label" else ()
    return np.concatenate([attribute.leaves, *own])


def stored_bytes(plan: Any) -> int:
    """Return the predicted bytes of the octree of a plan in a file, with its attributes, and of a
    copy that waits beside it."""
    values = getattr(plan, "stored_values", 0) + getattr(plan, "waiting", 0)
    return NODE_BYTES * plan.nodes + BRICK_BYTES * plan.bricks + values
