"""The plan of an extraction, from the numbers of nodes of an octree."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from voxtool.choices import MARCHING_CUBES, SHARP, SURFACE_NETS, VOXEL_FACES
from voxtool.errors import MemoryLimitError
from voxtool.job import Cost, Plan
from voxtool.opencl.histopyramid import pyramid_bytes
from voxtool.spatial.bvh import tree_bytes
from voxtool.svo.octree.layout import BRICK_BYTES
from voxtool.svo.octree.octree import VOXEL
from voxtool.svo.surface.samples import WORD_LEVELS

BESIDE, MOST_BESIDE = 6, 27  # words beside a word of a surface, and beside a single one
NAIVE_SAMPLES = 1024  # along a side, if every cube is visited: 32 bits count their edges
WORD_BYTES = 52  # on the device: a word of tiles,
TILE_BYTES = 128  # a tile,
EDGE_BYTES = {MARCHING_CUBES: 40, VOXEL_FACES: 36, SURFACE_NETS: 96, SHARP: 280}  # a cut edge,
MERGE_BYTES = 80  # and one of voxel faces that are merged
SOURCE_BYTES = 60, 24  # for a sharp surface: a vertex of the source, and a face
ADAPTIVE_BYTES = 1500  # on the host: a cut edge, whose vertices and faces are merged
COLOURED_BYTES, COLOUR_BYTES = 100, 8  # on the host: a brick with colours, a cut edge
SCAN = "scan"
# How marching cubes find the places of outputs, and the arity of the pyramid. A GPU is said to gain
# by pyramids [Dyken 2008]; none was measured here, and on a CPU the scan is faster.
COMPACTIONS = {SCAN: None, "pyramid-2": 2, "pyramid-4": 4, "pyramid-5": 5}
RELAXATIONS = 16  # of surface nets of voxels, as in VTK


@dataclass(frozen=True)
class ExtractionPlan(Plan):
    """The decisions of an extraction."""

    facts = ("style", "level", "samples_along_side: samples")
    predicted = ("tiles: visited", "cut_cubes: cubes")

    style: str
    level: int | str
    isovalue: float
    merge: bool
    relaxations: int  # rounds in which vertices of nets move towards the mean of their neighbours
    lanes: int | None  # vertices that a work-item moves side by side; None: what suits the device
    nodes: tuple[int, ...]  # numbers of nodes of the levels, level 0 first, with added roots
    rooted: bool  # roots were added, because cubes begin below the octree's low sides
    # predicted, then counted: words of 4 x 4 x 4 tiles, tiles of 4 x 4 x 4 samples that are
    # examined, cubes and edges that are cut; what lies between leaves without nodes is not
    # predicted
    words: int
    tiles: int
    cubes: int
    edges: int
    coarser: Callable[[], Iterable[ExtractionPlan]] = field(compare=False, repr=False)
    corners: int = 0  # vertices and faces of the source of a sharp surface
    faces: int = 0
    fractions: bool = False  # samples are voxels, and how much of them is inside
    naive: bool = False  # every cube of the root is visited
    compaction: str = SCAN  # of COMPACTIONS; of marching cubes
    coloured: bool = False  # the octree's voxels have colours
    colours: bool = False  # and so will the surface
    adaptive: float | None = None  # how far cells of different size may take it, world units

    @property
    def voxels(self) -> bool:
        """True if samples are voxels."""
        return self.level == "voxel"

    @property
    def stages(self) -> list[str]:
        stages = {
            "tiles": True,
            "samples": True,
            "crossings": self.style == SHARP,
            "classify": True,
            "lost voxels": not self.voxels,
            "vertices": self.style != MARCHING_CUBES,
            "relax": self.relaxations > 0,
            "quads": self.style == SHARP or self.merge,
            "merge": self.merge,
            "triangles": True,
            "read back": True,
            "self-intersections": self.style == SHARP,
            "adaptive cells": self.adaptive is not None,
            "tree": self.style == SHARP or self.adaptive is not None,
            "sharp edges": self.style == SHARP,
            "colours": self.colours,
        }
        return [stage for stage, runs in stages.items() if runs]

    @property
    def samples(self) -> int:
        """Samples along a side of the root."""
        side = 4 << (len(self.nodes) - 1)  # in voxels
        return max(side // (1 if isinstance(self.level, str) else 4 << self.level), 1)

    @property
    def visited(self) -> int:
        """Tiles that are examined."""
        return max(self.samples**3 // 64, 1) if self.naive else self.tiles

    @property
    def colourless(self) -> str:
        """The reason why the surface of an octree with colours has none, or ""."""
        if self.merge:
            return "squares of several colours are merged"
        return "cells of several colours are merged" if self.adaptive is not None else ""

    @property
    def arity(self) -> int | None:
        """The arity of the histogram pyramid, None without one."""
        return COMPACTIONS[self.compaction]

    @property
    def cost(self) -> Cost:
        """The predicted bytes on the device, the surface included."""
        bricks = BRICK_BYTES * self.nodes[0]
        octree = bricks + 4 * sum(self.nodes[1:])
        if self.level not in ("voxel", 0):
            octree += 4 * self.nodes[1]  # coverages
        sample = 2 if self.fractions else 0 if self.voxels else 1 if self.level == 0 else 4
        tiles = WORD_BYTES * self.words + TILE_BYTES * self.visited
        tiles += (64 * sample + 12 * (sample > 0)) * active_tiles(self.nodes, self.level)
        if self.arity is not None:
            tiles += pyramid_bytes(self.visited, 3, self.arity)
        corner, face = SOURCE_BYTES
        source = corner * self.corners + face * self.faces
        edge = EDGE_BYTES[self.style] + (MERGE_BYTES if self.merge else 0)
        apart = untangling_bytes(self.edges) if self.style == SHARP else 0
        adaptive = self.adaptive is not None
        apart += proving_bytes(2 * self.edges) if adaptive else 0
        return Cost(
            device=octree + tiles + max(edge * self.edges + source, apart),
            largest=max(bricks, 16 * self.words, 64 * self.visited, 28 * self.edges),
            host=(COLOURED_BYTES * self.nodes[0] + COLOUR_BYTES * self.edges) * self.colours
            + ADAPTIVE_BYTES * self.edges * adaptive,
        )

    def fits(self, max_memory: int, max_allocation: int) -> bool:
        """Return True if memory suffices."""
        return not self.cost.shortage(max_memory, max_allocation)

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError, which names the finest level that fits, if the extraction needs
        more bytes, in total or in one buffer, or visits all of more samples than NAIVE_SAMPLES
        along a side."""
        if self.naive and self.samples > NAIVE_SAMPLES:
            raise MemoryLimitError(
                f"level {self.level} has {self.samples} samples along a side, of {NAIVE_SAMPLES} "
                "that are all visited: leave out naive"
            )
        if self.fits(max_memory, max_allocation):
            return
        own = {"naive": self.naive, "adaptive": self.adaptive}
        coarser = (replace(plan, **own) for plan in self.coarser())
        fitting = (plan.level for plan in coarser if plan.fits(max_memory, max_allocation))
        level = next(fitting, None)
        hint = "no level fits" if level is None else f"choose level {level}"
        if self.naive:
            hint += ", or leave out naive"
        raise MemoryLimitError(
            f"a {self.style} surface of level {self.level} "
            f"{self.cost.shortage(max_memory, max_allocation)}: {hint}; or allow more (see "
            "--max-memory)"
        )

    @property
    def reasons(self) -> dict[str, str]:
        out = {}
        if not self.naive:
            out["cubes away from nodes"] = "a set of tiles holds those that the surface may cross"
        if self.voxels:
            out["coverages, and voxels lost to them"] = "samples are voxels"
            if self.fractions:
                out["relaxation"] = "fractions are smooth as they are"
        elif self.level == 0:
            out["coverages of 32 bits"] = "a brick's 64 voxels fit 8 bits"
        if not self.rooted:
            out["root above the octree"] = "no voxel touches the low sides of its cube"
        if self.style == MARCHING_CUBES:
            out["loops and quads"] = "marching cubes need none"
        elif self.style == VOXEL_FACES:
            out["crossings and relaxation"] = "voxel faces lie on the corners of samples"
        elif self.style == SHARP and not self.relaxations:
            out["relaxation"] = "the source is closed, so that all vertices lie where planes meet"
        elif self.style == SHARP:
            out["relaxation of vertices that have planes"] = "they lie where these meet"
        elif not self.relaxations:
            out["relaxation"] = "coverages are smooth as they are"
        if not self.merge:
            out["sorting"] = "Morton-ordered bits are sorted; only --merge sorts"
        if self.coloured and not self.colours:
            out["colours"] = self.colourless or "the mesh is written without"
        return out

    def decisions(self) -> dict[str, Any]:
        adaptive = {} if self.adaptive is None else {"adaptive_tolerance": self.adaptive}
        return {**super().decisions(), **adaptive}

    def rows(self) -> list[tuple[str, str]]:
        samples = "fractions" if self.fractions else "samples"
        surface = f"{self.style}, level {self.level}: {self.samples} {samples} along the root"
        cubes = f"about {self.cubes:,}, in {self.visited:,} tiles"
        cells = [] if self.adaptive is None else [("adaptive", f"within {self.adaptive:g}")]
        return [("surface", surface), *cells, ("cut cubes", cubes)]


