"""From an octree to the cubes that its surface cuts (the thesis, section 4.1), no dense grid.

A sample is a node of one level, its scalar the share of its voxels that are set; or a voxel. A cube
has eight samples at its corners and is cut where some are inside and others are not. Cubes begin at
the level's nodes, or beside them in empty or inside space: the thesis's NullCubes, which it lists,
sorts and makes unique. Here 4 x 4 x 4 samples are a tile, and a set of tiles is one bit each in
Morton order: bits that are set twice are set once, and their order is the sorted one. A tile's
inside samples are a mask in the order of a brick, so that its 64 cubes are classified at once.

Where an inside leaf touches an empty one and no node lies between (open meshes have such leaves),
the tiles along their contact are found, too; the thesis would leave holes.

Kernels: kernels/svo/surface/cut_cells.cl.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.opencl import Array, Device
from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.octree import BRICK_SIDE, BRICK_VOXELS, INSIDE, LINK, VALID, Octree
from voxtool.svo.surface.isosurface import Lost

if TYPE_CHECKING:
    from collections.abc import Callable

SOURCE = "svo/surface/cut_cells.cl"
VOXEL = -2  # the level of samples that are voxels: a node of level n spans 4 * 2**n of them
MAX_LEVEL = 8  # up to which a node's voxels are counted in 32 bits
MAX_PRESENT = 1 << 24  # tiles: their 192 edges each are counted in 32 bits
LOST_ITEMS = 256  # work-items that count lost voxels
ISOVALUE_BITS = 16  # of a fraction of a voxel
_BIT = np.uint64(1) << np.arange(BRICK_SIDE**3, dtype=np.uint64)
LOW_LAYER = [np.bitwise_or.reduce(_BIT[BRICK_VOXELS[:, a] == 0]) for a in range(3)]


@dataclass(frozen=True)
class Field:
    """Samples of a level, against an isovalue.

    level : VOXEL, or the level of the nodes that are samples.
    full : voxels of a sample.
    isovalue : of a sample's voxels, in 2**-16; the isovalue asked for is rounded to it once.
    """

    level: int
    full: int
    isovalue: int

    @classmethod
    def of(cls, level: int | str, isovalue: float) -> Field:
        """The field of a level, or "voxel", and an isovalue in (0, 1)."""
        level = VOXEL if isinstance(level, str) else level
        full = (BRICK_SIDE << level) ** 3 if level != VOXEL else 1
        scale = full << ISOVALUE_BITS
        return cls(level, full, min(max(round(Fraction(isovalue) * scale), 1), scale))

    @property
    def threshold(self) -> int:
        """The least number of voxels of a sample that is inside."""
        return ceil(Fraction(self.isovalue, 1 << ISOVALUE_BITS))

    @property
    def side(self) -> int:
        """Voxels along a side of a sample."""
        return BRICK_SIDE << self.level if self.level != VOXEL else 1

    @property
    def options(self) -> dict[str, int | str]:
        """What the kernels are built with."""
        if self.level == VOXEL:
            return {"VOXELS": 1}
        return {"SAMPLE": "uchar" if self.level == 0 else "uint"}


@dataclass(frozen=True)
class Tree:
    """The links of an octree from its root down to level 1, with roots added above it where tiles
    are larger than it, or its voxels touch the low sides of its cube.

    children : the nodes' `child` words, root first; offsets : where each level begins in them, and
    their end; bricks : how many.
    shift : voxels that the octree's corner lies from that of the root, along each axis.
    """

    children: np.ndarray
    offsets: np.ndarray
    bricks: int
    shift: int

    @property
    def top(self) -> int:
        """The root's level."""
        return len(self.offsets) - 1

    def first(self, level: int) -> np.uint32:
        """Where a level begins in `children`."""
        return np.uint32(self.offsets[self.top - level])

    def nodes(self, level: int) -> int:
        """How many nodes a level has."""
        return int(np.diff(self.offsets)[self.top - level]) if level else self.bricks

    def tiles_along_side(self, field: Field) -> int:
        """Tiles along a side of the root."""
        return 1 << (self.top - field.level - 2)


