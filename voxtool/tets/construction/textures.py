"""A mesh of cells to the textures of a volume [TetVol, section 4.1].

Everything is computed in float64, in local coordinates, and rounded to float32 once. The plane of a
face is computed from its vertices in one order, whichever cell has the face; the cell on the other
side has the negated plane.

Kernels: kernels/tets/construction/textures.cl.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from voxtool.choices import LAYOUTS, MAX_TEXTURE_2D
from voxtool.errors import MeshError, VoxtoolError
from voxtool.job import Job
from voxtool.opencl import Device, default_device, program
from voxtool.opencl.primitives import bucket_sort, exclusive_scan
from voxtool.tets.construction.conforming import ConformingCells, hexahedra, tetrahedra
from voxtool.tets.construction.neighbours import FACES, match_faces
from voxtool.tets.construction.plan import VolumePlan
from voxtool.tets.volume.mesh import UnstructuredMesh, VolumeCells, volume_cells
from voxtool.tets.volume.volume import BLOCK, TetVolume
from voxtool.vector import triple

if TYPE_CHECKING:
    from voxtool.opencl import Array

SOURCE = "tets/construction/textures.cl"
MORTON_BITS = 21  # bits of each coordinate of a centroid
LEAST = 2.0**-126  # some devices round smaller numbers of float32 to 0

HEADERS = {
    "tets/construction/order.h": program.c_constants(MORTON_BITS=MORTON_BITS)
    + f"\n#define LEAST {LEAST.hex()}"
}


def build_tet(
    mesh: UnstructuredMesh,
    layout: str = "raycast",
    merge_distance: float = 0.0,
    **request: Any,
) -> TetVolume:
    """Return the volume of a mesh: `plan_tet(...).run()`; see voxtool.build_tet."""
    return plan_tet(mesh, layout, merge_distance, **request).run()


def plan_tet(
    mesh: UnstructuredMesh,
    layout: str = "raycast",
    merge_distance: float = 0.0,
    *,
    max_texture: int = MAX_TEXTURE_2D,
    device: Device | None = None,
    max_memory: int | None = None,
) -> VolumeJob:
    """Return the job of the volume of a mesh; see voxtool.build_tet."""
    if layout not in LAYOUTS:
        raise VoxtoolError(f"layout {layout!r} is unknown: choose {', '.join(LAYOUTS)}")
    if layout == "projection" and mesh.constant:
        raise VoxtoolError(
            f"{mesh.name or 'mesh'}: {mesh.scalar} is one a cell, and the layout projection holds "
            "scalars of vertices: use --layout raycast"
        )
    found = volume_cells(mesh)
    device = device or default_device()
    device.require_float64("the textures of volumes")
    cells: Counter[str] = Counter()
    for kind, block in found.blocks:
        cells[kind] += len(block)
    ignored, points = found.report["ignored"], len(found.points)
    plan = VolumePlan(
        layout, merge_distance, dict(cells), ignored, points, mesh.constant, max_texture=max_texture
    )
    return VolumeJob(mesh, found, plan, device, max_memory)


class VolumeJob(Job[TetVolume]):
    """A planned volume; `run` returns a TetVolume."""

    device: Device
    plan: VolumePlan

    def __init__(
        self,
        mesh: UnstructuredMesh,
        found: VolumeCells,
        plan: VolumePlan,
        device: Device,
        max_memory: int | None,
    ) -> None:
        self.mesh, self.found, self.plan = mesh, found, plan
        self.device, self.max_memory = device, max_memory

    def _run(self) -> TetVolume:
        plan = self.plan
        conforming, order, neighbours, planes, gradients = plan.stages
        with self.stage(conforming):
            conform = hexahedra if plan.layout == "hexahedra" else tetrahedra
            found = conform(self.device, self.found, plan.merge_distance, plan.max_pairs)
        with self.stage(order):
            frame = _frame(found, self.found)
            cells = _ordered(self.device, found, frame, plan.floats)
            heights = None
            if found.thin:
                heights = found.heights(frame.scale)[cells.items.get(), None].astype(np.float32)
        report = found.report
        del found  # frees its cells
        with self.stage(neighbours):
            across, counts = match_faces(cells.cells, cells.corners, cells.count, cells.points)
        with self.stage(planes):
            normals, plane_error = _planes(cells)
        with self.stage(gradients):
            slopes, scalar_error = _gradients(cells)
            ranges = _ranges(cells, slopes)
        errors = {"plane_error": plane_error, "scalar_error": scalar_error}
        textures = {"neighbours": across, "normals": normals, "gradients": slopes, "ranges": ranges}
        return self._volume(frame, cells, textures, heights, {**report, **counts}, errors)

    def _volume(
        self,
        frame: Frame,
        cells: OrderedCells,
        textures: dict[str, Array],
        heights: np.ndarray | None,
        counts: dict[str, Any],
        errors: dict[str, float],
    ) -> TetVolume:
        """Return the volume that holds the textures."""
        mesh, floats, faces = self.mesh, self.plan.floats, FACES[cells.corners]
        found = {name: array.take() for name, array in textures.items()}
        numbers = cells.cells.take().view(np.int32).reshape(-1, cells.corners)
        outside = int(np.count_nonzero(found["neighbours"] < 0))
        return TetVolume(
            self.plan.layout,
            cells.vertices.take().reshape(-1, 4),
            numbers,
            found["neighbours"].reshape(-1, faces),
            found["normals"].reshape(faces, -1, floats),
            found["gradients"].reshape(-1, floats),
            numbers[:, :2].copy() if self.plan.layout == "projection" else None,
            found["ranges"].reshape(-1, 2),
            triple(frame.origin),
            frame.scale,
            (frame.low, frame.high),
            mesh.scalar,
            mesh.constant,
            heights,
            mesh.units,
            mesh.source_sha256,
            self.plan.decisions(),
            {**counts, "boundary_faces": outside, **errors},
        )


class Frame(NamedTuple):
    """The local frame of a volume: world = origin + scale * local; and its range of scalars."""

    origin: np.ndarray
    scale: float
    low: float
    high: float

    def local(self, points: np.ndarray) -> np.ndarray:
        """Return points in local coordinates."""
        return (points - self.origin) / self.scale

    def normalised(self, scalars: np.ndarray) -> np.ndarray:
        """Return scalars in [0, 1]."""
        return (scalars - self.low) / ((self.high - self.low) or 1.0)


def _frame(mesh: ConformingCells, found: VolumeCells) -> Frame:
    """Return the frame that brings a mesh into [-1, 1] around its middle, by a power of two.

    Raises
    ------
    MeshError : float64 does not hold the range of positions or scalars; `found` has the names.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    origin = low / 2 + high / 2 + 0.0
    reach = float(np.maximum(high - origin, origin - low).max())
    if not 2.0**-1000 < reach < 2.0**1000:
        raise MeshError(
            f"{found.name}: positions up to {reach:g} from the middle of the mesh: scale "
            "them to what float64 computes with, 1e-300 to 1e300"
        )
    mantissa, exponent = math.frexp(reach)
    scale = math.ldexp(1.0, exponent - (mantissa == 0.5))
    least, most = float(mesh.scalars.min()), float(mesh.scalars.max())
    if not math.isfinite(most - least):
        raise MeshError(
            f"{found.name}: {found.scalar} from {least:g} to {most:g} is a range that "
            "float64 does not hold: scale it"
        )
    return Frame(origin, scale, least, most)


