"""Extraction of a triangle mesh from an octree: marching cubes, voxel faces or surface nets.

The stages, on the device [voCCeL, chapter 4 and sections 5.1 and 6.3]:

1. tiles, samples: the cubes that the surface may cross, and the scalars at their corners.
2. classify: the case of each cut cube.
3. vertices, triangles: by marching cubes (marching_cubes.py) or by a dual style (dual.py).

All of it is integer arithmetic: the crossing of an edge is rounded once, to 2**-14 of a sample's
side, so the mesh is the same on every device.
"""

from __future__ import annotations

import contextlib
import math
import operator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

from voxtool.choices import (
    MARCHING_CUBES,
    STYLE_ALIASES,
    STYLES,
    SURFACE_NETS,
    VOXEL_FACES,
)
from voxtool.errors import VoxtoolError
from voxtool.job import Job
from voxtool.opencl import Device, default_device
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.surface.cut_cells import (
    classify_cubes,
    count_lost,
    find_tiles,
)
from voxtool.svo.surface.dual import dual_surface, split_quads
from voxtool.svo.surface.greedy_meshing import join_squares
from voxtool.svo.surface.isosurface import Isosurface
from voxtool.svo.surface.marching_cubes import march_cubes
from voxtool.svo.surface.plan import MAX_SAMPLES, ExtractionPlan
from voxtool.svo.surface.sampling import MAX_LEVEL, Sampling, grow_tree

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.svo.octree import Octree
    from voxtool.svo.surface.sampling import Tree

# Shares of the set voxels from which on their loss is a warning: in samples below the isovalue,
# and, of them, away from the surface.
MUCH_BELOW, MUCH_VANISHED = 0.5, 0.01