def grow(octree: Octree, field: Field) -> Tree:
    """The octree's links, with the cubes that begin below its low sides in reach."""
    offsets = octree.offsets[:-1].astype(np.int64)
    children = np.ascontiguousarray(octree.nodes["child"][: offsets[-1]])
    tree = Tree(children, offsets, len(octree.bricks), 0)
    if _touches_low_sides(tree, octree.bricks, field):
        tree = replace(_with_root(tree, 7), shift=octree.grid.side)
    while tree.top < field.level + 2:
        tree = _with_root(tree, 0)
    return tree


def _with_root(tree: Tree, octant: int) -> Tree:
    """A root above the root, which becomes its child in an octant."""
    siblings = np.zeros(8, np.uint32)
    siblings[octant] = tree.children[0]
    children = np.concatenate([np.array([VALID], np.uint32), siblings, tree.children[1:]])
    return replace(tree, children=children, offsets=np.append([0, 1], tree.offsets[1:] + 8))


def _touches_low_sides(tree: Tree, bricks: np.ndarray, field: Field) -> bool:
    """Whether a voxel is set in the first samples along an axis; above level 0, may be set."""
    nodes = np.zeros(1, np.uint32)
    sides = np.full(1, 7, np.uint8)  # the low sides that a node lies at: a bit each axis
    octants = np.arange(8, dtype=np.uint32)
    high_sides = ~octants.astype(np.uint8)
    for number in range(tree.top, 0, -1):
        child = tree.children[tree.first(number) + nodes]
        refined = np.flatnonzero(child & VALID)
        if (child & INSIDE).any() or (number == field.level and len(refined)):
            return True
        below = sides[refined, None] & high_sides
        parent, octant = np.nonzero(below)
        sides = below[parent, octant]
        nodes = (child[refined] & LINK)[parent] + octants[octant]
    if field.level != VOXEL:
        return bool(bricks[nodes].any())
    return any((bricks[nodes[sides >> a & 1 == 1]] & LOW_LAYER[a]).any() for a in range(3))


@dataclass(frozen=True)
class Tiles:
    """The present tiles of a field, on the device.

    present, inside : a bit each tile, in words of 64: those with a slot, those that are inside as a
    whole; ranks : present tiles before each word.
    codes, masks, source : (n,) of each present tile its Morton code, its inside samples, and which
    active tile it is, if any.
    samples, below : voxels of the 64 samples of each active tile, and (as a mask) which of them are
    not inside though they have some; None where samples are voxels.
    shift : samples that the grid's corner lies from the root's, along each axis.
    """

    field: Field
    n: int
    present: Array
    inside: Array
    ranks: Array
    codes: Array
    masks: Array
    source: Array
    samples: Array | None
    below: Array | None
    shift: int

    @property
    def arguments(self) -> tuple[Array | np.uint32, ...]:
        """What kernels find tiles and masks by: TILES."""
        return self.present, self.ranks, self.inside, np.uint32(self.present.size), self.masks

    @property
    def sample_arguments(self) -> tuple[Array | np.uint32 | np.uint64, ...]:
        """What kernels tell coverages by: SAMPLES."""
        isovalue = np.uint64(self.field.isovalue)
        if self.samples is None:
            return (isovalue,)
        return self.source, self.samples, np.uint32(self.field.full), isovalue

    def release(self) -> None:
        """Give back all device memory."""
        for array in (self.present, self.inside, self.ranks, self.codes, self.masks, self.source):
            array.release()
        for array in (self.samples, self.below):
            if array:
                array.release()


