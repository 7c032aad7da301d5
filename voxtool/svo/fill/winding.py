"""The winding number of a mesh on a grid, by whole numbers wherever holes are far.

Caps C close a mesh M (caps.py). By linearity w(M) = w(M + C) - w(C), and M + C is closed: about a
voxel's shifted centre its number N is the crossings of the row before it, those that enter less
those that leave, which integers tell (docs/voxels.md). So a voxel is inside where
N >= w(C) + 1/2. Away from the caps w(C) is smooth and small, between -1/2 and 1/2 all but near the
holes, and there inside is where N >= 1. What is left is found block by block, from the octree's
root down: w(C) in the middle of a block, and how far it can be from that in the block, by the law
of Biot and Savart (nowhere is it steeper than the sum of dl / (4 pi r^2) over the boundary), leave
one threshold k, inside is where N >= k; or else the block is split. Voxels of bricks that are left
are decided one by one.

At a voxel, triangles of caps that are near count by one crossing of the row, which integers decide
with the rule for ties, and the angles of three strips that the triangle's edges sweep towards +x,
(a, b and |a|, |b| from the centre; the other two coordinates as complex numbers u, v)

    w = crossing + sum of arg(conj(u) v + (|a| + ax) (|b| + bx)) / 2 pi,

whose jumps are those of the crossing. So a centre on a cap, or behind an edge, is no special case.

Others count through their moments (proximity/winding.py), from so many radii on that the number,
where it is about 1/2, is within 5e-7 of the sum over all triangles. Inside is where it is HALF or
more: 1/2, up to 1e-6.

Kernels: kernels/svo/fill/winding.cl.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from voxtool.errors import MemoryLimitError, human
from voxtool.grid import FIXED_POINT_BITS
from voxtool.mesh.mesh import Mesh
from voxtool.morton import morton_decode
from voxtool.opencl import Array, Device, program
from voxtool.spatial.bvh import ARITY, LEAF, TriangleTree, build_tree
from voxtool.spatial.winding_number import WindingNumber
from voxtool.svo.build import DeviceOctree
from voxtool.svo.fill.caps import Caps
from voxtool.svo.layout import BRICK, BRICK_BYTES, BRICK_SIDE, MAX_LINK, NODE_BYTES
from voxtool.vector import cross, length

SOURCE = "svo/fill/winding.cl"
# Radii from which on caps count through their moments, and how near to 1/2 a number that is found
# so must be asked again: the errors are some 5e-3, 3e-4, 8e-6 and 2e-7. They fall with the fourth
# power; where caps lie one upon another, that makes up for their number.
REACHES = ((2.0, 2.0**-6), (4.0, 2.0**-9), (10.0, 2.0**-14), (24.0, 0.0))
DOUBT = REACHES[0][1]
HALF = 0.5 - 2.0**-21  # so that where it is 1/2 rounding does not show
NOWHERE = 1 << 30  # number of a voxel beyond the grid
BY_VOXEL = NOWHERE  # in place of a brick's threshold
BRICK_LEVEL = BRICK_SIDE.bit_length() - 1
BATCH = 1 << 14  # bricks whose voxels are numbered at once
# A bit is left free below: with it Oclgrind 21.10 meets a shift that it does not know.
ENTERS = 2
HEADERS = {"svo/fill/winding.h": program.c_constants(NOWHERE=NOWHERE, ENTERS=ENTERS)}


@dataclass(frozen=True)
class Crossings:
    """The crossings of rows with a closed mesh: sorted keys of a row, x_bits - 2 bits of the first
    voxel beyond, counted from -1, and ENTERS where the row enters."""

    keys: Array
    n: int
    x_bits: int


class NearHoles:
    """The bricks in which the caps of a mesh count, and what they hold.

    nodes : (n,) uint64 rising Morton codes of the level-1 nodes that hold them.
    """

    def __init__(
        self,
        device: Device,
        caps: Caps,
        fixed: np.ndarray,
        shape: tuple[int, int, int],
        side: int,
        mesh: tuple[Array, Array],
        first_cap: int,
        wide: bool,
        max_memory: int,
    ) -> None:
        """Build the trees, and find the bricks.

        Parameters
        ----------
        fixed : (V, 3) int32 vertices, in 1/256 voxel.
        shape : voxels of the grid; side : voxels along a side of its octree.
        mesh : the vertices and the faces on the device, from first_cap on those of the caps.
        wide : as in the plan.
        max_memory : bytes that the octree may take for the sake of the bricks.

        Raises
        ------
        MemoryLimitError : it would take more.
        """
        self.device, self.shape = device, shape
        self._mesh = *mesh, np.uint32(first_cap)
        self._options: dict[str, int | str] = {"CODE": "ulong", **({"WIDE": 1} if wide else {})}
        points = fixed.astype(np.float64)
        cap_mesh = Mesh(points, caps.faces)
        self._cap_tree = _tree(device, cap_mesh)
        farther = math.sqrt(math.sqrt(caps.most))
        self._windings = [
            WindingNumber(cap_mesh, device, tree=self._cap_tree, reach=reach * farther)
            for reach, _ in REACHES
        ]
        self._hole_tree = _tree(device, _boxes(points, caps))
        frame = self._cap_tree.frame
        self._frame = np.array([*frame.centre, np.ldexp(1.0, -frame.exponent)])
        areas = _areas(points[caps.faces] * self._frame[3])
        by_hole = np.add.reduceat(areas, caps.first[:-1] - 2 * np.arange(caps.holes))
        self._holes = device.put(caps.first.astype(np.uint32)), device.put(caps.loops)
        self._areas = device.put(_sums(self._hole_tree, by_hole)), device.put(by_hole)
        self._max_memory = max_memory
        self._bricks, self._thresholds = self._find_bricks(side)
        self.nodes = np.unique(self._bricks >> np.uint64(3))

    def _find_bricks(self, side: int) -> tuple[np.ndarray, np.ndarray]:
        """The bricks in which not N >= 1 decides.

        Parameters
        ----------
        side : voxels along a side of the octree.

        Returns
        -------
        (n,) uint64 rising Morton codes, and (n,) int64 thresholds of N, or BY_VOXEL.
        """
        codes, thresholds = [], []
        blocks = np.zeros(1, np.uint64)
        for level in range(side.bit_length() - 1, BRICK_LEVEL - 1, -1):
            threshold = self._thresholds_of(blocks, level)
            unlike = (threshold != 1) & (threshold != BY_VOXEL)
            self._refuse_beyond(int(unlike.sum()) * 8 ** (level - BRICK_LEVEL) + len(blocks))
            inner = _descend(blocks[unlike], level - BRICK_LEVEL)
            codes.append(inner)
            thresholds.append(np.repeat(threshold[unlike], len(inner) // max(unlike.sum(), 1)))
            blocks = blocks[threshold == BY_VOXEL]
            if level > BRICK_LEVEL:
                blocks = _descend(blocks, 1)
                low = morton_decode(blocks) << (level - 1)
                blocks = blocks[(low < self.shape).all(axis=1)]
        codes.append(blocks)
        thresholds.append(np.full(len(blocks), BY_VOXEL))
        found, threshold = np.concatenate(codes), np.concatenate(thresholds)
        order = np.argsort(found)
        return found[order], threshold[order]

    def _refuse_beyond(self, bricks: int) -> None:
        """Holes may need more bricks than any plan of the mesh can tell."""
        needed = 8 * bricks * (NODE_BYTES + 2 * BRICK_BYTES)  # if each is in a node of its own
        if 8 * bricks >= MAX_LINK or needed > self._max_memory:
            raise MemoryLimitError(
                f"near the holes of this mesh {bricks:,} bricks and more, {human(needed)}, differ "
                "from what whole numbers tell, more than fits: close the mesh, or choose a smaller "
                "dim or another fill"
            )

    def _thresholds_of(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """(n,) int64: from which N on the voxels of blocks of 2**level are inside, or BY_VOXEL."""
        spreads = self._spreads(blocks, level)
        near = np.flatnonzero(np.isfinite(spreads))
        middles = (morton_decode(blocks[near]) * 2 + 1) << (level - 1 + FIXED_POINT_BITS)
        local = self._cap_tree.frame.local(middles.astype(np.float64))
        at = self.device.put(local)
        half_more = self._windings[0].at_local(at, len(near)).take() + 0.5
        at.release()
        known = np.abs(half_more - np.rint(half_more)) > spreads[near] + DOUBT
        thresholds = np.full(len(blocks), BY_VOXEL)
        thresholds[near[known]] = np.ceil(half_more[known])
        return thresholds

    def _spreads(self, blocks: np.ndarray, level: int) -> np.ndarray:
        holes, caps, n = self._hole_tree, self._cap_tree, len(blocks)
        codes, spreads = self.device.put(blocks), self.device.empty(n, np.float64)
        self.device.kernel(SOURCE, "bound_spreads", **self._options)(
            n, codes, np.uint32(n), np.uint32(level), np.float64(0.5 - DOUBT), self._frame,
            holes.nodes, holes.names, *self._areas, np.uint32(holes.count),
            np.uint32(holes.first_leaf), *self._holes, caps.nodes, caps.names,
            np.uint32(caps.count), np.uint32(caps.first_leaf), *self._mesh, spreads,
        )  # fmt: skip
        codes.release()
        return spreads.take()

    def fill(self, tree: DeviceOctree, bricks: Array, crossings: Crossings) -> None:
        """Write these bricks among those of an octree in which their nodes are refined."""
        level1 = tree.refined[0]
        node = np.searchsorted(level1.codes.get(0, level1.n), self._bricks >> np.uint64(3))
        places = 8 * node + (self._bricks & np.uint64(7)).astype(np.int64)
        n = len(places)
        masks = self.device.put(self._masks(crossings))
        at = self.device.put(places.astype(np.uint32))
        place = self.device.kernel(SOURCE, "place_bricks", **self._options)
        place(n, masks, at, np.uint32(n), bricks)
        masks.release()
        at.release()

    def _masks(self, crossings: Crossings) -> np.ndarray:
        """(n,) uint64 masks of the voxels inside."""
        masks = np.empty(len(self._bricks), BRICK)
        for start in range(0, len(masks), BATCH):
            part = slice(start, start + BATCH)
            threshold = np.repeat(self._thresholds[part].astype(np.float64), BRICK_SIDE**3)
            voxels = _descend(self._bricks[part], BRICK_LEVEL)
            numbers = np.empty(len(voxels))
            single = threshold == BY_VOXEL
            threshold[single] = HALF
            numbers[~single] = self._numbers(voxels[~single], crossings, None)
            asked = np.flatnonzero(single)
            for winding, (_, doubt) in zip(self._windings, REACHES, strict=True):
                numbers[asked] = self._numbers(voxels[asked], crossings, winding)
                asked = asked[np.abs(numbers[asked] - 0.5) < doubt]
            inside = (numbers >= threshold) & (numbers != NOWHERE)
            masks[part] = np.packbits(inside, bitorder="little").view(BRICK)
        return masks

    def _numbers(
        self, voxels: np.ndarray, crossings: Crossings, winding: WindingNumber | None
    ) -> np.ndarray:
        """(n,) float64 numbers of the mesh at voxels, given by their Morton codes; those of the
        mesh with its caps where no winding number of these is given."""
        caps, n = self._cap_tree, len(voxels)
        codes, numbers = self.device.put(voxels), self.device.empty(n, np.float64)
        self.device.kernel(SOURCE, "number_voxels", **self._options)(
            n, codes, np.uint32(n), np.array([*self.shape, 0], np.int32), crossings.keys,
            np.uint32(crossings.n), np.uint32(crossings.x_bits), np.uint32(winding is not None),
            self._frame, caps.leaves, caps.names, np.uint32(caps.count),
            np.uint32(caps.first_leaf), (winding or self._windings[0]).moments, *self._mesh,
            numbers,
        )  # fmt: skip
        codes.release()
        return numbers.take()


def _tree(device: Device, mesh: Mesh) -> TriangleTree:
    return build_tree(device, mesh, np.zeros(len(mesh.faces), np.uint8))


def _boxes(points: np.ndarray, caps: Caps) -> Mesh:
    """For each hole a face from the low to the high corner of its box, which has that box."""
    ends = points[caps.loops]
    low, high = (f.reduceat(ends, caps.first[:-1]) for f in (np.minimum, np.maximum))
    low_corner = np.arange(caps.holes, dtype=np.int32)
    high_corner = low_corner + caps.holes
    return Mesh(np.concatenate([low, high]), np.stack([low_corner, high_corner, high_corner], 1))


def _areas(triangles: np.ndarray) -> np.ndarray:
    u, v = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
    return length(cross(u, v)) / 2


def _descend(codes: np.ndarray, levels: int) -> np.ndarray:
    """The Morton codes of what lies so many levels below."""
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
