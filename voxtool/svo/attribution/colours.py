"""Colours, normals and areas of surface voxels: a job that adds them to an octree.

The surface's part of each triangle in each voxel is found by clipping it to the voxel's closed
cube [Sutherland 1974]. A voxel's colour is the mean over these parts by area, in linear light; its
normal is the unit vector along the mean of the triangles' unit normals. Both are in float64 and
summed as whole numbers of 2^-32, so that the order of triangles does not show. A triangle in the
common side of two voxels counts by half in each. A voxel that the surface only touches has the
values of its lowest triangle. With "nearest", the colour is that of
the greatest part at its centroid, as texel, vertex and material have it.

The stages: the octree, by its own job; the surface, as mode surface26 has it; the pairs of a
triangle and a voxel, by scan conversion, once for all attributes; the values. Kernels:
kernels/svo/attribution/colours.cl.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from voxtool.choices import ATTRIBUTES, COLOURS
from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.job import Cost, Job
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Array, Device, program
from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.attributes import BITS, Attribute
from voxtool.svo.attribution.look import (
    NO_LOOK,
    check_look,
    look_arguments,
    look_bytes,
    texels_of,
)
from voxtool.svo.layout import BRICK
from voxtool.svo.octree import Octree
from voxtool.svo.plan import VoxelizePlan
from voxtool.svo.scan import SOURCE as SCAN
from voxtool.svo.scan import ActiveNodes, Scan, find_active_nodes
from voxtool.svo.voxelize import VoxelizeJob, plan_voxelize

SOURCE = "svo/attribution/colours.cl"
OPPOSED = 1 << 16  # a sum of normals shorter than this share of the area is 0
UNIT = 1 << 32  # of an area: that of a voxel's largest face
HEADERS = {"svo/attribution/colours.h": program.c_constants(OPPOSED=OPPOSED, UNIT=UNIT)}
NO_FACE = np.uint32(0xFFFFFFFF)
INSIDE_COLOUR = (128, 128, 128, 255)  # of set voxels that the surface does not meet
AREA_BYTES, COLOUR_BYTES, NORMAL_BYTES, INDEX_BYTES = 8, 36, 36, 8  # of a surface voxel
VALUES = {"colour": ((4,), np.uint8), "normal": ((3,), np.float32), "area": ((), np.float32)}
TARGETS = ("areas", "colour_sums", "normal_sums", "greatest", "faces_of")  # of a pass


@dataclass(frozen=True)
class AttributePlan:
    """The decisions on how colours and normals are found."""

    octree: Any  # the plan of the octree
    surface: VoxelizePlan  # of its surface
    names: tuple[str, ...]
    nearest: bool  # the colour of the greatest part, instead of the mean
    materials: int
    texels: int
    look: int  # bytes of the appearance
    shared: bool  # the octree's own scan serves: it is this surface

    @property
    def stages(self) -> list[str]:
        """The stages that will run, in order."""
        own = [] if self.shared else ["surface"]
        return [*self.octree.stages, *own, "attributes"]

    @property
    def values(self) -> int:
        """Predicted voxels of the surface."""
        return round(sum(self.surface.survey.areas)) + self.surface.survey.triangles

    @property
    def cost(self) -> Cost:
        """The predicted bytes."""
        of = {"colour": COLOUR_BYTES, "normal": NORMAL_BYTES, "area": AREA_BYTES}
        each = AREA_BYTES + INDEX_BYTES + sum(of[name] for name in self.names)
        inner, surface = self.octree.cost, self.surface.cost
        device = surface.device + each * self.values + self.look
        return Cost(
            device=max(inner.device, device),
            host=inner.host + 2 * each * self.values,
            largest=max(inner.largest, surface.largest, 32 * self.values, self.look),
        )

    @property
    def left_out(self) -> dict[str, str]:
        """What is not needed, and why."""
        out = dict(self.octree.left_out)
        if "colour" in self.names and not self.texels:
            out["textures"] = "no material has one"
        if "colour" not in self.names:
            out["colours"] = f"{' and '.join(self.names)} alone were asked for"
        if self.shared:
            out["a second scan of the surface"] = "the octree is the surface"
        return out

    def as_dict(self) -> dict[str, Any]:
        """All of the plan in JSON types."""
        return {
            **self.octree.as_dict(),
            **self.described(),
            "stages": self.stages,
            "left_out": self.left_out,
            "predicted_values": self.values,
            "predicted_device_bytes": self.cost.device,
        }

    def described(self) -> dict[str, Any]:
        """What is stored with the octree, in JSON types."""
        colour = {"colour": COLOURS[self.nearest]} if "colour" in self.names else {}
        counts = {"materials": self.materials, "texels": self.texels} if colour else {}
        return {"attributes": list(self.names), **colour, **counts}

    def rows(self) -> list[tuple[str, str]]:
        """Names and texts, which `--plan` prints before the stages."""
        text = ", ".join(self.names)
        if "colour" in self.names:
            rule = "of the greatest part" if self.nearest else "means by area"
            text += f"; colours are {rule}, of {self.materials:,} materials, {self.texels:,} texels"
        return [*self.octree.rows(), ("attributes", text)]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError if the job needs more bytes than these."""
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
    """A voxelization whose surface voxels have colours and normals."""

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
    ) -> None:
        self.inner, self.mesh = inner, mesh
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
        )

    def _surface(self, device: Device | None) -> VoxelizeJob:
        """Return the job of the surface on the grid of the octree."""
        inner: Any = self.inner
        more: dict[str, Any] = {"device": device or inner.device}
        grid = inner.grid  # of parts, which are not of a window
        if isinstance(inner, VoxelizeJob):
            grid, more["window"] = inner.whole, inner.window
        return plan_voxelize(
            self.mesh, grid, "surface26", every_face=True, max_memory=self.max_memory, **more
        )

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
        found: list[_Surface] = []
        if self.plan.shared:

            def keep(scan: Scan, active: ActiveNodes, bricks: Array) -> None:
                found.append(self._values(scan, active, bricks))

            inner = copy.copy(self.surface)
            inner.surface_found = keep
            octree = inner._run()
        else:
            octree = self.inner._run()
            scan = Scan(self.surface.lattice, self.surface.plan)
            self.device.prepare((SCAN, scan.options))
            with self.stage("surface"):
                active = find_active_nodes(scan)
                bricks = scan.surface(active)
            found.append(self._values(scan, active, bricks))
        (surface,) = found
        plan = {**octree.plan, **self.plan.described(), "stages": self.plan.stages}
        more = surface.attributes(octree)
        return replace(octree, attributes=(*octree.attributes, *more), plan=plan)

    def findings(self, result: Octree) -> Iterable[str]:
        """Warnings about the octree."""
        return self.inner.findings(result)

    def notes(self, result: Octree) -> Iterable[str]:
        """Remarks on the octree."""
        return self.inner.notes(result)

    def _inner_sides(self) -> tuple[list[int], list[int]]:
        """Return the first and last sides of voxels across each axis that two of them share, also
        with one outside the window."""
        low = self.surface.window[0] if self.surface.window else (0, 0, 0)
        shape = self.surface.whole.shape
        return [1 - a for a in low], [n - 1 - a for a, n in zip(low, shape, strict=True)]

    def _values(self, scan: Scan, active: ActiveNodes, bricks: Array) -> _Surface:
        """Return the values of all voxels in the bricks of the active nodes."""
        device, plan, count = self.device, self.plan, 16 * active.nodes.n
        device.prepare((SOURCE, scan.options))
        starts = device.empty(count + 1, np.uint32)
        scan.kernel(SCAN, "count_bits")(count, bricks, starts)
        n = exclusive_scan(starts, count)
        masks = bricks.get(0, 8 * active.nodes.n)
        found = {name: np.empty((0, *VALUES[name][0]), VALUES[name][1]) for name in plan.names}
        if n:
            coloured = "colour" in plan.names
            look: dict[str, Any] = look_arguments(self.mesh, device) if coloured else NO_LOOK
            work = _Work(scan, active, bricks, starts, n, look, *self._inner_sides())
            with self.stage("attributes"):
                found.update(work.values(plan.names, plan.nearest))
        codes = active.nodes.get().astype(np.uint64)
        return _Surface(codes, masks, found)


