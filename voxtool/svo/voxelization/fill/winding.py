"""The winding rule, with integer winding numbers everywhere except near holes [Jacobson 2013].

Caps C close a mesh M (caps.py). The winding number w is additive: w(M) = w(M + C) - w(C). M + C is
closed, so its winding number N about a voxel's shifted centre is an integer: the crossings of the
row before the centre, counted +1 where the row enters and -1 where it leaves (docs/voxels.md). A
voxel is inside if N >= w(C) + 1/2.

Away from holes, w(C) lies between -1/2 and 1/2, and the condition is N >= 1. Blocks of voxels are
examined from the octree's root down. w(M) is smooth where M does not pass, also across caps, and
w(C) is smooth where caps do not pass. By the law of Biot and Savart, its derivatives are integrals
along the boundary: a sum over the boundary's edges gives the polynomial of third order about the
block's middle, and a bound of the rest. Together with the number in the middle, it decides blocks
at once, or all voxels except a few near the level set of 1/2; otherwise the block is split. In
the bricks that remain, near the boundary and where M and C pass together, the number at all voxels
is summed in single precision: near triangles one by one, and farther ones at the brick's corners.

Voxels whose number is too near to 1/2 for that are decided separately. There, a triangle of a near
cap counts by one crossing of the row, decided by integers with the tie rule, and the angles of the
strips that its three edges sweep towards +x. With vectors a and b from the centre to an edge's
ends, and their y and z as complex numbers u and v,

    w = crossing + sum of arg(conj(u) v + (|a| + ax) (|b| + bx)) / 2 pi.

The discontinuities of the sum and of the crossing cancel, so a centre on a cap or behind an edge is
no special case. Triangles farther away count through their moments (spatial/winding_number.py), at
a distance at which a number near 1/2 differs by less than 5e-7 from the sum over all triangles. A
voxel is inside if its number is at least HALF. Where more than CROWD leaves of caps are near, as
in a book of thousands of pages, the sums would take too long: there the condition is N >= 1, as if
the caps were part of the mesh. Kernels: blocks.cl, voxels.cl and bricks.cl in
kernels/svo/voxelization/fill/winding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from voxtool.errors import MemoryLimitError, human
from voxtool.grid import FIXED_POINT_BITS
from voxtool.mesh.mesh import Mesh
from voxtool.morton import morton_decode
from voxtool.opencl import Array, program
from voxtool.opencl.builder import Request
from voxtool.spatial.bvh import ARITY, LEAF, TriangleTree, build_tree
from voxtool.spatial.bvh import SOURCE as BVH
from voxtool.spatial.winding_number import SOURCE as MOMENTS
from voxtool.spatial.winding_number import WindingNumber
from voxtool.svo.octree.build import DeviceOctree
from voxtool.svo.octree.layout import BRICK, BRICK_BYTES, BRICK_SIDE, MAX_LINK, NODE_BYTES, descend
from voxtool.svo.voxelization.fill.caps import Caps
from voxtool.svo.voxelization.fill.rows import Crossings
from voxtool.svo.voxelization.lattice import LatticeMesh
from voxtool.svo.voxelization.plan import VoxelizePlan
from voxtool.svo.voxelization.scan_conversion import NODE_LEVEL
from voxtool.vector import cross, length

SOURCE = "svo/voxelization/fill/winding.cl"
# Distances, in radii, beyond which caps count through their moments; and the difference to 1/2
# below which a number is computed again at the next distance. The errors are about 5e-3, 3e-4,
# 8e-6 and 2e-7: they fall with the fourth power of the distance. If m caps coincide, the distances
# grow by the fourth root of m to compensate.
REACHES = ((2.0, 2.0**-6), (4.0, 2.0**-9), (10.0, 2.0**-14), (24.0, 0.0))
DOUBT = REACHES[0][1]
ROUGH, MIDDLE = 1, 2  # the reaches of numbers in the middle of blocks: to examine, and to expand
LIMIT = 0.5  # of a useful expansion's error
TAKEN_LEVEL = 4  # of the largest blocks whose bricks are decided by one expansion
EXPANSION = 20  # numbers
DIPOLE_FIELDS = 9  # numbers of a triangle
NONE, SOME, ALL = range(3)  # voxels
HALF = 0.5 - 2.0**-21  # 1/2 minus the rounding error
BEYOND_GRID = 1 << 30  # number of a voxel beyond the grid
BRICK_LEVEL = BRICK_SIDE.bit_length() - 1
BATCH = 1 << 14  # bricks whose voxels are computed in one launch
HEADERS = {
    "svo/voxelization/fill/winding.h": program.c_constants(
        BEYOND_GRID=BEYOND_GRID,
        BRICK_LEVEL=BRICK_LEVEL,
        DIPOLE_FIELDS=DIPOLE_FIELDS,
        EXPANSION=EXPANSION,
        NONE=NONE,
        SOME=SOME,
        ALL=ALL,
    )
}


def programs(plan: VoxelizePlan) -> list[Request]:
    """Return the programs that a plan with holes uses."""
    return [(BVH, {}), (MOMENTS, {}), (SOURCE, _options(plan))]


def _options(plan: VoxelizePlan) -> dict[str, int | str]:
    return {"CODE": "ulong", **({"WIDE": 1} if plan.wide else {})}


class NearHoles:
    """The bricks in which N >= 1 does not decide, once they are found by `decide`."""

    def __init__(
        self, mesh: LatticeMesh, plan: VoxelizePlan, max_memory: int, crossings: Crossings
    ) -> None:
        assert mesh.caps is not None
        self._device, self._max_memory, caps = mesh.device, max_memory, mesh.caps
        self._options = _options(plan)
        self._crowd, self._side, self._shape = plan.crowd, plan.side, plan.shape
        self._most_left = plan.most_left
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
        self._voxel = unit * 2**FIXED_POINT_BITS  # a voxel's side in the frame
        corners = points[caps.faces] / 2**FIXED_POINT_BITS  # voxels
        a, b, c = corners.swapaxes(0, 1)
        normals = cross(b - a, c - a) / 2
        areas = self._voxel**2 * length(normals)
        by_hole = np.add.reduceat(areas, caps.first[:-1] - 2 * np.arange(caps.holes))
        first, edges = _groups(caps, tree.frame.local(points))
        self._may_crowd = tree.count > LEAF * plan.crowd
        self.crowded = False  # whether more caps are near some voxels than are summed
        self._arguments: dict[str, Any] = {  # of kernels
            "shape": plan.shape,
            "crossings": crossings.keys,
            "count": crossings.n,
            "x_bits": crossings.x_bits,
            "frame": (*tree.frame.centre, unit),
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "first_cap": mesh.triangles,
            "cap_nodes": tree.nodes,
            "cap_names": tree.names,
            "cap_leaves": tree.leaves,
            "cap_count": tree.count,
            "cap_first_leaf": tree.first_leaf,
            "cap_areas": self._device.put(_sums(tree, areas)),
            "cap_dipoles": self._device.put(_dipoles(tree, corners, normals)),
            "hole_nodes": holes.nodes,
            "hole_names": holes.names,
            "hole_count": holes.count,
            "hole_first_leaf": holes.first_leaf,
            "first": self._device.put(first),
            "edges": self._device.put(edges),
            "areas": self._device.put(_sums(holes, by_hole)),
            "hole_areas": self._device.put(by_hole),
        }

    def decide(self, touched: np.ndarray, capped: np.ndarray) -> np.ndarray:
        """Find the bricks and their voxels. Return the ascending Morton codes of the level-1 nodes
        that contain them, once for each.

        `touched` holds the ascending codes of the level-1 nodes that the mesh touches, and `capped`
        those that the mesh or its caps touch. Raises MemoryLimitError if the bricks need an octree
        of more than max_memory bytes.
        """
        self._touched, self._capped = touched.astype(np.uint64), capped.astype(np.uint64)
        found, bricks, left = [], 0, 0.0
        blocks = np.zeros(1, np.uint64)
        for level in range(self._side.bit_length() - 1, BRICK_LEVEL - 1, -1):
            if level == BRICK_LEVEL and left > self._most_left:
                break
            expanded, rest = self._examine(blocks, level)
            left, blocks = len(rest) / max(len(blocks), 1), rest
            found.append(expanded)
            bricks += len(expanded.blocks) * 8 ** (level - BRICK_LEVEL)
            self._refuse_beyond(bricks + len(blocks))
            if level > BRICK_LEVEL:
                blocks = self._within(descend(blocks), level - 1)
        parts = [self._by_expansions(found), self._by_sums(blocks)]
        codes, masks = (np.concatenate(each) for each in zip(*parts, strict=True))
        order = np.argsort(codes)
        self._bricks, self._masks = codes[order], masks[order]
        return self._bricks >> np.uint64(3)

    def _within(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """Return the blocks that reach into the grid."""
        return blocks[(morton_decode(blocks) << level < self._shape).all(axis=1)]

    def _kernel(self, name: str) -> Callable[..., None]:
        """Return a kernel compiled with the plan's options."""
        return self._device.kernel(SOURCE, name, **self._options)

    def _examine(self, blocks: np.ndarray, level: int) -> tuple[_Expanded, np.ndarray]:
        """Return the blocks of 2**level voxels that expansions decide, except a few voxels, and
        those that are left; N >= 1 decides all others."""
        crowds = self._find_crowds(blocks, level)
        blocks, free = blocks[crowds != ALL], crowds[crowds != ALL] == NONE
        meshed, capped = (_touches(n, blocks, level) for n in (self._touched, self._capped))
        met = meshed & free
        met[met] = self._meet_caps(blocks[met], level)
        some = np.flatnonzero(free & ~met)
        expansions = self._expand(blocks[some], level)
        near = np.isfinite(expansions[:, -1])
        some, expansions = some[near], expansions[near]
        middles = blocks[some] << np.uint64(3 * level) | np.uint64(7 << 3 * (level - 1))
        rest, slope = expansions[:, -1], length(expansions[:, :3]) * self._voxel
        precise = (rest < slope / 2**level) & (level <= TAKEN_LEVEL)  # those that may be taken
        numbers, values = self._numbers(middles, None), np.empty(len(some))
        for reach, these in ((ROUGH, ~precise), (MIDDLE, precise)):
            values[these] = self._numbers(middles[these], self._windings[reach])
            rest[these] += REACHES[reach][1]
        counted = meshed[some]
        values[counted] -= numbers[counted]
        low, high = self._ranges(expansions, values, level)
        alike = np.where(counted, (low > -0.5) & (high < 0.5), (low > 0.5) | (high < 0.5))
        as_counted = (low > 0.5) == (numbers >= 1)
        done = alike & (counted | (~capped[some] & as_counted)) & (numbers != BEYOND_GRID)
        taken = alike | (rest < slope / 2**level) | ((level == BRICK_LEVEL) & (rest < DOUBT))
        taken &= (numbers != BEYOND_GRID) & (level <= TAKEN_LEVEL) & ~done
        left = np.ones(len(blocks), bool)
        left[some[done | taken]] = False
        of = (blocks[some[taken]], level, expansions[taken], values[taken], counted[taken])
        return _Expanded(*of), blocks[left]

    def _expand(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """Return (n, EXPANSION) float64 expansions of w(C) in blocks about the voxels beyond their
        middles."""
        n = len(blocks)
        codes, found = self._device.put(blocks), self._device.empty(n * EXPANSION, np.float64)
        self._kernel("expand_blocks")(n, codes, level, LIMIT, found, **self._arguments)
        return found.take().reshape(n, EXPANSION)

    def _meet_caps(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """Return (n,) bool, False where no cap passes between the voxels of a block."""
        n = len(blocks)
        codes, met = self._device.put(blocks), self._device.empty(n, np.uint8)
        self._kernel("meet_caps")(n, codes, level, met=met, **self._arguments)
        return met.take() != 0

    def _ranges(
        self, expansions: np.ndarray, values: np.ndarray, level: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (n,) float64 bounds from below and above of expanded numbers at voxels."""
        half = 2 ** (level - 1) * self._voxel
        slope, bend, twist = expansions[:, :3], expansions[:, 3:9], expansions[:, 9:-1]
        sizes = np.sqrt((bend[:, :3] ** 2).sum(axis=1) + (bend[:, 3:] ** 2).sum(axis=1) / 2)
        spread = 3 * half**2 * sizes + half * np.abs(slope).sum(axis=1)
        spread += half**3 * np.abs(twist).sum(axis=1) + expansions[:, -1]
        return values - spread, values + spread

    def _find_crowds(self, blocks: np.ndarray, level: int) -> np.ndarray:
        """Return (n,) uint8, ALL for blocks with more than CROWD leaves near every voxel, SOME if
        that may be so for some voxels, otherwise NONE."""
        n = len(blocks)
        if not self._may_crowd:
            return np.full(n, NONE, np.uint8)
        codes, found = self._device.put(blocks), self._device.empty(n, np.uint8)
        most = {"moments": self._windings[0].moments, "most": self._crowd}
        self._kernel("find_crowds")(n, codes, level, crowded=found, **most, **self._arguments)
        found = found.take()
        self.crowded |= bool((found == ALL).any())
        return found

    def _numbers(self, voxels: np.ndarray, winding: WindingNumber | None) -> np.ndarray:
        """Return (n,) float64 winding numbers at voxels, given by Morton codes. They are those of
        the mesh with its caps if `winding`, the winding number of the caps, is None, or else those
        of the mesh alone."""
        n = len(voxels)
        codes, numbers = self._device.put(voxels), self._device.empty(n, np.float64)
        self._kernel("number_voxels")(n, codes, numbers, **self._arguments)
        if winding:
            most = int(self._crowd * (winding.reach / self._windings[0].reach) ** 2)
            subtract_caps = self._kernel("subtract_caps")
            crowds = self._device.zeros(1, np.uint32)
            subtract_caps(n, codes, winding.moments, most, crowds, numbers, **self._arguments)
            self.crowded |= bool(crowds.take()[0])
        return numbers.take()

    def _by_expansions(self, found: list[_Expanded]) -> tuple[np.ndarray, np.ndarray]:
        """Return the codes and masks of the bricks in expanded blocks that N >= 1 does not
        decide."""
        parts = [self._within(descend(f.blocks, f.level - BRICK_LEVEL), BRICK_LEVEL) for f in found]
        bricks = np.concatenate(parts)
        levels = np.repeat([f.level for f in found], [len(f.blocks) for f in found])
        arrays = {
            name: np.concatenate([getattr(f, name) for f in found])
            for name in ("blocks", "expansions", "values", "counted")
        }
        starts = arrays["blocks"] << (3 * (levels - BRICK_LEVEL)).astype(np.uint64)
        order = np.argsort(starts)
        parents = order[np.searchsorted(starts[order], bricks, "right") - 1]
        arrays |= {"parents": parents.astype(np.uint32), "levels": levels.astype(np.uint8)}
        arrays["counted"] = arrays["counted"].astype(np.uint8)
        of = {name: self._device.put(values) for name, values in arrays.items()}
        return self._decided("decide_by_expansions", bricks, MIDDLE, **of)

    def _by_sums(self, bricks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the codes and masks of the bricks that N >= 1 does not decide, by summing the
        number of every voxel."""
        winding = self._windings[0]
        return self._decided(
            "decide_bricks", bricks, 0 if self._may_crowd else 1, moments=winding.moments,
            reach=winding.reach, most=self._crowd, doubt=DOUBT,
        )  # fmt: skip

    def _decided(
        self, kernel: str, bricks: np.ndarray, first: int, **arguments: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the codes and masks of the bricks that N >= 1 does not decide, by a kernel, and
        by precise numbers at the voxels that it leaves open."""
        n = len(bricks)
        inside, left = (self._device.empty(n, BRICK) for _ in range(2))
        same = self._device.empty(n, np.uint8)
        results = {"inside": inside, "open": left, "same": same}
        codes = self._device.put(bricks)
        self._kernel(kernel)(n, bricks=codes, **results, **arguments, **self._arguments)
        kept = same.take() == 0
        bricks, masks, left = bricks[kept], inside.take()[kept], left.take()[kept]
        brick = np.flatnonzero(left)
        for start in range(0, len(brick), BATCH):
            part = brick[start : start + BATCH]
            asked = np.flatnonzero(_unpacked(left[part]))
            voxels = descend(bricks[part], BRICK_LEVEL)[asked]
            found = _unpacked(masks[part])
            found[asked] = self._precise_numbers(voxels, first) >= HALF
            masks[part] = np.packbits(found, bitorder="little").view(BRICK)
        return bricks, masks

    def _precise_numbers(self, voxels: np.ndarray, first: int) -> np.ndarray:
        """Return (n,) float64 winding numbers at voxels in the grid, with moments used beyond
        the `first` of the reaches. Those near 1/2 are computed again, with the next one."""
        numbers, asked = np.empty(len(voxels)), np.arange(len(voxels))
        for winding, (_, doubt) in zip(self._windings[first:], REACHES[first:], strict=True):
            numbers[asked] = self._numbers(voxels[asked], winding)
            asked = asked[np.abs(numbers[asked] - 0.5) < doubt]
        return numbers

    def _refuse_beyond(self, bricks: int) -> None:
        """Raise MemoryLimitError if this number of bricks does not fit; no plan predicts it."""
        needed = 8 * bricks * (NODE_BYTES + 2 * BRICK_BYTES)  # if every brick lies in another node
        if 8 * bricks >= MAX_LINK or needed > self._max_memory:
            raise MemoryLimitError(
                f"near the holes of this mesh, winding numbers need {bricks:,} bricks or more, "
                f"{human(needed)}, which does not fit: close the mesh, or choose a smaller dim or "
                "another fill"
            )

    def fill(self, tree: DeviceOctree, bricks: Array) -> None:
        """Write these bricks into those of an octree in which their nodes are refined."""
        level1 = tree.refined[0]
        node = np.searchsorted(level1.codes.get(0, level1.n), self._bricks >> np.uint64(3))
        places = 8 * node + (self._bricks & np.uint64(7)).astype(np.int64)
        device = bricks.device
        masks, at = device.put(self._masks), device.put(places.astype(np.uint32))
        self._kernel("place_bricks")(len(places), masks, at, bricks)


@dataclass(frozen=True)
class _Expanded:
    """Blocks of 2**level voxels with the arguments of the kernel decide_by_expansions."""

    blocks: np.ndarray
    level: int
    expansions: np.ndarray
    values: np.ndarray
    counted: np.ndarray


def _touches(nodes: np.ndarray, blocks: np.ndarray, level: int) -> np.ndarray:
    """Return (n,) bool, True for blocks of 2**level voxels in which, or for bricks around which,
    there are level-1 nodes, given by ascending codes."""
    if level < NODE_LEVEL:
        blocks, level = blocks >> np.uint64(3 * (NODE_LEVEL - level)), NODE_LEVEL
    shift = np.uint64(3 * (level - NODE_LEVEL))
    first, end = (np.searchsorted(nodes, each << shift) for each in (blocks, blocks + np.uint64(1)))
    return end > first


def _unpacked(masks: np.ndarray) -> np.ndarray:
    """Return (64 n,) bool voxels of (n,) masks."""
    return np.unpackbits(masks.view(np.uint8), bitorder="little").view(bool)


def _boxes(points: np.ndarray, caps: Caps) -> Mesh:
    """Return one face per hole, from the low to the high corner of the hole's bounding box."""
    ends = points[caps.loops]
    low, high = (f.reduceat(ends, caps.first[:-1]) for f in (np.minimum, np.maximum))
    low_corner = np.arange(caps.holes, dtype=np.int32)
    high_corner = low_corner + caps.holes
    return Mesh(np.concatenate([low, high]), np.stack([low_corner, high_corner, high_corner], 1))


def _groups(caps: Caps, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the boundary edges in groups of eight: the first group of each hole, (H + 1,) uint32,
    and (groups, 8, 8) float64, the x, y, z of an edge's start and of its end, its length, and 1
    over its square; 1 if it has none. The last group of a hole is filled with its last vertex."""
    groups = -(-np.diff(caps.first) // 8)
    first = np.concatenate([[0], np.cumsum(groups)])
    edge = np.arange(8 * first[-1]) - np.repeat(8 * first[:-1] - caps.first[:-1], 8 * groups)
    last = np.repeat(caps.first[1:] - 1, 8 * groups)
    ends = caps.edges[np.minimum(edge, last)]
    ends[edge > last, 0] = ends[edge > last, 1]  # an edge without length
    values = points[ends].reshape(-1, 8, 6).transpose(0, 2, 1)
    lengths = length((values[:, 3:] - values[:, :3]).transpose(0, 2, 1))[:, None]
    inverse = 1 / np.where(lengths > 0, lengths, 1.0) ** 2
    return first.astype(np.uint32), np.concatenate([values, lengths, inverse], axis=1)


def _dipoles(tree: TriangleTree, corners: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the triangles of each leaf of a tree as dipoles, (leaves, DIPOLE_FIELDS, LEAF)
    float64, from (F, 3, 3) corners and (F, 3) area vectors, in voxels. The fields are the x, y, z
    of the middle and of the area vector, the area, and of the distances from the middle to the
    corners the sum of the squares and the maximum. A leaf with fewer triangles is filled with 0."""
    assert tree.names is not None
    faces = tree.names.get(0, tree.count) // 3
    middle = corners.mean(axis=1)
    squares = ((corners - middle[:, None]) ** 2).sum(axis=2)
    sizes = [length(normals), squares.sum(axis=1), np.sqrt(squares.max(axis=1))]
    fields = np.column_stack([middle, normals, *sizes])[faces]
    padded = np.zeros((-(-tree.count // LEAF) * LEAF, DIPOLE_FIELDS))
    padded[: tree.count] = fields
    return padded.reshape(-1, LEAF, DIPOLE_FIELDS).transpose(0, 2, 1)


def _sums(tree: TriangleTree, values: np.ndarray) -> np.ndarray:
    """Return the sums of the faces' values over each node and leaf of their tree, and zeros to
    the end of the last node's children."""
    assert tree.names is not None
    sums = np.zeros(tree.first_leaf + -(-tree.count // LEAF) + ARITY)
    below, size = values[tree.names.get(0, tree.count) // 3], LEAF
    parts = [*tree.parts(), (tree.first_leaf, -(-tree.count // LEAF))]
    for first, count in reversed(parts):
        padded = np.zeros((count, size))
        padded.ravel()[: len(below)] = below
        below = np.cumsum(padded, axis=1)[:, -1]
        sums[first : first + count] = below
        size = ARITY
    return sums