@dataclass(frozen=True, eq=False)
class OrderedCells:
    """Cells along the Morton curve of their centroids, and vertices in the order of first use.

    cells : uint32, the `corners` vertices of each of `count` cells.
    placed : float64, local position and normalised scalar (0 where `constant`) of each of `points`.
    vertices : float32, the same, rounded.
    scalars : float64, the normalised scalar of each cell where these are constant, else none; and
        items : uint32, the place in it of each cell.
    options : -D options of the kernels.
    """

    cells: Array
    corners: int
    count: int
    placed: Array
    vertices: Array
    points: int
    scalars: Array
    items: Array
    options: dict[str, int | str]

    @property
    def device(self) -> Device:
        return self.cells.device

    @property
    def constant(self) -> bool:
        """True if each cell has one scalar."""
        return "CONSTANT" in self.options

    def run(self, kernel: str, size: int, *arguments: Any) -> None:
        """Launch a kernel of textures.cl."""
        self.device.kernel(SOURCE, kernel, **self.options)(size, *arguments)


def _ordered(device: Device, mesh: ConformingCells, frame: Frame, floats: int) -> OrderedCells:
    """Return cells in order, in local coordinates."""
    points, corners, count = len(mesh.vertices), mesh.corners, mesh.count
    options: dict[str, int | str] = {"CORNERS": corners, "FLOATS": floats}
    options |= {"CONSTANT": 1} if mesh.constant else {}
    local = np.zeros((points, 4))
    local[:, :3] = frame.local(mesh.vertices)
    scalars = frame.normalised(mesh.scalars)
    if not mesh.constant:
        local[:, 3], scalars = scalars, scalars[:0]
    cells = OrderedCells(
        device.empty(corners * count, np.uint32), corners, count,
        device.empty(4 * points, np.float64), device.empty(4 * points, np.float32), points,
        device.put(scalars), _morton_order(device, mesh, local, options), options,
    )  # fmt: skip
    first = device.put(np.full(points, 0xFFFFFFFF, np.uint32))
    cells.run("order_cells", count, mesh.cells, cells.items, cells.cells, first)
    numbers = device.empty(corners * count + 1, np.uint32)
    cells.run("flag_first", corners * count, cells.cells, first, numbers)
    exclusive_scan(numbers, corners * count)
    cells.run("renumber_corners", corners * count, cells.cells, first, numbers)
    cells.run(
        "place_points", points, device.put(local), first, numbers, cells.placed, cells.vertices
    )
    return cells