@dataclass
class _Work:
    """Launches the kernels of a surface."""

    scan: Scan
    active: ActiveNodes
    bricks: Array
    starts: Array
    n: int  # voxels
    look: dict[str, Any]
    inner_low: Sequence[int]  # the first side of voxels across each axis that two of them share
    inner_high: Sequence[int]  # and the last

    def values(self, names: Sequence[str], nearest: bool) -> dict[str, np.ndarray]:
        """Return the values of attributes, (n,) or (n, channels)."""
        device, n = self.scan.mesh.device, self.n
        nearest = nearest and "colour" in names
        sums: dict[str, Array] = {}
        if not nearest or len(names) > 1:
            sums["areas"] = device.zeros(n, np.uint64)
        if "colour" in names and not nearest:
            sums["colour_sums"] = device.zeros(4 * n, np.uint64)
        if "normal" in names:
            sums["normal_sums"] = device.zeros(3 * n, np.uint64)
        faces_of = device.put(np.full(n, NO_FACE))
        if nearest:
            greatest = device.zeros(n, np.uint32)
            self.add(**sums, greatest=greatest)
            self.add(greatest=greatest, faces_of=faces_of)
        else:
            self.add(**sums, faces_of=faces_of)
        values = {
            name: device.zeros(row[0] * n, dtype)
            for name, (row, dtype) in VALUES.items()
            if name in names and row
        }
        if values:
            self.finish(int(nearest), faces_of, sums, values)
        found = {name: array.take().reshape(n, -1) for name, array in values.items()}
        if "area" in names:
            unit = max(_face_areas(self.scan)) / UNIT
            found["area"] = (sums["areas"].get() * unit).astype(np.float32)
        return found

    def add(self, **targets: Array) -> None:
        """Visit the pairs of triangles and voxels."""
        shares, triangles = self.scan.shares(0)
        self.scan.kernel(SOURCE, "add_parts")(
            shares, **triangles, **self.active.lookup, **self.look, masks=self.bricks,
            starts=self.starts, scale=_scale(self.scan), inner_low=self.inner_low,
            inner_high=self.inner_high, **{**dict.fromkeys(TARGETS), **targets},
        )  # fmt: skip

    def finish(
        self, nearest: int, faces_of: Array, sums: dict[str, Array], values: dict[str, Array]
    ) -> None:
        """Turn sums into values."""
        mesh = self.scan.mesh
        self.scan.kernel(SOURCE, "finish_values")(
            16 * self.active.nodes.n, self.active.nodes.codes, self.bricks, self.starts,
            mesh.vertices, mesh.faces, **self.look, scale=_scale(self.scan), nearest=nearest,
            areas=sums.get("areas"), colour_sums=sums.get("colour_sums"),
            normal_sums=sums.get("normal_sums"), faces_of=faces_of,
            colour_values=values.get("colour"), normal_values=values.get("normal"),
        )  # fmt: skip


