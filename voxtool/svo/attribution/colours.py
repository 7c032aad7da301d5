"""Colours, normals and areas of surface voxels: a job that adds them to an octree.

The surface's part of each triangle in each voxel is found by clipping it to the voxel's closed
cube [Sutherland 1974]. A voxel's colour is the mean over these parts by area, in linear light; its
normal is the unit vector along the mean of the triangles' unit normals. Both are in float64 and
summed as whole numbers of 2^-32, so that the order of triangles does not show. A triangle in the
common side of two voxels counts by half in each. A voxel that the surface only touches has the
values of its lowest triangle. With "nearest", the colour is that of the greatest part at its
centroid, as texel, vertex and material have it.

Exposed voxels of a solid that the surface does not meet have the colour and the normal of its
nearest point (exposed.py).

The stages: the octree, by its own job; the surface, as mode surface26 has it; the pairs of a
triangle and a voxel, by scan conversion, once for all attributes; the values (surface_pass.py); the
exposed voxels of a solid.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from voxtool.choices import ATTRIBUTES, COLOURS
from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.job import Cost, Job, Plan
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Array, Device
from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.attribution.exposed import (
    UNSEEN,
    Bricks,
    exposed_bytes,
    exposed_voxels,
    with_exposed,
)
from voxtool.svo.attribution.materials import (
    NO_LOOK,
    check_look,
    look_arguments,
    look_bytes,
    texels_of,
)
from voxtool.svo.attribution.nearest_surface import (
    NearestSurface,
    placed_bytes,
    programs,
    search_bytes,
)
from voxtool.svo.attribution.surface_pass import SOURCE, VALUES, Pass, SurfaceValues, without_values
from voxtool.svo.octree.layout import BRICK_BYTES, NODE_BYTES
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.plan import VoxelizePlan
from voxtool.svo.voxelization.scan_conversion import SOURCE as SCAN
from voxtool.svo.voxelization.scan_conversion import ActiveNodes, Scan, find_active_nodes
from voxtool.svo.voxelization.voxelize import VoxelizeJob, plan_voxelize

AREA_BYTES, COLOUR_BYTES, NORMAL_BYTES, INDEX_BYTES = 8, 36, 36, 8  # of a surface voxel
EXPOSED = "exposed voxels"  # a stage


@dataclass(frozen=True)
class AttributePlan(Plan):
    """The decisions on how colours and normals are found."""

    facts = ()
    predicted = ("values",)

    octree: Any  # the plan of the octree
    surface: VoxelizePlan  # of its surface
    names: tuple[str, ...]
    nearest: bool  # the colour of the greatest part, instead of the mean
    materials: int
    texels: int
    look: int  # bytes of the appearance
    shared: bool  # the octree's own scan serves: it is this surface
    exposed: bool  # voxels that the surface does not meet may be exposed, and have values

    @property
    def stages(self) -> list[str]:
        own = [] if self.shared else ["surface"]
        return [*self.octree.stages, *own, "attributes", *[EXPOSED] * self.exposed]

    @property
    def values(self) -> int:
        """Predicted voxels of the surface."""
        return round(sum(self.surface.survey.areas)) + self.surface.survey.triangles

    @property
    def nodes(self) -> int:
        """Predicted number of nodes."""
        return self.octree.nodes

    @property
    def bricks(self) -> int:
        """Predicted number of bricks."""
        return self.octree.bricks

    @property
    def stored_values(self) -> int:
        """Predicted bytes of the attributes in a file, with their masks."""
        each = sum(without_values(name).blank.nbytes for name in self.names)
        masks = BRICK_BYTES * self.bricks * len(self.names)
        return getattr(self.octree, "stored_values", 0) + each * self.values + masks

    @property
    def waiting(self) -> int:
        """Predicted bytes of the octree on the disk, from which windows are completed."""
        return (NODE_BYTES * self.nodes + BRICK_BYTES * self.bricks) * self.exposed

    @property
    def cost(self) -> Cost:
        of = {"colour": COLOUR_BYTES, "normal": NORMAL_BYTES, "area": AREA_BYTES}
        each = AREA_BYTES + INDEX_BYTES + sum(of[name] for name in self.names)
        inner, surface = self.octree.cost, self.surface.cost
        device = surface.device + each * self.values + self.look
        search = eroded = placed = 0
        if self.exposed:
            triangles = self.surface.survey.triangles
            search = search_bytes(triangles, self.values) + self.look
            eroded, placed = exposed_bytes(self.bricks), placed_bytes(triangles)
        return Cost(
            device=max(inner.device, device, search, eroded),
            host=inner.host + 2 * each * self.values + eroded + placed,
            largest=max(inner.largest, surface.largest, 32 * self.values, self.look),
        )

    @property
    def reasons(self) -> dict[str, str]:
        coloured, solid = "colour" in self.names, "solid" in self.octree.mode
        alone = f"{' and '.join(self.names)} alone were asked for"
        why = "areas are where the surface is" if solid else "the surface meets every voxel"
        return {
            **self.octree.left_out,
            "textures": "no material has one" if coloured and not self.texels else "",
            "colours": "" if coloured else alone,
            "a second scan of the surface": "the octree is the surface" if self.shared else "",
            "values of exposed voxels": "" if self.exposed else why,
        }

    def as_dict(self) -> dict[str, Any]:
        return {**self.octree.as_dict(), **self.described(), **super().as_dict()}

    def described(self) -> dict[str, Any]:
        """The part of the plan that is stored with the octree, in JSON types."""
        colour = {"colour": COLOURS[self.nearest]} if "colour" in self.names else {}
        counts = {"materials": self.materials, "texels": self.texels} if colour else {}
        return {"attributes": list(self.names), **colour, **counts}

    def rows(self) -> list[tuple[str, str]]:
        text = ", ".join(self.names)
        if "colour" in self.names:
            rule = "of the greatest part" if self.nearest else "means by area"
            text += f"; colours are {rule}, of {self.materials:,} materials, {self.texels:,} texels"
        rows = [*self.octree.rows(), ("attributes", text)]
        if self.exposed:
            rows.append(("exposed", "where the surface does not meet them, of its nearest point"))
        return rows

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        self.octree.refuse_beyond(max_memory, max_allocation)
        if shortage := self.cost.shortage(max_memory, max_allocation):
            raise MemoryLimitError(
                f"{' and '.join(self.names)} of about {self.values:,} surface voxels {shortage}: "
                "choose a smaller dim, or fewer attributes"
            )


def plan_attributes(
    inner: Job[Octree],
    mesh: Mesh,
    names: Sequence[str],
    *,
    colour: str = COLOURS[0],
    device: Device | None = None,
    max_memory: int | None = None,
) -> SurfaceAttributesJob:
    """Return the job that adds attributes of the surface to the octree of another job.

    Parameters
    ----------
    inner : Job
        Makes the octree.
    mesh : Mesh
        The mesh that it voxelizes; with an appearance for colours.
    names : sequence of str
        Of ATTRIBUTES.
    colour : str
        One of COLOURS.

    Raises
    ------
    VoxtoolError
        If a name is unknown, or given twice.
    MeshError
        If colours are asked for and the mesh has none.
    """
    unknown = [name for name in names if name not in ATTRIBUTES]
    if unknown or len(set(names)) < len(names) or not names:
        raise VoxtoolError(
            f"attributes {', '.join(names)!r}: give one or more of {', '.join(ATTRIBUTES)}, each "
            "once"
        )
    if colour not in COLOURS:
        raise VoxtoolError(f"colour {colour!r} is unknown: choose one of {', '.join(COLOURS)}")
    return SurfaceAttributesJob(inner, mesh, tuple(names), colour, device, max_memory)


class SurfaceAttributesJob(Job[Octree]):
    """A voxelization whose surface voxels have colours and normals.

    Attributes
    ----------
    alone : bool
        What lies around the window is not known, so that exposed voxels get no values.
    """

    device: Device
    plan: AttributePlan
    surface: VoxelizeJob

    def __init__(
        self,
        inner: Job[Octree],
        mesh: Mesh,
        names: tuple[str, ...],
        colour: str,
        device: Device | None,
        max_memory: int | None,
        *,
        alone: bool = False,
    ) -> None:
        self.inner, self.mesh, self.alone = inner, mesh, alone
        self.max_memory = inner.max_memory if max_memory is None else max_memory
        coloured = "colour" in names
        look = check_look(mesh) if coloured else None
        whole = isinstance(inner, VoxelizeJob) and inner.is_whole_surface
        self.surface = self._surface(device) if not whole else inner  # pyright: ignore[reportAttributeAccessIssue]
        self.device = self.surface.device
        self.plan = AttributePlan(
            inner.plan,
            self.surface.plan,
            names,
            coloured and colour == COLOURS[1],
            len(look.materials) if look else 0,
            texels_of(look) if look else 0,
            look_bytes(mesh) if coloured else 0,
            whole,
            "solid" in inner.plan.mode and set(names) != {UNSEEN},
        )

    def _surface(self, device: Device | None) -> VoxelizeJob:
        """Return the job of the surface on the grid of the octree."""
        inner: Any = self.inner
        more = {"device": device or inner.device, "max_memory": self.max_memory}
        place = {"grid": inner.whole, "window": inner.window}
        return plan_voxelize(self.mesh, mode="surface26", every_face=True, **place, **more)

    def with_(self, **decisions: Any) -> SurfaceAttributesJob:
        """Return the job with decisions of its plan, or of those inside it, forced."""
        job = copy.copy(self)
        own = {f.name for f in fields(AttributePlan)} - {"octree", "surface"}
        mine = {name: value for name, value in decisions.items() if name in own}
        others = {name: value for name, value in decisions.items() if name not in own}
        if others:
            job.inner = self.inner.with_(**others)
            shared = job.plan.shared
            job.surface = job.inner if shared else self.surface.with_(**others)  # pyright: ignore[reportAttributeAccessIssue]
        job.plan = replace(self.plan, octree=job.inner.plan, surface=job.surface.plan, **mine)
        return job

    def _run(self) -> Octree:
        if self.plan.shared:
            found: list[SurfaceValues] = []

            def keep(scan: Scan, active: ActiveNodes, bricks: Array) -> None:
                found.append(self._values(scan, active, bricks))

            inner = copy.copy(self.surface)
            inner.surface_found = keep
            octree = inner._run()
            (surface,) = found
        else:
            octree, surface = self.inner._run(), self.surface_values()
        plan = self.scene(octree.plan)
        more = surface.attributes(octree.levels()[-1].codes, octree.bricks)
        octree = replace(octree, attributes=(*octree.attributes, *more), plan=plan)
        if not self.plan.exposed or self.alone:
            return octree
        with self.stage(EXPOSED):
            low = np.array(self.surface.window[0] if self.surface.window else (0, 0, 0))
            return with_exposed(octree, self._exposed(octree), self.whole_surface, low, self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """The attributes of the surface."""
        return self.plan.names

    @property
    def whole_surface(self) -> NearestSurface:
        """The surface, of whose nearest points voxels take values."""
        place = self.device, self.max_memory
        return NearestSurface(self.mesh, self.surface.whole, self.plan.nearest, *place)

    def _exposed(self, octree: Octree) -> Bricks:
        """Return the exposed voxels; those of a window also depend on the voxels around it."""
        inner: Any = self.inner
        low, shape = np.zeros(3, np.int64), np.array(octree.grid.shape)
        if self.surface.window:
            begin = np.maximum(np.array(self.surface.window[0]) - 1, 0)
            low = self.surface.window[0] - begin
            end = np.minimum(begin + low + shape + 1, self.surface.whole.shape)
            octree = inner.within((begin.tolist(), (end - begin).tolist()))._run()
        return exposed_voxels(octree, low, shape, self.device, self.max_memory)

    def surface_values(self) -> SurfaceValues:
        """Return the values of the surface's voxels, by a pass of its own."""
        scan = Scan(self.surface.lattice, self.surface.plan)
        self.device.prepare((SCAN, scan.options))
        with self.stage("surface"):
            active = find_active_nodes(scan)
            bricks = scan.surface(active)
        return self._values(scan, active, bricks)

    def scene(self, inner: dict[str, Any]) -> dict[str, Any]:
        """Return the plan that is stored with the octree, in JSON types, of that which is stored
        without attributes."""
        return {**inner, **self.plan.described(), "stages": self.plan.stages}

    def findings(self, result: Octree) -> Iterable[str]:
        """Return warnings about the octree."""
        return self.inner.findings(result)

    def notes(self, result: Octree) -> Iterable[str]:
        """Return remarks on the octree."""
        return self.inner.notes(result)

    def doubts(self, result: Octree) -> Iterable[str]:
        """Return remarks on what was decided to be inside."""
        return self.inner.doubts(result)

    def _inner_sides(self) -> tuple[list[int], list[int]]:
        """Return the first and last sides of voxels across each axis that two of them share, also
        with one outside the window."""
        low = self.surface.window[0] if self.surface.window else (0, 0, 0)
        shape = self.surface.whole.shape
        return [1 - a for a in low], [n - 1 - a for a, n in zip(low, shape, strict=True)]

    def _values(self, scan: Scan, active: ActiveNodes, bricks: Array) -> SurfaceValues:
        """Return the values of all voxels in the bricks of the active nodes."""
        device, plan, count = self.device, self.plan, 16 * active.nodes.n
        device.prepare((SOURCE, scan.options))
        if plan.exposed and not self.alone:
            device.prepare(*programs(device, plan.values // 2))
        starts = device.empty(count + 1, np.uint32)
        scan.kernel(SCAN, "count_bits")(count, bricks, starts)
        n = exclusive_scan(starts, count)
        masks = bricks.get(0, 8 * active.nodes.n)
        found = {name: np.empty((0, *VALUES[name][0]), VALUES[name][1]) for name in plan.names}
        if n:
            coloured = "colour" in plan.names
            look: dict[str, Any] = look_arguments(self.mesh, device) if coloured else NO_LOOK
            work = Pass(scan, active, bricks, starts, n, look, *self._inner_sides())
            with self.stage("attributes"):
                found.update(work.values(plan.names, plan.nearest))
        codes = active.nodes.get().astype(np.uint64)
        return SurfaceValues(codes, masks, found)
