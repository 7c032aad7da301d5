"""Voxelization in windows: an octree that is larger than the memory that it may take.

A window is a subtree of the octree (subtree.py). The grid is halved along its axes until each
window's plan fits; windows without a triangle that matters to them cost nothing. They are voxelized
one after the other, in Morton order, each from the faces that can change it, and wait on disk
(files/windows.py) until the number of nodes of each level is known. A cluster makes them beside one
another (spread.py).
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from voxtool.arrays import digest_of
from voxtool.errors import MemoryLimitError, count_of, human
from voxtool.files.windows import Key, Window, Windows
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.job import Cost, Job, Plan
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.subset import mesh_of
from voxtool.morton import morton_decode
from voxtool.opencl import Device
from voxtool.svo.attributes import Attribute
from voxtool.svo.layout import BRICK_BYTES, MAX_LINK, NODE_BYTES
from voxtool.svo.links import EMPTY
from voxtool.svo.octree import Octree
from voxtool.svo.plan import NODE_BLOCK, VoxelizePlan
from voxtool.svo.voxelize import VoxelizeJob, plan_voxelize
from voxtool.tiles.octree import BlockAttribute, BlockOctree
from voxtool.tiles.subtree import Subtree, joined, labels_by_level, leaf_subtree, subtree_of

LEAST = NODE_BLOCK  # voxels along a side of a window
MARGIN = 8  # voxels around a window whose faces may reach into its nodes
Content = tuple[Sequence[np.ndarray], np.ndarray, int]
CORNERS = morton_decode(np.arange(8, dtype=np.uint64))  # of the eight halves of a cube, in order


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
        return list(dict.fromkeys(stage for plan in self.plans for stage in plan.stages))

    @property
    def reasons(self) -> dict[str, str]:
        return self.whole.left_out

    @property
    def cost(self) -> Cost:
        """The predicted bytes of the largest window, and of the states of all nodes."""
        cost = Cost.most(plan.cost for plan in self.plans)
        states = sum(plan.nodes - plan.bricks for plan in self.plans)
        return replace(cost, host=cost.host + 2 * states)

    @property
    def nodes(self) -> int:
        """Predicted number of nodes of the octree."""
        return sum(plan.nodes for plan in self.plans)

    @property
    def disk(self) -> int:
        """Predicted bytes of the file, and at most of the windows that wait for it."""
        return sum(stored_bytes(plan) for plan in self.plans)

    def as_dict(self) -> dict[str, Any]:
        facts = {"windows": self.count, "predicted_disk_bytes": self.disk}
        costs = {"predicted_device_bytes": self.cost.device}
        return {**self.whole.as_dict(), **facts, **costs}

    def rows(self) -> list[tuple[str, str]]:
        sides = sorted({part.key[3] for part in self.root.windows()})
        wide = f"of {' to '.join(str(side) for side in sorted({sides[0], sides[-1]}))} voxels"
        count = count_of(self.count, "window")
        return [
            *self._rows_of_whole(),
            ("windows", f"{count} {wide} a side, one after the other"),
            disk_row(self.disk),
        ]

    def _rows_of_whole(self) -> list[tuple[str, str]]:
        """Return the rows of the job in one piece that hold for its windows, too."""
        return [row for row in self.whole.rows() if row[0] not in ("octree", "work")]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError if the octree has too many nodes; every window fits."""
        if self.nodes >= MAX_LINK:
            raise MemoryLimitError(
                f"an octree of about {self.nodes:,} nodes exceeds links of 30 bits: choose a "
                "smaller dim, or store equal subtrees once (--dag)"
            )


def disk_row(size: int) -> tuple[str, str]:
    """Return the name and the text of the row that `--plan` prints of the disk."""
    return "disk", f"about {human(size)}, of the file and of windows that wait for it"


