"""The winding rule, with integer winding numbers everywhere except near holes [Jacobson 2013].

Caps C close a mesh M (caps.py). The winding number w is additive: w(M) = w(M + C) - w(C). M + C is
closed, so its winding number N about a voxel's shifted centre is an integer: the crossings of the
row before the centre, counted +1 where the row enters and -1 where it leaves (docs/voxels.md). A
voxel is inside if N >= w(C) + 1/2.

Away from holes, w(C) lies between -1/2 and 1/2, and the condition is N >= 1. Blocks of voxels are
examined from the octree's root down. For a block, the law of Biot and Savart bounds how much w(C)
can differ from its value in the middle: its gradient is at most the sum of dl / (4 pi r^2) over the
boundary. If the condition is N >= k, with one integer k, in the whole block, k is kept; otherwise
the block is split. In the bricks that remain, each voxel is decided separately.

At a voxel, a triangle of a near cap counts by one crossing of the row, decided by integers with the
tie rule, and the angles of the strips that its three edges sweep towards +x. With vectors a and b
from the centre to an edge's ends, and their y and z as complex numbers u and v,

    w = crossing + sum of arg(conj(u) v + (|a| + ax) (|b| + bx)) / 2 pi.

The discontinuities of the sum and of the crossing cancel, so a centre on a cap or behind an edge is
no special case. Triangles farther away count through their moments (spatial/winding_number.py), at
a distance at which a number near 1/2 differs by less than 5e-7 from the sum over all triangles. A
voxel is inside if its number is at least HALF. Where more than CROWD leaves of caps are near, as
in a book of thousands of pages, the sums would take too long: there the condition is N >= 1, as if
the caps were part of the mesh. Kernels: kernels/svo/fill/winding.cl.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from voxtool.errors import MemoryLimitError, human
from voxtool.grid import FIXED_POINT_BITS
from voxtool.mesh.mesh import Mesh
from voxtool.morton import morton_decode
from voxtool.opencl import Array, program
from voxtool.spatial.bvh import ARITY, LEAF, TriangleTree, build_tree
from voxtool.spatial.winding_number import WindingNumber
from voxtool.svo.build import DeviceOctree
from voxtool.svo.fill.caps import Caps
from voxtool.svo.fill.rows import Crossings
from voxtool.svo.lattice import LatticeMesh
from voxtool.svo.layout import BRICK, BRICK_BYTES, BRICK_SIDE, MAX_LINK, NODE_BYTES, descend
from voxtool.svo.plan import VoxelizePlan
from voxtool.vector import cross, length

SOURCE = "svo/fill/winding.cl"
# Distances, in radii, beyond which caps count through their moments; and the difference to 1/2
# below which a number is computed again at the next distance. The errors are about 5e-3, 3e-4,
# 8e-6 and 2e-7: they fall with the fourth power of the distance. If m caps coincide, the distances
# grow by the fourth root of m to compensate.
REACHES = ((2.0, 2.0**-6), (4.0, 2.0**-9), (10.0, 2.0**-14), (24.0, 0.0))
DOUBT = REACHES[0][1]
HALF = 0.5 - 2.0**-21  # 1/2 minus the rounding error
BEYOND_GRID = 1 << 30  # number of a voxel beyond the grid
BY_VOXEL = BEYOND_GRID  # in place of a brick's threshold
BRICK_LEVEL = BRICK_SIDE.bit_length() - 1
BATCH = 1 << 14  # bricks whose voxels are computed in one launch
HEADERS = {"svo/fill/winding.h": program.c_constants(BEYOND_GRID=BEYOND_GRID)}


class NearHoles:
    """The bricks in which N >= 1 does not decide; `nodes` holds the ascending Morton codes of the
    level-1 nodes that contain them.

    Raises MemoryLimitError if these bricks need an octree of more than max_memory bytes.
    """

    def __init__(self, mesh: LatticeMesh, plan: VoxelizePlan, max_memory: int) -> None:
        assert mesh.caps is not None
        self._device, self._max_memory, caps = mesh.device, max_memory, mesh.caps
        self._options: dict[str, int | str] = {"CODE": "ulong"} | ({"WIDE": 1} if plan.wide else {})
        self._crowd = plan.crowd
        points = mesh.fixed.astype(np.float64)
        cap_mesh = Mesh(points, caps.faces)
        tree = build_tree(self._device, cap_mesh, np.zeros(len(caps.faces), np.uint8))
        farther = math.sqrt(math.sqrt(caps.most))
        self._windings = [
            WindingNumber(cap_mesh, self._device, tree=tree, reach=reach * farther, repeats=False)
            for reach, _ in REACHES
        ]
        holes = build_tree(self._device, _boxes(points, caps), np.zeros(caps.holes, np.uint8))
        unit = float(np.ldexp(1.0, -tree.frame.exponent))
        a, b, c = (unit * points[caps.faces[:, i]] for i in range(3))
        areas = length(cross(b - a, c - a)) / 2
        by_hole = np.add.reduceat(areas, caps.first[:-1] - 2 * np.arange(caps.holes))
        self._frame = tree.frame
        self.crowded = False  # whether more caps are near some voxels than are summed
        self._arguments: dict[str, Any] = {  # of kernels
            "shape": plan.shape,
            "frame": (*tree.frame.centre, unit),
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "first_cap": mesh.triangles,
            "cap_nodes": tree.nodes,
            "cap_names": tree.names,
            "cap_leaves": tree.leaves,
            "cap_count": tree.count,
            "cap_first_leaf": tree.first_leaf,
            "hole_nodes": holes.nodes,
            "hole_names": holes.names,
            "hole_count": holes.count,
            "hole_first_leaf": holes.first_leaf,
            "first": self._device.put(caps.first.astype(np.uint32)),
            "loops": self._device.put(tree.frame.local(points[caps.loops])),
            "areas": self._device.put(_sums(holes, by_hole)),
            "hole_areas": self._device.put(by_hole),
        }
        self._bricks, self._thresholds = self._find_bricks(plan.side, plan.shape)
        self.nodes = np.unique(self._bricks >> np.uint64(3))

    def _kernel(self, name: str) -> Callable[..., None]:
        """Return a kernel compiled with the plan's options."""
        return self._device.kernel(SOURCE, name, **self._options)

    def _find_thresholds(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """Return (n,) int64, the least N inside of blocks of 2**level voxels, or BY_VOXEL."""
        free = ~self._find_crowds(blocks, level)
        thresholds = np.ones(len(blocks), np.int64)
        thresholds[free] = self._thresholds_by_bounds(blocks[free], level)
        return thresholds

    def _find_crowds(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """Return (n,) bool, True for blocks with more than CROWD leaves near every voxel."""
        n = len(blocks)
        if self._arguments["cap_count"] <= LEAF * self._crowd:
            return np.zeros(n, bool)
        codes, found = self._device.put(blocks), self._device.empty(n, np.uint8)
        most = {"moments": self._windings[0].moments, "most": self._crowd}
        self._kernel("find_crowds")(n, codes, level, crowded=found, **most, **self._arguments)
        crowded = found.take() != 0
        self.crowded |= bool(crowded.any())
        return crowded

    def _thresholds_by_bounds(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """Return the same where no more than CROWD leaves are near."""
        variations = self._variations(blocks, level)
        near = np.flatnonzero(np.isfinite(variations))
        middles = (morton_decode(blocks[near]) * 2 + 1) << (level - 1 + FIXED_POINT_BITS)
        at = self._device.put(self._frame.local(middles.astype(np.float64)))
        half_more = self._windings[0].at_local(at, len(near)).take() + 0.5
        known = np.abs(half_more - np.rint(half_more)) > variations[near] + DOUBT
        thresholds = np.full(len(blocks), BY_VOXEL)
        thresholds[near[known]] = np.ceil(half_more[known])
        return thresholds

    def _variations(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """Return (n,) float64 bounds of the difference of w(C) to its value in a block's middle;
        infinite if the bound is 1/2 or more, or a cap passes between the voxels."""
        n = len(blocks)
        codes, variations = self._device.put(blocks), self._device.empty(n, np.float64)
        self._kernel("bound_variation")(n, codes, level, 0.5 - DOUBT, variations, **self._arguments)
        self._kernel("exclude_caps")(n, codes, level, variations, **self._arguments)
        return variations.take()

    def _numbers(
        self, voxels: np.ndarray, crossings: Crossings, winding: WindingNumber | None
    ) -> np.ndarray:
        """Return (n,) float64 winding numbers at voxels, given by Morton codes: of the mesh, or
        of the mesh with its caps if `winding`, the winding number of the caps, is None."""
        n, listed = len(voxels), (crossings.keys, crossings.n, crossings.x_bits)
        codes, numbers = self._device.put(voxels), self._device.empty(n, np.float64)
        self._kernel("number_voxels")(n, codes, *listed, numbers, **self._arguments)
        if winding:
            most = int(self._crowd * (winding.reach / self._windings[0].reach) ** 2)
            subtract_caps = self._kernel("subtract_caps")
            crowds = self._device.zeros(1, np.uint32)
            subtract_caps(n, codes, winding.moments, most, crowds, numbers, **self._arguments)
            self.crowded |= bool(crowds.take()[0])
        return numbers.take()

    def _find_bricks(self, side: int, shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return (n,) uint64 ascending codes of bricks, and (n,) int64 least N or BY_VOXEL."""
        codes, thresholds = [], []
        blocks = np.zeros(1, np.uint64)
        for level in range(side.bit_length() - 1, BRICK_LEVEL - 1, -1):
            threshold = self._find_thresholds(blocks, level)
            unlike = (threshold != 1) & (threshold != BY_VOXEL)
            self._refuse_beyond(int(unlike.sum()) * 8 ** (level - BRICK_LEVEL) + len(blocks))
            if unlike.any():
                inner = descend(blocks[unlike], level - BRICK_LEVEL)
                codes.append(inner)
                thresholds.append(np.repeat(threshold[unlike], len(inner) // unlike.sum()))
            blocks = blocks[threshold == BY_VOXEL]
            if level > BRICK_LEVEL:
                blocks = descend(blocks, 1)
                low = morton_decode(blocks) << (level - 1)
                blocks = blocks[(low < shape).all(axis=1)]
        codes.append(blocks)
        thresholds.append(np.full(len(blocks), BY_VOXEL))
        found, threshold = np.concatenate(codes), np.concatenate(thresholds)
        order = np.argsort(found)
        return found[order], threshold[order]

    def _refuse_beyond(self, bricks: int) -> None:
        """Raise MemoryLimitError if this number of bricks does not fit; no plan predicts it."""
        needed = 8 * bricks * (NODE_BYTES + 2 * BRICK_BYTES)  # if every brick lies in another node
        if 8 * bricks >= MAX_LINK or needed > self._max_memory:
            raise MemoryLimitError(
                f"near the holes of this mesh, winding numbers need {bricks:,} bricks or more, "
                f"{human(needed)}, which does not fit: close the mesh, or choose a smaller dim or "
                "another fill"
            )

    def fill(self, tree: DeviceOctree, bricks: Array, crossings: Crossings) -> None:
        """Write these bricks into those of an octree in which their nodes are refined."""
        level1 = tree.refined[0]
        node = np.searchsorted(level1.codes.get(0, level1.n), self._bricks >> np.uint64(3))
        places = 8 * node + (self._bricks & np.uint64(7)).astype(np.int64)
        device = bricks.device
        masks, at = device.put(self._masks(crossings)), device.put(places.astype(np.uint32))
        self._kernel("place_bricks")(len(places), masks, at, bricks)

    def _masks(self, crossings: Crossings) -> np.ndarray:
        """Return (n,) uint64 masks of the voxels inside. Numbers near 1/2 are computed again, with
        moments used only at a larger distance."""
        masks = np.empty(len(self._bricks), BRICK)
        for start in range(0, len(masks), BATCH):
            part = slice(start, start + BATCH)
            threshold = np.repeat(self._thresholds[part].astype(np.float64), BRICK_SIDE**3)
            voxels = descend(self._bricks[part], BRICK_LEVEL)
            numbers = np.empty(len(voxels))
            single = threshold == BY_VOXEL
            threshold[single] = HALF
            numbers[~single] = self._numbers(voxels[~single], crossings, None)
            asked = np.flatnonzero(single)
            for winding, (_, doubt) in zip(self._windings, REACHES, strict=True):
                numbers[asked] = self._numbers(voxels[asked], crossings, winding)
                asked = asked[np.abs(numbers[asked] - 0.5) < doubt]
            inside = (numbers >= threshold) & (numbers != BEYOND_GRID)
            masks[part] = np.packbits(inside, bitorder="little").view(BRICK)
        return masks


def _boxes(points: np.ndarray, caps: Caps) -> Mesh:
    """Return one face per hole, from the low to the high corner of the hole's bounding box."""
    ends = points[caps.loops]
    low, high = (f.reduceat(ends, caps.first[:-1]) for f in (np.minimum, np.maximum))
    low_corner = np.arange(caps.holes, dtype=np.int32)
    high_corner = low_corner + caps.holes
    return Mesh(np.concatenate([low, high]), np.stack([low_corner, high_corner, high_corner], 1))


def _sums(tree: TriangleTree, values: np.ndarray) -> np.ndarray:
    """Return the sums of the faces' values over each node and leaf of their tree."""
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
