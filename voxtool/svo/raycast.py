"""Ray casting of an octree at any of its levels, as the demonstration program of [voCCeL].

A ray goes from node to node and skips empty ones [Laine 2010]. Each node of the drawn level that
holds a set voxel is a cube. Orthographic rays are whole lines; perspective ones begin at the eye.
What lies in a plane between two cells and along it is in the upper one.

Shading uses the smooth surface that coverages suggest: the shares of set voxels of the nodes that
are drawn, or of 2 x 2 x 2 voxels. Normals are opposite to the gradient of a quadratic B-spline over
their means around the corners of cells.

Times along rays are float64, and that of a plane is rounded three times, so the error of a hit is
2**-51 of its distance from the eye: 1e-9 voxel at a million voxels.

Kernels: kernels/svo/raycast.cl.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from voxtool.camera import Rays, checked_colour
from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.opencl import Array, Device, default_device, program
from voxtool.svo.layout import INSIDE
from voxtool.svo.octree import VOXEL, Octree, level_number
from voxtool.vector import dot

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
    """Return the premultiplied colour of each ray, (height, width, 4) float32; its alpha is 1 if
    the ray meets a cube, otherwise 0."""
    device = device or default_device()
    width, height = rays.size
    paint = np.array([rays.light(), checked_colour(colour)], np.float32)
    picture = device.empty(4 * width * height, np.float32)
    _draw("paint_picture", octree, rays, level, device, paint=device.put(paint), picture=picture)
    return picture.take().reshape(height, width, 4)


def depths(
    octree: Octree, rays: Rays, *, level: int | str = "voxel", device: Device | None = None
) -> np.ndarray:
    """Return the depth along the view, from the eye, at which each ray meets a cube, (height,
    width) float64 in world units; infinite where it meets none."""
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
    """Run a kernel on every pixel. The octree stays on the device for the next picture."""
    frame, finest = _frame(octree, rays), size_exponent(octree, level)
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
    """Return the octree as arguments of kernels: the words of the nodes above level 0, the
    coverages of those that are refined, the bricks, and where these would begin among the nodes."""
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
    """Return the origin, direction, right and down of the rays, in voxels, and the pitch, (5, 3)
    float64; times along rays and the pitch are in units of the longest pitch."""
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


def size_exponent(octree: Octree, level: int | str) -> int:
    """Return k for a level whose nodes, or voxels, have 2**k voxels along a side; raise
    VoxtoolError if the octree has no such level."""
    return level_number(octree, level, octree.depth - 1) - VOXEL
