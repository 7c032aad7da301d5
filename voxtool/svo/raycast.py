"""Ray casting of an octree at any of its levels, as the demonstration program of [voCCeL].

A ray goes from node to node and skips empty ones [Laine 2010]. Each node of the drawn level that
holds a set voxel is a cube.

Shading uses the smooth surface that coverages suggest: the shares of set voxels of the nodes that
are drawn, or of 2 x 2 x 2 voxels. Normals are opposite to the gradient of a quadratic B-spline over
their means around the corners of cells.

Times along rays are float64, and that of a plane is rounded three times, so the error of a hit is
2**-51 of its distance from the eye: 1e-9 voxel at a million voxels.

Kernels: kernels/svo/raycast.cl.
"""

from __future__ import annotations

import contextlib
import operator
from typing import TYPE_CHECKING

import numpy as np

from voxtool.camera import checked_colour
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


def cast(
    octree: Octree,
    rays: Rays,
    *,
    level: int | str = "voxel",
    colour: Sequence[float] = COLOUR,
    device: Device | None = None,
) -> np.ndarray:
    """The picture that rays in the world give of an octree.

    Orthographic rays are whole lines; perspective ones begin at the eye. What lies in a plane
    between two cells and along it is in the upper one. The octree stays on the device for the next
    picture.

    Parameters
    ----------
    level : what is drawn as cubes: "voxel", or the nodes of a level, from 0 (bricks) on, that hold
        a set voxel.
    colour : red, green and blue in [0, 1] of what faces the light.

    Returns
    -------
    (height, width, 4) float32: premultiplied red, green, blue and alpha, which is 1 where a cube is
    met and otherwise 0; the same bit for bit on every device.

    Raises
    ------
    DeviceError : there is no device.
    VoxtoolError : there is no such level or colour, or the eye is too far away.
    MemoryLimitError : the octree or the picture does not fit on the device.
    """
    device = device or default_device()
    width, height = rays.size
    paint = np.array([rays.light(), checked_colour(colour)], np.float32)
    picture = device.empty(4 * width * height, np.float32)
    _draw("paint_picture", octree, rays, level, device, paint=device.put(paint), picture=picture)
    return picture.take().reshape(height, width, 4)


def depths(
    octree: Octree, rays: Rays, *, level: int | str = "voxel", device: Device | None = None
) -> np.ndarray:
    """(height, width) float64: how deep along the view, from the eye, each ray meets a cube, in
    world units; infinite where it meets none. Else as cast."""
    device = device or default_device()
    width, height = rays.size
    depths = device.empty(width * height, np.float64)
    _draw("find_depths", octree, rays, level, device, depths=depths)
    scale, eye = max(octree.grid.pitch), 0.0
    if not rays.perspective:  # they begin abreast of the grid's corner
        eye = dot(np.subtract(octree.grid.origin, rays.origin), rays.direction)
    return depths.take().reshape(height, width) * scale + eye


def _draw(
    kernel: str, octree: Octree, rays: Rays, level: int | str, device: Device, **named: Array
) -> None:
    """Run a kernel on every pixel."""
    frame, finest = _frame(octree, rays), checked_level(octree, level)
    tree = device.keep(octree, "render", octree.nbytes, lambda: _cover(octree, device))
    width, height = rays.size
    with device.stage("ray casting"):
        device.kernel(SOURCE, kernel)(
            -(-width // TILE) * -(-height // TILE) * TILE**2,
            **tree,
            frame=device.put(frame),
            perspective=rays.perspective,
            width=width,
            height=height,
            root=octree.depth + 1,
            finest=finest,
            **named,
            local=TILE**2,
        )


def _cover(octree: Octree, device: Device) -> dict[str, Array | int]:
    """The octree as the kernels take it: the words of the nodes above level 0, the coverages of
    those that are refined, the bricks, and where these would begin among the nodes."""
    *offsets, _ = octree.offsets.tolist()
    if len(octree.nodes) > INSIDE:
        raise MemoryLimitError(
            f"{len(octree.nodes):,} nodes exceed the {INSIDE:,} that are drawn: choose a smaller "
            "dim"
        )
    with device.stage("coverage"):
        children = device.put(octree.nodes["child"][: offsets[-1]])
        tree: dict[str, Array | int] = {
            "words": device.empty(offsets[-1], np.uint32),
            "shares": device.empty(len(octree.nodes) // 8, np.float32),
            "bricks": device.view(octree.bricks),
            "first_brick": offsets[-1],
        }
        cover_level = device.kernel(SOURCE, "cover_level")
        for d in reversed(range(octree.depth - 1)):
            n, k = offsets[d + 1] - offsets[d], octree.depth - d
            cover_level(n, children=children, first=offsets[d], k=k, **tree)
    return tree


def _frame(octree: Octree, rays: Rays) -> np.ndarray:
    """(5, 3) float64: origin, direction, right and down of the rays, in voxels, and the pitch;
    times along rays and the pitch are in units of the longest pitch."""
    grid = octree.grid
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


def checked_level(octree: Octree, level: int | str) -> int:
    """k of a level: its nodes have sides of 2**k voxels."""
    if level == "voxel":
        return 0
    with contextlib.suppress(TypeError):
        number = operator.index(level)  # pyright: ignore[reportArgumentType]
        if 0 <= number < octree.depth:
            return number + 2
    raise VoxtoolError(
        f"level {level!r}: choose 'voxel' or a level from 0 to {octree.depth - 1}, those "
        f"that an octree of dim {octree.grid.dim} has"
    )
