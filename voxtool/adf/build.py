"""From a mesh to its adaptively sampled distance field.

From the root down, level by level. A cell has a list of triangles, among which are the nearest ones
to every point of the cell; its children take what they need of it, so lists grow short as cells
grow small, and no tree is asked. A child is refined while its trilinear interpolation is further
from the exact distance than the tolerance.

Kernels: kernels/adf/build.cl.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.accuracy import measure
from voxtool.adf.field import (
    JUMP,
    MAX_LEVEL,
    NO_LEAF,
    POINT_BITS,
    DistanceField,
    assemble,
    bound_values,
)
from voxtool.adf.hashing import build_hash, cell_of, identifier_type, key_of
from voxtool.adf.plan import BLOCK_BYTES, PILOT_LEVEL, FieldPlan
from voxtool.choices import SIGNS
from voxtool.errors import VoxtoolError
from voxtool.opencl import Array, Device, default_device, program
from voxtool.opencl.primitives import exclusive_scan
from voxtool.spatial.bvh import FIELDS, LEAF, Frame, build_tree
from voxtool.spatial.pseudonormals import pseudonormals
from voxtool.spatial.self_intersections import find_self_intersections
from voxtool.spatial.sides import find_sides, shells_agree
from voxtool.spatial.signed_distance import default_sign
from voxtool.spatial.winding_number import WindingNumber

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.mesh.mesh import Mesh
    from voxtool.spatial.pseudonormals import Pseudonormals

SOURCE = "adf/build.cl"
TOLERANCE = 1e-3  # unless another is asked for
MAX_LEVEL_ASKED = 9
MARGIN = 1 / 16  # of the cube's side, on each side of the mesh's longest
CROSSED = 64.0  # tolerances that the edge of a leaf may have where triangles pass, unless certain
REACH = 2.0  # of winding numbers: an error of 5e-3 is ample for signs, in half of the time
KEPT = 32  # triangles of a cell that are weighed against each other, at most
NOWHERE = BEYOND = 0xFFFFFFFF  # no triangle; no cell, as it is out of the cube
COARSE = BEYOND - 1  # no cell, as there is a leaf
UNKNOWN, OUTSIDE, INSIDE = 0, 1, 2  # sides of the mesh

HEADERS = {
    "adf/build.h": program.c_constants(
        JUMP=JUMP,
        KEPT=KEPT,
        NOWHERE=NOWHERE,
        BEYOND=BEYOND,
        COARSE=COARSE,
        UNKNOWN=UNKNOWN,
        OUTSIDE=OUTSIDE,
        INSIDE=INSIDE,
    )
}


def build_adf(
    mesh: Mesh,
    device: Device | None = None,
    *,
    tolerance: float = TOLERANCE,
    max_level: int = MAX_LEVEL_ASKED,
    band: float = math.inf,
    sign: str | None = None,
    continuous: bool = True,
    bounds: bool = True,
    max_bytes: int | None = None,
    max_memory: int | None = None,
) -> DistanceField:
    """The distance field of a mesh.

    Cells that triangles pass are refined at least until their edge is CROSSED tolerances, unless
    their error is certainly within the tolerance: a wall that no sample hits is wrong by no more
    than half of that.

    Parameters
    ----------
    tolerance : of the error, in sides of the cube, the margin included.
    max_level : at which leaves are refined no more, 1 to 21; the root has level 0.
    band : how far from the surface cells are refined, in sides of the cube.
    sign : as SignedDistance; by default "pseudonormal" for meshes that are closed, wound
        consistently, do not meet themselves, and have no shells that are nested and wound alike;
        and "winding" for others. Forced on these, pseudo-normals make signs that may be wrong, and
        bounds are those of the distance without its sign.
    continuous : whether leaves of different level agree on what they share.
    bounds : whether each leaf's own error bound is stored.
    max_bytes : that the four textures may take, about; the largest errors are refined first.
    max_memory : bytes that the build may use; by default what the device has.

    Returns
    -------
    The field. Its `reached` has "leaves"; "missed", the leaves whose error is over the tolerance,
    and if there are any "worst": the largest, its level and where (world units); "jumps", the
    leaves in which the sign changes away from the surface; "balanced", whether no leaf has a
    neighbour that is coarser by more than one level; and "errors", as voxtool.adf.accuracy.measure.

    Raises
    ------
    MeshError, DeviceError : as SignedDistance.
    VoxtoolError : a number is out of range. MemoryLimitError : it does not fit.
    """
    build = _Build(
        mesh, device, max_memory,
        Request(tolerance, max_level, band, sign, continuous, bounds, max_bytes),
    )  # fmt: skip
    build.run()
    field = build.field()
    with build.device.stage("errors"):
        errors = measure(field, mesh, build.device)
    return replace(field, reached={**field.reached, "errors": errors})


def plan_adf(mesh: Mesh, device: Device | None = None, **request: Any) -> FieldPlan:
    """How a field will be built: its upper levels are, to foretell the others.

    Parameters
    ----------
    request : as build_adf.

    Raises
    ------
    As build_adf.
    """
    build = _Build(mesh, device, None, Request(**request))
    build.run(PILOT_LEVEL - 1)
    return build.plan


def cube_of(mesh: Mesh) -> tuple[np.ndarray, float]:
    """The origin and the side of the cube of a mesh's field, world units: the mesh is in its
    middle, MARGIN of the side from it along the longest of its sides.

    Raises
    ------
    MeshError : as Frame.of.
    """
    frame = Frame.of(mesh)
    extent = _extent(mesh, frame)
    origin = frame.centre - np.ldexp(extent, frame.exponent)
    return origin, math.ldexp(2 * extent, frame.exponent)


def _misplaced(origin: np.ndarray, side: float) -> float:
    """How far at most a point in world coordinates is from where the field takes it to be, in
    sides: by rounding to fixed point, and of coordinates far from 0."""
    farthest = float(np.maximum(np.abs(origin), np.abs(origin + side)).max())
    return math.sqrt(3) * (2.0**-POINT_BITS + 2 * float(np.spacing(farthest)) / side)


def _extent(mesh: Mesh, frame: Frame) -> float:
    """Half of the cube's side, in the frame."""
    low, high = frame.local(mesh.bounds)
    return float((high - low).max()) / (2 - 4 * MARGIN)


