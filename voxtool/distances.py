"""Exact distances as jobs: from any points, and at the voxel centres of a grid.

The signs on a grid are those of voxelize: a distance is negative exactly where the voxel is set.
The magnitudes are those of the unrounded mesh.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import SIGNS
from voxtool.errors import MemoryLimitError, VoxtoolError, human
from voxtool.job import Cost, Job
from voxtool.memory import available_memory
from voxtool.opencl import default_device
from voxtool.spatial import insides
from voxtool.spatial.distance import POINT_BYTES, POINTS_AT_ONCE
from voxtool.spatial.signed_distance import SignedDistance, default_sign, distance_bytes
from voxtool.svo.image import VoxelImage
from voxtool.svo.voxelize import VoxelizeJob, plan_voxelize

if TYPE_CHECKING:
    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

LOCATED_BYTES = 56  # further bytes a point for its nearest point
SIGN_STAGES = {"pseudonormal": ["pseudo-normals"], "winding": ["moments"], "none": []}
SIGN_NAMES = {"pseudonormal": "pseudo-normals", "winding": "winding numbers"}


@dataclass(frozen=True)
class DistancePlan:
    """The plan of distances at points."""

    triangles: int
    sign: str  # one of SIGNS
    located: bool  # whether gradients, nearest points or faces are computed
    block: int = POINTS_AT_ONCE  # points on the device at once

    @property
    def stages(self) -> list[str]:
        first, last = SIGN_STAGES[self.sign], ["distance"]
        if self.sign == "winding":
            return ["tree", *first, *last, "winding number"]
        return [*first, "tree", *last]

    @property
    def left_out(self) -> dict[str, str]:
        reason = "no distance is negative" if self.sign == "none" else f"the sign is {self.sign}"
        out = {what: reason for sign, what in SIGN_NAMES.items() if sign != self.sign}
        if not self.located:
            out["gradients, nearest points and faces"] = "not requested"
        return out

    @property
    def cost(self) -> Cost:
        signed = insides.BYTES if self.sign == "winding" else 0
        points = self.block * (POINT_BYTES + signed + (LOCATED_BYTES if self.located else 0))
        size = distance_bytes(self.triangles, self.sign)
        return Cost(size + points, 2 * points, max(120 * self.triangles, 24 * self.block))

    def as_dict(self) -> dict[str, Any]:
        return {
            **asdict(self),
            "stages": self.stages,
            "left_out": self.left_out,
            "predicted_device_bytes": self.cost.device,
        }

    def rows(self) -> list[tuple[str, str]]:
        return [("scene", f"{self.triangles:,} triangles"), ("sign", self.sign)]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        if shortage := self.cost.shortage(max_memory, max_allocation):
            raise MemoryLimitError(f"{self.triangles:,} triangles {shortage}: simplify the mesh")


@dataclass(eq=False)
class DistanceJob(Job[SignedDistance]):
    """A planned SignedDistance: the result of `run()`, for any number of points."""

    mesh: Mesh
    plan: DistancePlan
    device: Device
    max_memory: int | None

    def _run(self) -> SignedDistance:
        return SignedDistance(self.mesh, self.plan.sign, self.device)


def plan_distance(
    mesh: Mesh,
    *,
    sign: str | None = None,
    located: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> DistanceJob:
    """Return the job whose result, a SignedDistance, measures points; see voxtool.plan_distance."""
    if sign is not None and sign not in SIGNS:
        raise VoxtoolError(f"sign {sign!r}: choose one of {', '.join(SIGNS)}")
    device = device or default_device()
    plan = DistancePlan(len(mesh.faces), sign or default_sign(mesh, device), located)
    return DistanceJob(mesh, plan, device, max_memory)


@dataclass(frozen=True)
class DistanceGridPlan:
    """The plan of distances at the voxel centres of a grid."""

    shape: tuple[int, int, int]
    dtype: str  # of the result, "float64" or "float32"
    distance: DistancePlan  # of the magnitudes
    voxels: Any = None  # the plan of the octree that gives the signs; None without signs

    @property
    def stages(self) -> list[str]:
        return [*(self.voxels.stages if self.voxels else []), *self.distance.stages]

    @property
    def left_out(self) -> dict[str, str]:
        if self.voxels:
            return dict(self.voxels.left_out)
        return {"voxels": "no distance is negative"}

    @property
    def cost(self) -> Cost:
        nx, ny, nz = self.shape
        costs = [self.distance.cost, *([self.voxels.cost] if self.voxels else [])]
        return Cost(
            max(cost.device for cost in costs),
            nx * ny * nz * np.dtype(self.dtype).itemsize + sum(cost.host for cost in costs),
            max(cost.largest for cost in costs),
        )

    def as_dict(self) -> dict[str, Any]:
        return {
            **(self.voxels.as_dict() if self.voxels else {"shape": list(self.shape)}),
            "dtype": self.dtype,
            "triangles": self.distance.triangles,
            "stages": self.stages,
            "left_out": self.left_out,
            "predicted_device_bytes": self.cost.device,
            "predicted_host_bytes": self.cost.host,
        }

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

    def _run(self) -> np.ndarray:
        octree = self.voxels.run(self._progress) if self.voxels else None
        distances = self._magnitudes()
        if octree is None:
            return distances
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
    device, voxels = device or default_device(), None
    if fill != "none":
        voxels = plan_voxelize(mesh, grid, fill=fill, gap=gap, device=device, max_memory=max_memory)
    magnitudes = DistancePlan(len(mesh.faces), "none", located=False)
    plan = DistanceGridPlan(grid.shape, name, magnitudes, voxels.plan if voxels else None)
    return DistanceGridJob(mesh, grid, plan, voxels, device, max_memory)
