"""Voxels that know which part of a mesh they belong to.

Each part is voxelized by its own fill rule, and a voxel that several parts set belongs to the
first one by priority; in a surface, to the part whose triangles that set it have the greatest area
in the voxel. Parts that are closed lie side by side in one larger grid and are voxelized at once
(atlas.py); others one after the other.

The stages: find the parts; voxelize the closed ones; voxelize the others; unite them (paint.py); in
a surface, measure the areas in voxels of several parts (part_pieces.py).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from voxtool.choices import MODES
from voxtool.errors import MemoryLimitError, MeshWarning, VoxtoolError, count_of
from voxtool.grid import Grid
from voxtool.job import Cost, Job, Plan
from voxtool.mesh.appearance import Parts
from voxtool.mesh.mesh import Mesh
from voxtool.morton import morton_decode
from voxtool.opencl import Array, Device, default_device
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.layout import BRICK_VOXELS
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.priority_union import Nodes, Union, painted, unite
from voxtool.svo.voxelization import part_pieces
from voxtool.svo.voxelization.connected.about import CONNECTED, RULE, about_connected, united
from voxtool.svo.voxelization.mesh_parts import PartMesh, parts_of, ranks_of
from voxtool.svo.voxelization.part_octrees import Atlas, plan_parts
from voxtool.svo.voxelization.scan_conversion import SEPARATING, TOUCHED, Scan, add_nodes
from voxtool.svo.voxelization.voxelize import VoxelizeJob, Window, plan_voxelize

UNITE, AREAS = "unite parts", "areas"
SHARED_BYTES = 64  # bytes of the union on device and host, a brick, beside its values


@dataclass(frozen=True)
class PartLabelsPlan(Plan):
    """The plan of a voxelization with labels.

    mode : the octree's
    names : the labels'
    together : parts that are voxelized at once
    alone : (part, reason) of the others
    dtype : the labels'
    side : voxels along a side of the grid in which the first ones lie
    inner : plans of the voxelizations
    """

    facts = ("mode", "labels", "dtype", "together", "side", "alone")
    costs = ("device", "host")

    mode: str
    names: tuple[str, ...]
    together: int
    alone: tuple[tuple[int, str], ...]
    dtype: str
    side: int
    inner: tuple[Any, ...]

    @property
    def surface(self) -> bool:
        return "surface" in self.mode and "solid" not in self.mode

    @property
    def connects(self) -> bool:
        """True if voxels may be added to connect thin parts."""
        return any(getattr(plan, "connects", False) for plan in self.inner)

    @property
    def stages(self) -> tuple[str, ...]:
        own = [stage for plan in self.inner for stage in plan.stages]
        return (*dict.fromkeys(own), UNITE, *(AREAS,) * self.surface)

    @property
    def labels(self) -> int:
        """Number of labels."""
        return len(self.names)

    @property
    def reasons(self) -> dict[str, str]:
        together = "all are closed: they lie side by side in one"
        areas = "parts that fill a voxel go by priority"
        return {
            "a voxelization for each part": "" if self.alone else together,
            "areas of triangles in voxels": "" if self.surface else areas,
        }

    @property
    def nodes(self) -> int:
        """Predicted number of nodes, at most."""
        return sum(plan.nodes for plan in self.inner)

    @property
    def bricks(self) -> int:
        """Predicted number of bricks, at most."""
        return sum(plan.bricks for plan in self.inner)

    @property
    def stored_values(self) -> int:
        """Predicted bytes of the labels in a file, at most."""
        return 64 * np.dtype(self.dtype).itemsize * self.bricks

    @property
    def cost(self) -> Cost:
        bricks = self.bricks
        values = 64 * np.dtype(self.dtype).itemsize + SHARED_BYTES
        host = sum(plan.cost.host for plan in self.inner) + values * bricks
        most = Cost.most(plan.cost for plan in self.inner)
        return Cost(
            max(most.device, values * bricks), host, max(most.largest, values * bricks // 2)
        )

    def scene(self) -> dict[str, Any]:
        """The part of the plan that is stored with the octree, in JSON types."""
        more = {CONNECTED: True} if self.connects else {}
        return {"labels": len(self.names), **more, "stages": list(self.stages)}

    def decisions(self) -> dict[str, Any]:
        alone = [{"part": self.names[part], "reason": why} for part, why in self.alone]
        return {**super().decisions(), "alone": alone}

    def as_dict(self) -> dict[str, Any]:
        return {**super().as_dict(), "voxelizations": [plan.as_dict() for plan in self.inner]}

    def rows(self) -> list[tuple[str, str]]:
        rows = [("labels", f"{count_of(len(self.names), 'name')}, {self.dtype}")]
        if self.together:
            where = f"at once, in a grid of {self.side:,} voxels a side"
            rows.append(("closed", f"{count_of(self.together, 'part')}, voxelized {where}"))
        reasons: dict[str, int] = {}
        for _, why in self.alone:
            reasons[why] = reasons.get(why, 0) + 1
        rows += [("alone", f"{count_of(n, 'part')}: {why}") for why, n in reasons.items()]
        return [*rows, *[(CONNECTED, f"{RULE}, each by itself")] * self.connects]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError if a voxelization or the union needs more bytes."""
        for plan in self.inner:
            plan.refuse_beyond(max_memory, max_allocation)
        if shortage := self.cost.shortage(max_memory, max_allocation):
            raise MemoryLimitError(
                f"uniting {count_of(len(self.names), 'part')} {shortage}: choose a smaller dim, or "
                "allow more (see --max-memory)"
            )


