"""Extraction of a triangle mesh from an octree: marching cubes, or a dual style.

The stages, on the device [voCCeL, chapter 4 and sections 5.1 and 6.3]:

1. tiles, samples: the cubes that the surface may cross, and the scalars at their corners.
2. classify: the case of each cut cube.
3. vertices, triangles: by marching cubes (marching_cubes.py) or a dual style (dual.py).
4. self-intersections, of sharp surfaces: removed as far as that can be had (untangle.py).
5. adaptive cells, if a tolerance is given: fewer triangles where the surface is flat (adaptive.py).

All of it but sharp surfaces is integer arithmetic: the crossing of an edge is rounded once, to
2**-14 of a sample's side, so the mesh is the same on every device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, Self

import numpy as np

from voxtool.choices import (
    DEFAULT_STYLE,
    MARCHING_CUBES,
    MAX_DIM,
    SHARP,
    STYLE_ALIASES,
    STYLES,
    SURFACE_NETS,
    VOXEL_FACES,
    VOXEL_LEVEL,
)
from voxtool.errors import VoxtoolError, count_of
from voxtool.job import Job, one_call
from voxtool.memory import available_memory
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device, default_device
from voxtool.svo.octree.attributes import has_colours
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.layout import BRICK_SIDE
from voxtool.svo.octree.octree import VOXEL, Octree, level_number
from voxtool.svo.surface.cut_cells import MAX_LEVEL, Extracted, Tiles, find_tiles, lost_of
from voxtool.svo.surface.dual import dual_surface
from voxtool.svo.surface.isosurface import Isosurface, Lost
from voxtool.svo.surface.plan import (
    COMPACTIONS,
    RELAXATIONS,
    SCAN,
    ExtractionPlan,
    active_tiles,
    words_of,
)
from voxtool.svo.surface.samples import Sampling, Tree, grow_tree

# Shares of the set voxels from which on their loss is a warning: in samples below the isovalue,
# and, of them, away from the surface.
MUCH_BELOW, MUCH_VANISHED = 0.5, 0.01


def plan_extract(
    octree: Octree,
    *,
    style: str = DEFAULT_STYLE,
    level: int | str | None = None,
    isovalue: float = 0.5,
    merge: bool = False,
    source: Mesh | None = None,
    adaptive: float | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> ExtractJob:
    """Return the planned job of `extract`; see `voxtool.extract`. `source` may be any mesh in the
    place of the octree: links that it does not cross are closed smoothly."""
    style, level, share = _checked(octree, style, level, isovalue, merge, source)
    tolerance = _tolerance(adaptive, style, merge)
    tree, plan = _plan(octree, style, level, share, merge)
    coloured = has_colours(octree)
    colours = coloured and not merge and tolerance is None
    plan = replace(plan, coloured=coloured, colours=colours, adaptive=tolerance)
    if has_fractions(octree) and style != VOXEL_FACES:
        plan = replace(plan, fractions=True, relaxations=0)
    device = device or default_device()
    if source is not None:
        plan = replace(plan, corners=len(source.vertices), faces=len(source.faces))
        from voxtool.svo.surface.sharp import crosses_all

        if crosses_all(octree, source, device):
            plan = replace(plan, relaxations=0)
    return ExtractJob(octree, source, tree, plan, device, max_memory)


extract = one_call(plan_extract, "extract", Isosurface)


def plan_unread(
    octree: OctreeContent,
    *,
    style: str = DEFAULT_STYLE,
    level: int | str | None = None,
    isovalue: float = 0.5,
    merge: bool = False,
    source: Mesh | None = None,
) -> ExtractionPlan:
    """Return the plan of an extraction from an octree whose nodes are not read: that of a root
    above its own."""
    style, level, share = _checked(octree, style, level, isovalue, merge, source)
    sizes = np.diff(octree.offsets.astype(np.int64))[::-1].tolist()
    nodes = (*sizes[:-1], 8, 1)
    return plan_of(nodes, True, "solid" in octree.mode, style, level, share, merge)


def _checked(
    octree: OctreeContent,
    style: str,
    level: int | str | None,
    isovalue: float,
    merge: bool,
    source: Mesh | None,
) -> tuple[str, int | str, float]:
    """Return the style, the level and the isovalue of a request; raise VoxtoolError if it is of no
    extraction from this octree."""
    style = STYLE_ALIASES.get(style, style)
    if style not in STYLES:
        raise VoxtoolError(f"style {style!r} is unknown: choose one of {', '.join(STYLES)}")
    fractions = has_fractions(octree)
    level = VOXEL_LEVEL if level is None else level
    number = level_number(octree, level, _coarsest(octree))
    level = VOXEL_LEVEL if number == VOXEL else number
    try:
        share = float(isovalue)
    except (TypeError, ValueError):
        share = math.nan
    if not 0 < share < 1:  # NaN neither
        raise VoxtoolError(f"isovalue {isovalue!r}: choose a share of set voxels between 0 and 1")
    if merge and style != VOXEL_FACES:
        raise VoxtoolError(f"{style} has no coplanar squares to merge: choose {VOXEL_FACES}")
    if (source is None) == (style == SHARP):
        raise VoxtoolError(
            f"style {SHARP} takes the mesh that the octree was made from: give its source"
            if style == SHARP
            else f"a source goes with style {SHARP}, not {style}"
        )
    if style == SHARP and level != VOXEL_LEVEL:
        raise VoxtoolError(f"level {level}: a {SHARP} surface has voxels as samples")
    if fractions and (style == SHARP or level != VOXEL_LEVEL):
        raise VoxtoolError(
            f"style {style}, level {level}: the octree has fractions, which are of voxels: choose "
            f"level voxel and no style {SHARP}, or voxelize with --mode solid"
        )
    if "solid" not in octree.mode and (style, level) != (VOXEL_FACES, VOXEL_LEVEL):
        raise VoxtoolError(
            f"an octree of mode {octree.mode} has no inside to extract a {style} surface from: "
            f"voxelize with --mode solid, or extract --style {VOXEL_FACES} --level voxel"
        )
    return style, level, share


def _tolerance(adaptive: float | None, style: str, merge: bool) -> float | None:
    """Return the tolerance of a request; raise VoxtoolError if it is none, or does not go with a
    style."""
    if adaptive is None:
        return None
    try:
        tolerance = float(adaptive)
    except (TypeError, ValueError):
        tolerance = math.nan
    if not 0 < tolerance < math.inf:  # NaN neither
        raise VoxtoolError(f"adaptive {adaptive!r}: give a length greater than 0, in world units")
    if style == SHARP or merge:
        what = "merged squares" if merge else f"a {SHARP} surface"
        styles = ", ".join(name for name in STYLES if name != SHARP)
        raise VoxtoolError(f"{what} cannot be adaptive: choose one of {styles}, without merge")
    return tolerance


def has_fractions(octree: OctreeContent) -> bool:
    """Return whether an octree says how much of each voxel is inside."""
    return any(attribute.name == "fraction" for attribute in octree.attributes)


def _plan(
    octree: Octree, style: str, level: int | str, isovalue: float, merge: bool = False
) -> tuple[Tree, ExtractionPlan]:
    """Return the links of the octree, and the plan of an extraction from them."""
    solid = "solid" in octree.mode
    tree = grow_tree(octree, Sampling.of(level, isovalue))
    nodes = tuple(tree.count(number) for number in range(tree.top + 1))

    def coarser() -> Iterator[ExtractionPlan]:
        first = 0 if isinstance(level, str) else level + 1
        coarsens = solid and style != SHARP and not has_fractions(octree)
        last = _coarsest(octree) if coarsens else -1
        for other in range(first, last + 1):
            yield _plan(octree, style, other, isovalue, merge)[1]

    return tree, plan_of(nodes, tree.shift > 0, solid, style, level, isovalue, merge, coarser)


def plan_of(
    nodes: tuple[int, ...],
    rooted: bool,
    solid: bool,
    style: str,
    level: int | str,
    isovalue: float,
    merge: bool = False,
    coarser: Callable[[], Iterable[ExtractionPlan]] = tuple,
) -> ExtractionPlan:
    """Return the plan of an extraction from an octree, given its nodes by level.

    A surface is taken to cross every fourth sample of a tile, or eight of the 64 voxels of a brick,
    and twice as many if the octree has no inside.
    """
    voxels = level == "voxel"
    active = active_tiles(nodes, level)
    cubes = active * (16 if not voxels else 8 if solid else 20)
    return ExtractionPlan(
        style=style,
        level=level,
        isovalue=isovalue,
        merge=merge,
        relaxations=RELAXATIONS if style in (SURFACE_NETS, SHARP) and voxels else 0,
        lanes=None,
        nodes=nodes,
        rooted=rooted,
        words=words_of(nodes, level),
        tiles=2 * active,
        cubes=cubes,
        edges=cubes,
        coarser=coarser,
    )


def surface_of(
    tiles: Tiles,
    plan: ExtractionPlan,
    counted: Callable[..., None],
    crossings: dict[str, Any] | None = None,
) -> Extracted:
    """Return the surface of the tiles; `counted` and `crossings` are those of dual_surface."""
    if plan.style == MARCHING_CUBES:
        from voxtool.svo.surface.marching_cubes import march_cubes

        return march_cubes(tiles, counted, plan.arity)
    lanes = plan.lanes or tiles.device.lanes
    rounds, merge = plan.relaxations, plan.merge
    return dual_surface(tiles, counted, plan.style, rounds, lanes, merge, crossings)


def fits_whole(
    octree: OctreeContent, plan: ExtractionPlan, device: Device, max_memory: int | None
) -> bool:
    """Return whether an extraction fits in memory, with the octree."""
    most = device.max_memory if max_memory is None else max_memory
    fits = plan.fits(most, device.info.max_allocation)
    return fits and 2 * octree.nbytes <= available_memory()


def _coarsest(octree: OctreeContent) -> int:
    """Return the highest level whose nodes can be samples."""
    return min(octree.depth - 1, MAX_LEVEL)


def is_much(lost: Lost, count: int) -> bool:
    """Return whether the samples lose enough of the set voxels for a warning."""
    return lost.below > MUCH_BELOW * count or lost.vanished > MUCH_VANISHED * count


def losses(lost: Lost, count: int) -> str:
    """Return how many of the set voxels the samples do not show."""
    where = f"{lost.vanished:,} of them away from" if lost.vanished else "all of them at"
    return (
        f"{lost.below:,} set voxels ({100 * lost.below / count:.2g} %) lie in samples below the "
        f"isovalue, {where} the surface"
    )


class ExtractJob(Job[Isosurface]):
    """The planned extraction of a surface.

    Attributes
    ----------
    octree : Octree
        The octree whose surface is extracted.
    source : Mesh or None
        The mesh whose features a sharp surface keeps.
    plan : ExtractionPlan
        The decisions.
    """

    plan: ExtractionPlan
    device: Device

    def __init__(
        self,
        octree: Octree,
        source: Mesh | None,
        tree: Tree,
        plan: ExtractionPlan,
        device: Device,
        max_memory: int | None,
    ) -> None:
        self.octree, self.source, self._tree = octree, source, tree
        self.plan, self.device, self.max_memory = plan, device, max_memory

    def with_(self, **decisions: Any) -> Self:
        """Return a copy of the job with fields of its plan replaced, as `relaxations`; raise
        TypeError if the plan has no such field, or it is of the request; ValueError if the style
        has no such compaction."""
        asked = {"style", "level", "isovalue", "merge", "fractions", "adaptive"}
        if requested := asked & decisions.keys():
            raise TypeError(f"{', '.join(sorted(requested))}: plan another extraction")
        possible = COMPACTIONS if self.plan.style == MARCHING_CUBES else (SCAN,)
        if (compaction := decisions.get("compaction", SCAN)) not in possible:
            raise ValueError(f"compaction {compaction!r}: choose one of {', '.join(possible)}")
        return super().with_(**decisions)

    def _run(self) -> Isosurface:
        device, plan = self.device, self.plan
        sampling = Sampling.of(plan.level, plan.isovalue, plan.fractions)
        allowed = device.max_memory if self.max_memory is None else self.max_memory

        known: dict[str, int] = {}

        def counted(**numbers: int) -> None:
            known.update(numbers)
            replace(plan, **known).refuse_beyond(allowed, device.info.max_allocation)

        tiles = find_tiles(device, self.octree, self._tree, sampling, counted, naive=plan.naive)
        crossings = None
        if self.source is not None:
            from voxtool.svo.surface.sharp import find_crossings

            with device.stage("crossings"):
                crossings = find_crossings(device, self.source, self.octree.grid)
        found = surface_of(tiles, plan, counted, crossings)
        with device.stage("read back"):
            surface = Isosurface(
                grid=self.octree.grid,
                units=self.octree.units,
                style=plan.style,
                level=plan.level,
                side=sampling.side,
                isovalue=plan.isovalue,
                points=found.points.take().reshape(-1, 3),
                faces=found.triangles.take().view("int32").reshape(-1, 3),
                tiles=tiles.n,
                cubes=found.cubes,
                lost=lost_of(found.lost),
                merged=plan.merge,
                features=found.features,
            )
            homes = [home.take().reshape(-1, 3) for home in found.homes]
        if homes and len(surface.faces):
            surface = self._untangled(surface, homes)
        if plan.adaptive is not None and len(surface.faces):
            with device.stage("adaptive cells"):
                from voxtool.svo.surface.adaptive import adapt

                surface = adapt(surface, plan.adaptive, device)
        return self._with_colours(surface) if plan.colours else surface

    def _with_colours(self, surface: Isosurface) -> Isosurface:
        """Return the surface with the colours of the voxels."""
        from voxtool.svo.surface.colours import surface_colours

        with self.device.stage("colours"):
            colours = surface_colours(
                self.octree, surface.style, surface.side, surface.points, surface.faces, self.device
            )
        return replace(surface, colours=colours)

    def _untangled(self, surface: Isosurface, homes: list[np.ndarray]) -> Isosurface:
        """Return a sharp surface whose faces do not intersect, as far as that can be had."""
        from voxtool.svo.surface.untangle import untangle

        with self.device.stage("self-intersections"):
            found = untangle(surface, homes, self.device)
        assert surface.features is not None
        features = replace(
            surface.features,
            moved=int(np.count_nonzero(found.moved)),
            crossed=found.crossed,
            undecided=found.undecided,
        )
        assert self.source is not None
        from voxtool.svo.surface.sharp_edges import farthest_sharp_edge

        with self.device.stage("sharp edges"), self.device.reporting(lambda _: None):
            edges = farthest_sharp_edge(self.source, self.octree, found.surface, self.device)
        features = replace(features, farthest=edges)
        return replace(found.surface, features=features)

    def findings(self, result: Isosurface) -> Iterator[str]:
        """Yield why the surface is empty, or what the samples lose if that is much."""
        count, lost = self.octree.count, result.lost
        if not count:
            yield "no voxel is set, so there is no surface: voxelize a mesh with --mode solid"
        elif not len(result.faces):
            yield (
                f"none of the {count:,} set voxels lies in a sample that reaches the isovalue "
                f"{result.isovalue:g}: {self._keeping()}, or choose a lower isovalue"
            )
        elif is_much(lost, count):
            yield self._losses(result)
        if result.features and (tangled := result.features.crossed + result.features.undecided):
            yield (
                f"{count_of(tangled, 'face')} of {len(result.faces):,} may pass through others: "
                "choose another dim"
            )

    def notes(self, result: Isosurface) -> Iterator[str]:
        """Yield what the samples lose if that is little, how far sharp edges are if that is more
        than a voxel, and why colours are left out."""
        if result.features and result.features.farthest:
            distance, place = result.features.farthest
            if distance > result.pitch:
                spot = ", ".join(f"{value:.6g}" for value in place)
                yield (
                    f"the surface ends up to {distance:.3g}, {distance / result.pitch:.3g} voxels, "
                    f"before sharp edges of the source, near {spot}: choose smaller voxels"
                )
        if result.lost.vanished and not is_much(result.lost, self.octree.count):
            yield self._losses(result)
        if self.plan.coloured and (reason := self.plan.colourless):
            option = "--merge" if self.plan.merge else "--adaptive"
            yield f"colours are left out: {reason}; without {option} they are written"

    def details(self, result: Isosurface) -> Iterator[str]:
        """Yield which voxels the samples round off, and which vertices no plane places."""
        if result.features and result.features.open:
            yield (
                f"{count_of(result.features.open, 'vertex')} of {len(result.points):,} have no "
                "crossing with the source and are placed as in surface nets"
            )
        lost, count = result.lost, self.octree.count
        if lost.below and not (lost.vanished or is_much(lost, count)):
            yield losses(lost, count)

    def _losses(self, result: Isosurface) -> str:
        """Return the number of voxels that the samples do not show, and what would keep them."""
        return f"{losses(result.lost, self.octree.count)}: {self._keeping()}"

    def _keeping(self) -> str:
        """Return what would keep voxels that samples lose: samples of their own size, or smaller
        voxels."""
        if self.plan.fractions:
            return "a lower isovalue may keep them"
        finer = BRICK_SIDE * self.octree.grid.dim
        hints = []
        if self.plan.level != VOXEL_LEVEL:
            hints.append(f"--level {VOXEL_LEVEL} --style {SURFACE_NETS} keeps them all")
        if finer <= MAX_DIM:
            hints.append(f"voxelizing with --dim {finer} may keep them")
        return ", ".join(hints) or "a lower isovalue may keep them"