def untangling_bytes(edges: int) -> int:
    """Return the bytes on the device of the test for self-intersections, of two faces and about one
    vertex for each cut edge."""
    return tree_bytes(2 * edges) + 80 * edges


def proving_bytes(faces: int) -> int:
    """Return the bytes on the device of the distances between two surfaces of up to `faces` faces
    each."""
    from voxtool.spatial.distance import POINT_BYTES, POINTS_AT_ONCE, rounded_bytes
    from voxtool.spatial.hausdorff import PART_BYTES, PIECES_AT_ONCE

    trees = 2 * (tree_bytes(faces) + rounded_bytes(faces))
    pieces = PART_BYTES * min(PIECES_AT_ONCE, faces)
    return trees + POINT_BYTES * min(POINTS_AT_ONCE, faces) + pieces


def active_tiles(nodes: tuple[int, ...], level: int | str) -> int:
    """Return the number of tiles that have nodes: one for each brick, or for 64 nodes that are
    samples."""
    if isinstance(level, str):  # voxel
        return nodes[0]
    return nodes[level + 1] // 8 if level + 1 < len(nodes) - 1 else 1


def words_of(nodes: tuple[int, ...], level: int | str) -> int:
    """Return the predicted number of words of tiles: those that are refined nodes, and as many as
    a surface has beside them."""
    own = WORD_LEVELS + (VOXEL if isinstance(level, str) else level)
    refined = nodes[own - 1] // 8 if own < len(nodes) else 1
    return MOST_BESIDE + BESIDE * refined
