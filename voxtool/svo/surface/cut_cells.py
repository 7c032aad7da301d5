"""The cubes of an octree's samples that the surface cuts, without a dense grid.

A sample is a node of one level, its scalar the number of its voxels that are set; or a voxel, or
how much of it is inside if the octree has fractions. A
cube has samples at its eight corners; it is cut if some of them are inside and others are not.
Cubes begin at the level's nodes or beside them in uniform space: the NullCubes of [voCCeL, section
4.1], which are listed, sorted and made unique there. Here 4 x 4 x 4 samples are a tile, and a set
of tiles is one bit each in Morton order, so it needs no sorting. The inside samples of a tile are a
mask in the order of a brick, so its 64 cubes are classified at once.

Where an inside leaf touches an empty one and no node lies between them (octrees of open meshes have
such leaves), the tiles along their contact are found, too.

Kernels: kernels/svo/surface/cut_cells.cl.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.opencl import Array, Device
from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.layout import BRICK_SIDE, BRICK_VOXELS, INSIDE, LINK, NODE, VALID
from voxtool.svo.octree import VOXEL, Octree
from voxtool.svo.surface.isosurface import Features, Lost

SOURCE = "svo/surface/cut_cells.cl"
MAX_PRESENT = 1 << 24  # tiles: 32 bits count their 192 edges each
MAX_EDGES = 1 << 30  # that the surface cuts
MAX_LEVEL = 8  # up to which 32 bits count a node's voxels
ISOVALUE_BITS = 16  # of a fraction of a voxel
FULL_VOXEL = 1 << 15  # the scalar of a voxel that is wholly inside, of fractions
_BIT = np.uint64(1) << np.arange(BRICK_SIDE**3, dtype=np.uint64)
LOW_LAYER = [np.bitwise_or.reduce(_BIT[BRICK_VOXELS[:, a] == 0]) for a in range(3)]
LOST_ITEMS = 256  # work-items that count lost voxels


@dataclass(frozen=True)
class Sampling:
    """A level of samples, and an isovalue."""

    level: int  # of the nodes that are samples, or VOXEL
    isovalue: int  # of a sample's scalar, in 2**-16: that of the request, rounded once
    fractions: bool = False  # whether scalars of voxels are how much of them is inside

    @classmethod
    def of(cls, level: int | str, isovalue: float, fractions: bool = False) -> Sampling:
        """Return the sampling of a level, or "voxel", and an isovalue in (0, 1)."""
        sampling = cls(VOXEL if isinstance(level, str) else level, 0, fractions)
        scale = sampling.full << ISOVALUE_BITS  # a power of two: the product is exact
        return replace(sampling, isovalue=min(max(round(isovalue * scale), 1), scale))

    @property
    def side(self) -> int:
        """Voxels along a side of a sample."""
        return 1 << (self.level - VOXEL)

    @property
    def full(self) -> int:
        """The scalar of a sample that is wholly inside: its voxels, or FULL_VOXEL."""
        return FULL_VOXEL if self.fractions else self.side**3

    @property
    def binary(self) -> bool:
        """True if samples are voxels that are set or not."""
        return self.level == VOXEL and not self.fractions

    @property
    def threshold(self) -> int:
        """The least scalar of a sample that is inside."""
        return -(-self.isovalue >> ISOVALUE_BITS)

    @property
    def options(self) -> dict[str, int | str]:
        """The -D options of the kernels."""
        if self.binary:
            return {"VOXELS": 1}
        if self.fractions:
            return {"FRACTIONS": 1, "SAMPLE": "ushort", "DIFFERENCE": "uint"}
        if self.level == 0:
            return {"SAMPLE": "uchar", "COVERAGE": "ulong", "DIFFERENCE": "uint"}
        return {"SAMPLE": "uint", "COVERAGE": "uint", "DIFFERENCE": "ulong"}


@dataclass(frozen=True)
class Tree:
    """The links of an octree from its root down to level 1.

    Roots are added above the octree's where tiles are larger than it, or where its voxels touch the
    low sides of its cube, because cubes begin one sample below them.
    """

    nodes: np.ndarray  # the octree's, root first
    offsets: list[int]  # the first node of each level in them, and their end
    bricks: int  # number of bricks
    shift: int  # voxels from the root's corner to the octree's, along each axis

    @property
    def top(self) -> int:
        """The root's level."""
        return len(self.offsets) - 1

    def first(self, level: int) -> int:
        """Return the place of a level's first node."""
        return self.offsets[self.top - level]

    def count(self, level: int) -> int:
        """Return the number of nodes of a level."""
        if not level:
            return self.bricks
        return self.offsets[self.top - level + 1] - self.offsets[self.top - level]


