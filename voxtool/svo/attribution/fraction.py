"""The share of each voxel that lies inside a mesh, which is rounded to the finest lattice.

Along a row of voxels, towards high x, triangles begin and end the inside. By the divergence
theorem, the volume of a voxel that is inside is the sum, over the parts of triangles in it, of the
volumes between them and its high-x side, and the sum of the areas, across x, of the parts before
it. Both have signs, and the areas of a closed mesh add up to whole faces wherever a voxel is not
touched.

The stages, on the device, after those of the solid, whose fill rule decides about voxels that no
triangle touches:

1. Touched voxels: those of the 26-separating surface, numbered in the order of the bits.
2. Parts: each triangle is clipped to columns of voxels, and its part in a column to the voxels
   there. Integers decide what lies where, and corners are rounded once, to float64. Area and volume
   are rounded to 2**-40 and added in integers.
3. Sums along rows (fraction_rows.py): each gives the volumes of its touched voxels, rounded to
   2**-31; on request rows along x, y and z give the areas of their faces, too.

Holes of an open mesh are closed by the caps of fill/caps.py, which count as its faces.

Kernels: kernels/svo/attribution/fraction.cl; docs/fractions.md has the bound.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np

from voxtool.choices import FILLS, FRACTION_TYPES
from voxtool.errors import MeshError, VoxtoolError, count_of
from voxtool.grid import Grid
from voxtool.job import Cost, Job, Plan
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import volume
from voxtool.opencl import Array, Device
from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.attribution.fraction_rows import FACES, Parts, Shares, sum_rows
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.exact_sums import whole_sum
from voxtool.svo.octree.layout import BRICK, BRICK_BYTES
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.stored_volume import WHOLE
from voxtool.svo.voxelization.plan import VoxelizePlan
from voxtool.svo.voxelization.scan_conversion import (
    COVERED,
    MET,
    TOUCHED,
    ActiveNodes,
    Scan,
    add_nodes,
)
from voxtool.svo.voxelization.scan_conversion import SOURCE as SCAN
from voxtool.svo.voxelization.voxelize import VoxelizeJob, Window, plan_voxelize

SOURCE = "svo/attribution/fraction.cl"
TYPES = {kind: np.dtype(f"<{kind}") for kind in FRACTION_TYPES}
MODE = "solid+fraction"  # of the octree
# in the plan that is stored
MESH_VOLUME, LATTICE_VOLUME, LATTICE_BITS = (
    "mesh_volume_voxels", "lattice_volume_voxels", "lattice_bits",
)  # fmt: skip
VOXEL_BYTES = 4 * 4 + 4  # bytes of a touched voxel: its sums and its share
FACE_BYTES = 4 * 4 + 4 * FACES  # more with faces: sums across y and z, and the shares of faces


def plan_fractions(
    mesh: Mesh,
    grid: Grid,
    *,
    fill: str = FILLS[0],
    kind: str = FRACTION_TYPES[0],
    faces: bool = False,
    bits: int | None = None,
    window: Window | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> FractionJob:
    """Return the planned job of an octree with fractions; see `voxtool.voxelize`.

    The lattice is of 2**-bits voxel: by default the finest one for the mesh and the grid. Parts of
    a mesh are given that of the whole.
    """
    check_type(kind)
    if bits is None:
        bits = grid.finest_bits(mesh.bounds)
    options: dict[str, Any] = {"window": window, "device": device, "max_memory": max_memory}
    solid = plan_voxelize(mesh, grid, "solid", fill=fill, bits=bits, **options)
    solid.settle()
    if solid.plan.fill == "flood":
        why = f" ({solid.inside.why})" if solid.inside else ""
        raise MeshError(
            f"{mesh.name or 'mesh'}: a flood fills whole voxels{why}, so there are no fractions: "
            "repair the mesh (voxtool repair), or choose fill winding, nonzero or parity"
        )
    solid.device.require_float64("fractions")
    caps = (solid.plan.holes, solid.plan.caps)
    y, z = (bool((solid.lattice.fixed[:, axis] < 0).any()) for axis in (1, 2))
    return FractionJob(solid.capped(), FractionPlan(solid.plan, kind, caps, faces, (y, z)))


def check_type(kind: str) -> None:
    """Raise VoxtoolError if there is no such type of fractions."""
    if kind not in TYPES:
        raise VoxtoolError(f"fraction type {kind!r} is unknown: choose one of {', '.join(TYPES)}")


def lattice_row(bits: int) -> tuple[str, str]:
    """Return the name and the text of the row that `--plan` prints of a lattice."""
    return "lattice", f"vertices are rounded to 2^-{bits} of a voxel"


def volume_in_units(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Return six times the signed volume of a closed mesh of (V, 3) int32 vertices, exactly."""
    if not len(faces):
        return 0
    low = vertices[faces[0, 0]].astype(np.int64)
    a, b, c = (vertices[corners].astype(np.int64) - low for corners in faces.T)
    total = 0
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        term = b[:, j] * c[:, k] - b[:, k] * c[:, j]
        total += whole_sum(a[:, i] * (term >> 31)) << 31
        total += whole_sum(a[:, i] * (term & 0x7FFFFFFF))
    return total