def find_tiles(
    device: Device, octree: Octree, tree: Tree, field: Field, counted: Callable[..., None]
) -> Tiles:
    """The tiles of samples that hold a cube that may be cut, and their samples.

    Parameters
    ----------
    counted : is told `tiles=`, how many there are, before memory is taken for them.

    Raises
    ------
    MemoryLimitError : they are more than MAX_PRESENT; or what `counted` raises.
    """
    words = max(tree.tiles_along_side(field) ** 3 // 64, 1)
    with device.stage("tiles"):
        bricks = device.view(octree.bricks)
        children = device.view(tree.children)
        inside = device.zeros(words, np.uint64)
        refined = _place_nodes(device, tree, children, field, inside)
        active = device.zeros(words, np.uint64)
        kernel(device, field, "mark_tiles")(refined.size, refined, np.uint32(refined.size), active)
        present, ranks = device.empty(words, np.uint64), device.empty(words + 1, np.uint32)
        kernel(device, field, "find_tiles")(words, active, inside, np.uint32(words), present, ranks)
        active.release()
        n = exclusive_scan(ranks, words)
        if n > MAX_PRESENT:
            raise MemoryLimitError(
                f"{n:,} tiles of samples exceed the {MAX_PRESENT:,} that are extracted: choose a "
                "coarser level"
            )
        counted(tiles=n)
        codes, source = device.empty(n, np.uint32), device.empty(n, np.uint32)
        masks = device.empty(n, np.uint64)
        kernel(device, field, "list_tiles")(
            words, present, ranks, inside, np.uint32(words), codes, masks, source
        )
    shift = tree.shift // field.side
    tiles = Tiles(field, n, present, inside, ranks, codes, masks, source, None, None, shift)
    with device.stage("samples"):
        if field.level == VOXEL:
            _sample_voxels(device, tiles, refined, bricks)
        else:
            samples, below = _sample_nodes(device, tree, tiles, refined, children, bricks)
            tiles = replace(tiles, samples=samples, below=below)
    for array in (refined, bricks, children):
        array.release()
    return tiles


def kernel(device: Device, field: Field, name: str) -> Callable[..., None]:
    """A kernel of kernels/svo/surface/cut_cells.cl for this field."""
    return device.kernel(SOURCE, name, **field.options)


def _place_nodes(device: Device, tree: Tree, children: Array, field: Field, inside: Array) -> Array:
    """The Morton codes of the nodes whose descendants are samples: a tile each, or eight where
    samples are voxels; inside leaves from their level up are marked."""
    place_nodes = kernel(device, field, "place_nodes")
    codes = device.empty(0, np.uint32)
    for level in range(tree.top, max(field.level + 2, 1) - 1, -1):
        above, codes = codes, device.empty(tree.nodes(level - 1) // 8, np.uint32)
        place_nodes(
            tree.nodes(level), children, tree.first(level), np.uint32(tree.nodes(level)), above,
            np.uint32(level == tree.top), np.uint32(3 * (level - field.level - 2)), codes, inside,
        )  # fmt: skip
        above.release()
    return codes


def _sample_voxels(device: Device, tiles: Tiles, refined: Array, bricks: Array) -> None:
    """The masks of the active tiles, which are the bricks."""
    kernel(device, tiles.field, "sample_tiles")(
        bricks.size, refined, np.uint32(bricks.size), bricks, tiles.present, tiles.ranks,
        tiles.masks, tiles.source,
    )  # fmt: skip


def _sample_nodes(
    device: Device, tree: Tree, tiles: Tiles, refined: Array, children: Array, bricks: Array
) -> tuple[Array, Array]:
    """The coverages of the samples of each active tile, from the bricks up, and those below; and
    the tiles' masks."""
    field = tiles.field
    finer = bricks
    for level in range(1, field.level + 1):
        coverage = device.empty(tree.nodes(level), np.uint32)
        kernel(device, field, "cover_level")(
            coverage.size, children, tree.first(level), np.uint32(coverage.size),
            np.uint32((BRICK_SIDE << level) ** 3), bricks, finer, np.uint32(level == 1), coverage,
        )  # fmt: skip
        if finer is not bricks:
            finer.release()
        finer = coverage
    sampled = np.uint8 if field.level == 0 else np.uint32
    samples, below = device.empty(64 * refined.size, sampled), device.empty(refined.size, np.uint64)
    kernel(device, field, "sample_tiles")(
        refined.size, refined, np.uint32(refined.size), children, tree.first(field.level + 1),
        np.uint32(field.full), np.uint32(field.threshold), bricks, finer,
        tiles.present, tiles.ranks, samples, below, tiles.masks, tiles.source,
    )  # fmt: skip
    if finer is not bricks:
        finer.release()
    return samples, below


@dataclass(frozen=True)
class CutCubes:
    """The cubes that the surface cuts, on the device, in the order of their tiles.

    n, edges : how many cubes and edges are cut.
    cut, cut_edges : the cut cubes of each tile, and its cut edges along x, y and z, as masks.
    first_cube, first_edge : (tiles + 1,), (3 tiles + 1,) how many cut cubes, and edges, are before.
    places, cases : (n,) slot of the tile << 6 | place in it, and case, of each cube.
    """

    n: int
    edges: int
    cut: Array
    cut_edges: Array
    first_cube: Array
    first_edge: Array
    places: Array
    cases: Array

    @property
    def lookup(self) -> tuple[Array, Array]:
        """What kernels find a cut cube by: CUBES."""
        return self.cut, self.first_cube

    def release(self) -> None:
        """Give back all device memory."""
        for array in (self.cut, self.cut_edges, self.first_cube, self.first_edge, self.places,
                      self.cases):  # fmt: skip
            array.release()


def classify_cubes(device: Device, tiles: Tiles, counted: Callable[..., None]) -> CutCubes:
    """The cubes whose corners are not all alike, and their cases.

    Parameters
    ----------
    counted : is told `tiles=`, `cubes=` and `edges=` before memory is taken for the cubes.

    Raises
    ------
    MemoryLimitError : there are 2**30 edges or more, of which dual surfaces have links of 32 bits;
        or what `counted` raises.
    """
    n = np.uint32(tiles.n)
    cut, cut_edges = device.empty(tiles.n, np.uint64), device.empty(3 * tiles.n, np.uint64)
    first_cube = device.empty(tiles.n + 1, np.uint32)
    first_edge = device.empty(3 * tiles.n + 1, np.uint32)
    with device.stage("classify"):
        kernel(device, tiles.field, "classify_cubes")(
            tiles.n, tiles.codes, n, *tiles.arguments, cut, cut_edges, first_cube, first_edge
        )
        cubes = exclusive_scan(first_cube, tiles.n)
        edges = exclusive_scan(first_edge, 3 * tiles.n)
        if edges >= 1 << 30:
            raise MemoryLimitError(
                f"{edges:,} cut edges exceed links of 32 bits: choose a coarser level"
            )
        counted(tiles=tiles.n, cubes=cubes, edges=edges)
        places, cases = device.empty(cubes, np.uint32), device.empty(cubes, np.uint8)
        kernel(device, tiles.field, "list_cubes")(
            tiles.n, tiles.codes, n, *tiles.arguments, first_cube, places, cases
        )
    return CutCubes(cubes, edges, cut, cut_edges, first_cube, first_edge, places, cases)


def count_lost(device: Device, tiles: Tiles, cubes: CutCubes) -> Lost:
    """The set voxels in samples that are not inside."""
    if tiles.field.level == VOXEL:
        return Lost(0, 0)
    lost = device.empty(2 * LOST_ITEMS, np.uint64)
    with device.stage("lost voxels"):
        kernel(device, tiles.field, "count_lost")(
            LOST_ITEMS, tiles.codes, np.uint32(tiles.n), *tiles.arguments, *tiles.sample_arguments,
            tiles.below, cubes.cut, np.uint32(LOST_ITEMS), lost,
        )  # fmt: skip
        below, vanished = lost.take().reshape(-1, 2).sum(axis=0)
    return Lost(int(below), int(vanished))
