"""Scan conversion: the level-1 nodes and voxels that triangles touch ([voCCeL], section 3.2,
listings A.4 and A.5).

A work-item processes one triangle or, if triangles are large, one tile of a triangle's columns.

A node of 8 x 8 x 8 voxels is active if a triangle touches it. The set is a bit array in Morton
order with the number of set bits before each word, which gives the rank of a node in constant time.
In large grids, the active blocks of 8 x 8 x 8 nodes are found first, and only they have bits; in
larger ones, before these the regions of 8 x 8 x 8 blocks.

Kernels: kernels/svo/voxelization/scan_conversion.cl.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.morton import spread_bits
from voxtool.opencl import Array, program
from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.octree.build import DeviceOctree, code_name
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE
from voxtool.svo.voxelization.lattice import LatticeMesh
from voxtool.svo.voxelization.plan import CELL, NODE_BLOCK, REGION, VoxelizePlan

SOURCE = "svo/voxelization/scan_conversion.cl"
TOUCHED, SEPARATING, CROSSED, COVERED, MET = range(5)  # what a triangle is scan-converted into
NODE_LEVEL = CELL.bit_length() - 1
BLOCK_WORDS = (NODE_BLOCK // CELL) ** 3 // 32


# The spread bits of each byte, for each axis.
MORTON_TABLE = np.array([spread_bits(np.arange(256)) << axis for axis in range(3)], np.uint32)


def _morton_table() -> str:
    """Return MORTON_TABLE as an OpenCL constant."""
    axes = ("{" + ", ".join(map(str, bits)) + "}" for bits in MORTON_TABLE.tolist())
    return f"__constant const uint SPREAD[3][256] = {{{', '.join(axes)}}};"


HEADERS = {
    "svo/voxelization/scan_conversion_constants.h": program.c_constants(
        TOUCHED=TOUCHED,
        SEPARATING=SEPARATING,
        CROSSED=CROSSED,
        COVERED=COVERED,
        MET=MET,
        NODE_LEVEL=NODE_LEVEL,
        NODE_BLOCK=NODE_BLOCK,
    ),
    "svo/voxelization/morton_table.h": _morton_table(),
}
Lookup = dict[str, Any]  # arguments by which kernels find a node's rank, and its target


@dataclass(frozen=True)
class BitSet:
    """A set of cells."""

    words: Array  # bits of the cells in Morton order, 32 a word
    ranks: Array  # set bits before each word
    codes: Array  # ascending Morton codes of the n cells in the set
    n: int

    def get(self) -> np.ndarray:
        """Return the codes on the host."""
        return self.codes.get(0, self.n)


@dataclass(frozen=True)
class ActiveNodes:
    """The active level-1 nodes."""

    nodes: BitSet
    above: tuple[BitSet, ...]  # the blocks that have words, unless all have; before them regions
    tree: DeviceOctree | None = None  # if a node is found in it, and not by its rank

    @property
    def lookup(self) -> Lookup:
        """Arguments by which kernels find the rank of a node."""
        return _lookup(self.above, self.nodes.words, self.nodes.ranks, self.tree)


class Scan:
    """Launches kernels over the triangles of a mesh, in the variants that the plan selects."""

    def __init__(self, mesh: LatticeMesh, plan: VoxelizePlan) -> None:
        self.mesh, self.plan, self.device = mesh, plan, mesh.device
        self.code = np.dtype(np.uint32 if plan.code_bits == 32 else np.uint64)
        self.options: dict[str, int | str] = {
            "CODE": code_name(self.code),
            "COLUMN_TILE": plan.column_tile,
            **mesh.options,
            **({"WIDE": 1} if plan.wide else {}),
            **({"MORTON_TABLE": 1} if plan.morton == "table" else {}),
            **({"BASE_OVERLAP": 1} if plan.overlap == "base" else {}),
            **({"DESCENT": 1} if plan.descends else {}),
            **({"ANCESTORS": 1} if plan.descends and plan.addressing == "jumps" else {}),
            **({"PLANE_TILE": BRICK_SIDE} if plan.plane_tiles else {}),
        }

    def kernel(self, source: str, name: str, **more: int) -> Callable[..., None]:
        """Return a kernel compiled with the plan's options, and more."""
        return self.device.kernel(source, name, **self.options, **more)

    def shares(
        self, kind: int, level: int = 0, faces: Array | None = None
    ) -> tuple[int, dict[str, Any]]:
        """Return the number of work-items for triangles in boxes of 2**level voxels, and the
        kernels' arguments by name; faces : other than the mesh's."""
        n = faces.size // 3 if faces else self.mesh.triangles
        arguments: dict[str, Any] = {
            "vertices": self.mesh.vertices,
            "faces": faces or self.mesh.faces,
            "triangles": n,
            "tile_offsets": None,
            "level": level,
            "shape": tuple(-(-side >> level) for side in self.plan.shape),
            # for a solid, level-1 nodes are widened along x, so that the first voxel at or beyond
            # every crossing lies in an active node ([voCCeL], eq. 3.6)
            "pad": 1 << (self.mesh.bits - 1) if self.plan.solid and level else 0,
        }
        if not (self.plan.tiled_nodes if level else self.plan.tiled):
            return n, arguments
        tiles = self.device.empty(n + 1, np.uint32)
        self.kernel(SOURCE, "count_tiles")(n, kind, tiles, **arguments)
        if n * (max(self.plan.shape) // self.plan.column_tile + 1) ** 2 >= 1 << 32:
            total = int(tiles.get(0, n).sum(dtype=np.uint64))
            if total >= 1 << 32:
                raise MemoryLimitError(
                    f"{total:,} shares of large triangles exceed 32-bit indices: choose a smaller "
                    "dim, or voxelize windows of the grid"
                )
        return exclusive_scan(tiles, n), {**arguments, "tile_offsets": tiles}

    def set_boxes(self, kind: int, lookup: Lookup, *of: Any) -> None:
        """Set the bits, in the target of a lookup, of boxes that triangles touch, or that separate;
        `of` as for `shares`."""
        n, triangles = self.shares(kind, *of)
        self.kernel(SOURCE, "set_boxes")(n, kind, **lookup, **triangles)

    def surface(self, active: ActiveNodes) -> Array:
        """Return the bricks of the active nodes, with the voxels of the surface set."""
        return self.voxels(TOUCHED if self.plan.surface == "26" else SEPARATING, active)

    def voxels(self, kind: int, active: ActiveNodes) -> Array:
        """Return the bricks of the active nodes, with the voxels that triangles touch, or that
        separate, set."""
        bricks = self.device.zeros(8 * active.nodes.n, BRICK)
        self.set_boxes(kind, {**active.lookup, "target": bricks})
        return bricks


def find_active_nodes(scan: Scan) -> ActiveNodes:
    """Return the level-1 nodes that the mesh touches."""
    return _find(scan, lambda level, lookup: scan.set_boxes(TOUCHED, lookup, level))


def add_nodes(scan: Scan, nodes: np.ndarray, faces: Array | None = None) -> ActiveNodes:
    """Return the level-1 nodes whose Morton codes are given, and those that some faces touch."""
    codes = scan.device.put(nodes.astype(scan.code))

    def activate(level: int, lookup: Lookup) -> None:
        scan.kernel(SOURCE, "activate_nodes")(codes.size, codes, level, **lookup)
        if faces:
            scan.set_boxes(TOUCHED, lookup, level, faces)

    return _find(scan, activate)


def _find(scan: Scan, activate: Callable[[int, Lookup], None]) -> ActiveNodes:
    """Return the level-1 nodes whose bits `activate` sets, of boxes of 2**level voxels."""
    plan = scan.plan
    sides = [REGION] * (plan.blocked and plan.regions) + [NODE_BLOCK] * plan.blocked + [CELL]
    sets: tuple[BitSet, ...] = ()
    above: BitSet | None = None
    for side in sides:
        count = BLOCK_WORDS * above.n if above else max((plan.side // side) ** 3 // 32, 1)
        words = scan.device.zeros(count, np.uint32)
        activate(side.bit_length() - 1, {**_lookup(sets, words, words), "target": words})
        above = _collect(scan, words, above)
        sets = (*sets, above)
    assert above
    return ActiveNodes(above, sets[:-1])


def _lookup(
    above: tuple[BitSet, ...], words: Array, ranks: Array, tree: DeviceOctree | None = None
) -> Lookup:
    regions, blocks = (None, None, *above)[-2:]
    found: Lookup = {"words": words, "ranks": ranks}
    for name, cells in (("region", regions), ("block", blocks)):
        found[f"{name}_words"] = cells and cells.words
        found[f"{name}_ranks"] = cells and cells.ranks
    if tree is None:
        return {**found, "tree": None, "tree_offsets": None, "top": 0}
    offsets = words.device.put(tree.offsets)
    return {**found, "tree": tree.nodes, "tree_offsets": offsets, "top": tree.top}


def _collect(scan: Scan, words: Array, above: BitSet | None) -> BitSet:
    """Return the set with the given bits."""
    n = words.size
    ranks = scan.device.empty(n + 1, np.uint32)
    scan.kernel(SOURCE, "count_bits")(n, words, ranks)
    count = exclusive_scan(ranks, n)
    codes = scan.device.empty(count, scan.code)
    scan.kernel(SOURCE, "write_mortons")(n, words, ranks, above and above.codes, codes)
    return BitSet(words, ranks, codes, count)
