"""Pictures of an octree by ray casting, at any of its levels: the thesis's demonstration program.

A ray goes from node to node and passes empty ones as a whole (Laine and Karras, Efficient Sparse
Voxel Octrees, I3D 2010); of the level that is drawn, each node that holds a set voxel is a cube.

Light falls on the smooth surface that the coverages suggest, which are the shares of set voxels of
the nodes that are drawn, or of 2 x 2 x 2 voxels: normals are against the gradient of a quadratic
B-spline over their means around the corners of cells.

Times along rays are float64, and that of a plane is rounded three times: a ray meets it where it
should to 2**-51 of the distance from the eye, in voxels, so to 1e-9 voxel at a million voxels.

Kernels: kernels/svo/raycast.cl.
"""

from __future__ import annotations

import contextlib
import operator
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.opencl import Array, Device, default_device, program
from voxtool.svo.layout import INSIDE
from voxtool.svo.octree import Octree
from voxtool.vector import dot

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.camera import Rays

SOURCE = "svo/raycast.cl"
COLOUR = (0.88, 0.85, 0.8)  # a warm light grey
TILE = 8  # pixels along a side of the tile that a work-group draws
HEADERS = {"svo/raycast.h": program.c_constants(TILE=TILE)}


def render_svo(
    octree: Octree,
    rays: Rays,
    *,
    level: int | str = "voxel",
    colour: Sequence[float] = COLOUR,
    device: Device | None = None,
) -> np.ndarray:
    """A picture of an octree; as OctreeRenderer, for a single use."""
    return OctreeRenderer(octree, device)(rays, level=level, colour=colour)


class OctreeRenderer:
    """An octree on a device, uploaded once and drawn many times."""

    def __init__(self, octree: Octree, device: Device | None = None) -> None:
        """Upload the octree and find the coverage of its nodes.

        Raises
        ------
        DeviceError : there is no device.
        MemoryLimitError : the octree does not fit on it.
        """
        self.octree = octree
        self.device = device or default_device()
        with self.device.stage("coverage"):
            self._tree = self._cover()

    def __call__(
        self, rays: Rays, *, level: int | str = "voxel", colour: Sequence[float] = COLOUR
    ) -> np.ndarray:
        """The picture that rays in the world give.

        Orthographic rays are whole lines; perspective ones begin at the eye. What lies in a plane
        between two cells and along it is in the upper one.

        Parameters
        ----------
        level : what is drawn as cubes: "voxel", or the nodes of a level, from 0 (bricks) on, that
            hold a set voxel.
        colour : red, green and blue in [0, 1] of what faces the light.

        Returns
        -------
        (height, width, 4) float32: premultiplied red, green, blue and alpha, which is 1 where a
        cube is met and otherwise 0; the same bit for bit on every device.

        Raises
        ------
        VoxtoolError : there is no such level or colour, or the eye is too far away.
        MemoryLimitError : the picture does not fit on the device.
        """
        paint = np.array([rays.light(), _checked_colour(colour)], np.float32)
        width, height = rays.size
        picture = self.device.empty(4 * width * height, np.float32)
        self._draw("paint_picture", rays, level, self.device.put(paint), picture)
        return picture.take().reshape(height, width, 4)

    def depths(self, rays: Rays, *, level: int | str = "voxel") -> np.ndarray:
        """(height, width) float64: how deep along the view, from the eye, each ray meets a cube, in
        world units; infinite where it meets none. Else as when called."""
        width, height = rays.size
        depths = self.device.empty(width * height, np.float64)
        self._draw("find_depths", rays, level, depths)
        scale, eye = max(self.octree.grid.pitch), 0.0
        if not rays.perspective:  # they begin abreast of the grid's corner
            eye = dot(np.subtract(self.octree.grid.origin, rays.origin), rays.direction)
        return depths.take().reshape(height, width) * scale + eye

    def _cover(self) -> tuple[Array, Array, Array, np.uint32]:
        """The octree as the kernels take it: the words of the nodes above level 0, the coverages of
        those that are refined, the bricks, and where these would begin among the nodes."""
        device, octree = self.device, self.octree
        *offsets, _ = octree.offsets.tolist()
        if len(octree.nodes) > INSIDE:
            raise MemoryLimitError(
                f"{len(octree.nodes):,} nodes exceed the {INSIDE:,} that are drawn: choose a "
                "smaller dim"
            )
        bricks, first_brick = device.view(octree.bricks), np.uint32(offsets[-1])
        children = device.put(octree.nodes["child"][: offsets[-1]])
        words = device.empty(offsets[-1], np.uint32)
        shares = device.empty(len(octree.nodes) // 8, np.float32)
        cover_level = device.kernel(SOURCE, "cover_level")
        for d in reversed(range(octree.depth - 1)):
            n = offsets[d + 1] - offsets[d]
            cover_level(
                n, children, np.uint32(offsets[d]), np.uint32(n), np.int32(octree.depth - d),
                words, shares, bricks, first_brick,
            )  # fmt: skip
        children.release()
        return words, shares, bricks, first_brick

    def _draw(self, kernel: str, rays: Rays, level: int | str, *results: Array) -> None:
        """Run a kernel on every pixel."""
        width, height = rays.size
        frame = self.device.put(self._frame(rays))
        with self.device.stage("ray casting"):
            self.device.kernel(SOURCE, kernel)(
                -(-width // TILE) * -(-height // TILE) * TILE**2, *self._tree, frame,
                np.int32(rays.perspective), np.uint32(width), np.uint32(height),
                np.int32(self.octree.depth + 1), np.int32(self._checked_level(level)), *results,
                local=TILE**2,
            )  # fmt: skip
        frame.release()

    def _frame(self, rays: Rays) -> np.ndarray:
        """(5, 3) float64: origin, direction, right and down of the rays, in voxels, and the pitch;
        times along rays and the pitch are in units of the longest pitch."""
        grid = self.octree.grid
        scale = max(grid.pitch)
        pitch = np.array(grid.pitch) / scale
        with np.errstate(over="ignore", invalid="ignore"):
            local = rays.local(grid.origin, scale)
            steps = np.stack([local.origin, local.direction, local.right, local.down]) / pitch
        if not np.isfinite(steps).all():
            raise VoxtoolError(
                f"rays from {tuple(rays.origin.tolist())} are too far from voxels of {scale:g}: "
                "choose an eye that is nearer"
            )
        return np.concatenate([steps, pitch[None]])

    def _checked_level(self, level: int | str) -> int:
        """k of a level: its nodes have sides of 2**k voxels."""
        if level == "voxel":
            return 0
        with contextlib.suppress(TypeError):
            number = operator.index(level)  # pyright: ignore[reportArgumentType]
            if 0 <= number < self.octree.depth:
                return number + 2
        raise VoxtoolError(
            f"level {level!r}: choose 'voxel' or a level from 0 to {self.octree.depth - 1}, those "
            f"that an octree of dim {self.octree.grid.dim} has"
        )


def _checked_colour(colour: Sequence[float]) -> tuple[float, ...]:
    """Red, green and blue."""
    with contextlib.suppress(TypeError, ValueError):
        rgb = tuple(float(c) for c in colour)
        if len(rgb) == 3 and all(0 <= c <= 1 for c in rgb):
            return rgb
    raise VoxtoolError(f"colour {colour!r}: give red, green and blue between 0 and 1")
