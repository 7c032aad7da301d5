"""Pictures of an octree by ray casting, at any of its levels, as the demonstration of [voCCeL].

Rays of neighbouring pixels go from node to node together (kernels/packets.h), which the picture
does not show, and skip empty ones [Laine 2010]. Each node of the drawn level that
holds a set voxel is a cube. Orthographic rays are whole lines; perspective ones begin at the eye.
What lies in a plane between two cells and along it is in the upper one.

With an isovalue, the nodes of a level are drawn by coverage: those of whose voxels at least this
share is set ([voCCeL] 2.4). Up to level 6, single precision holds coverages exactly.

Shading uses the smooth surface that coverages suggest: the shares of set voxels of the nodes that
are drawn, or of 2 x 2 x 2 voxels. Normals are opposite to the gradient of a quadratic B-spline over
their means around the corners of cells.

Times along rays are float64, and that of a plane is rounded three times, so the error of a hit is
2**-51 of its distance from the eye: 1e-9 voxel at a million voxels.

Kernels: kernels/svo/pictures/raycast.cl.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from voxtool.camera import Rays, box_corners, checked_colour
from voxtool.choices import WHITE
from voxtool.errors import GridError, MemoryLimitError, VoxtoolError
from voxtool.opencl import Array, Device, default_device, program
from voxtool.svo.cells.counts import check_isovalue
from voxtool.svo.cells.ray_links import box_of, cover_of, coverages, drawn_bytes, linked_nodes
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.layout import BRICK_SIDE, INSIDE
from voxtool.svo.octree.octree import VOXEL, Octree, level_number
from voxtool.svo.pictures.painting import check_painting, colours_of_cells, painted, with_labels
from voxtool.units import difference
from voxtool.vector import dot

if TYPE_CHECKING:
    from voxtool.grid import Grid

SOURCE = "svo/pictures/raycast.cl"
COLOUR = (0.88, 0.85, 0.8)  # a warm light grey
ONLY_HERE = (0.84, 0.37, 0.0)  # vermilion, and a blue: colour-blind eyes tell them apart
ONLY_THERE = (0.0, 0.45, 0.7)
COARSE_LEVELS = 5  # levels below the root down to which nodes bound what is shown
TILE = 8  # a work-group draws TILE x TILE packets of rays
HEADERS = {"svo/pictures/raycast.h": program.c_constants(TILE=TILE)}


@dataclass(frozen=True, eq=False)
class OctreeScene:
    """The voxels of an octree, or the nodes of a level as cubes.

    colour_by: the attribute whose colours they have, or "none"; by default the colour, or else the
        label, if there is one.
    only: names of labels; other voxels are not drawn.
    other: an octree of the same grid. Among the voxels that rays meet first, those that only
    `content` has are drawn in ONLY_HERE, those that only the other has in ONLY_THERE, and those of
    both in `colour`.
    """

    kind: ClassVar[str] = "octree"
    samples: ClassVar[int] = 2

    content: Octree | MergedOctree
    level: int | str = "voxel"  # or a level, from 0 for bricks
    colour: Sequence[float] = COLOUR  # red, green and blue of a face towards the light, 0 to 1
    isovalue: float | None = None  # of a level: the least share of a node's voxels; by default any
    other: Octree | MergedOctree | None = None
    lanes: int | None = None  # rays that a work-item follows, 1 or 16; by default what suits it
    colour_by: str | None = None
    only: Sequence[str] = ()

    def __post_init__(self) -> None:
        _size_exponent(self.content, self.level)
        check_painting(self.content, self.colour_by)
        if self.other is not None and (self.only or (self.attribute and self.colour_by)):
            raise VoxtoolError("a difference has its own colours: drop it, or colour_by and only")
        if self.only:  # what is drawn is an octree of these voxels
            object.__setattr__(self, "content", with_labels(self.content, tuple(self.only)))
            object.__setattr__(self, "only", ())
        check_isovalue(self.isovalue)
        if self.isovalue is not None and self.level == "voxel":
            raise VoxtoolError("an isovalue is a share of a node: choose a level, too")
        units = "" if self.other is None else self.other.units
        if message := difference(self.content.units, units, "voxelize one again --like the other"):
            raise GridError(f"the octrees are {message}")
        if self.other is not None and self.other.grid != self.content.grid:
            raise GridError(
                "octrees of different grids have no difference: voxelize both on one grid, with "
                "--like"
            )
        checked_colour(self.colour)

    @property
    def attribute(self) -> str:
        """The attribute whose colours are drawn, or ""."""
        return "" if self.other is not None else painted(self.content, self.colour_by)

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages of drawing, in order."""
        return ("coverage", "ray casting")

    @property
    def left_out(self) -> dict[str, str]:
        """The parts that are not drawn, each with the reason."""
        if self.level == "voxel":
            return {}
        out = {f"voxels finer than level {self.level}": "nodes of that level are drawn as cubes"}
        if self.isovalue is not None:
            out["nodes of less coverage"] = f"the isovalue is {self.isovalue:g}"
        return out

    @property
    def counts(self) -> dict[str, int]:
        """The sizes of the octree, by name."""
        content = self.content
        if isinstance(content, MergedOctree):
            return {"subtrees": sum(content.sizes[:-1]), "distinct_bricks": content.sizes[-1]}
        return {"nodes": len(content.nodes), "bricks": len(content.bricks)}

    @property
    def device_bytes(self) -> int:
        """Bytes of the octrees on the device."""
        return sum(map(drawn_bytes, filter(None, (self.content, self.other))))

    def points(self) -> np.ndarray:
        """Return (N, 3) float64 points in world units whose convex hull holds everything shown: the
        corners of coarse nodes, clipped to the bounding box of the voxels or cubes."""
        if self.other is not None:
            both = self.content, self.other
            shown = [octree for octree in both if octree.count] or both
            alone = [replace(self, content=octree, other=None) for octree in shown]
            return np.concatenate([scene.points() for scene in alone])
        octree, grid = self.content, self.content.grid
        origin, pitch = np.array(grid.origin), np.array(grid.pitch)
        finest = BRICK_SIDE if self.level == "voxel" else 1 << _size_exponent(octree, self.level)
        if not octree.count:
            return origin + pitch * box_corners(np.zeros((1, 3), np.int64), np.array(grid.shape))
        coarse = max(octree.depth - 1 - COARSE_LEVELS, 0)
        low, high = box_of(octree)
        boxes = [
            box_corners(cells // finest * finest, max(side, finest))
            for cells, side in cover_of(octree, coarse)
        ]
        low, high = low // finest * finest, -(-high // finest) * finest
        return origin + pitch * np.clip(np.concatenate(boxes), low, high)

    def local_rays(self, rays: Rays) -> Rays:
        """Return rays in units of the longest pitch from the grid's corner; see Rays.local."""
        return _local_rays(self.content.grid, rays)

    def draw(self, rays: Rays, device: Device) -> np.ndarray:
        """Return the premultiplied colour of every ray, (H, W, 4) float32."""
        if self.other is not None:
            return self._difference(self.other, rays, device)
        how: dict[str, Any] = {
            "level": self.level, "isovalue": self.isovalue, "colour": self.colour,
            "device": device, "lanes": self.lanes,
        }  # fmt: skip
        if self.attribute and isinstance(self.content, Octree):
            return cast_attribute(self.content, rays, self.attribute, **how)
        return cast(self.content, rays, **how)

    def _difference(self, other: Octree | MergedOctree, rays: Rays, device: Device) -> np.ndarray:
        """Return the colours by which octree a ray meets first: a voxel of both is met by both at
        one depth, since depths are those of the planes of one grid."""
        how: dict[str, Any] = {
            "level": self.level, "isovalue": self.isovalue, "device": device, "lanes": self.lanes,
        }  # fmt: skip
        here, there = (depths(octree, rays, **how) for octree in (self.content, other))
        picture = cast(self.content, rays, colour=WHITE, **how)
        beyond = there < here
        picture[beyond] = cast(other, rays, colour=WHITE, **how)[beyond]
        for met, colour in (
            (here < there, ONLY_HERE), (beyond, ONLY_THERE), (here == there, self.colour)
        ):  # fmt: skip
            picture[met, :3] *= np.array(colour, np.float32)
        return picture

    def why_empty(self) -> str:
        """Return why the scene is empty, or ""."""
        count = self.content.count + (self.other.count if self.other else 0)
        if not count:
            return "no voxel of the octree is set"
        least, number = self.isovalue, self.level
        if least is None or isinstance(number, str):
            return ""
        most = max(_most(octree, number) for octree in filter(None, (self.content, self.other)))
        if most >= least:
            return ""
        return f"of its nodes of level {number} at most {most:.3g} is set: choose that isovalue"


def _most(octree: Octree | MergedOctree, number: int) -> float:
    """Return the largest coverage of a node of a level; inside leaves above hold such nodes."""
    above = (len(cells) and side > BRICK_SIDE << number for cells, side in cover_of(octree, number))
    return 1.0 if any(above) else float(coverages(octree, number).max())


def cast(
    octree: Octree | MergedOctree,
    rays: Rays,
    *,
    level: int | str = "voxel",
    isovalue: float | None = None,
    colour: Sequence[float] = COLOUR,
    device: Device | None = None,
    lanes: int | None = None,
) -> np.ndarray:
    """Return the premultiplied colour of each ray, (height, width, 4) float32; its alpha is 1 if
    the ray meets a cube, otherwise 0."""
    device = device or default_device()
    arrays = _paint(rays, colour, device)
    _draw("paint_picture", octree, rays, level, isovalue, device, lanes, **arrays)
    width, height = rays.size
    return arrays["picture"].take().reshape(height, width, 4)


def cast_attribute(
    octree: Octree,
    rays: Rays,
    attribute: str,
    *,
    level: int | str = "voxel",
    isovalue: float | None = None,
    colour: Sequence[float] = COLOUR,
    device: Device | None = None,
    lanes: int | None = None,
) -> np.ndarray:
    """Return the same in the colours of an attribute of the cubes; see painting.py."""
    device = device or default_device()
    width, height = rays.size
    cells = device.empty(4 * width * height, np.int32)
    arrays = _paint(rays, WHITE, device) | {"cells": cells}
    _draw("paint_picture", octree, rays, level, isovalue, device, lanes, **arrays)
    picture = arrays["picture"].take().reshape(-1, 4)
    hits = np.flatnonzero(picture[:, 3])
    met = cells.take().reshape(-1, 4)[hits]
    size = _size_exponent(octree, level)
    picture[hits, :3] *= colours_of_cells(octree, attribute, met, size, checked_colour(colour))
    return picture.reshape(height, width, 4)


def _paint(rays: Rays, colour: Sequence[float], device: Device) -> dict[str, Array]:
    """Return the light and the colour, and the picture, as arguments of the kernel."""
    width, height = rays.size
    paint = np.array([rays.light(), checked_colour(colour)], np.float32)
    picture = device.empty(4 * width * height, np.float32)
    return {"paint": device.put(paint), "picture": picture}


def depths(
    octree: Octree | MergedOctree,
    rays: Rays,
    *,
    level: int | str = "voxel",
    isovalue: float | None = None,
    device: Device | None = None,
    lanes: int | None = None,
) -> np.ndarray:
    """Return the depth along the view, from the eye, at which each ray meets a cube, (height,
    width) float64 in world units; infinite where it meets none."""
    device = device or default_device()
    width, height = rays.size
    depths = device.empty(width * height, np.float64)
    _draw("find_depths", octree, rays, level, isovalue, device, lanes, depths=depths)
    scale, eye = max(octree.grid.pitch), 0.0
    if not rays.perspective:  # they begin abreast of the grid's corner
        eye = dot(np.subtract(octree.grid.origin, rays.origin), rays.direction)
    return depths.take().reshape(height, width) * scale + eye


def _draw(
    kernel: str,
    octree: Octree | MergedOctree,
    rays: Rays,
    level: int | str,
    isovalue: float | None,
    device: Device,
    lanes: int | None,
    **named: Array,
) -> None:
    """Run a kernel on every packet of rays. The octree stays on the device for the next picture."""
    frame, finest = _frame(octree, rays), _size_exponent(octree, level)
    lanes = lanes or device.lanes
    options = {"LANES": lanes, **({"DEPTHS": 1} if kernel == "find_depths" else {})}
    options |= {"CELLS": 1} if "cells" in named else {}
    draw, cover = (device.kernel(SOURCE, name, **options) for name in (kernel, "cover_level"))
    tree = device.keep(octree, "render", drawn_bytes(octree), lambda: _cover(octree, device, cover))
    width, height = rays.size
    side = TILE * math.isqrt(lanes)  # pixels along a side of a work-group's tile
    with device.stage("ray casting"):
        draw(
            -(-width // side) * -(-height // side) * TILE**2,
            **tree,
            frame=device.put(frame),
            perspective=rays.perspective,
            width=width,
            height=height,
            root=octree.depth + 1,
            finest=finest,
            least=_least(isovalue),
            **named,
            local=TILE**2,
        )


def _least(isovalue: float | None) -> float:
    """Return the smallest number of single precision that is not below an isovalue."""
    least = np.float32(isovalue or 0)
    return float(np.nextafter(least, np.float32(2)) if least < (isovalue or 0) else least)


def _cover(
    octree: Octree | MergedOctree, device: Device, cover_level: Callable[..., None]
) -> dict[str, Array | int]:
    """Return the octree as arguments of kernels: the words of the nodes above level 0, the
    coverages of those that are refined, the bricks, and where these would begin among the nodes."""
    with device.stage("coverage"):
        linked = linked_nodes(octree)
        offsets = linked.offsets
        if (size := offsets[-1] + len(linked.bricks)) > INSIDE:
            raise MemoryLimitError(
                f"{size:,} nodes exceed the {INSIDE:,} that are drawn: voxelize with a smaller dim"
            )
        children = device.put(linked.children)
        tree: dict[str, Array | int] = {
            "words": device.empty(offsets[-1], np.uint32),
            "shares": device.empty(size // 8, np.float32),
            "bricks": device.view(linked.bricks),
            "first_brick": offsets[-1],
        }
        for d in reversed(range(octree.depth - 1)):
            n, k = offsets[d + 1] - offsets[d], octree.depth - d
            cover_level(n, children=children, first=offsets[d], k=k, **tree)
    return tree


def _frame(octree: Octree | MergedOctree, rays: Rays) -> np.ndarray:
    """Return the origin, direction, right and down of the rays, in voxels, and the pitch, (5, 3)
    float64; times along rays and the pitch are in units of the longest pitch."""
    grid = octree.grid
    pitch = np.array(grid.pitch) / max(grid.pitch)
    local = _local_rays(grid, rays)
    steps = np.stack([local.origin, local.direction, local.right, local.down])
    return np.concatenate([steps / pitch, pitch[None]])


def _local_rays(grid: Grid, rays: Rays) -> Rays:
    return rays.local(grid.origin, max(grid.pitch))


def _size_exponent(octree: Octree | MergedOctree, level: int | str) -> int:
    """Return k for a level whose nodes, or voxels, have 2**k voxels along a side; raise
    VoxtoolError if the octree has no such level."""
    return level_number(octree, level, octree.depth - 1) - VOXEL