def _morton_order(
    device: Device, mesh: ConformingCells, local: np.ndarray, options: dict[str, int | str]
) -> Array:
    """Return the cells along the Morton curve of their centroids, uint32."""
    count = mesh.count
    bits = min(count.bit_length(), 3 * MORTON_BITS)  # about as many buckets as cells
    buckets, keys = device.empty(count, np.uint32), device.empty(count, np.uint64)
    device.kernel(SOURCE, "key_centroids", **options)(
        count, mesh.cells, device.put(local), 3 * MORTON_BITS - bits, buckets, keys
    )
    return bucket_sort(buckets, keys, count, 1 << bits)[2]


def _planes(cells: OrderedCells) -> tuple[Array, float]:
    """Return the planes of each face, and the largest distance of a face's vertex, in float32, from
    its plane."""
    floats, count = int(cells.options["FLOATS"]), cells.count
    normals = cells.device.empty(FACES[cells.corners] * count * floats, np.float32)
    errors = cells.device.empty(count, np.float64)
    cells.run("find_planes", count, cells.cells, cells.placed, cells.vertices, normals, errors)
    return normals, float(errors.take().max())


def _gradients(cells: OrderedCells) -> tuple[Array, float]:
    """Return gradient and scalar term of each cell, and the largest difference of a cell's scalar
    at a vertex from that of the vertex in float32."""
    count = cells.count
    gradients = cells.device.empty(int(cells.options["FLOATS"]) * count, np.float32)
    if cells.constant:
        cells.run("find_gradients", count, cells.scalars, cells.items, gradients)
        return gradients, 0.0
    errors = cells.device.empty(count, np.float64)
    cells.run("find_gradients", count, cells.cells, cells.placed, cells.vertices, gradients, errors)
    return gradients, float(errors.take().max())


def _ranges(cells: OrderedCells, gradients: Array) -> Array:
    """Return the range of normalised scalars of each block of cells."""
    blocks = -(-cells.count // BLOCK)
    ranges = cells.device.empty(2 * blocks, np.float32)
    scalars = gradients if cells.constant else cells.vertices
    cells.run("find_ranges", blocks, cells.cells, cells.count, scalars, ranges)
    return ranges
