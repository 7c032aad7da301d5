"""The cubes of an octree's samples that the surface cuts, without a dense grid.

A cube has samples at its eight corners; it is cut if some of them are inside and others are not.
Cubes begin at the level's nodes or beside them in uniform space: the NullCubes of [voCCeL, section
4.1], which are listed, sorted and made unique there. Here 4 x 4 x 4 samples are a tile, and a set
of tiles is one bit each in Morton order, so it needs no sorting. The inside samples of a tile are a
mask in the order of a brick, so its 64 cubes are classified at once.

Where an inside leaf touches an empty one and no node lies between them (octrees of open meshes have
such leaves), the tiles along their contact are found, too.

Kernels: kernels/svo/surface/cut_cells.cl.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.opencl import Array, Device
from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.octree import Octree
from voxtool.svo.surface.isosurface import Lost
from voxtool.svo.surface.sampling import VOXEL, Sampling, Tree

if TYPE_CHECKING:
    from collections.abc import Callable

SOURCE = "svo/surface/cut_cells.cl"
MAX_PRESENT = 1 << 24  # tiles: 32 bits count their 192 edges each
LOST_ITEMS = 256  # work-items that count lost voxels


@dataclass(frozen=True)
class Tiles:
    """The present tiles of a sampling, on the device.

    n : number of present tiles.
    present, inside : a bit for each tile of the root, in words of 64: whether it has a slot, and
        whether all of it is inside.
    ranks : number of present tiles before each word.
    codes, masks, source : (n,) Morton code and inside samples of each present tile, and its number
        among the active tiles, if it is one.
    samples, below : set voxels of the 64 samples of each active tile, and as a mask those samples
        that have set voxels and are not inside; None if samples are voxels.
    shift : samples that the grid's corner lies from the root's, along each axis.
    """

    sampling: Sampling
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
    def arguments(self) -> dict[str, Any]:
        """Arguments of kernels, by name: TILES and SAMPLES among them."""
        return {
            "codes": self.codes,
            "present": self.present,
            "ranks": self.ranks,
            "inside": self.inside,
            "words": self.present.size,
            "masks": self.masks,
            "source": self.source,
            "samples": self.samples,
            "full": self.sampling.full,
            "isovalue": self.sampling.isovalue,
            "shift": self.shift,
        }


def find_tiles(
    device: Device, octree: Octree, tree: Tree, sampling: Sampling, counted: Callable[..., None]
) -> Tiles:
    """The tiles that hold a cube that may be cut, and their samples.

    Parameters
    ----------
    counted : called with `tiles=`, their number, before memory is taken for them.

    Raises
    ------
    MemoryLimitError : there are more than MAX_PRESENT tiles; or what `counted` raises.
    """
    words = max(tree.tiles_along_side(sampling) ** 3 // 64, 1)
    with device.stage("tiles"):
        bricks = device.view(octree.bricks)
        children = device.view(tree.children)
        inside = device.zeros(words, np.uint64)
        refined = _place_nodes(device, tree, children, sampling, inside)
        active = device.zeros(words, np.uint64)
        kernel(device, sampling, "mark_tiles")(refined.size, refined, active)
        present, ranks = device.empty(words, np.uint64), device.empty(words + 1, np.uint32)
        kernel(device, sampling, "find_tiles")(words, active, inside, present, ranks)
        del active
        n = exclusive_scan(ranks, words)
        if n > MAX_PRESENT:
            raise MemoryLimitError(
                f"{n:,} tiles of samples exceed the {MAX_PRESENT:,} that are extracted: choose a "
                "coarser level"
            )
        counted(tiles=n)
        codes, source = device.empty(n, np.uint32), device.empty(n, np.uint32)
        masks = device.empty(n, np.uint64)
        kernel(device, sampling, "list_tiles")(words, present, ranks, inside, codes, masks, source)
    shift = tree.shift // sampling.side
    tiles = Tiles(sampling, n, present, inside, ranks, codes, masks, source, None, None, shift)
    with device.stage("samples"):
        if sampling.level == VOXEL:
            kernel(device, sampling, "sample_tiles")(
                bricks.size, refined, bricks, present, ranks, masks, source
            )
            return tiles
        samples, below = _sample_nodes(device, tree, tiles, refined, children, bricks)
        return replace(tiles, samples=samples, below=below)


def kernel(device: Device, sampling: Sampling, name: str) -> Callable[..., None]:
    """A kernel of kernels/svo/surface/cut_cells.cl for this sampling."""
    return device.kernel(SOURCE, name, **sampling.options)


def _place_nodes(
    device: Device, tree: Tree, children: Array, sampling: Sampling, inside: Array
) -> Array:
    """The Morton codes of the nodes whose descendants are samples: one a tile, or one for eight
    tiles if samples are voxels. Marks the tiles in inside leaves from their level up."""
    place_nodes = kernel(device, sampling, "place_nodes")
    codes = device.empty(0, np.uint32)
    for level in range(tree.top, max(sampling.level + 2, 1) - 1, -1):
        above, codes = codes, device.empty(tree.nodes(level - 1) // 8, np.uint32)
        place_nodes(
            tree.nodes(level),
            children,
            first=tree.first(level),
            above_codes=above,
            is_root=level == tree.top,
            shift=3 * (level - sampling.level - 2),
            codes=codes,
            inside=inside,
        )
    return codes


def _sample_nodes(
    device: Device, tree: Tree, tiles: Tiles, refined: Array, children: Array, bricks: Array
) -> tuple[Array, Array]:
    """The samples of each active tile and those below the isovalue; sets the tiles' masks."""
    sampling = tiles.sampling
    coverage = bricks
    for level in range(1, sampling.level + 1):
        finer, coverage = coverage, device.empty(tree.nodes(level), np.uint32)
        kernel(device, sampling, "cover_level")(
            coverage.size,
            children,
            first=tree.first(level),
            full=(BRICK_SIDE << level) ** 3,
            bricks=bricks,
            below=finer,
            below_bricks=level == 1,
            coverage=coverage,
        )
    sampled = np.uint8 if sampling.level == 0 else np.uint32
    samples, below = device.empty(64 * refined.size, sampled), device.empty(refined.size, np.uint64)
    kernel(device, sampling, "sample_tiles")(
        refined.size,
        children=children,
        first=tree.first(sampling.level + 1),
        threshold=sampling.threshold,
        bricks=bricks,
        coverage=coverage,
        below=below,
        **{**tiles.arguments, "codes": refined, "samples": samples},
    )
    return samples, below


