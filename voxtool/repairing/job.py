"""Repair: any triangle mesh made closed, consistently wound and manifold.

The stages:

1. The fill rule decides which voxels of a grid are inside, as in `voxelize`
(svo/voxelization/voxelize.py).
2. Components that are not wanted are dropped (svo/sets/components.py).
3. A surface net separates the voxels from the others: closed and manifold (svo/surface).
4. Its vertices move onto the mesh, where it passes their cells (fit.py), and the distances between
   the two are measured.
5. For an offset, or a hollow solid, the voxels are chosen anew, by their exact distance to that
   surface (walls.py), and steps 3 and 4 are repeated with the points at that distance as the mesh.
6. If asked, the surface is simplified (simplify.py).
7. The result is checked.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import VoxtoolError, count_of
from voxtool.grid import Grid
from voxtool.job import Job
from voxtool.mesh.topology import components
from voxtool.opencl import default_device
from voxtool.repairing.fit import NONE, Fitted, fit
from voxtool.repairing.measure import measure
from voxtool.repairing.plan import STYLE, RepairPlan
from voxtool.repairing.result import Repaired
from voxtool.repairing.simplify import check_library, simplify
from voxtool.repairing.targets import Level, Target
from voxtool.repairing.walls import beyond, cavities, check_walls, drain_of, plate, thinnest, within
from voxtool.spatial.distance import TriangleDistance
from voxtool.svo.sets.booleans import combine
from voxtool.svo.sets.components import plan_keep_components
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.voxelization.voxelize import VoxelizeJob, plan_voxelize

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.svo.octree.octree import Octree


def grid_for(mesh: Mesh, dim: int | None = None, tolerance: float | None = None) -> Grid:
    """Return the grid around a mesh of this dim, or whose voxels have this diagonal in world
    units."""
    if tolerance is None:
        return Grid.fit(mesh, dim)
    return Grid.fit(mesh, dim, pitch=tolerance / math.sqrt(3))


def plan_repair(
    mesh: Mesh,
    grid: Grid,
    *,
    fill: str = "auto",
    gap: int = 0,
    keep_components: int | None = None,
    offset: float = 0.0,
    shell: float = 0.0,
    thicken: float = 0.0,
    drains: Sequence[Sequence[float]] = (),
    simplify: float = 0.0,
    device: Device | None = None,
    max_memory: int | None = None,
) -> RepairJob:
    """Return the planned job of `repair`; see `voxtool.repair`."""
    if len(set(grid.pitch)) > 1:
        raise VoxtoolError(f"voxels of {grid.pitch}: repair needs cubes: give one pitch")
    if keep_components is not None and keep_components < 1:
        raise VoxtoolError(f"{keep_components} components: keep 1 or more")
    holes = tuple(tuple(map(float, drain)) for drain in drains)
    check_walls(grid.pitch[0], float(offset), float(shell), float(thicken), holes)
    if not (math.isfinite(simplify) and simplify >= 0):
        raise VoxtoolError(f"simplify {simplify:g} is no length: give 0 or more")
    if simplify:
        check_library()
    device = device or default_device()
    device.require_float64("exact distances")
    request: dict[str, Any] = {"device": device, "max_memory": max_memory}
    if thicken:
        voxels = plan_voxelize(mesh, grid, "surface26", **request)
    else:
        voxels = plan_voxelize(mesh, grid, fill=fill, gap=gap, **request)
    plan = RepairPlan(
        voxels.plan, len(mesh.faces), grid.pitch[0], keep_components, float(offset), float(shell),
        float(thicken), holes, float(simplify),
    )  # fmt: skip
    return RepairJob(mesh, voxels, plan, device, max_memory)


class RepairJob(Job[Repaired]):
    """The planned repair of a mesh.

    Attributes
    ----------
    mesh : Mesh
        The mesh that is repaired.
    plan : RepairPlan
        The decisions.
    """

    plan: RepairPlan
    device: Device
    _doubts: Sequence[str] = ()

    def __init__(
        self,
        mesh: Mesh,
        voxels: VoxelizeJob,
        plan: RepairPlan,
        device: Device,
        max_memory: int | None,
    ) -> None:
        self.mesh, self._voxels = mesh, voxels
        self.plan, self.device, self.max_memory = plan, device, max_memory

    def _run(self) -> Repaired:
        plan, onto_mesh = self.plan, TriangleDistance(self.mesh, self.device)
        found = self._voxels.run()
        self._doubts = self._voxels.doubts(found)
        target = Level(onto_mesh, plan.thicken / 2)
        if plan.thicken:
            with self.stage("plate"):
                found = plate(found, onto_mesh, target.reach, self.device)
        octree, number = self._kept(found)
        fitted, simplified = self._fitted(octree, [target]), {}
        if plan.simplify and not (plan.offset or plan.shell):
            fitted, simplified = self._simplified(fitted)
        surface = fitted.surface.mesh()
        onto_surface = TriangleDistance(surface, self.device)
        with self.stage("distances"):
            distances = measure(surface, onto_surface, self.mesh, onto_mesh, octree)
        wall: dict[str, Any] = {}
        if plan.offset:
            octree, fitted = self._offset(octree, onto_surface)
        elif plan.shell:
            octree, fitted, wall = self._hollow(octree, fitted, onto_surface, target)
        if plan.simplify and not simplified:
            fitted, simplified = self._simplified(fitted)
        with self.stage("check"):
            checked = fitted.surface.check()
        checked["self_intersecting_faces"] = fitted.found.crossed
        checked["undecided_faces"] = fitted.found.undecided
        return Repaired(
            surface=fitted.surface,
            fill=found.fill,
            voxels=octree.count,
            components=number,
            on_target=int(np.count_nonzero(fitted.targets != NONE)),
            checked=checked,
            distances=distances,
            wall=wall,
            simplified=simplified,
        )

    def _fitted(self, octree: Octree, targets: Sequence[Target]) -> Fitted:
        """Return the surface of an octree, laid onto targets."""
        request = {"device": self.device, "max_memory": self.max_memory}
        return fit(plan_extract(octree, style=STYLE, **request).run(), targets, self.device)

    def _simplified(self, fitted: Fitted) -> tuple[Fitted, dict[str, Any]]:
        """Return the surface with fewer triangles, and the facts of its report."""
        with self.stage("simplify"):
            return simplify(fitted, self.plan.simplify, self.device)

    def _offset(self, octree: Octree, distance: TriangleDistance) -> tuple[Octree, Fitted]:
        """Return the octree and the surface at the offset from a surface."""
        reach = self.plan.offset
        with self.stage("offset"):
            change = within if reach > 0 else beyond
            moved = change(octree, distance, abs(reach), self.device)
        if not moved.count:
            raise VoxtoolError(f"offset {reach:g}: nothing is left: choose a smaller one")
        return moved, self._fitted(moved, [Level(distance, abs(reach))])

    def _hollow(
        self, octree: Octree, fitted: Fitted, distance: TriangleDistance, outer: Target
    ) -> tuple[Octree, Fitted, dict[str, Any]]:
        """Return the octree and the surface of a hollow solid, and what its wall is like."""
        wall, device, shells = self.plan.shell, self.device, _shells(fitted)
        with self.stage("cavities"):
            cavity, count = cavities(octree, distance, wall, device)
            if not count:
                raise VoxtoolError(
                    f"a wall of {wall:g} leaves no cavity: no part is thick enough: choose a "
                    "thinner wall"
                )
        with self.stage("drains"):
            surface = fitted.surface.mesh()
            drains = [
                drain_of(drain, wall, cavity, surface, distance, device)
                for drain in self.plan.drains
            ]
            holes = [hole for hole, _ in drains]
            gone = [cavity, *(voxels for _, voxels in drains)]
            hollow = combine([octree, *gone], "difference", device=device)
        fitted = self._fitted(hollow, [outer, Level(distance, wall), *holes])
        facts = {
            "wanted": wall,
            "thinnest": thinnest(fitted.surface, distance, wall, holes),
            "cavities": count,
            "closed": _shells(fitted) - shells,
        }
        return hollow, fitted, facts

    def _kept(self, octree: Octree) -> tuple[Octree, int]:
        """Return the components that are wanted, and how many there were, 0 if all are wanted."""
        if not octree.count:
            raise VoxtoolError(
                f"{self.mesh.name or 'mesh'}: no voxel of dim {octree.grid.dim} is inside by "
                f"{octree.fill}, so there is no surface: fill by flood, or choose a larger dim"
            )
        if self.plan.keep is None:
            return octree, 0
        chosen = plan_keep_components(octree, self.plan.keep)
        return chosen.run(), len(chosen.sizes)

    def details(self, result: Repaired) -> Iterator[str]:
        """Yield what was done."""
        away = len(result.vertices) - result.on_target
        yield from self._doubts
        filled = "" if self.plan.thicken else f"filled by {result.fill}; "
        moved = self.plan.offset or self.plan.shell or self.plan.thicken
        yield (
            f"{filled}{count_of(away, 'vertex')} of {len(result.vertices):,} away from the "
            f"{'distance asked' if moved else 'mesh'}: over holes, or where voxels are too coarse"
        )
        if result.components > (self.plan.keep or 0) > 0:
            dropped = result.components - (self.plan.keep or 0)
            yield f"{count_of(dropped, 'component')} of {result.components:,} dropped"
        if found := result.simplified:
            yield (
                f"simplified from {found['triangles_before']:,} triangles: moved by at most "
                f"{found['deviation']:.4g}, of {found['wanted']:.4g} allowed"
            )

    def doubts(self, result: Repaired) -> Sequence[str]:
        """Return remarks on what was decided to be inside."""
        return self._doubts

    def findings(self, result: Repaired) -> Iterator[str]:
        """Yield what is wrong with the result."""
        if result.faults:
            yield result.faults
        if self.plan.drains and result.wall["closed"] > 0:
            yield (
                f"{result.wall['closed']:,} of {count_of(result.wall['cavities'], 'cavity')} "
                "without a drain: add drains, or choose a thicker wall"
            )


def _shells(fitted: Fitted) -> int:
    """Return the number of shells of a surface."""
    a, b, c = fitted.surface.faces.T
    roots = components(np.append(a, b), np.append(b, c), len(fitted.surface.points))
    return len(np.unique(roots))