class WindowsJob(Job[BlockOctree]):
    """A voxelization that runs window by window.

    Attributes
    ----------
    store : Windows
        Where windows wait; to be set before it runs.
    """

    device: Device
    plan: WindowsPlan
    store: Windows
    least = LEAST

    def __init__(self, whole: VoxelizeJob) -> None:
        whole.settle()
        self.whole, self.device, self.max_memory = whole, whole.device, whole.max_memory
        self.grid, self.mesh = whole.grid, whole.mesh
        self._free()
        self.all_faces = np.arange(len(self.mesh.faces))
        self.root = (0, 0, 0, self.grid.side)
        self.plan = self._plan()

    def _free(self) -> None:
        """Free the memory of the whole mesh on the device."""
        del self.whole.lattice

    def _plan(self) -> WindowsPlan:
        """Return the plan, whose windows all fit."""
        return WindowsPlan(self._whole_plan, self._divide(self.root, self.all_faces))

    @property
    def _whole_plan(self) -> Any:
        """The plan of the job in one piece."""
        return self.whole.plan

    @property
    def request(self) -> dict[str, Any]:
        """The content and the rule of the octree that is made, in JSON types."""
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

    def _mesh_of(self, faces: np.ndarray) -> Mesh:
        """Return the mesh of some faces."""
        return mesh_of(self.mesh, faces)

    @property
    def _options(self) -> dict[str, Any]:
        """The options of each window's voxelization."""
        plan = self.whole.plan
        mode, _, added = plan.mode.partition("+")
        fill = plan.fill if plan.solid else "auto"
        more = {"max_memory": self.max_memory, "closed": not self._is_wound}
        return {"mode": mode, "fill": fill, "with_surface": bool(added), **more}

    def _job(self, key: Key, faces: np.ndarray) -> VoxelizeJob:
        """Return the job of a window."""
        window = key[:3], shape_of(key, self.grid)
        mesh = self._mesh_of(faces)
        return plan_voxelize(mesh, self.grid, window=window, device=self.device, **self._options)

    def _sets_nothing(self, job: Any) -> bool:
        """Return whether a window is empty."""
        return sets_nothing(job.plan)

    def _complete(self, job: VoxelizeJob, key: Key, faces: np.ndarray) -> Job[Octree]:
        """Return the job that makes a window, given `job`, which makes its octree alone."""
        return job

    def _shortage(self, job: Any) -> str:
        """Return the memory that a window lacks, as messages say it; "" if it lacks none."""
        return job.shortage

    def _divide(self, key: Key, faces: np.ndarray) -> Part:
        """Return a cube as a window if its plan fits, or in eight."""
        if min(shape_of(key, self.grid)) <= 0:
            return Part(key)
        faces = self._faces_of(key, faces)
        if not len(faces):
            return Part(key)
        job = self._job(key, faces)
        if self._sets_nothing(job):
            return Part(key)
        made = self._complete(job, key, faces)
        shortage = self._shortage(made)
        if not shortage:
            return Part(key, window=True, plan=made.plan)
        refuse_smallest(key, shortage, self.least)
        return Part(key, parts=tuple(self._divide(half, faces) for half in halves_of(key)))

    # ---- the work

    def _run(self) -> BlockOctree:
        root = self.plan.root
        self._prepare()
        self._done = 0
        self._make(self._missing(root, self.all_faces))
        tree = self._tree()
        mesh = self.mesh
        origin = (mesh.source_sha256, mesh.units, mesh.transform)
        count = sum(map(self.store.voxels, self._used))
        self._attributes = tuple(
            BlockAttribute(one, leaves_of(one, tree), tree.bricks, self.store, self._used)
            for one in self._kinds()
        )
        result = (self.grid, *self._rule, tree, count, self._bricks)
        return BlockOctree(*result, self._scene(), *origin, self._attributes)

    @property
    def _rule(self) -> tuple[str, str]:
        """The mode and the fill rule of the octree."""
        return self.whole.plan.mode, self.whole.plan.rule

    def _scene(self) -> dict[str, Any]:
        """Return the plan that is stored with the octree, in JSON types."""
        return self.whole.plan.scene()

    def _kinds(self) -> Sequence[Attribute]:
        """Return the attributes of the octree, without values."""
        return ()

    def _prepare(self) -> None:
        """Do what comes before all windows."""

    def _missing(self, part: Part, faces: np.ndarray) -> Iterator[tuple[Key, np.ndarray]]:
        """Yield the windows that are not made yet, with the faces that can change them."""
        if part.window and part.key in self.store:
            self._done += 1
            return
        faces = self._faces_of(part.key, faces)
        if part.window:
            yield part.key, faces
        for half in part.parts:
            yield from self._missing(half, faces)

    def _make(self, missing: Iterable[tuple[Key, np.ndarray]]) -> None:
        """Make windows; they wait on disk."""
        for key, faces in missing:
            self._report()
            with self.device.reporting(lambda _: None):  # not the stages within
                self.store.put(key, self._finished(key, faces))

    def _finished(self, key: Key, faces: np.ndarray) -> Window:
        """Return a window, made."""
        return Window(*self._content(key, faces))

    def _content(self, key: Key, faces: np.ndarray) -> Content:
        """Return the states of the nodes of a window by level, from the root down, its bricks, and
        the number of its voxels."""
        return content_of(self._job(key, faces), key[3])

    def _leaf(self, key: Key) -> int:
        """Return the state of a cube that is no window."""
        return EMPTY

    def _tree(self) -> Subtree:
        """Return the tree of the octree; its bricks wait on disk, in the windows that are used."""
        self._used: list[Key] = []
        return self._made(self.plan.root)

    def _divided_part(self, part: Part) -> Part:
        """Return a cube as it was divided in the end."""
        return part

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


def shape_of(key: Key, grid: Grid) -> tuple[int, int, int]:
    """Return the voxels of a window along each axis."""
    x, y, z = (min(key[3], n - a) for a, n in zip(key[:3], grid.shape, strict=True))
    return x, y, z


def leaves_of(attribute: Attribute, tree: Subtree) -> np.ndarray:
    """Return the values of inside leaves of a tree: only labels have some."""
    own = tree.labels if attribute.name == "label" else ()
    return np.concatenate([attribute.leaves, *own])


def stored_bytes(plan: Any) -> int:
    """Return the predicted bytes of the octree of a plan in a file, with its attributes, and of a
    copy that waits beside it."""
    values = getattr(plan, "stored_values", 0) + getattr(plan, "waiting", 0)
    return NODE_BYTES * plan.nodes + BRICK_BYTES * plan.bricks + values


def content_of(job: VoxelizeJob, side: int) -> Content:
    """Return the content of the window of `side` voxels that a job makes."""
    octree = job._run()
    return subtree_of(octree, side).levels, octree.bricks, octree.count


def attributed(octree: Octree, side: int) -> Window:
    """Return an octree with attributes as the window of `side` voxels."""
    levels = subtree_of(octree, side).levels
    return Window(levels, octree.bricks, octree.count, octree.attributes)


def refuse_smallest(key: Key, shortage: str, least: int = LEAST) -> None:
    """Raise MemoryLimitError if a window that does not fit cannot be divided."""
    if key[3] <= least:
        raise MemoryLimitError(
            f"a window of {key[3]} voxels a side {shortage}: allow more, or choose a smaller dim"
        )


def halves_of(key: Key) -> list[Key]:
    """Return the eight cubes of a cube, in Morton order."""
    x, y, z, side = key
    half = side // 2
    return [(x + half * i, y + half * j, z + half * k, half) for i, j, k in CORNERS.tolist()]
