"""What rays of a viewpoint meet of a volume: each cell's ways out, and where rays enter.

Cells that the transfer function leaves transparent are no part of it: rays leave before them and
enter again behind.

Kernels: kernels/tets/view.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.opencl.primitives import exclusive_scan
from voxtool.tets.volume import BLOCK, FACES
from voxtool.vector import dot

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.camera import Rays
    from voxtool.opencl import Array, Device
    from voxtool.tets.transfer import LocalTransfer
    from voxtool.tets.volume import TetVolume

SOURCE = "tets/view.cl"
NOWHERE = -1
ON_PLANE = 2.0**-21  # as in kernels/tets/ray.h
MOST_ENTRIES = (1 << 31) - 1
NEAREST = 0.5  # of the middle to the eye, in sizes of the local frame


class VolumeTextures:
    """The textures of a volume on a device."""

    def __init__(self, volume: TetVolume, device: Device) -> None:
        self.volume = volume
        self.device = device
        with device.stage("upload"):
            self.vertices = device.put(volume.vertices)
            self.cells = device.put(volume.cells)
            self.neighbours = device.put(volume.neighbours)
            self.sides = device.put(volume.faces.astype(np.uint8))
            textures = [device.put(volume.normals), device.put(volume.gradients), self.vertices]
            if volume.anchors is not None:
                textures.append(device.put(volume.anchors))
        # the parameters TEXTURES of kernels/tets/textures.h
        self.arguments = (*textures, np.uint32(len(volume.cells)))
        self.options: dict[str, int | str] = {
            "FACES": len(FACES[volume.layout]),
            **({"ANCHORED": 1} if volume.anchors is not None else {}),
        }

    def kernel(self, name: str, **options: int | str) -> Callable[..., None]:
        """A kernel of view.cl for these textures."""
        return self.device.kernel(SOURCE, name, **self.options, **options)


class VisibleCells:
    """What a transfer function shows of a volume.

    kept : (blocks,) bool; cells : how many are in these; exposed : how many of their faces lead to
    none of these.
    """

    def __init__(self, textures: VolumeTextures, transfer: LocalTransfer) -> None:
        volume, device = textures.volume, textures.device
        self.textures = textures
        self.kept = kept_blocks(volume, transfer)
        kept = kept_cells(volume, self.kept)
        self.cells = int(np.count_nonzero(kept))
        leads_on = np.append(kept, False)[volume.neighbours]  # -1 is the last
        exposed = np.flatnonzero((kept[:, None] & ~leads_on).ravel()).astype(np.int32)
        self.exposed = len(exposed)
        self.on_device = device.put(self.kept.astype(np.uint8))
        self.exposed_on_device = device.put(exposed)

    def look(self, view: Viewpoint, slots: int) -> Array:
        """The records of these cells for a viewpoint: (T, 4 (slots + 1)) float32."""
        textures = self.textures
        device, cells = textures.device, len(textures.volume.cells)
        with device.stage("look"):
            records = device.empty(4 * (slots + 1) * cells, np.float32)
            look = textures.kernel("look", **view.options)
            look(
                cells,
                *textures.arguments,
                textures.neighbours,
                self.on_device,
                view.on_device,
                np.uint32(slots),
                records,
            )
        return records

    def enter(self, view: Viewpoint) -> Entries:
        """Where the rays of a viewpoint enter these cells.

        Raises
        ------
        MemoryLimitError : more than MOST_ENTRIES times, or the device has no memory for them.
        """
        textures = self.textures
        device, vertices = textures.device, len(textures.volume.vertices)
        width, height = view.rays.size
        size = np.int32(width), np.int32(height)
        n = np.uint32(self.exposed)
        with device.stage("entries"):
            projected = device.empty(4 * vertices, np.float32)
            project = textures.kernel("project_vertices", **view.options)
            project(vertices, textures.vertices, np.uint32(vertices), view.on_device, projected)
            outlines = (self.exposed_on_device, n, textures.cells, projected, textures.sides)
            ends = device.zeros(width * height + 1, np.uint32)
            count = textures.kernel("count_entries", **view.options)
            count(self.exposed, *outlines, *size, ends)
            found = int(ends.get(0, width * height).sum(dtype=np.uint64))
            if found > MOST_ENTRIES:
                raise MemoryLimitError(
                    f"rays enter the volume {found} times, at most {MOST_ENTRIES} fit: choose a "
                    "smaller picture"
                )
            exclusive_scan(ends, width * height)
            entries = device.empty(2 * found, np.uint32)
            list_entries = textures.kernel("list_entries", **view.options)
            list_entries(
                self.exposed,
                *textures.arguments,
                *outlines,
                *size,
                view.on_device,
                ends,
                entries,
            )
            sort = textures.kernel("sort_entries", **view.options)
            sort(width * height, ends, np.uint32(width * height), entries)
        return Entries(ends, entries, found)


@dataclass(frozen=True)
class Viewpoint:
    """Rays in a volume's frame, on a device.

    middle : t of rays from which depths are counted, near that of the volume's middle.
    on_device : origin, direction, right, down and middle, 13 float64; options : of kernels.
    """

    rays: Rays
    middle: float
    on_device: Array
    options: dict[str, int | str]

    @staticmethod
    def of(rays: Rays, volume: TetVolume, device: Device) -> Viewpoint:
        """The viewpoint of rays in world units.

        Raises
        ------
        MemoryLimitError : the device cannot hold their picture.
        """
        width, height = rays.size
        if 16 * width * height > device.info.max_allocation:
            raise MemoryLimitError(
                f"{device.info.name} cannot hold a picture of {width} x {height} pixels, "
                f"{16 * width * height} bytes: choose a smaller one"
            )
        local = rays.local(volume.origin, volume.scale)
        middle = 0.0
        if local.perspective:
            middle = max(-float(dot(local.origin, local.direction)), NEAREST)
        numbers = [*local.origin, *local.direction, *local.right, *local.down, middle]
        options: dict[str, int | str] = {"PERSPECTIVE": 1} if local.perspective else {}
        return Viewpoint(local, middle, device.put(np.array(numbers)), options)

    def arguments(self) -> tuple[np.float32, np.float32, np.float32]:
        """Of kernels: the middle, and the squares of a pixel's steps, for the lengths of rays."""
        right, down = self.rays.right, self.rays.down
        return np.float32(self.middle), np.float32(dot(right, right)), np.float32(dot(down, down))


