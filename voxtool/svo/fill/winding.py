"""The winding number of a mesh on a grid, by whole numbers wherever holes are far.

Caps C close a mesh M (caps.py). By linearity w(M) = w(M + C) - w(C), and M + C is closed: about a
voxel's shifted centre its number N is the crossings of the row before it, those that enter minus
those that leave, in exact integers (docs/voxels.md). So a voxel is inside where N >= w(C) + 1/2.
Away from the caps w(C) is smooth and small, between -1/2 and 1/2 except near the holes, and there
inside is where N >= 1. The rest is found block by block, from the octree's root down: w(C) in the
middle of a block, and a bound on how far it can be from that in the block, by the law of Biot and
Savart (its gradient is at most the sum of dl / (4 pi r^2) over the boundary), leave one threshold
k, inside is where N >= k; or else the block is split. Voxels of bricks that are left are decided
one by one.

At a voxel, triangles of caps that are near count by one crossing of the row, which integers decide
with the rule for ties, and the angles of three strips that the triangle's edges sweep towards +x,
(a, b and |a|, |b| from the centre; the other two coordinates as complex numbers u, v)

    w = crossing + sum of arg(conj(u) v + (|a| + ax) (|b| + bx)) / 2 pi,

whose jumps are those of the crossing. So a centre on a cap, or behind an edge, is no special case.

Other triangles count through their moments (spatial/winding_number.py), from such a distance
on that a number near 1/2 is within 5e-7 of the sum over all triangles. Inside is where it
is HALF or more: 1/2, up to 1e-6. The rule is that of [Jacobson 2013]. Kernels:
kernels/svo/fill/winding.cl.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MemoryLimitError, human
from voxtool.grid import FIXED_POINT_BITS
from voxtool.mesh.mesh import Mesh
from voxtool.morton import morton_decode
from voxtool.opencl import Array, program
from voxtool.spatial.bvh import ARITY, LEAF, TriangleTree, build_tree
from voxtool.spatial.winding_number import WindingNumber
from voxtool.svo.fill.caps import Caps
from voxtool.svo.layout import BRICK, BRICK_BYTES, BRICK_SIDE, MAX_LINK, NODE_BYTES
from voxtool.vector import cross, length

if TYPE_CHECKING:
    from voxtool.svo.build import DeviceOctree
    from voxtool.svo.fill.crossings import Crossings
    from voxtool.svo.lattice import LatticeMesh
    from voxtool.svo.plan import VoxelizePlan

SOURCE = "svo/fill/winding.cl"
# Radii from which on caps count through their moments, and how near to 1/2 a number that is found
# so must be computed again: the errors are about 5e-3, 3e-4, 8e-6 and 2e-7. They fall with the
# fourth power; where caps lie one upon another, that makes up for their number.
REACHES = ((2.0, 2.0**-6), (4.0, 2.0**-9), (10.0, 2.0**-14), (24.0, 0.0))
DOUBT = REACHES[0][1]
HALF = 0.5 - 2.0**-21  # 1/2, less what rounding takes
BEYOND_GRID = 1 << 30  # number of a voxel beyond the grid
BY_VOXEL = BEYOND_GRID  # in place of a brick's threshold
BRICK_LEVEL = BRICK_SIDE.bit_length() - 1
BATCH = 1 << 14  # bricks whose voxels are numbered at once
HEADERS = {"svo/fill/winding.h": program.c_constants(BEYOND_GRID=BEYOND_GRID)}


class CapField:
    """The winding number of the caps of a mesh: bounds of it in blocks of voxels, and the numbers
    of the mesh at voxels."""

    def __init__(self, mesh: LatticeMesh, wide: bool) -> None:
        """Build the trees over the caps and over the holes.

        Parameters
        ----------
        mesh : with caps; wide : as in VoxelizePlan.
        """
        assert mesh.caps is not None
        self.mesh, self.device, caps = mesh, mesh.device, mesh.caps
        self._options: dict[str, int | str] = {"CODE": "ulong", **({"WIDE": 1} if wide else {})}
        points = mesh.fixed.astype(np.float64)
        cap_mesh = Mesh(points, caps.faces)
        self.tree = build_tree(self.device, cap_mesh, np.zeros(len(caps.faces), np.uint8))
        farther = math.sqrt(math.sqrt(caps.most))
        self.windings = [
            WindingNumber(cap_mesh, self.device, tree=self.tree, reach=reach * farther)
            for reach, _ in REACHES
        ]
        boxes = _boxes(points, caps)
        self._holes = build_tree(self.device, boxes, np.zeros(caps.holes, np.uint8))
        frame = self.tree.frame
        self._frame = (*frame.centre, float(np.ldexp(1.0, -frame.exponent)))
        areas = _areas(points[caps.faces] * self._frame[3])
        by_hole = np.add.reduceat(areas, caps.first[:-1] - 2 * np.arange(caps.holes))
        self._first = self.device.put(caps.first.astype(np.uint32))
        self._loops = self.device.put(caps.loops)
        self._areas = self.device.put(_sums(self._holes, by_hole))
        self._hole_areas = self.device.put(by_hole)

    def kernel(self, name: str) -> Callable[..., None]:
        """A kernel with the plan's options."""
        return self.device.kernel(SOURCE, name, **self._options)

    def thresholds(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """(n,) int64: from which N on the voxels of blocks of 2**level are inside, or BY_VOXEL."""
        spreads = self._spreads(blocks, level)
        near = np.flatnonzero(np.isfinite(spreads))
        middles = (morton_decode(blocks[near]) * 2 + 1) << (level - 1 + FIXED_POINT_BITS)
        at = self.device.put(self.tree.frame.local(middles.astype(np.float64)))
        half_more = self.windings[0].at_local(at, len(near)).take() + 0.5
        known = np.abs(half_more - np.rint(half_more)) > spreads[near] + DOUBT
        thresholds = np.full(len(blocks), BY_VOXEL)
        thresholds[near[known]] = np.ceil(half_more[known])
        return thresholds

    def _spreads(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """(n,) float64: by how much the number can differ from that of a block's middle; infinite
        where that is 1/2 or a cap passes between the voxels."""
        n, holes, caps, mesh = len(blocks), self._holes, self.tree, self.mesh
        codes, spreads = self.device.put(blocks), self.device.empty(n, np.float64)
        self.kernel("bound_spreads")(
            n, codes, level, 0.5 - DOUBT, self._frame, holes.nodes, holes.names, self._areas,
            self._hole_areas, holes.count, holes.first_leaf, self._first, self._loops,
            mesh.vertices, spreads,
        )  # fmt: skip
        self.kernel("exclude_caps")(
            n, codes, level, self._frame, caps.nodes, caps.names, caps.count, caps.first_leaf,
            mesh.vertices, mesh.faces, mesh.triangles, spreads,
        )  # fmt: skip
        return spreads.take()

    def numbers(
        self, voxels: np.ndarray, crossings: Crossings, winding: WindingNumber | None
    ) -> np.ndarray:
        """(n,) float64 winding numbers of the mesh at voxels, given by their Morton codes; of the
        mesh with its caps where no winding number of these is given."""
        n, caps, mesh = len(voxels), self.tree, self.mesh
        codes, numbers = self.device.put(voxels), self.device.empty(n, np.float64)
        self.kernel("number_voxels")(
            n, codes, mesh.grid.shape, crossings.keys, crossings.n, crossings.x_bits, numbers
        )
        if winding:
            self.kernel("subtract_caps")(
                n, codes, self._frame, caps.leaves, caps.names, caps.count, caps.first_leaf,
                winding.moments, mesh.vertices, mesh.faces, mesh.triangles, numbers,
            )  # fmt: skip
        return numbers.take()


class NearHoles:
    """The bricks in which the caps of a mesh count, and what they hold.

    Attributes
    ----------
    nodes : (n,) uint64 rising Morton codes of the level-1 nodes that hold them.
    """

    def __init__(self, mesh: LatticeMesh, plan: VoxelizePlan, max_memory: int) -> None:
        """Find the bricks.

        Parameters
        ----------
        mesh : with caps.
        max_memory : bytes that the octree may take because of the bricks.

        Raises
        ------
        MemoryLimitError : it would take more.
        """
        self._field = CapField(mesh, plan.wide)
        self._max_memory = max_memory
        self._bricks, self._thresholds = self._find_bricks(plan.side, plan.shape)
        self.nodes = np.unique(self._bricks >> np.uint64(3))

    def _find_bricks(self, side: int, shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
        """The bricks in which N >= 1 does not decide.

        Returns
        -------
        (n,) uint64 rising Morton codes, and (n,) int64 thresholds of N, or BY_VOXEL.
        """
        codes, thresholds = [], []
        blocks = np.zeros(1, np.uint64)
        for level in range(side.bit_length() - 1, BRICK_LEVEL - 1, -1):
            threshold = self._field.thresholds(blocks, level)
            unlike = (threshold != 1) & (threshold != BY_VOXEL)
            self._refuse_beyond(int(unlike.sum()) * 8 ** (level - BRICK_LEVEL) + len(blocks))
            inner = _descend(blocks[unlike], level - BRICK_LEVEL)
            codes.append(inner)
            thresholds.append(np.repeat(threshold[unlike], len(inner) // max(unlike.sum(), 1)))
            blocks = blocks[threshold == BY_VOXEL]
            if level > BRICK_LEVEL:
                blocks = _descend(blocks, 1)
                low = morton_decode(blocks) << (level - 1)
                blocks = blocks[(low < shape).all(axis=1)]
        codes.append(blocks)
        thresholds.append(np.full(len(blocks), BY_VOXEL))
        found, threshold = np.concatenate(codes), np.concatenate(thresholds)
        order = np.argsort(found)
        return found[order], threshold[order]

    def _refuse_beyond(self, bricks: int) -> None:
        """Holes may need more bricks than any plan of the mesh can predict."""
        needed = 8 * bricks * (NODE_BYTES + 2 * BRICK_BYTES)  # if each is in a node of its own
        if 8 * bricks >= MAX_LINK or needed > self._max_memory:
            raise MemoryLimitError(
                f"near the holes of this mesh {bricks:,} bricks and more, {human(needed)}, differ "
                "from what whole numbers decide, more than fits: close the mesh, or choose a "
                "smaller dim or another fill"
            )

    def fill(self, tree: DeviceOctree, bricks: Array, crossings: Crossings) -> None:
        """Write these bricks among those of an octree in which their nodes are refined."""
        level1 = tree.refined[0]
        node = np.searchsorted(level1.codes.get(0, level1.n), self._bricks >> np.uint64(3))
        places = 8 * node + (self._bricks & np.uint64(7)).astype(np.int64)
        device = bricks.device
        masks, at = device.put(self._masks(crossings)), device.put(places.astype(np.uint32))
        self._field.kernel("place_bricks")(len(places), masks, at, bricks)

    def _masks(self, crossings: Crossings) -> np.ndarray:
        """(n,) uint64 masks of the voxels inside. A number that is near 1/2 is computed again, with
        caps counting through their moments from farther away only."""
        masks = np.empty(len(self._bricks), BRICK)
        for start in range(0, len(masks), BATCH):
            part = slice(start, start + BATCH)
            threshold = np.repeat(self._thresholds[part].astype(np.float64), BRICK_SIDE**3)
            voxels = _descend(self._bricks[part], BRICK_LEVEL)
            numbers = np.empty(len(voxels))
            single = threshold == BY_VOXEL
            threshold[single] = HALF
            numbers[~single] = self._field.numbers(voxels[~single], crossings, None)
            asked = np.flatnonzero(single)
            for winding, (_, doubt) in zip(self._field.windings, REACHES, strict=True):
                numbers[asked] = self._field.numbers(voxels[asked], crossings, winding)
                asked = asked[np.abs(numbers[asked] - 0.5) < doubt]
            inside = (numbers >= threshold) & (numbers != BEYOND_GRID)
            masks[part] = np.packbits(inside, bitorder="little").view(BRICK)
        return masks


def _boxes(points: np.ndarray, caps: Caps) -> Mesh:
    """A face for each hole, from the low to the high corner of the hole's bounding box."""
    ends = points[caps.loops]
    low, high = (f.reduceat(ends, caps.first[:-1]) for f in (np.minimum, np.maximum))
    low_corner = np.arange(caps.holes, dtype=np.int32)
    high_corner = low_corner + caps.holes
    return Mesh(np.concatenate([low, high]), np.stack([low_corner, high_corner, high_corner], 1))


def _areas(triangles: np.ndarray) -> np.ndarray:
    u, v = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
    return length(cross(u, v)) / 2


def _descend(codes: np.ndarray, levels: int) -> np.ndarray:
    """The Morton codes of all cells that lie a number of levels below."""
    below = np.arange(8**levels, dtype=np.uint64)
    return ((codes << np.uint64(3 * levels))[:, None] | below).ravel()


def _sums(tree: TriangleTree, values: np.ndarray) -> np.ndarray:
    """The sums of the faces' values over each node and leaf of their tree."""
    assert tree.names is not None
    sums = np.zeros(tree.first_leaf + -(-tree.count // LEAF))
    below, size = values[tree.names.get(0, tree.count) // 3], LEAF
    parts = [*tree.parts(), (tree.first_leaf, len(sums) - tree.first_leaf)]
    for first, count in reversed(parts):
        padded = np.zeros((count, size))
        padded.ravel()[: len(below)] = below
        below = np.cumsum(padded, axis=1)[:, -1]
        sums[first : first + count] = below
        size = ARITY
    return sums
