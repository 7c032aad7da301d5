"""Links of a lattice that cross the wall, and where: for boundary conditions of lattice Boltzmann
methods that know how far the wall is ([Bouzidi 2001]).

A link goes from the centre of a fluid voxel to that of a neighbour that is none of the fluid. Its
place is the first point of the source mesh on it, as a share of the link: 0 is the centre of the
fluid voxel, 1 that of its neighbour. The mesh is that of the fixed-point lattice by which it was
voxelized. Integers decide whether a link meets a triangle; its two ends and the triangle's edges
count. The place is the quotient of two whole numbers in double precision, and is kept in single. A
link that meets no triangle has the place 0.5 and is marked: the fill rule, or a change of the
octree, put the wall there.

Kernel: kernels/svo/solvers/wall_links.cl.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from voxtool.arrays import Data, digest_of
from voxtool.choices import FLUIDS, LATTICES
from voxtool.errors import MemoryLimitError, VoxtoolError, human
from voxtool.grid import Grid
from voxtool.job import Cost, Job, Plan
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device, default_device, program
from voxtool.spatial.bvh import build_tree, tree_bytes
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.images.image_parts import ImageInParts, fitting_image
from voxtool.svo.images.neighbour_layers import Places, Rows, layers_of
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.voxelization.lattice import place_mesh
from voxtool.svo.voxelization.plan import NARROW_EXTENT

SOURCE = "svo/solvers/wall_links.cl"
FIND, TREE, MEASURE = "find links", "tree", "measure links"
NO_LINK, CROSSED, UNCROSSED = range(3)  # flags
NO_PLACE, MIDDLE = -1.0, 0.5  # places where there is no link, and where no triangle crosses it
EXTRA = 1 << 14  # bytes of a result beside its rows
CHUNK = 1 << 16  # fluid voxels that are measured at once
VERTEX_BYTES, FACE_BYTES = 72, 24  # of a mesh in its three systems, on the device and the host
# The rest, then the links by their length; each is followed by the opposite one.
STEPS = np.array(
    [
        (0, 0, 0),
        *[(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)],
        *[(1, 1, 0), (-1, -1, 0), (1, -1, 0), (-1, 1, 0), (1, 0, 1), (-1, 0, -1)],
        *[(1, 0, -1), (-1, 0, 1), (0, 1, 1), (0, -1, -1), (0, 1, -1), (0, -1, 1)],
        *[(1, 1, 1), (-1, -1, -1), (1, 1, -1), (-1, -1, 1)],
        *[(1, -1, 1), (-1, 1, -1), (-1, 1, 1), (1, -1, -1)],
    ],
    np.int8,
)
MOST_LINKS = len(STEPS)
_TABLE = ", ".join(f"{{{x}, {y}, {z}}}" for x, y, z in STEPS.tolist())
HEADERS = {
    "svo/solvers/wall_links.h": program.c_constants(MOST_LINKS=MOST_LINKS)
    + f"\n__constant char STEPS[MOST_LINKS][3] = {{{_TABLE}}};\n"
}


@dataclass(frozen=True, eq=False, repr=False)
class WallLinks(Data):
    """The links of a lattice that cross the wall.

    Attributes
    ----------
    grid : Grid
        The grid of the octree.
    lattice : str
        "D3Q19" or "D3Q27".
    fluid : str
        Which voxels of the octree are the fluid: "unset" or "set".
    directions : (Q, 3) int8
        The steps of the links in voxels; the first is the rest.
    voxels : (N, 3) int32
        The fluid voxels that have links, in lexicographic order.
    places : (N, Q) float32
        Where each link first meets the mesh, as a share of the link; -1 where there is no link.
    flags : (N, Q) uint8
        0: no link; 1: the mesh crosses it; 2: no triangle does, and the place is 0.5.
    source_sha256, units : str
        Those of the octree.
    """

    grid: Grid
    lattice: str
    fluid: str
    directions: np.ndarray
    voxels: np.ndarray
    places: np.ndarray
    flags: np.ndarray
    source_sha256: str
    units: str

    def __repr__(self) -> str:
        return f"<WallLinks {self.lattice}, {self.count:,} links of {len(self.voxels):,} voxels>"

    @property
    def count(self) -> int:
        """Number of links."""
        return int(np.count_nonzero(self.flags))

    @property
    def uncrossed(self) -> int:
        """Number of links that no triangle crosses."""
        return int(np.count_nonzero(self.flags == UNCROSSED))

    def digest(self) -> str:
        """Return the SHA-256 of the grid, the lattice, the fluid and the arrays."""
        head = {**self.grid.exact, "lattice": self.lattice, "fluid": self.fluid}
        return digest_of(head, self.directions, self.voxels, self.places, self.flags)


@dataclass(frozen=True)
class LinksPlan(Plan):
    """The plan: which links there are, and what measuring them takes."""

    stages = (TREE, MEASURE)
    facts = ("lattice", "fluid", "voxels", "links", "triangles", "bytes")
    costs = ("device", "host")
    refusal = "the links {shortage}: choose a smaller dim, or D3Q19"

    lattice: str
    fluid: str
    voxels: int  # fluid voxels that have links
    links: int
    triangles: int
    vertices: int
    held: int  # bytes of the octree's image, while links are found
    wide: bool | None = None  # predicates use 128 bits; None: as the mesh's largest triangle needs

    @property
    def reasons(self) -> dict[str, str]:
        count = LATTICES[self.lattice]
        return {"links to corners": "" if count == len(STEPS) else f"{self.lattice} has none"}

    @property
    def bytes(self) -> int:
        """A bound of the bytes of the result."""
        return EXTRA + self.voxels * (12 + 5 * LATTICES[self.lattice])

    @property
    def cost(self) -> Cost:
        """The memory of the result, the mesh, its tree and a chunk of voxels."""
        mesh = self.vertices * VERTEX_BYTES + self.triangles * FACE_BYTES
        chunk = min(CHUNK, self.voxels) * (16 + 8 * LATTICES[self.lattice])
        device = mesh + tree_bytes(self.triangles) + chunk
        host = self.held + mesh + 2 * chunk + self.bytes + 16 * self.voxels
        return Cost(device + host, host, max(tree_bytes(self.triangles), chunk))

    def as_dict(self) -> dict[str, Any]:
        return {**super().as_dict(), "largest_allocation": self.cost.largest}

    def rows(self) -> list[tuple[str, str]]:
        return [
            ("links", f"{self.lattice}: {self.links:,} links of {self.voxels:,} fluid voxels"),
            ("fluid", f"the voxels that are {self.fluid}"),
            ("mesh", f"{self.triangles:,} triangles"),
            ("file", f"at most {human(self.bytes)}"),
        ]


@dataclass(eq=False)
class LinksJob(Job[WallLinks]):
    """The planned measurement of links."""

    octree: OctreeContent
    source: Mesh
    voxels: np.ndarray  # (N, 3) int32
    wanted: np.ndarray  # (N,) uint32, a bit for each link
    plan: LinksPlan
    device: Device
    max_memory: int | None = None
    progress: Callable[[float], None] | None = None

    def _run(self) -> WallLinks:
        octree, device, lattice = self.octree, self.device, self.plan.lattice
        count = LATTICES[lattice]
        placed = place_mesh(self.source, octree.grid, None, None, None, device)
        wide = self.plan.wide
        if wide is None:
            wide = placed.survey().extent > NARROW_EXTENT
        fixed = replace(self.source, vertices=placed.fixed.astype(np.float64), transform=())
        tree = build_tree(device, fixed)
        scale = 2.0**-tree.frame.exponent
        centre = tree.frame.centre.tolist()
        measure = device.kernel(SOURCE, "measure_links", **({"WIDE": 1} if wide else {}))
        places = np.empty((len(self.voxels), count), np.float32)
        flags = np.empty(places.shape, np.uint8)
        bits = np.arange(count, dtype=np.uint32)
        with self.stage(MEASURE):
            for start in range(0, len(places), CHUNK):
                chosen = slice(start, start + CHUNK)
                n = len(places[chosen])
                found = device.empty(n * count, np.float64)
                measure(
                    n, device.put(self.voxels[chosen]), device.put(self.wanted[chosen]), count,
                    placed.vertices, placed.faces, tree.face_of, tree.count, tree.nodes,
                    tree.first_leaf, *centre, scale, found,
                )  # fmt: skip
                own = found.take().reshape(n, count)
                links = (self.wanted[chosen][:, None] >> bits & 1).astype(bool)
                flags[chosen] = np.where(links, CROSSED, NO_LINK)
                flags[chosen][links & np.isinf(own)] = UNCROSSED
                places[chosen] = np.where(links, np.where(np.isinf(own), MIDDLE, own), NO_PLACE)
                if self.progress:
                    self.progress(min((start + CHUNK) / len(places), 1.0))
        return WallLinks(
            octree.grid, lattice, self.plan.fluid, STEPS[:count], self.voxels, places, flags,
            octree.source_sha256, octree.units,
        )  # fmt: skip

    def findings(self, result: WallLinks) -> Iterator[str]:
        if not len(result.voxels):
            yield "there is no link: no fluid voxel is beside the wall"
        elif result.uncrossed:
            yield (
                f"no triangle crosses {result.uncrossed:,} of {result.count:,} links, whose place "
                "is 0.5 and whose flag is 2: the fill rule, or a change of the octree, put the "
                "wall there"
            )


def plan_wall_links(
    octree: OctreeContent,
    source: Mesh,
    lattice: str = "D3Q19",
    fluid: str = FLUIDS[0],
    *,
    device: Device | None = None,
    max_memory: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> LinksJob:
    """Return the planned job of finding where the links of a lattice cross the wall.

    Parameters
    ----------
    octree : OctreeContent
        The voxels.
    source : Mesh
        The mesh that the octree was made from, in its place: see `sharp.source_of`.
    lattice : str
        "D3Q19" or "D3Q27".
    fluid : str
        "unset": the voxels of the grid that are not set; "set": those that are.
    device, max_memory
        As everywhere.
    progress : callable
        Called with the share of voxels that are measured, from 0 to 1.

    Raises
    ------
    VoxtoolError
        If the lattice or the fluid is unknown.
    """
    if lattice not in LATTICES:
        raise VoxtoolError(f"lattice {lattice!r} is unknown: choose one of {', '.join(LATTICES)}")
    if fluid not in FLUIDS:
        raise VoxtoolError(f"fluid {fluid!r} is unknown: choose one of {', '.join(FLUIDS)}")
    device = device or default_device()
    device.require_float64("links")
    image = fitting_image(replace(VoxelImage.of(octree), dense=False), max_memory)
    try:
        voxels, wanted = find_links(image, LATTICES[lattice], fluid, max_memory)
    except MemoryLimitError as error:
        raise MemoryLimitError(
            f"{human(image.limit if isinstance(image, ImageInParts) else max_memory or 0)} of "
            "memory are too few to find the links: choose a smaller dim (see --max-memory)"
        ) from error
    links = int(np.bitwise_count(wanted).sum(dtype=np.int64))
    sizes = (len(source.faces), len(source.vertices))
    plan = LinksPlan(lattice, fluid, len(voxels), links, *sizes, image.host_bytes)
    return LinksJob(octree, source, voxels, wanted, plan, device, max_memory, progress)


def find_links(
    image: VoxelImage, count: int, fluid: str, max_memory: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the fluid voxels that have links, (N, 3) int32 in lexicographic order, and which of
    the first `count` of STEPS they have, (N,) uint32 with a bit for each; MemoryLimitError if
    they take more than `max_memory` bytes."""
    (nx, ny, nz), rows = image.shape, Rows.of(image)
    voxels, wanted, held = [np.empty((0, 3), np.int32)], [np.empty(0, np.uint32)], 0
    for x, *near in layers_of(image):
        if not 0 <= x < nx:
            continue
        own = near[1]
        found: list[tuple[int, np.ndarray]] = []
        for link, (dx, dy, dz) in enumerate(STEPS[:count].tolist()):
            step = dy * rows.width + dz
            if not link or not 0 <= x + dx < nx:
                continue
            # the end of the link that is not set: that of the wall, or that of the fluid
            if fluid == "set":
                unset, others = own.keys + step, near[1 + dx]
            else:
                unset, others = near[1 + dx].keys - step, own
            unset = unset[others.find(unset) < 0]
            y, z = np.divmod(unset, rows.width)
            unset = unset[(y >= 1) & (y <= ny) & (z >= 1) & (z <= nz)]
            keys = unset - step if fluid == "set" else unset
            if len(keys):
                found.append((link, keys))
        if not found:
            continue
        places = Places.united([keys for _, keys in found], rows.size)
        bits = np.zeros(len(places), np.uint32)
        for link, keys in found:
            bits[places.find(keys)] |= np.uint32(1 << link)
        y, z = np.divmod(places.keys, rows.width)
        voxels.append(np.stack([np.full(len(y), x), y - 1, z - 1], axis=1).astype(np.int32))
        wanted.append(bits)
        held += voxels[-1].nbytes + bits.nbytes
        if max_memory is not None and held > max_memory:
            raise MemoryLimitError("the list of fluid voxels is too long")
    return np.concatenate(voxels), np.concatenate(wanted)