def tree_of(octree: Octree) -> Tree:
    """Return the octree's links."""
    offsets = octree.offsets[:-1].tolist()
    return Tree(octree.nodes[: offsets[-1]], offsets, len(octree.bricks), 0)


def grow_tree(octree: Octree, sampling: Sampling) -> Tree:
    """Return the octree's links, with roots added above its own where they are needed."""
    tree = tree_of(octree)
    if _touches_low_sides(tree, octree.bricks, sampling):
        tree = replace(_with_root(tree, 7), shift=octree.grid.side)
    while tree.top < sampling.level + 2:
        tree = _with_root(tree, 0)
    return tree


def _with_root(tree: Tree, octant: int) -> Tree:
    """Return the tree with a root above its own, which becomes the child in an octant."""
    above = np.zeros(9, NODE)
    above["child"][0] = VALID
    above["child"][1 + octant] = tree.nodes["child"][0]
    nodes = np.concatenate([above, tree.nodes[1:]])
    offsets = [0, 1, *(offset + 8 for offset in tree.offsets[1:])]
    return replace(tree, nodes=nodes, offsets=offsets)


def _touches_low_sides(tree: Tree, bricks: np.ndarray, sampling: Sampling) -> bool:
    """Return True if a voxel is set, or above level 0 may be set, in the first samples along an
    axis."""
    nodes = np.zeros(1, np.uint32)
    sides = np.full(1, 7, np.uint8)  # the low sides at which a node lies: a bit for each axis
    octants = np.arange(8, dtype=np.uint32)
    high_sides = ~octants.astype(np.uint8)
    for level in range(tree.top, 0, -1):
        child = tree.nodes["child"][tree.first(level) + nodes]
        refined = np.flatnonzero(child & VALID)
        if (child & INSIDE).any() or (level == sampling.level and len(refined)):
            return True
        below = sides[refined, None] & high_sides
        parent, octant = np.nonzero(below)
        sides = below[parent, octant]
        nodes = (child[refined] & LINK)[parent] + octants[octant]
    if sampling.level != VOXEL:
        return bool(bricks[nodes].any())
    return any((bricks[nodes[sides >> a & 1 == 1]] & LOW_LAYER[a]).any() for a in range(3))


@dataclass(frozen=True)
class Tiles:
    """The tiles that hold a cube that may be cut, which are called present, on the device.

    The arguments of kernels, by name:

    words : number of words in a set of tiles, which has a bit for each tile of the root.
    present, inside : (words,) sets of the present tiles and of those that are wholly inside.
    ranks : (words,) number of present tiles before each word.
    codes, masks, source : (n,) Morton code and inside samples of each present tile, and its number
        among the tiles that have nodes, if it is one.
    samples, below, lost_below : set voxels of the 64 samples of each tile that has nodes; as a mask
        those samples that have set voxels and are not inside, and the set voxels of these; missing
        if samples are voxels.
    full, isovalue : voxels of a sample, and the isovalue.
    shift : samples from the root's corner to the grid's, along each axis.
    """

    device: Device
    sampling: Sampling
    n: int
    arguments: dict[str, Any]
    core: tuple[int, int]  # the places of the first tile and beyond the last one that are asked for

    def kernel(self, source: str, name: str, **defines: int) -> Callable[..., None]:
        """Return a kernel compiled for the type of samples, with further -D options."""
        return self.device.kernel(source, name, **self.sampling.options, **defines)