class Volumes(NamedTuple):
    """Signed volumes of a mesh, in voxels.

    lattice : with its vertices on the lattice, the exact number rounded once
    mesh : with its vertices as they are, in float64
    """

    lattice: float
    mesh: float


@dataclass(frozen=True)
class FractionPlan(Plan):
    """The decisions of an octree with fractions: those of its solid, and the type of values."""

    facts = ("fraction_type: kind", "face_fractions: faces", f"{LATTICE_BITS}: solid.bits")
    predicted = ("touched_voxels: touched",)

    solid: VoxelizePlan
    kind: str
    caps: tuple[int, int] = (0, 0)  # holes that were closed, and the triangles that close them
    faces: bool = False  # whether faces of voxels have shares, too
    before: tuple[bool, bool] = (False, False)  # along y and z: vertices lie before the grid

    @property
    def stages(self) -> list[str]:
        return [*self.solid.stages, "touched voxels", "parts", "sums along rows", "fractions"]

    @property
    def reasons(self) -> dict[str, str]:
        return {
            **self.solid.left_out,
            "surface voxels": "",
            "values of whole voxels": "only cut voxels store one",
            "faces of voxels": "" if self.faces else "no shares of theirs are asked for",
        }

    @property
    def nodes(self) -> int:
        """Predicted number of nodes."""
        return self.solid.nodes

    @property
    def bricks(self) -> int:
        """Predicted number of bricks."""
        return self.solid.bricks

    @property
    def stored_values(self) -> int:
        """Predicted bytes of the fractions in a file, with their masks."""
        numbers = 1 + FACES * self.faces
        masks = BRICK_BYTES * self.bricks * (1 + self.faces)
        return numbers * TYPES[self.kind].itemsize * self.touched + masks

    @property
    def touched(self) -> int:
        """Predicted number of voxels that triangles touch."""
        return round(sum(self.solid.survey.areas)) + self.solid.survey.triangles

    @property
    def cost(self) -> Cost:
        """The predicted bytes: those of the solid, and of its touched voxels."""
        solid, bricks = self.solid.cost, self.solid.bricks
        entry = 8 * self.solid.shape[1] * self.solid.shape[2] * self.solid.entry
        masks = (8 + 8 + 8 + 8) * bricks  # touched, their numbers, partial, and the solid's
        numbers, voxel = 1, VOXEL_BYTES
        if self.faces:
            x, y, z = self.solid.shape
            entry += 8 * x * (z * self.before[0] + y * self.before[1])
            masks, numbers, voxel = masks + 8 * bricks, 1 + FACES, voxel + FACE_BYTES
        value = 4 + TYPES[self.kind].itemsize
        return Cost(
            device=max(solid.device, solid.host + masks + voxel * self.touched + entry),
            host=solid.host + 8 * (1 + self.faces) * bricks + numbers * value * self.touched,
            largest=max(solid.largest, 4 * max(4, FACES * self.faces) * self.touched, entry),
        )

    def as_dict(self) -> dict[str, Any]:
        return {**self.solid.as_dict(), **super().as_dict()}

    def scene(self) -> dict[str, Any]:
        """The part of the plan that is stored in the octree, in JSON types."""
        own = {"stages": self.stages, "left_out": self.left_out, LATTICE_BITS: self.solid.bits}
        return {**self.solid.scene(), **own}

    def rows(self) -> list[tuple[str, str]]:
        what = "of voxels and their faces, " * self.faces
        fractions = f"{what}of type {self.kind}, about {self.touched:,} voxels that triangles touch"
        caps = [("caps", self.closing)] if self.caps[1] else []
        own = [("fractions", fractions), lattice_row(self.solid.bits)]
        return [*self.solid.rows(), *caps, *own]

    @property
    def closing(self) -> str:
        """The holes and the triangles that close them, in words."""
        holes, caps = self.caps
        return f"{count_of(holes, 'hole')} closed by {count_of(caps, 'cap triangle')}"

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        self.solid.refuse_beyond(
            max_memory, max_allocation, lambda solid: replace(self, solid=solid).cost
        )