def extract(
    octree: Octree,
    *,
    style: str = MARCHING_CUBES,
    level: int | str | None = None,
    isovalue: float = 0.5,
    merge: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> Isosurface:
    """The surface between the inside and the outside of an octree, closed at the grid's border.

    `plan_extract` with the same arguments says what this would do, and refuses nothing.

    Parameters
    ----------
    octree : Octree
    style : "marching-cubes", "voxel-faces" (the samples' own faces, two triangles a square) or
        "surface-nets" (every vertex kept in its cube).
    level : level of the nodes that are samples, from 0 (bricks), or "voxel"; by default 0 for
        marching cubes, and "voxel" for the other styles.
    isovalue : in (0, 1): a sample is inside if at least this share of its voxels is set.
    merge : join coplanar squares of voxel faces to rectangles (greedy meshing); leaves T-junctions.
    device : where to compute; the default device if None.
    max_memory : bytes that the device may use; by default what device and machine have.

    Returns
    -------
    Isosurface, the same bit for bit on every device. Without `merge` each edge has two faces and
    each vertex one fan of them. Inside samples that are diagonal on a face of a cube are separated,
    except where that would pinch a dual surface (case_tables.py).

    Raises
    ------
    VoxtoolError : an argument is out of range, or the octree is of a surface and has no inside.
    MemoryLimitError : the surface would not fit.
    DeviceError : no usable device.

    Warns
    -----
    MeshWarning : the surface is empty, or the samples lose parts of the octree.
    """
    return plan_extract(
        octree,
        style=style,
        level=level,
        isovalue=isovalue,
        merge=merge,
        device=device,
        max_memory=max_memory,
    ).run()


def plan_extract(
    octree: Octree,
    *,
    style: str = MARCHING_CUBES,
    level: int | str | None = None,
    isovalue: float = 0.5,
    merge: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> ExtractJob:
    """The job that `extract` with the same arguments runs.

    Raises
    ------
    VoxtoolError, DeviceError : as `extract`.
    """
    style = STYLE_ALIASES.get(style, style)
    level, share = _checked(octree, style, level, isovalue, merge)
    tree, plan = _plan(octree, style, level, share, merge)
    return ExtractJob(octree, tree, plan, device or default_device(), max_memory)


def _checked(
    octree: Octree, style: str, level: int | str | None, isovalue: float, merge: bool
) -> tuple[int | str, float]:
    """The level and the isovalue of a request, checked."""
    if style not in STYLES:
        raise VoxtoolError(f"style {style!r} is unknown: choose one of {', '.join(STYLES)}")
    if level is None:
        level = 0 if style == MARCHING_CUBES else "voxel"
    if not isinstance(level, str):
        with contextlib.suppress(TypeError):  # a numpy integer, too
            level = int(operator.index(level))
    known = isinstance(level, int) and 0 <= level <= _coarsest(octree)
    if level != "voxel" and not known:
        raise VoxtoolError(
            f"level {level!r}: choose 'voxel' or a level from 0 to {_coarsest(octree)}, those that "
            f"an octree of dim {octree.grid.dim} has"
        )
    try:
        share = float(isovalue)
    except (TypeError, ValueError):
        share = math.nan
    if not 0 < share < 1:  # NaN neither
        raise VoxtoolError(f"isovalue {isovalue!r}: choose a share of set voxels between 0 and 1")
    if merge and style != VOXEL_FACES:
        raise VoxtoolError(f"{style} has no coplanar squares to merge: choose {VOXEL_FACES}")
    if "solid" not in octree.mode and (style, level) != (VOXEL_FACES, "voxel"):
        raise VoxtoolError(
            f"an octree of mode {octree.mode} has no inside to extract a {style} surface from: "
            f"voxelize with --mode solid, or extract --style {VOXEL_FACES} --level voxel"
        )
    return level, share


def _plan(
    octree: Octree, style: str, level: int | str, isovalue: float, merge: bool = False
) -> tuple[Tree, ExtractionPlan]:
    """The links of the octree, and the plan of an extraction from them."""
    solid = "solid" in octree.mode
    tree = grow_tree(octree, Sampling.of(level, isovalue))

    def coarser() -> Iterator[ExtractionPlan]:
        first = 0 if isinstance(level, str) else level + 1
        for other in range(first, _coarsest(octree) + 1 if solid else 0):
            yield _plan(octree, style, other, isovalue, merge)[1]

    return tree, ExtractionPlan.predict(
        style,
        level,
        isovalue,
        merge=merge,
        solid=solid,
        nodes=tuple(tree.nodes(number) for number in range(tree.top + 1)),
        rooted=tree.shift > 0,
        coarser=coarser,
    )


def _coarsest(octree: Octree) -> int:
    """The highest level whose nodes can be samples."""
    return min(octree.depth - 1, MAX_LEVEL)


class ExtractJob(Job[Isosurface]):
    """The extraction of a surface, planned by `plan_extract`.

    Attributes
    ----------
    plan
        ExtractionPlan; `with_(relaxations=0)` forces one of its decisions.
    """

    plan: ExtractionPlan
    device: Device

    def __init__(
        self,
        octree: Octree,
        tree: Tree,
        plan: ExtractionPlan,
        device: Device,
        max_memory: int | None,
    ) -> None:
        self.octree, self._tree = octree, tree
        self.plan, self.device, self.max_memory = plan, device, max_memory

    def with_(self, **decisions: Any) -> Self:
        """The same job with decisions of its plan forced.

        Raises
        ------
        TypeError
            the plan has no such field, or it is of the request: plan another extraction.
        """
        if requested := {"style", "level", "isovalue", "merge"} & decisions.keys():
            raise TypeError(f"{', '.join(sorted(requested))}: plan another extraction")
        return super().with_(**decisions)

    def _run(self) -> Isosurface:
        device, plan = self.device, self.plan
        sampling = Sampling.of(plan.level, plan.isovalue)
        allowed = device.max_memory if self.max_memory is None else self.max_memory

        def counted(**numbers: int) -> None:
            replace(plan, **numbers).refuse_beyond(allowed, device.info.max_allocation)

        tiles = find_tiles(device, self.octree, self._tree, sampling, counted)
        cubes = classify_cubes(device, tiles, counted)
        lost = count_lost(device, tiles, cubes)
        if plan.style == MARCHING_CUBES:
            points, triangles = march_cubes(device, tiles, cubes)
        else:
            points, quads, n = dual_surface(device, tiles, cubes, plan.style, plan.relaxations)
            if plan.merge:
                with device.stage("merge"):
                    points, quads, n = join_squares(device, points, quads, n)
            with device.stage("triangles"):
                triangles = split_quads(device, tiles, points, quads, n)
        with device.stage("read back"):
            return Isosurface(
                grid=self.octree.grid,
                units=self.octree.units,
                style=plan.style,
                level=plan.level,
                side=sampling.side,
                isovalue=plan.isovalue,
                points=points.take().reshape(-1, 3),
                faces=triangles.take().view("int32").reshape(-1, 3),
                tiles=tiles.n,
                cubes=cubes.n,
                lost=lost,
                merged=plan.merge,
            )

    def findings(self, result: Isosurface) -> Iterator[str]:
        """Why the surface is empty, or what the samples lose if that is much of the octree."""
        count, lost = self.octree.count, result.lost
        if not count:
            yield "no voxel is set, so there is no surface: voxelize a mesh with --mode solid"
        elif not len(result.faces):
            yield (
                f"none of the {count:,} set voxels lies in a sample that reaches the isovalue "
                f"{result.isovalue:g}: {self._keeping()}, or choose a lower isovalue"
            )
        elif lost.below > MUCH_BELOW * count or lost.vanished > MUCH_VANISHED * count:
            yield self.losses(result)

    def notes(self, result: Isosurface) -> Iterator[str]:
        """What the samples lose, where that is little."""
        if result.lost.below and not list(self.findings(result)):
            yield self.losses(result)

    def losses(self, result: Isosurface) -> str:
        """How many voxels the samples do not show, and what keeps them; "" if they show all."""
        lost, count = result.lost, self.octree.count
        if not lost.below:
            return ""
        where = f"{lost.vanished:,} of them away from" if lost.vanished else "all of them at"
        serious = lost.vanished or lost.below > MUCH_BELOW * count
        return (
            f"{lost.below:,} set voxels ({100 * lost.below / count:.2g} %) lie in samples below "
            f"the isovalue, {where} the surface{f': {self._keeping()}' if serious else ''}"
        )

    def _keeping(self) -> str:
        """What keeps voxels that samples lose: samples of their own size, or smaller voxels."""
        finer = BRICK_SIDE * self.octree.grid.dim
        hints = []
        if _plan(self.octree, SURFACE_NETS, "voxel", 0.5)[1].samples <= MAX_SAMPLES:
            hints.append(f"--level voxel --style {SURFACE_NETS} keeps them all")
        if finer <= BRICK_SIDE * MAX_SAMPLES:
            hints.append(f"voxelizing with --dim {finer} may keep them")
        return ", ".join(hints) or "a lower isovalue may keep them"