@dataclass(frozen=True)
class Extracted:
    """A surface on the device.

    cubes : number of cut cubes.
    lost : as of count_lost.
    points : (3 V,) int32 as Isosurface.points.
    triangles : (3 F,) uint32 vertices, counter-clockwise seen from outside.
    first, runs : (runs n + 1,) uint32, the numbers of vertices, of triangles or quads, and at last
        of cut cubes before each of n tiles; those of each run begin with the sum of the runs
        before. Of merged faces it holds no longer.
    features, homes : of a sharp surface; homes: (3 V,) int32, where vertices may move to: their
        best places in their cells, and the means of their crossings.
    """

    cubes: int
    lost: Array | None
    points: Array
    triangles: Array
    first: Array
    runs: int
    features: Features | None = None
    homes: tuple[Array, ...] = ()


def find_tiles(
    device: Device,
    octree: Octree,
    tree: Tree,
    sampling: Sampling,
    counted: Callable[..., None],
    core: tuple[int, int] | None = None,
    naive: bool = False,
) -> Tiles:
    """Return the tiles that hold a cube that may be cut, and their samples; of those asked for are
    all, or those whose codes are from `core[0]` to below `core[1]`. If `naive`, all tiles of the
    root are returned. Before memory is taken for them, `counted` is called with `tiles=`, their
    number. MemoryLimitError is raised if there are
    more than MAX_PRESENT."""
    side = 1 << (tree.top - sampling.level - 2)  # tiles along a side of the root
    words = max(side**3 // 64, 1)
    with device.stage("tiles"):
        inside, active = device.zeros(words, np.uint64), device.zeros(words, np.uint64)
        if naive:
            active = device.put(np.full(words, (1 << min(side**3, 64)) - 1, np.uint64))
        scene = {
            "words": words,
            "inside": inside,
            "full": sampling.full,
            "isovalue": sampling.isovalue,
            "bricks": device.view(octree.bricks),
            "nodes": device.view(tree.nodes),
            **(_fractions_of(device, octree) if sampling.fractions else {}),
        }
        tiles = Tiles(device, sampling, 0, scene, (0, 0))
        nodes = _place_nodes(tiles, tree, active)
        present, ranks = device.empty(words, np.uint64), device.empty(words + 1, np.uint32)
        tiles.kernel(SOURCE, "find_tiles")(words, active, inside, present, ranks)
        del active
        n = exclusive_scan(ranks, words)
        if n > MAX_PRESENT:
            raise MemoryLimitError(
                f"{n:,} tiles of samples exceed the {MAX_PRESENT:,} that are extracted: choose a "
                "coarser level"
            )
        counted(tiles=n)
        scene |= {
            "shift": tree.shift // sampling.side,
            "present": present,
            "ranks": ranks,
            "codes": device.empty(n, np.uint32),
            "masks": device.empty(n, np.uint64),
            "source": device.empty(n, np.uint32),
        }
        tiles.kernel(SOURCE, "list_tiles")(words, **scene)
    with device.stage("samples"):
        _sample_tiles(tiles, tree, nodes)
    del scene["bricks"], scene["nodes"]  # frees memory
    asked = (0, n) if core is None else scene["codes"].get(0, n).searchsorted(core)
    return replace(tiles, n=n, core=(int(asked[0]), int(asked[1])))


def _fractions_of(device: Device, octree: Octree) -> dict[str, Array]:
    """Return the masks of voxels that have a fraction of their own, the number of such voxels
    before each brick, and their scalars."""
    fraction = octree.attribute("fraction")
    values, firsts = fraction.values, fraction.starts(octree.bricks)
    if values.dtype.kind == "f":  # float32 times a power of two: exact
        scalars = np.floor(values * np.float32(FULL_VOXEL) + np.float32(0.5))
    else:
        most = int(np.iinfo(values.dtype).max)
        scalars = (values.astype(np.uint64) * FULL_VOXEL + most // 2) // most
    return {
        "partial": device.put(fraction.held(octree.bricks)),
        "firsts": device.put(firsts.astype(np.uint32)),
        "fractions": device.put(scalars.astype(np.uint16)),
    }


def _place_nodes(tiles: Tiles, tree: Tree, active: Array) -> Array:
    """Return the Morton codes of the nodes whose descendants are samples: one a tile, or one for
    eight tiles if samples are voxels. Mark these tiles as active, and those in inside leaves from
    their level up."""
    place_nodes, level = tiles.kernel(SOURCE, "place_nodes"), tiles.sampling.level
    codes = tiles.device.empty(0, np.uint32)
    last = max(level + 2, 1)
    for own in range(tree.top, last - 1, -1):
        above, codes = codes, tiles.device.empty(tree.count(own - 1) // 8, np.uint32)
        place_nodes(
            tree.count(own), tree.first(own), above, own == tree.top, own == last,
            3 * (own - level - 2), codes, active=active, **tiles.arguments,
        )  # fmt: skip
    return codes


def _sample_tiles(tiles: Tiles, tree: Tree, nodes: Array) -> None:
    """Set the masks of the tiles that have nodes and, unless samples are voxels, add their samples
    and those below the isovalue."""
    device, sampling, scene = tiles.device, tiles.sampling, tiles.arguments
    sample_tiles = tiles.kernel(SOURCE, "sample_tiles")
    if sampling.binary:
        sample_tiles(scene["bricks"].size, nodes, **scene)
        return
    if sampling.fractions:
        n = scene["bricks"].size
        scene["samples"] = device.empty(64 * n, np.uint16)
        sample_tiles(n, nodes, threshold=sampling.threshold, **scene)
        for name in ("partial", "firsts", "fractions"):
            del scene[name]  # frees memory
        return
    cover_level = tiles.kernel(SOURCE, "cover_level")
    coverage = scene["bricks"]
    for level in range(1, sampling.level + 1):
        finer, coverage = coverage, device.empty(tree.count(level), np.uint32)
        sized = {**scene, "full": (BRICK_SIDE << level) ** 3}
        cover_level(coverage.size, tree.first(level), finer, level == 1, coverage, **sized)
    sampled = np.uint8 if sampling.level == 0 else np.uint32
    scene["samples"] = device.empty(64 * nodes.size, sampled)
    scene["below"] = device.empty(nodes.size, np.uint64)
    scene["lost_below"] = device.empty(nodes.size, np.uint32)
    first = tree.first(sampling.level + 1)
    limits = sampling.full, sampling.threshold
    sample_tiles(nodes.size, nodes, first, limits, coverage, **scene)


def check_edges(edges: int) -> None:
    """Raise MemoryLimitError if there are more cut edges than links of 32 bits have."""
    if edges >= MAX_EDGES:
        raise MemoryLimitError(
            f"{edges:,} cut edges exceed links of 32 bits: choose a coarser level"
        )


def count_lost(tiles: Tiles, cut: Array) -> Array | None:
    """Count the set voxels in samples of the core that are not inside, given the mask of the cut
    cubes of each tile; `lost_of` reads the counts. None if samples are voxels."""
    if tiles.sampling.level == VOXEL:
        return None
    with tiles.device.stage("lost voxels"):
        counts = tiles.device.empty(2 * LOST_ITEMS, np.uint64)
        tiles.kernel(SOURCE, "count_lost")(
            LOST_ITEMS, core=tiles.core, cut=cut, lost=counts, **tiles.arguments
        )
    return counts


def lost_of(counts: Array | None) -> Lost:
    """Return what `count_lost` counted."""
    below, vanished = (0, 0) if counts is None else counts.take().reshape(-1, 2).sum(axis=0)
    return Lost(int(below), int(vanished))