def plan_labels(
    mesh: Mesh,
    grid: Grid,
    mode: str = "solid",
    *,
    labels: str | Parts,
    priority: str | Sequence[str] = "first",
    fill: str = "auto",
    gap: int = 0,
    with_surface: bool = False,
    connected: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> PartLabelsJob:
    """Return the planned voxelization of a mesh whose voxels are labelled by its parts; see
    `voxtool.voxelize`."""
    if mode not in MODES:
        raise VoxtoolError(f"mode {mode!r} is unknown: choose one of {', '.join(MODES)}")
    parts = parts_of(mesh, labels)
    ranks = ranks_of(parts.names, priority)
    device = device or default_device()
    own = PartMesh.of_mesh(mesh, parts.labels)
    request: dict[str, Any] = {"gap": gap, "with_surface": with_surface, "connected": connected}
    request |= {"device": device, "max_memory": max_memory}
    alone, atlas, jobs = plan_parts(mesh, own, grid, mode, fill, fill, **request)
    dtype = dtype_of_labels(len(parts.names))
    plan = PartLabelsPlan(
        mode + "+surface26" * with_surface, parts.names, len(atlas.parts) if atlas else 0,
        tuple(alone.items()), dtype, atlas.side if atlas else 0, tuple(job.plan for job in jobs),
    )  # fmt: skip
    return PartLabelsJob(mesh, grid, own, ranks, atlas, jobs, plan, device, max_memory)


def dtype_of_labels(n: int) -> str:
    """Return the smallest type of n labels."""
    return "u1" if n <= 1 << 8 else "u2" if n <= 1 << 16 else "u4"


@dataclass(eq=False)
class PartLabelsJob(Job[Octree]):
    """A planned voxelization with labels.

    Attributes
    ----------
    mesh : Mesh
    grid : Grid
    own : PartMesh
        The mesh, with vertices of its own for each part.
    ranks : (n,) uint32
        The rank of each label.
    atlas : Atlas or None
        Where the parts that are voxelized at once lie.
    jobs : list of VoxelizeJob
        That of the atlas if there is one, then one for each part alone.
    plan : PartLabelsPlan
    """

    mesh: Mesh
    grid: Grid
    own: PartMesh
    ranks: np.ndarray
    atlas: Atlas | None
    jobs: list[VoxelizeJob]
    plan: PartLabelsPlan
    device: Device
    max_memory: int | None = None
    window: Window | None = None  # of the whole grid, if `grid` is one
    whole_grid: Grid | None = None

    @property
    def whole(self) -> Grid:
        """The grid without the window."""
        return self.whole_grid or self.grid

    def _run(self) -> Octree:
        octrees = self._voxelized()
        with self.stage(UNITE):
            union = unite(self.device, self._nodes(octrees))
            label_of = np.argsort(self.ranks).astype(self.plan.dtype)  # of each rank
            values, leaves = painted(self.device, union, label_of)
        if self.plan.surface:
            with self.stage(AREAS):
                self._decide_by_area(union, values)
        octree = self._octree(union, values, leaves, {octree.fill for octree in octrees})
        if facts := united(one.plan for one in octrees):
            octree = replace(octree, plan={**octree.plan, CONNECTED: facts})
        return octree

    def _voxelized(self) -> list[Octree]:
        """Return the octrees of the jobs; what a job would warn of, this one says of its part."""
        octrees = []
        for job in self.jobs:
            with warnings.catch_warnings(action="ignore", category=MeshWarning):
                octrees.append(job.run(self._progress))
        return octrees

    def _nodes(self, octrees: Sequence[Octree]) -> Nodes:
        """Return the nodes of all parts on the lattice of the grid."""
        nodes = Nodes.of_depth((self.grid.side // 4).bit_length())
        rest = list(octrees)
        if self.atlas:
            self.atlas.add_to(nodes, rest.pop(0), self.ranks)
        for (part, _), octree in zip(self.plan.alone, rest, strict=True):
            nodes.add_octree(octree, int(self.ranks[part]))
        return nodes

    def _decide_by_area(self, union: Union, values: np.ndarray) -> None:
        """Set the labels of voxels of several parts to the one with the greatest area there, the
        lower label where areas are equal."""
        shared = union.shared.get()
        counts = np.bitwise_count(shared)
        if not counts.any():
            return
        bricks = np.flatnonzero(counts)
        masks = shared[bricks]
        bits = (masks[:, None] >> np.arange(64, dtype=np.uint64) & np.uint64(1)).astype(bool)
        row, bit = np.nonzero(bits)
        brick = bricks[row]
        codes = union.codes[brick >> 3] << np.uint64(3) | (brick & 7).astype(np.uint64)
        corners = 4 * morton_decode(codes) + BRICK_VOXELS[bit]
        areas, voxels, faces = self._areas(union, union.shared, counts, corners)
        labels = self.own.of[faces]
        best = _greatest(voxels, labels, areas, len(corners))
        below = union.bricks.get()[brick] & ((np.uint64(1) << bit.astype(np.uint64)) - np.uint64(1))
        values[union.starts[brick] + np.bitwise_count(below)] = best

    def _areas(
        self, union: Union, masks: Array, counts: np.ndarray, corners: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the area, the voxel's rank and the face of each piece of a triangle in voxels."""
        source = Mesh(self.own.points, self.own.faces, name=self.mesh.name)
        place: dict[str, Any] = {"window": self.window, "device": self.device}
        job = plan_voxelize(source, self.whole, self._kind_mode, every_face=True, **place)
        scan = Scan(job.lattice, job.plan)
        active = add_nodes(scan, union.codes)
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.uint32)
        kind = SEPARATING if self.plan.mode == "surface6" else TOUCHED
        found = part_pieces.list_pieces(scan, active, masks, self.device.put(starts), kind)
        areas = part_pieces.areas_of(scan, found, corners)
        return areas, found.voxels.get(0, found.n), found.faces.get(0, found.n)

    @property
    def _kind_mode(self) -> str:
        return "surface6" if self.plan.mode == "surface6" else "surface26"

    def _octree(
        self, union: Union, values: np.ndarray, leaves: np.ndarray, fills: set[str]
    ) -> Octree:
        fill = fill_of(fills)
        octree = Octree.of_states(self.grid, self.plan.mode, fill, union.levels, union.bricks.get())
        mesh, label = self.mesh, Attribute("label", values, leaves, names=self.plan.names)
        described = {"source_sha256": mesh.source_sha256, "units": mesh.units}
        described |= {"transform": mesh.transform, "plan": self.plan.scene()}
        return replace(octree, attributes=(label,), **described)

    def notes(self, result: Octree) -> list[str]:
        """Return lines about what is inside of parts, and the voxels that connect thin ones."""
        return [*self.doubts(result), *about_connected(result.plan)]

    def doubts(self, result: Octree) -> list[str]:
        """Return a line if shells of a part overlap."""
        differing = sum(getattr(job, "solid", job).differing for job in self.jobs)
        if not differing:
            return []
        return [
            f"{self.mesh.name or 'mesh'}: shells overlap within a part: their union is filled "
            f"(parity would differ in {differing:,} voxels)"
        ]

    def findings(self, result: Octree) -> Iterator[str]:
        """Yield a warning if parts set no voxel."""
        label = result.attribute("label")
        found = np.zeros(len(self.plan.names), bool)
        found[label.values] = True
        found[label.leaves] = True
        yield from self.lost(found)

    def lost(self, found: np.ndarray) -> Iterator[str]:
        """Yield a warning if parts set no voxel, given which labels were found."""
        lost = [self.plan.names[part] for part in self.own.parts.tolist() if not found[part]]
        if lost:
            some = ", ".join(lost[:5]) + (", ..." if len(lost) > 5 else "")
            yield (
                f"{self.mesh.name or 'mesh'}: {count_of(len(lost), 'part')} without a voxel, "
                f"{some}: choose smaller voxels, another priority, or add the surface"
            )


def fill_of(fills: Iterable[str]) -> str:
    """Return the fill of an octree whose parts have these fill rules."""
    rules = set(fills)
    return rules.pop() if len(rules) == 1 else "mixed"


def _greatest(voxels: np.ndarray, labels: np.ndarray, areas: np.ndarray, count: int) -> np.ndarray:
    """Return the label with the greatest sum of areas of each of `count` voxels, the lower one of
    equal sums."""
    order = np.lexsort([labels, voxels])
    voxels, labels = voxels[order], labels[order]
    new = np.ones(len(order), bool)
    new[1:] = (voxels[1:] != voxels[:-1]) | (labels[1:] != labels[:-1])
    firsts = np.flatnonzero(new)
    sums = np.add.reduceat(areas[order].astype(np.uint64), firsts)
    voxels, labels = voxels[firsts], labels[firsts]
    order = np.lexsort([labels, np.iinfo(np.uint64).max - sums, voxels])
    first = np.flatnonzero(np.diff(voxels[order], prepend=voxels[:1] + 1))
    assert len(first) == count
    return labels[order][first]