class FractionJob(Job[Octree]):
    """The voxelization of a mesh into fractions, surveyed and planned.

    Attributes
    ----------
    solid : VoxelizeJob
        The job of the solid, whose octree has the same nodes.
    """

    plan: FractionPlan
    device: Device

    def __init__(self, solid: VoxelizeJob, plan: FractionPlan) -> None:
        self.solid, self.device, self.max_memory = solid, solid.device, solid.max_memory
        self.plan = replace(plan, solid=solid.plan)
        self.disagreements = 0  # known once it has run

    @property
    def grid(self) -> Grid:
        """The grid of the octree."""
        return self.solid.grid

    @property
    def mesh(self) -> Mesh:
        """The mesh, whose faces are turned where the fill rule needs it."""
        return self.solid.mesh

    def with_(self, **decisions: Any) -> Self:
        """Return a copy of the job with fields of its plan, or of its solid's, replaced."""
        job = copy.copy(self)
        vars(job).pop("volumes", None)  # which depend on the caps
        own = {"kind": decisions.pop("kind")} if "kind" in decisions else {}
        job.solid = self.solid.with_(**decisions)
        job.plan = replace(self.plan, solid=job.solid.plan, **own)
        return job

    def _run(self) -> Octree:
        solid, found = self.shares()
        with self.stage("fractions"):
            attributes = attributes_of(found, self.plan.kind)
        plan = self.scene()
        return replace(solid, mode=MODE, plan=plan, bricks=found.bricks, attributes=attributes)

    def scene(self) -> dict[str, Any]:
        """Return the plan that is stored with the octree, in JSON types."""
        lattice, mesh = self.volumes
        return {**self.plan.scene(), MESH_VOLUME: mesh, LATTICE_VOLUME: lattice}

    def shares(self, axis_alone: int | None = None) -> tuple[Octree, Shares]:
        """Return the octree of the solid, and what lies inside of the voxels that triangles touch;
        with `axis_alone` by rows along this axis alone."""
        plan = replace(self.plan.solid, addressing="ranks")
        solid, scan = self.solid.solid_octree(), Scan(self.solid.lattice, plan)
        level = solid.levels(finest=1)[-1]
        active = add_nodes(scan, level.codes[level.refined])
        with self.stage("touched voxels"):
            touched, firsts, count = _touched(scan, active)
        with self.stage("parts"):
            turned = self.volumes.lattice < 0 and plan.fill != "winding"
            parts = _add_parts(scan, active, touched, firsts, count, turned, self.plan.faces)
        with self.stage("sums along rows"):
            found = sum_rows(self.device, solid, plan.shape, parts, scan.options, axis_alone)
        self.disagreements = found.disagreements
        return solid, found

    @cached_property
    def volumes(self) -> Volumes:
        """The signed volumes of the whole mesh, caps included, also for a window."""
        lattice = self.solid.lattice
        faces = lattice.faces.get(0, lattice.faces.size).reshape(-1, 3)
        rounded = volume_in_units(lattice.fixed, faces) / (6 << 3 * lattice.bits)
        unrounded = volume(Mesh(self.mesh.vertices, faces)) / self.grid.voxel_volume
        return Volumes(rounded, unrounded)

    def findings(self, result: Octree) -> Iterator[str]:
        """Yield warnings: the surface does not bound what the fill rule says, or nothing is set."""
        yield from self.solid.findings(result)
        yield from self.wrong()

    def wrong(self) -> Iterator[str]:
        """Yield a warning if the surface does not bound what the fill rule says."""
        if self.disagreements:
            places = count_of(self.disagreements, "place")
            yield (
                f"{self._name}: at {places} along rows the faces do not bound "
                f"what {self.plan.solid.rule} fills, so fractions before them may be wrong: see "
                "voxtool diagnose, or repair the mesh"
            )

    def notes(self, result: Octree) -> list[str]:
        """Return lines about an open mesh; they are not warnings."""
        notes = self.solid.notes(result)
        if not self.plan.caps[1]:
            return notes
        doubts = self.doubts(result)
        summary = doubts[0] if doubts else "".join(notes).partition("; ")[0]
        return [f"{summary or self._name}; {self.plan.closing}"]

    def doubts(self, result: Octree) -> list[str]:
        """Return remarks on what was decided to be inside."""
        return self.solid.doubts(result)

    @property
    def _name(self) -> str:
        return self.solid.mesh.name or "mesh"