@dataclass(frozen=True)
class Request:
    """What is asked of a build; see build_adf."""

    tolerance: float = TOLERANCE
    max_level: int = MAX_LEVEL_ASKED
    band: float = math.inf
    sign: str | None = None
    continuous: bool = True
    bounds: bool = True
    max_bytes: int | None = None

    def check(self) -> None:
        """Refuse what is out of range; raises VoxtoolError."""
        if not 0 <= self.tolerance < math.inf:
            raise VoxtoolError(f"tolerance {self.tolerance:g}: give a length from 0 on")
        if not 1 <= self.max_level <= MAX_LEVEL:
            raise VoxtoolError(f"max level {self.max_level}: choose 1 to {MAX_LEVEL}")
        if not self.band >= 0:
            raise VoxtoolError(f"band {self.band:g}: give a length from 0 on")
        if self.sign is not None and self.sign not in SIGNS:
            raise VoxtoolError(f"sign {self.sign!r}: choose one of {', '.join(SIGNS)}")
        if self.max_bytes is not None and self.max_bytes < BLOCK_BYTES:
            raise VoxtoolError(f"max bytes {self.max_bytes}: one block takes {BLOCK_BYTES}")


@dataclass
class _Level:
    """The refined cells of a level, on the device.

    identifiers : uint64, in rising order; sources : uint32, which child of the level above each is.
    begins, items : uint32, where the list of each begins, and the triangles of all lists.
    values : float64, 27 a cell, the distances of its block.
    masks, needed : uint8 an item and uint32 a child, which children need it and how many each does.
    states : uint8, on which side of the mesh each is; doubts : uint32, whose signs are not known.
    neighbours : uint32, 27 a cell, see find_neighbours.
    ranks : uint32, of the children, how many before each are refined.
    """

    number: int
    count: int
    identifiers: Array
    sources: Array
    begins: Array
    items: Array
    values: Array | None = None
    masks: Array | None = None
    needed: Array | None = None
    states: Array | None = None
    doubts: Array | None = None
    neighbours: Array | None = None
    ranks: Array | None = None

    def release(self, *names: str) -> None:
        """Give back the memory of these."""
        for name in names:
            array = getattr(self, name)
            if array is not None:
                array.release()
                setattr(self, name, None)


