"""Exact distances as jobs: from any points, and at the voxel centres of a grid.

The inside is that of voxelize (svo/voxelization/inside.py). On a grid a distance is negative
exactly where the voxel is set. The magnitudes are those of the unrounded mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import FIELD_SIGNS, FILLS, POINT_FILLS
from voxtool.errors import MemoryLimitError, VoxtoolError, human
from voxtool.job import Cost, Job, Plan
from voxtool.memory import available_memory
from voxtool.opencl import default_device
from voxtool.spatial import insides
from voxtool.spatial.distance import POINT_BYTES, POINTS_AT_ONCE
from voxtool.spatial.fill_rule import Inside, inside_of_closed
from voxtool.spatial.signed_distance import SignedDistance, distance_bytes
from voxtool.svo.voxelization.inside import inside_of

if TYPE_CHECKING:
    from voxtool.adf.construction.build import FieldJob
    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.svo.octree.octree import Octree
    from voxtool.svo.voxelization.voxelize import VoxelizeJob

LOCATED_BYTES = 56  # further bytes a point for its nearest point
SIGN_STAGES = {"pseudonormal": ["pseudo-normals"], "winding": ["moments"]}
SIGN_NAMES = {"pseudonormal": "pseudo-normals", "winding": "winding numbers"}


@dataclass(frozen=True)
class DistancePlan(Plan):
    """The plan of distances at points."""

    refusal = "{plan.triangles:,} triangles {shortage}: simplify the mesh"

    triangles: int
    sign: str  # one of voxtool.choices.SIGNS
    located: bool  # whether gradients, nearest points or faces are computed
    block: int = POINTS_AT_ONCE  # points on the device at once

    @property
    def stages(self) -> list[str]:
        first, last = SIGN_STAGES.get(self.sign, []), ["distance"]
        if self.sign == "winding":
            return ["tree", *first, *last, "winding number"]
        if self.sign in FILLS:
            return ["tree", *last, "crossings of lines"]
        return [*first, "tree", *last]

    @property
    def reasons(self) -> dict[str, str]:
        reason = "no distance is negative" if self.sign == "none" else f"the sign is {self.sign}"
        return {
            **{what: reason for sign, what in SIGN_NAMES.items() if sign != self.sign},
            "gradients, nearest points and faces": "" if self.located else "not requested",
        }

    @property
    def cost(self) -> Cost:
        signed = insides.BYTES if self.sign == "winding" else 0
        points = self.block * (POINT_BYTES + signed + (LOCATED_BYTES if self.located else 0))
        size = distance_bytes(self.triangles, self.sign)
        return Cost(size + points, 2 * points, max(120 * self.triangles, 24 * self.block))

    def rows(self) -> list[tuple[str, str]]:
        return [("scene", f"{self.triangles:,} triangles"), ("sign", self.sign)]


@dataclass(eq=False)
class DistanceJob(Job[SignedDistance]):
    """A planned SignedDistance: the result of `run()`, for any number of points."""

    mesh: Mesh
    inside: Inside
    plan: DistancePlan
    device: Device
    max_memory: int | None

    def _run(self) -> SignedDistance:
        return SignedDistance(self.inside.mesh_of(self.mesh), self.plan.sign, self.device)

    def notes(self, result: SignedDistance) -> list[str]:
        """Return what was decided to be inside, if it was in doubt."""
        return self.inside.note(self.mesh)

    doubts = notes


def inside_for(mesh: Mesh, fill: str, device: Device) -> tuple[Inside, str]:
    """Return what is inside of a mesh, and how the sign of a distance from a point is found, one of
    voxtool.choices.SIGNS.

    fill : one of voxtool.choices.POINT_FILLS. Raises VoxtoolError for any other, and for "flood".
    """
    if fill not in POINT_FILLS:
        raise VoxtoolError(f"fill {fill!r} is unknown: choose one of {', '.join(POINT_FILLS)}")
    if fill == "flood":
        raise VoxtoolError(
            "fill 'flood' fills whole voxels, and a point is in none: choose auto or winding, or "
            "measure a grid (--dim)"
        )
    if fill == "auto":
        inside = inside_of(mesh, device)
        return inside, inside.sign
    if fill in ("parity", "nonzero"):
        closed = inside_of_closed(mesh, device)
        if closed and closed.simple:
            return closed, closed.sign
    return Inside(None, fill), fill


def plan_field(mesh: Mesh, *, fill: str = "auto", **request: Any) -> FieldJob:
    """Return the job of building the distance field of a mesh; see voxtool.plan_adf."""
    from voxtool.adf.construction.build import plan_adf

    device = request.pop("device", None) or default_device()
    if fill == "auto":
        return plan_adf(mesh, decide=inside_of, device=device, **request)
    inside, sign = inside_for(mesh, fill, device)
    if sign not in FIELD_SIGNS:
        raise VoxtoolError(
            f"fill {fill!r} decides about fields of closed meshes whose parts do not overlap, and "
            f"{mesh.name or 'mesh'} is none: choose auto or winding"
        )
    return plan_adf(inside.mesh_of(mesh), sign=sign, device=device, **request)


def plan_distance(
    mesh: Mesh,
    *,
    fill: str = "auto",
    located: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> DistanceJob:
    """Return the job whose result, a SignedDistance, measures points; see voxtool.plan_distance."""
    device = device or default_device()
    inside, sign = inside_for(mesh, fill, device)
    plan = DistancePlan(len(mesh.faces), sign, located)
    return DistanceJob(mesh, inside, plan, device, max_memory)


@dataclass(frozen=True)
class DistanceGridPlan(Plan):
    """The plan of distances at the voxel centres of a grid."""

    facts = ("dtype", "triangles: distance.triangles")
    costs = ("device", "host")

    shape: tuple[int, int, int]
    dtype: str  # of the result, "float64" or "float32"
    distance: DistancePlan  # of the magnitudes
    voxels: Any = None  # the plan of the octree that gives the signs; None without signs

    @property
    def stages(self) -> list[str]:
        return [*(self.voxels.stages if self.voxels else []), *self.distance.stages]

    @property
    def reasons(self) -> dict[str, str]:
        return self.voxels.left_out if self.voxels else {"voxels": "no distance is negative"}

    @property
    def cost(self) -> Cost:
        nx, ny, nz = self.shape
        costs = [self.distance.cost, *([self.voxels.cost] if self.voxels else [])]
        host = nx * ny * nz * np.dtype(self.dtype).itemsize + sum(cost.host for cost in costs)
        return replace(Cost.most(costs), host=host)

    def as_dict(self) -> dict[str, Any]:
        voxels = self.voxels.as_dict() if self.voxels else {"shape": list(self.shape)}
        return {**voxels, **super().as_dict()}

    def rows(self) -> list[tuple[str, str]]:
        shape = " x ".join(map(str, self.shape))
        rows = self.voxels.rows() if self.voxels else [("grid", f"{shape} voxels")]
        return [*rows, ("distances", f"{shape} {self.dtype}")]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        for plan in (self.voxels, self.distance):
            if plan:
                plan.refuse_beyond(max_memory, max_allocation)
        free = available_memory()
        if self.cost.host > free:
            fits = int(max(self.shape) * (free / self.cost.host) ** (1 / 3))
            raise MemoryLimitError(
                f"{' x '.join(map(str, self.shape))} distances need {human(self.cost.host)} of the "
                f"machine's memory and {human(free)} are free: choose a dim of {fits} or less"
            )


@dataclass(eq=False)
class DistanceGridJob(Job[np.ndarray]):
    """A dense grid of distances, planned."""

    mesh: Mesh
    grid: Grid
    plan: DistanceGridPlan
    voxels: VoxelizeJob | None
    device: Device
    max_memory: int | None
    octree: Octree | None = None  # once it has run: what is inside

    def settle(self) -> None:
        if self.voxels:
            self.voxels.settle()
            self.plan = replace(self.plan, voxels=self.voxels.plan)

    def notes(self, result: np.ndarray) -> list[str]:
        """Return lines about what was decided to be inside."""
        return self.voxels.notes(self.octree) if self.voxels and self.octree else []

    def doubts(self, result: np.ndarray) -> list[str]:
        """Return those about decisions in doubt."""
        return self.voxels.doubts(self.octree) if self.voxels and self.octree else []

    def _run(self) -> np.ndarray:
        octree = self.octree = self.voxels.run(self._progress) if self.voxels else None
        distances = self._magnitudes()
        if octree is None:
            return distances
        from voxtool.svo.images.image import VoxelImage

        least, x = np.finfo(distances.dtype).tiny, 0
        for voxels in VoxelImage.of(octree).slabs():
            part = distances[x : x + len(voxels)]
            np.copyto(part, np.minimum(-part, -least), where=voxels)
            x += len(voxels)
        return distances

    def _magnitudes(self) -> np.ndarray:
        """Return the unsigned distances at the voxel centres, (nx, ny, nz)."""
        measure = SignedDistance(self.mesh, "none", self.device)
        distances = np.empty(self.grid.shape, self.plan.dtype)
        flat, block = distances.reshape(-1), self.plan.distance.block
        for start in range(0, len(flat), block):
            numbers = np.arange(start, min(start + block, len(flat)))
            cells = np.stack(np.unravel_index(numbers, self.grid.shape), axis=1)
            flat[numbers] = measure(self.grid.to_world(cells + 0.5))
        return distances


def plan_distance_grid(
    mesh: Mesh,
    grid: Grid,
    *,
    fill: str = "auto",
    gap: int = 0,
    dtype: Any = np.float64,
    device: Device | None = None,
    max_memory: int | None = None,
) -> DistanceGridJob:
    """Return the job of the distances at the voxel centres of a grid; see voxtool.distance_grid."""
    name = np.dtype(dtype).name
    if name not in ("float64", "float32"):
        raise VoxtoolError(f"dtype {name}: choose float64 or float32")
    if name == "float32":
        from voxtool.grid import check_single

        low = np.array(grid.origin)
        ends = np.array([*mesh.bounds, low, low + np.array(grid.shape) * grid.pitch])
        check_single("the array", grid.pitch, np.ptp(ends, axis=0).sum(), "leave out --float32")
    device, voxels = device or default_device(), None
    if fill != "none":
        from voxtool.svo.voxelization.voxelize import plan_voxelize

        voxels = plan_voxelize(mesh, grid, fill=fill, gap=gap, device=device, max_memory=max_memory)
    magnitudes = DistancePlan(len(mesh.faces), "none", located=False)
    plan = DistanceGridPlan(grid.shape, name, magnitudes, voxels.plan if voxels else None)
    return DistanceGridJob(mesh, grid, plan, voxels, device, max_memory)
