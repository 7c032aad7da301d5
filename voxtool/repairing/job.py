"""Repair: any triangle mesh made closed, consistently wound and manifold.

The stages:

1. The fill rule decides which voxels of a grid are inside (svo/voxelize.py): that of `voxelize`,
   but for closed meshes "nonzero", which unites parts that overlap, and fills shells inside out.
2. Components that are not wanted are dropped (svo/components.py).
3. A surface net separates the voxels from the others: closed and manifold (svo/surface).
4. Its vertices move onto the mesh, where it passes their cells (fit.py).
5. The result is checked, and its distances to the mesh are measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.arrays import Data
from voxtool.errors import VoxtoolError, count_of
from voxtool.grid import Grid
from voxtool.job import Job
from voxtool.opencl import default_device
from voxtool.repairing.fit import fit_to_mesh
from voxtool.repairing.plan import STYLE, RepairPlan
from voxtool.spatial.deviation import deviation
from voxtool.spatial.self_intersections import UNDECIDED
from voxtool.svo.components import plan_keep_components
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.surface.isosurface import Isosurface
from voxtool.svo.voxelize import VoxelizeJob, plan_voxelize

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.svo.octree import Octree

UNITING = "nonzero"  # in place of parity, which cuts out where parts of a mesh overlap
SAMPLES = 100_000  # on each surface, for mean and RMS distances


@dataclass(frozen=True, eq=False, repr=False)
class Repaired(Data):
    """A closed, consistently wound, manifold mesh.

    Attributes
    ----------
    surface
        The mesh: a net whose vertices were moved.
    fill
        Rule that decided what is inside.
    voxels, components
        Set voxels whose surface it is; their connected components before any were dropped, 0 where
        they were not counted.
    on_mesh
        Vertices that lie on the input, within half a step of the lattice.
    checked
        Counts of edges and vertices, shells, genus, volume; whether it is closed; faces that
        others pass through, and those of which that is undecided.
    distances
        To the input and back: see voxtool.deviation.
    """

    surface: Isosurface
    fill: str
    voxels: int
    components: int
    on_mesh: int
    checked: dict[str, Any]
    distances: dict[str, Any]

    def __repr__(self) -> str:
        return (
            f"<Repaired mesh, {len(self.vertices):,} vertices, {len(self.faces):,} faces, "
            f"{count_of(self.checked['shells'], 'shell')}>"
        )

    @property
    def grid(self) -> Grid:
        """The grid of the voxels."""
        return self.surface.grid

    @property
    def units(self) -> str:
        """Name of the world unit if known, or ""."""
        return self.surface.units

    @cached_property
    def vertices(self) -> np.ndarray:
        """(V, 3) float64, world units."""
        return self.surface.vertices

    @property
    def faces(self) -> np.ndarray:
        """(F, 3) int32, triangles, counter-clockwise seen from outside."""
        return self.surface.faces

    @property
    def normals(self) -> np.ndarray:
        """(V, 3) float64: unit normals of the vertices."""
        return self.surface.normals

    @property
    def faults(self) -> str:
        """What keeps the result from being certified: "" for a closed manifold in which no face
        passes through another."""
        if not self.checked["closed"]:
            return "the result is not closed and manifold: report this mesh"
        crossed = self.checked["self_intersecting_faces"] + self.checked["undecided_faces"]
        if crossed:
            return (
                f"{count_of(crossed, 'face')} of {len(self.faces)} may pass through others: choose "
                "another dim"
            )
        return ""

    def mesh(self) -> Mesh:
        """Return the result as a triangle mesh in world units."""
        return self.surface.mesh()

    def digest(self) -> str:
        """Return the SHA-256 of the surface; see Isosurface.digest."""
        return self.surface.digest()


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
    device: Device | None = None,
    max_memory: int | None = None,
) -> RepairJob:
    """Return the planned job of `repair`; see `voxtool.repair`."""
    if len(set(grid.pitch)) > 1:
        raise VoxtoolError(f"voxels of {grid.pitch}: repair needs cubes: give one pitch")
    if keep_components is not None and keep_components < 1:
        raise VoxtoolError(f"{keep_components} components: keep 1 or more")
    device = device or default_device()
    device.require_float64("exact distances")
    request = {"gap": gap, "device": device, "max_memory": max_memory}
    voxels = plan_voxelize(mesh, grid, fill=fill, **request)
    if fill == "auto" and voxels.plan.fill == "parity":
        voxels = plan_voxelize(mesh, grid, fill=UNITING, **request)
    plan = RepairPlan(voxels.plan, len(mesh.faces), grid.pitch[0], keep_components)
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
        octree = self._voxels.run()
        kept, components = self._kept(octree)
        if not kept.count:
            raise VoxtoolError(
                f"{self.mesh.name or 'mesh'}: no voxel of dim {kept.grid.dim} is inside by "
                f"{octree.fill}, so there is no surface: fill by flood, or choose a larger dim"
            )
        net = plan_extract(kept, style=STYLE, device=self.device, max_memory=self.max_memory).run()
        fitted = fit_to_mesh(net, self.mesh, self.device)
        with self.stage("check"):
            checked = fitted.surface.check()
        crossed, undecided = (int(np.count_nonzero(fitted.crossed == n)) for n in (1, UNDECIDED))
        with self.stage("distances"):
            distances = deviation(
                fitted.surface.mesh(), self.mesh, SAMPLES, self.plan.pitch, self.device
            )
        return Repaired(
            surface=fitted.surface,
            fill=octree.fill,
            voxels=kept.count,
            components=components,
            on_mesh=int(np.count_nonzero(fitted.on_mesh)),
            checked={
                **checked, "self_intersecting_faces": crossed, "undecided_faces": undecided,
            },
            distances=distances,
        )  # fmt: skip

    def _kept(self, octree: Octree) -> tuple[Octree, int]:
        """Return the components that are wanted, and how many there were."""
        if self.plan.keep is None:
            return octree, 0
        chosen = plan_keep_components(octree, self.plan.keep)
        return chosen.run(), len(chosen.sizes)

    def notes(self, result: Repaired) -> Iterator[str]:
        """Yield what was done."""
        away = len(result.vertices) - result.on_mesh
        yield (
            f"filled by {result.fill}; {count_of(away, 'vertex')} of {len(result.vertices)} away "
            "from the mesh: over holes, or where voxels are too coarse for it"
        )
        if result.components > (self.plan.keep or 0) > 0:
            dropped = result.components - (self.plan.keep or 0)
            yield f"{count_of(dropped, 'component')} of {result.components} dropped"

    def findings(self, result: Repaired) -> Iterator[str]:
        """Yield what is wrong with the result."""
        if result.faults:
            yield result.faults