class _Build:
    """A field in the making: level by level, what is done on the device, and what is kept."""

    def __init__(
        self, mesh: Mesh, device: Device | None, max_memory: int | None, request: Request
    ) -> None:
        request.check()
        self.mesh, self.request = mesh, request
        self.device = device = device or default_device()
        self.memory = (max_memory or device.max_memory, device.info.max_allocation)
        normals = None if request.sign == "none" else pseudonormals(mesh)
        self.tree = build_tree(device, mesh, None if normals is None else normals.flat)
        crossed = np.zeros(len(mesh.faces), bool)
        if normals is not None:
            crossed = find_self_intersections(device, mesh, self.tree)
        closed = default_sign(mesh) == "pseudonormal" and not crossed.any()
        if closed and normals is not None:
            closed = shells_agree(mesh, normals, device, self.tree)
        self.plan = FieldPlan(
            triangles=len(mesh.faces),
            flat=0 if normals is None else int(np.count_nonzero(normals.flat)),
            crossed=int(np.count_nonzero(crossed)),
            closed=closed,
            sign=request.sign or ("pseudonormal" if closed else "winding"),
            tolerance=request.tolerance,
            max_level=request.max_level,
            band=request.band,
            continuous=request.continuous,
            bounds=request.bounds,
            max_bytes=request.max_bytes,
        )
        self.extent = _extent(mesh, self.tree.frame)
        self.misplaced = _misplaced(*cube_of(mesh))
        self.options: dict[str, int] = {}
        self.sides: tuple[Any, ...] = ()
        self.winding: WindingNumber | None = None
        self.spheres: tuple[Any, ...] = ()
        if normals is not None:
            self._take_sides(normals, crossed)
        self.bound_values = device.put(bound_values())
        self.steepest = device.zeros(1, np.uint32)
        self.unbalanced = device.zeros(1, np.uint32)
        self.above: _Level | None = None
        self.identifiers: list[np.ndarray] = []
        self.voxels: list[np.ndarray] = []
        self.codes: list[np.ndarray] = []
        self.missed = self.jumps = 0
        self.worst: tuple[float, int, int] | None = None  # error, level, identifier

    def run(self, last: int = MAX_LEVEL) -> None:
        """From the root down, to cells of the last level."""
        level = self.root()
        self.plan = replace(self.plan, refined=(1,), items=level.items.size)
        self.plan.refuse_beyond(*self.memory)
        while level and level.number <= last:
            self.sample(level)
            if self.request.continuous:
                self.constrain(level)
            self.examine(level)
            level = self.refine(level)

    def _take_sides(self, normals: Pseudonormals, crossed: np.ndarray) -> None:
        """What tells inside from outside."""
        device, tree = self.device, self.tree
        self.options["SIGNED"] = 1
        if self.plan.flat:
            self.options["FLAT"] = 1
        self.sides = (tree.names, device.put(normals.features), device.put(normals.normals))
        if self.plan.sign == "winding":
            self.options["WINDING"] = 1
            self.winding = WindingNumber(self.mesh, device, tree=tree, reach=REACH)
            found = find_sides(self.mesh, normals, self.winding, crossed)
            self.sides = (*self.sides, device.put(found.front))
            self.spheres = (device.put(found.spheres), np.uint32(len(found.spheres)))
        self.options["CLOSED" if self.plan.certain else "JUMPS"] = 1

    def _kernel(self, name: str) -> Callable[..., None]:
        return self.device.kernel(SOURCE, name, **self.options)

    def root(self) -> _Level:
        """The root, whose list has every triangle, repeated ones once."""
        put = self.device.put
        triangles = self._distinct_triangles()
        level = _Level(
            0,
            1,
            put(np.ones(1, np.uint64)),
            put(np.zeros(1, np.uint32)),
            put(np.array([0, len(triangles)], np.uint32)),
            put(triangles),
        )
        alone = np.full(27, BEYOND, np.uint32)
        alone[13] = 0
        level.neighbours = put(alone)
        return level

    def _distinct_triangles(self) -> np.ndarray:
        """(n,) uint32: the triangles of the tree, but only the first of those that are equal, which
        are equally near everywhere, so that nothing would ever shorten a list of them."""
        leaves = self.tree.leaves.get().reshape(-1, FIELDS, LEAF)
        records = np.ascontiguousarray(leaves.transpose(0, 2, 1).reshape(-1, FIELDS))
        kept = np.arange(self.tree.count, dtype=np.uint32)
        codes = records[: len(kept)].view(np.uint64)
        mixed = np.zeros(len(kept), np.uint64)
        for field in codes.T:
            mixed = (mixed ^ field) * np.uint64(0x9E3779B97F4A7C15)
            mixed ^= mixed >> np.uint64(32)
        order = np.argsort(mixed, kind="stable")
        same = (codes[order[1:]] == codes[order[:-1]]).all(axis=1)
        return np.delete(kept, order[1:][same])

    def sample(self, level: _Level) -> None:
        """The exact distances at the vertices of a level's blocks, and who needs which triangle."""
        device, n = self.device, level.count
        level.values = device.empty(27 * n, np.float64)
        level.masks = device.empty(level.items.size, np.uint8)
        level.needed = device.empty(8 * n, np.uint32)
        states: tuple[Any, ...] = ()
        if "SIGNED" in self.options:
            level.states = device.empty(n, np.uint8)
            above = self.above.states if self.above else device.zeros(1, np.uint8)
            states = (level.sources, above, level.states)
        if self.winding:
            level.doubts, asked = device.empty(n, np.uint32), device.empty(n, np.uint32)
            states = (*states, *self.spheres, level.doubts, asked)
        with device.stage("sample"):
            self._kernel("sample_blocks")(
                n,
                np.uint32(n),
                level.identifiers,
                np.uint32(level.number),
                np.float64(self.extent),
                level.begins,
                self.tree.leaves,
                level.items,
                *self.sides,
                *states,
                level.values,
                level.masks,
                level.needed,
            )
        if self.winding:
            for _ in ("middles of blocks", "vertices"):
                self._settle(level, self.winding, asked)
            asked.release()

    def _settle(self, level: _Level, winding: WindingNumber, asked: Array) -> None:
        """The signs that are in doubt, by winding numbers where they are asked."""
        device, n = self.device, level.count
        size, place = np.uint32(n), (np.uint32(level.number), np.float64(self.extent))
        begins = device.empty(n + 1, np.uint32)
        with device.stage("signs"):
            self._kernel("count_asked")(n, size, asked, begins)
            total = exclusive_scan(begins, n)
            if total:
                points = device.empty(3 * total, np.float64)
                self._kernel("list_asked")(
                    n, size, level.identifiers, *place, asked, begins, points
                )
                numbers = winding.at_local(points, total)
                self._kernel("settle_signs")(
                    n,
                    size,
                    level.identifiers,
                    *place,
                    *self.spheres,
                    begins,
                    numbers,
                    level.doubts,
                    asked,
                    level.states,
                    level.values,
                )
                points.release()
                numbers.release()
        begins.release()

    def constrain(self, level: _Level) -> None:
        """What hangs on a coarser leaf takes its values."""
        if self.above is None:
            return
        device, above, n = self.device, self.above, level.count
        level.neighbours = device.empty(27 * n, np.uint32)
        with device.stage("constrain"):
            self._kernel("find_neighbours")(
                n,
                np.uint32(n),
                level.sources,
                above.ranks,
                above.neighbours,
                level.neighbours,
                self.unbalanced,
            )
            self._kernel("constrain_blocks")(
                n, np.uint32(n), level.sources, level.neighbours, above.values, level.values
            )

    def examine(self, level: _Level) -> None:
        """Which children are refined, and what is known of the error of the others."""
        device, n, request = self.device, level.count, self.request
        side = 2 * self.extent
        voxels = device.empty(27 * n, np.float32)
        level.ranks = device.empty(8 * n + 1, np.uint32)
        errors, codes = device.empty(8 * n, np.float32), device.empty(8 * n, np.uint8)
        can_refine = level.number + 1 < request.max_level
        coarse = 0.5 ** (level.number + 1) > CROSSED * request.tolerance
        with device.stage("examine"):
            self._kernel("store_voxels")(
                27 * n, np.uint32(27 * n), level.values, np.float64(self.extent), voxels
            )
            self._kernel("examine_children")(
                n,
                np.uint32(n),
                level.identifiers,
                np.uint32(level.number),
                np.float64(self.extent),
                level.begins,
                self.tree.leaves,
                level.items,
                *self.sides,
                *([level.doubts] if self.winding else []),
                voxels,
                np.float64(request.tolerance * side),
                np.float64(self.misplaced * side),
                np.float64(request.band * side),
                np.uint32(can_refine),
                np.uint32(coarse),
                np.uint32(request.max_bytes is not None),
                self.bound_values,
                level.masks,
                level.ranks,
                errors,
                codes,
                self.steepest,
            )
        self.identifiers.append(level.identifiers.get())
        self.voxels.append(voxels.take())
        self.codes.append(codes.take())
        if can_refine:
            refined = level.ranks.get(0, 8 * n)
            if request.max_bytes is not None:
                self._limit(refined, errors.get(), request.max_bytes // BLOCK_BYTES)
                device.write(level.ranks, refined)
            self.codes[-1][refined != 0] = NO_LEAF
        self._count_missed(level, errors.take())

    def _limit(self, refined: np.ndarray, errors: np.ndarray, most: int) -> None:
        """Refine no more than makes `most` blocks; the largest errors first."""
        left = most - sum(map(len, self.identifiers))
        wanted = np.flatnonzero(refined)
        worst_first = np.argsort(-errors[wanted], kind="stable")
        refined[wanted[worst_first[max(left, 0) :]]] = 0

    def _count_missed(self, level: _Level, errors: np.ndarray) -> None:
        """Of the leaves of this level, those that miss the tolerance, and those that jump."""
        self.jumps += int(np.count_nonzero((errors < 0) & (self.codes[-1] > 0)))
        over = np.flatnonzero((errors > np.float32(self.request.tolerance)) & (self.codes[-1] > 0))
        if len(over) == 0:
            return
        self.missed += len(over)
        worst = over[np.argmax(errors[over])]
        if self.worst is None or errors[worst] > self.worst[0]:
            identifier = int(self.identifiers[-1][worst // 8]) << 3 | int(worst % 8)
            self.worst = (float(errors[worst]), level.number + 1, identifier)

    def refine(self, level: _Level) -> _Level | None:
        """The refined children as the next level, or None if there are none."""
        device, n = self.device, level.count
        assert level.ranks
        assert level.needed
        if level.number + 1 >= self.request.max_level:
            return None
        with device.stage("hand down"):
            refined = level.ranks.get(0, 8 * n) != 0
            total = exclusive_scan(level.ranks, 8 * n)
            if total == 0:
                return None
            size = int(level.needed.get()[refined].sum(dtype=np.int64))
            self.plan = replace(self.plan, refined=(*self.plan.refined, total), items=size)
            self.plan.refuse_beyond(*self.memory)
            identifiers = device.empty(total, np.uint64)
            sources, begins = device.empty(total, np.uint32), device.empty(total + 1, np.uint32)
            self._kernel("list_refined")(
                8 * n,
                np.uint32(8 * n),
                level.ranks,
                level.identifiers,
                level.needed,
                identifiers,
                sources,
                begins,
            )
            exclusive_scan(begins, total)
            items = device.empty(size, np.uint32)
            self._kernel("hand_down")(
                total,
                np.uint32(total),
                sources,
                level.begins,
                level.items,
                level.masks,
                begins,
                items,
            )
        level.release("identifiers", "sources", "begins", "items", "masks", "needed", "doubts")
        if self.above:
            self.above.release("values", "states", "neighbours", "ranks")
        self.above = level
        return _Level(level.number + 1, total, identifiers, sources, begins, items)

    def field(self) -> DistanceField:
        """The textures."""
        origin, side = cube_of(self.mesh)
        identifiers = np.concatenate(self.identifiers)
        levels, ijk = cell_of(identifiers)
        with self.device.stage("hash"):
            table = build_hash(key_of(levels, ijk), self.device)
        codes = np.concatenate(self.codes)
        reached: dict[str, Any] = {
            "leaves": 7 * len(identifiers) + 1,
            "missed": self.missed,
            "jumps": self.jumps,
        }
        if self.worst:
            error, level, identifier = self.worst
            cell = cell_of(np.array([identifier], np.uint64))[1][0]
            where = origin + side * np.ldexp(cell + 0.5, -level)
            reached["worst"] = {"error": error, "level": level, "where": where.tolist()}
        if self.request.continuous:
            reached["balanced"] = not self.unbalanced.get()[0]
        return assemble(
            identifiers.astype(identifier_type(int(levels[-1]))),
            np.concatenate(self.voxels).reshape(-1, 3, 3, 3),
            codes.reshape(-1, 2, 2, 2) if self.request.bounds else None,
            table,
            origin=tuple(origin.tolist()),
            side=side,
            sign=self.plan.sign,
            tolerance=self.request.tolerance,
            max_level=self.request.max_level,
            band=self.request.band,
            continuous=self.request.continuous,
            lipschitz=float(self.steepest.get().view(np.float32)[0]),
            reached=reached,
            plan=self.plan.scene(),
            source_sha256=self.mesh.source_sha256,
            units=self.mesh.units,
        )