def without_values(kind: str, *, faces: bool) -> tuple[Attribute, ...]:
    """Return the attributes of an octree with fractions, without values."""
    none = np.empty(0, np.uint32)
    masks, shares = np.empty(0, BRICK), np.empty((0, FACES), np.uint32) if faces else None
    return attributes_of(Shares(masks, masks, masks, none, shares, masks, 0), kind)


def attributes_of(found: Shares, kind: str) -> tuple[Attribute, ...]:
    """Return the fractions of voxels, and of their faces if there are any."""
    whole = values_of(np.array([WHOLE], np.uint32), kind)[0].item()
    values = values_of(found.voxels[(found.voxels > 0) & (found.voxels < WHOLE)], kind)
    fraction = Attribute("fraction", values, values[:0], found.partial, whole)
    if found.faces is None:
        return (fraction,)
    kept = found.faces[(found.voxels > 0) & (found.faces != WHOLE).any(axis=1)]
    values = values_of(kept, kind)
    return fraction, Attribute("faces", values, values[:0], found.cut, (whole,) * FACES)


def values_of(shares: np.ndarray, kind: str) -> np.ndarray:
    """Return shares of 1 / WHOLE as values of a type, rounded to the nearest."""
    dtype = TYPES[kind]
    if dtype.kind == "f":
        return (shares / WHOLE).astype(dtype)
    most = np.iinfo(dtype).max
    return (
        (shares.astype(np.uint64) * np.uint64(most) + np.uint64(WHOLE // 2)) // np.uint64(WHOLE)
    ).astype(dtype)


def _touched(scan: Scan, active: ActiveNodes) -> tuple[Array, Array, int]:
    """Return the masks of the voxels that triangles touch, brick by brick, the numbers of such
    voxels before each half of a brick, and the number of all."""
    touched = scan.device.zeros(8 * active.nodes.n, BRICK)
    scan.set_boxes(TOUCHED, {**active.lookup, "target": touched})
    halves = 2 * touched.size
    firsts = scan.device.empty(halves + 1, np.uint32)
    scan.kernel(SCAN, "count_bits")(halves, touched, firsts)
    return touched, firsts, exclusive_scan(firsts, halves)


def _add_parts(
    scan: Scan,
    active: ActiveNodes,
    touched: Array,
    firsts: Array,
    count: int,
    turned: bool,
    faces: bool,
) -> Parts:
    """Return the sums of the parts of triangles in each touched voxel; `turned` says that the mesh
    is inside out, and `faces` that areas across y and z are summed, too."""
    device, plan, kind = scan.device, scan.plan, MET if faces else COVERED
    sums = device.zeros(2 * count, np.int64)
    across = device.zeros(2 * count, np.int64) if faces else None
    given = {"kind": kind, "turned": int(turned), "touched": touched, "firsts": firsts}

    def add(scan: Scan, entry: Array | None, across: Array | None) -> None:
        n, triangles = scan.shares(kind)
        scan.kernel(SOURCE, "add_parts")(
            n, sums=sums, across=across, entry=entry, **given, **triangles, **active.lookup
        )

    def rows(axis: int) -> Array:
        return device.zeros(plan.shape[(axis + 1) % 3] * plan.shape[(axis + 2) % 3], np.int64)

    entry = rows(0) if plan.entry else None
    add(scan, entry, across)
    entries = [entry, None, None]
    for axis in (1, 2) if faces else ():
        if (scan.mesh.fixed[:, axis] < 0).any():
            entries[axis] = rows(axis)
            add(_before(scan, axis), entries[axis], None)
    return Parts(touched, firsts, count, sums, across, (entries[0], entries[1], entries[2]))


def _before(scan: Scan, axis: int) -> Scan:
    """Return the scan of what lies before the grid along an axis, which becomes x."""
    order = [axis, (axis + 1) % 3, (axis + 2) % 3]
    vertices = scan.device.put(np.ascontiguousarray(scan.mesh.fixed[:, order]))
    shape = (0, scan.plan.shape[order[1]], scan.plan.shape[order[2]])
    return Scan(replace(scan.mesh, vertices=vertices), replace(scan.plan, shape=shape))
