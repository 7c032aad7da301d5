"""Queries of an octree at points: whether they lie in a set voxel, the coverage around them, and
the nearest set voxel.

The way from the root to a point's voxel is given by the bits of its coordinates ([voCCeL],
algorithm 1). In a merged octree the same way leads through distinct subtrees, which are not
expanded.

Points are rounded to voxels on the host, exactly (points.py); the device walks, for many points at
once. Coverages are float64, of at most 49 digits, so exact.

Nearest voxels are found by branch and bound, among nodes whose box of centres is not further than
the best so far. Distances from points to voxels, in float64, are rounded in one fixed way; if
several are equal, the voxel of the least x, then y, then z is found.

Kernels: kernels/svo/queries/query.cl, kernels/svo/queries/nearest.cl.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from voxtool.arrays import Data
from voxtool.choices import MAX_DIM
from voxtool.errors import GridError, VoxtoolError, human
from voxtool.job import Cost, Job, Plan
from voxtool.memory import check_memory
from voxtool.morton import morton_encode
from voxtool.opencl import Array, Device, default_device, program
from voxtool.spatial.distance import checked_points
from voxtool.svo.attributes.of_cells import CellValues
from voxtool.svo.attributes.of_points import values_of_voxels
from voxtool.svo.cells.ray_links import coverages, drawn_bytes, linked_nodes
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.links import EMPTY, FULL
from voxtool.svo.octree.octree import VOXEL, Octree, level_number
from voxtool.svo.queries.points import in_voxels, voxels_around

SOURCE, NEAREST = "svo/queries/query.cl", "svo/queries/nearest.cl"
BLOCK = 1 << 18  # points on the device at once
POINT_BYTES = 10  # bytes of a point on the device: its voxel, and what is found
NEAREST_BYTES = 40  # and for its nearest voxel
STACK = 7 * MAX_DIM.bit_length() + 1  # nodes that wait in a search
FAR = 1 << 20  # voxels from the grid; further away rounding makes many distances equal
STRETCH = 1 << 20  # times that a voxel may be longer than wide; no square underflows
COUNT_BYTES = 16  # bytes of a brick, for coverages, on the host
NODES = 2  # what the kernel adds to the place of a node: smaller numbers are EMPTY and FULL
HEADERS = {
    "svo/queries/query.h": program.c_constants(EMPTY=EMPTY, FULL=FULL, NODES=NODES),
    "svo/queries/nearest.h": program.c_constants(STACK=STACK),
}


@dataclass(frozen=True, eq=False)
class OctreeAnswers(Data):
    """The values of an octree at N points; for one point [x, y, z] without the leading axis.

    Attributes
    ----------
    contains : (N,) bool
        Whether the point lies in a set voxel. Voxels are half-open: a point on a plane between two
        is in the upper one. Outside the grid False.
    coverage : (N,) float64, or None
        The share of set voxels in the node of the level around the point; 0 outside the grid.
    nearest : (N, 3) int64, or None
        The set voxel x, y, z whose centre is nearest; -1 if no voxel is set.
    distance : (N,) float64, or None
        The distance from that centre, world units; infinite if no voxel is set.
    outside : (N,) bool
        Whether the point is outside the grid.
    label : (N,) int64, or None
        The label of the voxel around the point, an index of names; -1 if it is not set.
    colour : (N, 4) uint8, or None
        Its colour and opacity; 0 if it is not set, as in what follows.
    normal : (N, 3) float32, or None
    area : (N,) float32, or None
        The area of the surface in the voxel, in the mesh's unit squared.
    fraction : (N,) float64, or None
        The share of the voxel inside, from 0 to 1.
    faces : (N, 6) float64, or None
        The shares of its faces inside: at low x, high x, low y, high y, low z, high z.
    """

    contains: np.ndarray
    coverage: np.ndarray | None
    nearest: np.ndarray | None
    distance: np.ndarray | None
    outside: np.ndarray
    label: np.ndarray | None = None
    colour: np.ndarray | None = None
    normal: np.ndarray | None = None
    area: np.ndarray | None = None
    fraction: np.ndarray | None = None
    faces: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Leave the arrays writable: they are the caller's own."""

    def __getitem__(self, index: Any) -> OctreeAnswers:
        found: dict[str, Any] = {item.name: getattr(self, item.name) for item in fields(self)}
        for name, part in found.items():
            found[name] = None if part is None else part[index]
        return OctreeAnswers(**found)


