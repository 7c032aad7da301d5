"""The cubes of an octree's samples that the surface cuts, without a dense grid.

A sample is a node of one level, its scalar the number of its voxels that are set; or a voxel, or
how much of it is inside if the octree has fractions. A
cube has samples at its eight corners; it is cut if some of them are inside and others are not.
Cubes begin at the level's nodes or beside them in uniform space: the NullCubes of [voCCeL, section
4.1], which are listed, sorted and made unique there. Here 4 x 4 x 4 samples are a tile, and a set
of tiles is one bit each in words of 4 x 4 x 4 tiles, which are listed in Morton order (words.py).
The inside samples of a tile are a mask in the order of a brick, so its 64 cubes are classified at
once.

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
from voxtool.svo.octree.layout import BRICK_SIDE
from voxtool.svo.octree.octree import VOXEL, Octree
from voxtool.svo.surface.isosurface import Features, Lost
from voxtool.svo.surface.samples import FULL_VOXEL, WORD_LEVELS, Sampling, Tree
from voxtool.svo.surface.words import find_words

SOURCE = "svo/surface/cut_cells.cl"
MAX_PRESENT = 1 << 24  # tiles: 32 bits count their 192 edges each
MAX_EDGES = 1 << 30  # that the surface cuts
MAX_LEVEL = 8  # up to which 32 bits count a node's voxels
LOST_ITEMS = 256  # work-items that count lost voxels


@dataclass(frozen=True)
class Tiles:
    """The tiles that hold a cube that may be cut, which are called present, on the device.

    The arguments of kernels, by name:

    word_codes : (w,) Morton codes of the words, ascending.
    places, hash_shift : those of Words.table.
    present, inside : (w,) sets of the present tiles and of those that are wholly inside.
    ranks : (w,) number of present tiles before each word.
    codes, masks, source : (n,) Morton code and inside samples of each present tile, and its number
        among the tiles that have nodes, if it is one.
    samples : set voxels of the 64 samples of each tile that has nodes.
    below, lost_below : mask of the samples that have set voxels and are not inside, and the number
        of their set voxels. Both, and `samples`, are missing if samples are voxels.
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
    lost : as count_lost returns it.
    points : (3 V,) int32 as Isosurface.points.
    triangles : (3 F,) uint32 vertices, counter-clockwise seen from outside.
    first, runs : (runs n + 1,) uint32, the numbers of vertices, of triangles or quads, and at last
        of cut cubes before each of n tiles; those of each run begin with the sum of the runs
        before. It does not hold for merged faces.
    features, homes : missing unless the surface is sharp; homes : (3 V,) int32, where vertices may
        move to: their best places in their cells, and the means of their crossings.
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
    """Return the tiles that hold a cube that may be cut, and their samples: all, or those whose
    codes are from `core[0]` to below `core[1]`; all tiles of the root if `naive`. Before memory is
    taken for them, `counted` is called with `tiles=`, their number. MemoryLimitError is raised if
    there are more than MAX_PRESENT."""
    with device.stage("tiles"):
        words = find_words(tree, sampling.level + WORD_LEVELS, naive)
        w = len(words.codes)
        counted(words=w)
        places, hash_shift = words.table()
        inside, active = device.put(words.inside), device.zeros(w, np.uint64)
        if naive:
            active = device.put(np.full(w, ~np.uint64(0)))
        scene = {
            "word_codes": device.put(words.codes),
            "places": device.put(places),
            "hash_shift": hash_shift,
            "inside": inside,
            "full": sampling.full,
            "isovalue": sampling.isovalue,
            "bricks": device.view(octree.bricks),
            "nodes": device.view(tree.nodes),
            **(_fractions_of(device, octree) if sampling.fractions else {}),
        }
        tiles = Tiles(device, sampling, 0, scene, (0, 0))
        nodes = _place_nodes(tiles, tree, device.put(words.refined), active)
        present, ranks = device.empty(w, np.uint64), device.empty(w + 1, np.uint32)
        along = 1 << (tree.top - sampling.level - WORD_LEVELS)  # words along a side of the root
        find_tiles = tiles.kernel(SOURCE, "find_tiles")
        find_tiles(w, active, root=along**3, present=present, counts=ranks, **scene)
        del active
        n = exclusive_scan(ranks, w)
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
            "codes": device.empty(n, np.uint64),
            "masks": device.empty(n, np.uint64),
            "source": device.empty(n, np.uint32),
        }
        tiles.kernel(SOURCE, "list_tiles")(w, **scene)
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


def _place_nodes(tiles: Tiles, tree: Tree, codes: Array, active: Array) -> Array:
    """Return the Morton codes of the nodes whose descendants are samples: one a tile, or one for
    eight tiles if samples are voxels; `codes` are those of the refined words. Mark these tiles as
    active, and those in inside leaves."""
    place_nodes, level = tiles.kernel(SOURCE, "place_nodes"), tiles.sampling.level
    last = max(level + 2, 1)
    for own in range(level + WORD_LEVELS - 1, last - 1, -1):
        above, codes = codes, tiles.device.empty(tree.count(own - 1) // 8, np.uint64)
        place_nodes(
            tree.count(own), tree.first(own), above, own == last, 3 * (own - level - 2), codes,
            active=active, **tiles.arguments,
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