@dataclass(frozen=True)
class Entries:
    """Where rays enter: those of pixel p are at ends[p - 1] to ends[p], by their depth.

    entries : (count, 2) uint32 on the device: the depth's float32, and the cell.
    """

    ends: Array
    entries: Array
    count: int


def kept_blocks(volume: TetVolume, transfer: LocalTransfer) -> np.ndarray:
    """(blocks,) bool: the blocks of cells that the transfer function does not leave transparent."""
    return ~transfer.transparent(volume.ranges[:, 0], volume.ranges[:, 1])


def kept_cells(volume: TetVolume, kept: np.ndarray) -> np.ndarray:
    """(T,) bool: the cells of these blocks."""
    return np.repeat(kept, BLOCK)[: len(volume.cells)]


def cells_at(volume: TetVolume, point: np.ndarray) -> np.ndarray:
    """(n,) int64: the cells that hold a point of the local frame, or nearly; the surest first."""
    outside = np.full(len(volume.cells), -np.inf)
    for face, normals in enumerate(volume.normals):
        n = normals.astype(np.float64)
        height = dot(n, point)
        if volume.anchors is None:
            height += n[:, 3]
        else:
            anchor = volume.vertices[volume.anchors[:, int(face == 0)], :3].astype(np.float64)
            height -= dot(n, anchor)
        outside = np.maximum(outside, height)
    found = np.flatnonzero(outside <= ON_PLANE)
    return found[np.argsort(outside[found], kind="stable")]