class OctreeQuery:
    """An octree on a device, for many queries.

    Parameters
    ----------
    octree : Octree or MergedOctree
        The octree; a merged one is not expanded.
    level : int or "voxel", optional
        The level of the nodes whose coverage is returned; by default none is.
    nearest : bool
        Whether the nearest set voxels are returned.
    attributes : sequence of str
        Names of the attributes of the voxels that are returned.
    device : Device, optional
        Where to search; the default device if None.

    Raises
    ------
    VoxtoolError
        If there is no such level.
    GridError
        If nearest voxels are requested of voxels 2^20 times as long as wide.
    DeviceError
        If nearest voxels are requested and the device has no double precision.
    MemoryLimitError
        If the octree does not fit on the device.

    Examples
    --------
    >>> query = voxtool.OctreeQuery(octree)
    >>> query([0.1, 0.2, 0.3]).contains
    """

    def __init__(
        self,
        octree: Octree | MergedOctree,
        level: int | str | None = None,
        device: Device | None = None,
        *,
        nearest: bool = False,
        attributes: Sequence[str] = (),
    ) -> None:
        self.values = _attributes(octree, attributes)
        self.octree, self.nearest = octree, nearest
        self.device = device or default_device()
        if nearest:
            _check_nearest(octree, self.device)
        self.finest = None if level is None else _finest(octree, level)
        nbytes = drawn_bytes(octree)
        self.tree = self.device.keep(
            octree, "query", nbytes, lambda: _uploaded(octree, self.device)
        )
        self.coverages = np.empty(0)
        if self.finest:
            self.coverages = coverages(octree, self.finest + VOXEL)

    def __call__(self, points: Any) -> OctreeAnswers:
        """Return the values of the octree at (N, 3) or (3,) points in world units.

        Raises
        ------
        VoxtoolError
            If their shape is wrong, or a coordinate is NaN; with nearest voxels also if a point is
            2^20 voxels away from the grid.
        """
        single = np.ndim(points) == 1
        points = checked_points([points] if single else points)
        if (nan := np.isnan(points).any(axis=1)).any():
            raise VoxtoolError(f"point {np.argmax(nan)} (the first is 0) is NaN: leave it out")
        contains, outside = np.zeros(len(points), bool), np.ones(len(points), bool)
        coverage = None if self.finest is None else np.zeros(len(points))
        nearest, distance = None, None
        if self.nearest:
            nearest, distance = np.empty((len(points), 3), np.int64), np.empty(len(points))
        for start in range(0, len(points), BLOCK):
            stop = min(start + BLOCK, len(points))
            within, voxels = voxels_around(self.octree.grid, points[start:stop])
            places = start + np.flatnonzero(within)
            outside[places] = False
            contains[places] = self._found(voxels, 0) == FULL
            if coverage is not None:
                coverage[places] = self._coverage(voxels, contains[places])
            if nearest is not None and distance is not None:
                part = self._nearest(points[start:stop], start)
                nearest[start:stop], distance[start:stop] = part
        more = {
            name: np.zeros((len(points), *of.row), of.dtype) for name, of in self.values.items()
        }
        if more:
            within, voxels = voxels_around(self.octree.grid, points)
            codes = morton_encode(voxels)
            for name, values in self.values.items():
                more[name][within] = values_of_voxels(values, codes)
        shown = {name: _shown(name, values, contains) for name, values in more.items()}
        answers = OctreeAnswers(contains, coverage, nearest, distance, outside, **shown)
        return answers[0] if single else answers

    def _found(self, voxels: np.ndarray, finest: int) -> np.ndarray:
        """Return what the kernel finds of nodes of size 2**finest around voxels, (n,) uint32."""
        with self.device.stage("query"):
            found = self.device.empty(len(voxels), np.uint32)
            self.device.kernel(SOURCE, "find_nodes")(
                len(voxels), voxels=self.device.put(voxels.astype(np.uint16)), found=found,
                finest=finest, **self.tree,
            )  # fmt: skip
            return found.take()

    def _coverage(self, voxels: np.ndarray, contains: np.ndarray) -> np.ndarray:
        """Return the coverage of the nodes around voxels, (n,) float64."""
        if not self.finest:
            return contains.astype(np.float64)
        found = self._found(voxels, self.finest)
        coverage = (found == FULL).astype(np.float64)
        nodes = found >= NODES
        coverage[nodes] = self.coverages[found[nodes] - NODES]
        return coverage

    def _nearest(self, points: np.ndarray, start: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest set voxels of points, the first of which has a number, (n, 3) int64,
        and their distances."""
        grid, device = self.octree.grid, self.device
        places = in_voxels(grid, points)
        near = np.all((places >= -FAR) & (places <= np.array(grid.shape) + FAR), axis=1)
        if not near.all():
            raise VoxtoolError(
                f"point {start + np.argmin(near)} (the first is 0) is {FAR:,} voxels or more away "
                "from the grid: leave it out, or ask for no nearest voxels"
            )
        longest = max(grid.pitch)
        with device.stage("nearest"):
            keys = device.empty(len(points), np.uint64)
            squares = device.empty(len(points), np.float64)
            device.kernel(NEAREST, "nearest_voxels")(
                len(points), points=device.put(places), keys=keys, squares=squares,
                pitch=device.put(np.array(grid.pitch) / longest), **self.tree,
            )  # fmt: skip
            found, distances = keys.take(), np.sqrt(squares.take()) * longest
        voxels = np.stack([found >> np.uint64(bits) for bits in (32, 16, 0)], axis=1)
        voxels = (voxels & np.uint64(0xFFFF)).astype(np.int64)
        voxels[np.isinf(distances)] = -1
        return voxels, distances


def _attributes(octree: Octree | MergedOctree, names: Sequence[str]) -> dict[str, CellValues]:
    """Return the values of attributes by name; VoxtoolError if the octree has no such attribute."""
    if names and not isinstance(octree, Octree):
        raise VoxtoolError(f"merged subtrees have no attribute {names[0]!r}: voxelize with it")
    return {name: CellValues(octree, name, 0) for name in names if isinstance(octree, Octree)}


def _shown(name: str, values: np.ndarray, contains: np.ndarray) -> np.ndarray:
    """Return the values of an attribute as answers have them."""
    if name == "label":
        return np.where(contains, values.astype(np.int64), -1)
    if name in ("fraction", "faces"):
        whole = 1 if values.dtype.kind == "f" else np.iinfo(values.dtype).max
        return values.astype(np.float64) / whole
    return values


def _check_nearest(octree: Octree | MergedOctree, device: Device) -> None:
    """Raise GridError or DeviceError if nearest voxels cannot be found."""
    device.require_float64("nearest voxels")
    pitch = octree.grid.pitch
    if max(pitch) > STRETCH * min(pitch):
        raise GridError(
            f"voxels are more than {STRETCH:,} times as long as wide: ask for no nearest voxels"
        )


def _finest(octree: Octree | MergedOctree, level: int | str) -> int:
    """Return k of a level whose nodes, or voxels, have 2**k voxels along a side."""
    return level_number(octree, level, octree.depth - 1) - VOXEL


def _uploaded(octree: Octree | MergedOctree, device: Device) -> dict[str, Array | int]:
    """Return the octree as arguments of kernels."""
    with device.stage("upload"):
        linked = linked_nodes(octree)
        return {
            "words": device.put(linked.children),
            "firsts": device.put(np.array(linked.offsets, np.uint64)),
            "bricks": device.view(linked.bricks),
            "root": octree.depth + 1,
        }


@dataclass(frozen=True)
class QueryPlan(Plan):
    """The plan of queries at points."""

    costs = ("device", "host")
    refusal = "queries of the octree {shortage}: voxelize with a smaller dim, or with --dag"

    nbytes: int  # of the octree on the device
    bricks: int
    merged: bool
    level: int | str | None  # of the nodes whose coverage is returned
    nearest: bool  # whether nearest voxels are returned
    attributes: tuple[str, ...] = ()  # that are returned
    block: int = BLOCK  # points on the device at once

    @property
    def stages(self) -> list[str]:
        return ["upload", "query", *["nearest"] * self.nearest]

    @property
    def reasons(self) -> dict[str, str]:
        return {
            "coverage": "no level is given" if self.level is None else "",
            "nearest voxels": "" if self.nearest else "not requested",
            "nodes of equal subtrees": (
                "points follow the links of distinct ones" if self.merged else ""
            ),
        }

    @property
    def cost(self) -> Cost:
        counted = self.level not in (None, "voxel")
        points = (POINT_BYTES + NEAREST_BYTES * self.nearest) * self.block
        return Cost(self.nbytes + points, COUNT_BYTES * self.bricks * counted, self.nbytes + points)

    def rows(self) -> list[tuple[str, str]]:
        kind = "merged octree" if self.merged else "octree"
        return [("octree", f"{kind}, {human(self.nbytes)} on the device")]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        super().refuse_beyond(max_memory, max_allocation)
        check_memory(self.cost.host, "coverages", "choose level 'voxel', or a smaller octree")


@dataclass(eq=False)
class QueryJob(Job[OctreeQuery]):
    """A planned OctreeQuery: the result of `run()`, for any number of points."""

    octree: Octree | MergedOctree
    plan: QueryPlan
    device: Device
    max_memory: int | None

    def _run(self) -> OctreeQuery:
        plan = self.plan
        return OctreeQuery(
            self.octree, plan.level, self.device, nearest=plan.nearest, attributes=plan.attributes
        )


def plan_query(
    octree: Octree | MergedOctree,
    *,
    level: int | str | None = None,
    nearest: bool = False,
    attributes: Sequence[str] = (),
    device: Device | None = None,
    max_memory: int | None = None,
) -> QueryJob:
    """Return the job whose result, an OctreeQuery, answers at points; see voxtool.query_svo."""
    if level is not None:
        number = _finest(octree, level) + VOXEL
        level = "voxel" if number == VOXEL else number
    device = device or default_device()
    if nearest:
        _check_nearest(octree, device)
    attributes = tuple(attributes)
    _attributes(octree, attributes)
    merged = isinstance(octree, MergedOctree)
    bricks = 8 * octree.sizes[-2] if merged else len(octree.bricks)
    plan = QueryPlan(drawn_bytes(octree), bricks, merged, level, nearest, attributes)
    return QueryJob(octree, plan, device, max_memory)