def _face_areas(scan: Scan) -> tuple[float, float, float]:
    """Return the areas of a voxel's faces across x, y and z, in world units."""
    x, y, z = scan.mesh.grid.pitch
    return y * z, z * x, x * y


def _scale(scan: Scan) -> tuple[float, float, float]:
    """Return what components of a cross product on the lattice are multiplied by, for a normal in
    world units: equal ones where voxels are cubes."""
    areas = _face_areas(scan)
    return tuple(one / max(areas) for one in areas)  # pyright: ignore[reportReturnType]


@dataclass(frozen=True)
class _Surface:
    """The values of a surface's voxels, by the level-1 nodes that it touches."""

    codes: np.ndarray  # (N,) uint64 Morton codes of the nodes
    masks: np.ndarray  # (8 N,) uint64: voxels of their bricks
    values: dict[str, np.ndarray]

    def attributes(self, octree: Octree) -> list[Attribute]:
        """Return the attributes of the octree's set voxels that the surface meets."""
        codes = octree.levels()[-1].codes
        own = (self.codes[:, None] * 8 + np.arange(8, dtype=np.uint64)).ravel()
        if np.array_equal(codes, own) and np.array_equal(octree.bricks, self.masks):
            held, chosen = None, slice(None)
        else:
            held, chosen = self._common(octree, codes, own)
        defaults = {"colour": INSIDE_COLOUR, "normal": (0, 0, 0), "area": 0}
        return [
            Attribute(name, values[chosen], values[:0], held, defaults[name])
            for name, values in self.values.items()
        ]

    def _common(
        self, octree: Octree, codes: np.ndarray, own: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the voxels of the octree's bricks that are the surface's, too, and which of its
        values these have."""
        held, kept = np.zeros(len(codes), BRICK), np.zeros(len(own), BRICK)
        if len(own):
            place = np.minimum(np.searchsorted(own, codes), len(own) - 1)
            both = own[place] == codes
            held[both] = octree.bricks[both] & self.masks[place[both]]
            kept[place[both]] = held[both]
        set_ = (self.masks[:, None] & BITS) != 0
        return held, ((kept[:, None] & BITS) != 0)[set_]