@dataclass(frozen=True)
class CutCubes:
    """The cubes that the surface cuts, on the device, in the order of their tiles.

    n, edges : number of cubes and of edges that are cut.
    cut, cut_edges : (tiles,), (3 tiles,) masks of the cut cubes of each tile, and of its cut edges
        along x, y and z.
    first_cube, first_edge : (tiles + 1,), (3 tiles + 1,) number of cut cubes, and edges, before.
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
    def arguments(self) -> dict[str, Array]:
        """Arguments of kernels, by name: CUBES among them."""
        names = "cut", "cut_edges", "first_cube", "first_edge", "places", "cases"
        return {name: getattr(self, name) for name in names}


def classify_cubes(device: Device, tiles: Tiles, counted: Callable[..., None]) -> CutCubes:
    """The cubes whose corners are not all alike, and their cases.

    Parameters
    ----------
    counted : called with `tiles=`, `cubes=` and `edges=` before memory is taken for the cubes.

    Raises
    ------
    MemoryLimitError : there are 2**30 edges or more, beyond the 32-bit links of dual surfaces; or
        what `counted` raises.
    """
    cut, cut_edges = device.empty(tiles.n, np.uint64), device.empty(3 * tiles.n, np.uint64)
    first_cube = device.empty(tiles.n + 1, np.uint32)
    first_edge = device.empty(3 * tiles.n + 1, np.uint32)
    with device.stage("classify"):
        kernel(device, tiles.sampling, "classify_cubes")(
            tiles.n, cut, cut_edges, first_cube, first_edge, **tiles.arguments
        )
        cubes = exclusive_scan(first_cube, tiles.n)
        edges = exclusive_scan(first_edge, 3 * tiles.n)
        if edges >= 1 << 30:
            raise MemoryLimitError(
                f"{edges:,} cut edges exceed links of 32 bits: choose a coarser level"
            )
        counted(tiles=tiles.n, cubes=cubes, edges=edges)
        places, cases = device.empty(cubes, np.uint32), device.empty(cubes, np.uint8)
        kernel(device, tiles.sampling, "list_cubes")(
            tiles.n, first_cube, places, cases, **tiles.arguments
        )
    return CutCubes(cubes, edges, cut, cut_edges, first_cube, first_edge, places, cases)


def count_lost(device: Device, tiles: Tiles, cubes: CutCubes) -> Lost:
    """The set voxels in samples that are not inside."""
    if tiles.sampling.level == VOXEL:
        return Lost(0, 0)
    lost = device.empty(2 * LOST_ITEMS, np.uint64)
    with device.stage("lost voxels"):
        kernel(device, tiles.sampling, "count_lost")(
            LOST_ITEMS, tiles.n, below=tiles.below, cut=cubes.cut, lost=lost, **tiles.arguments
        )
        below, vanished = lost.take().reshape(-1, 2).sum(axis=0)
    return Lost(int(below), int(vanished))
