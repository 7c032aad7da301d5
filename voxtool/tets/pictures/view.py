"""A volume on a device, the records of its cells for a viewpoint, and the entries of rays.

Blocks of cells that the transfer function makes transparent are not drawn: rays leave the volume
in front of them and enter it again behind.

Kernels: kernels/tets/pictures/view.cl.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.opencl.primitives import exclusive_scan
from voxtool.tets.volume.volume import BLOCK, FACES, ON_PLANE
from voxtool.vector import cross, dot, unit

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.camera import Rays
    from voxtool.opencl import Array, Device
    from voxtool.tets.volume.volume import TetVolume

SOURCE = "tets/pictures/view.cl"
MAX_ENTRIES = (1 << 31) - 1
MAX_SHOWN = 4  # sets of cells whose exposed faces are kept
NEAREST = 0.5  # of the middle to the eye, in sizes of the local frame
SKEWED = 1e-7  # cosines that count as 0


class DeviceVolume:
    """The textures of a volume on a device, uploaded once and kept there as long as the volume.

    arguments, options : the kernels', by name.
    cells, vertices : their numbers; faces : the number of faces of a cell.
    """

    def __init__(self, volume: TetVolume, device: Device) -> None:
        self.device = device
        self.cells, self.vertices = len(volume.cells), len(volume.vertices)
        self.faces = len(FACES[volume.layout])
        with device.stage("upload"):
            self.arguments: dict[str, Any] = {
                "normals": device.put(volume.normals),
                "gradients": device.put(volume.gradients),
                "vertices": device.put(volume.vertices),
                "cells_vertices": device.put(volume.cells),
                "neighbours": device.put(volume.neighbours),
                "cells": self.cells,
                "anchors": None if volume.anchors is None else device.put(volume.anchors),
            }
        self.options: dict[str, int | str] = {"FACES": self.faces}
        if volume.anchors is not None:
            self.options["ANCHORED"] = 1
        self._shown: OrderedDict[bytes, ShownCells] = OrderedDict()
        self._longest: float | None = None
        self._volumes: Array | None = None

    @staticmethod
    def of(volume: TetVolume, device: Device) -> DeviceVolume:
        """Return the volume on the device, uploaded at the first call.

        Raises
        ------
        MemoryLimitError : it does not fit.
        """
        size = sum(volume.sizes().values())
        return device.keep(volume, "render", size, lambda: DeviceVolume(volume, device))

    def shown(self, volume: TetVolume, kept: np.ndarray) -> ShownCells:
        """Return the drawn cells of the blocks that are kept; the last few results are reused."""
        key = kept.tobytes()
        if key not in self._shown:
            cells = kept_cells(volume, kept)
            leads_on = np.append(cells, False)[volume.neighbours]  # -1 is the last
            exposed = np.flatnonzero((cells[:, None] & ~leads_on).ravel()).astype(np.int32)
            flags = self.device.put(kept.astype(np.uint8))
            if len(self._shown) == MAX_SHOWN:
                self._shown.popitem(last=False)
            self._shown[key] = ShownCells(kept, flags, self.device.put(exposed))
        return self._shown[key]

    def longest(self, volume: TetVolume) -> float:
        """Return the longest path through a cell, between two of its vertices, local, float32."""
        if self._longest is None:
            x, y, z, _ = volume.vertices[volume.cells].T
            square = np.float32(0)
            for i, j in combinations(range(len(x)), 2):
                dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
                square = max(square, (dx * dx + dy * dy + dz * dz).max())
            self._longest = float(np.sqrt(square))
        return self._longest

    def volumes(self, volume: TetVolume) -> Array:
        """Return six times the volume of each tetrahedron on the device, (T,) float64."""
        if self._volumes is None:
            self._volumes = self.device.put(volume.six_volumes())
        return self._volumes

    def kernel(self, name: str, **options: int | str) -> Callable[..., None]:
        """Return a kernel of view.cl for these textures."""
        return self.device.kernel(SOURCE, name, **self.options, **options)

    def project_vertices(self, view: Viewpoint) -> Array:
        """Return the position of each vertex in the picture, and its depth, (V, 4) float32, or
        float64 if the viewpoint is exact."""
        kind = np.float64 if "EXACT" in view.options else np.float32
        projected = self.device.empty(4 * self.vertices, kind)
        project = self.kernel("project_vertices", **view.options)
        project(self.vertices, **self.arguments, **view.arguments, projected=projected)
        return projected


@dataclass(frozen=True, eq=False)
class ShownCells:
    """The cells that are drawn: the transfer function does not make their block transparent.

    kept : (blocks,) bool, on the host; flags : the same on the device.
    exposed : (n,) int32 on the device: the faces without a drawn neighbour, as
        cell * faces + face.
    """

    kept: np.ndarray
    flags: Array
    exposed: Array


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Rays in a volume's frame, on a device; `arguments` and `options` of kernels by name.

    Depths are counted from the argument `middle`: t of rays near the volume's middle.
    """

    rays: Rays
    arguments: dict[str, Any]
    options: dict[str, int | str]

    @property
    def inside(self) -> bool:
        """True if there is an eye, and it is in the volume's box."""
        return self.rays.perspective and bool((np.abs(self.rays.origin) <= 1 + ON_PLANE).all())

    @staticmethod
    def of(local: Rays, volume: TetVolume, device: Device, exact: bool = False) -> Viewpoint:
        """Return the viewpoint of rays in the volume's frame; if `exact`, vertices are projected in
        float64.

        Raises
        ------
        MemoryLimitError : the device cannot hold their picture.
        """
        width, height = local.size
        if 16 * width * height > device.info.max_allocation:
            raise MemoryLimitError(
                f"{device.info.name} cannot hold a picture of {width} x {height} pixels, "
                f"{16 * width * height} bytes: choose a smaller one"
            )
        middle = 0.0
        if local.perspective:
            middle = max(-float(dot(local.origin, local.direction)), NEAREST)
        sides = volume.faces.astype(np.uint8)
        if volume_of(local) < 0:  # a mirrored picture
            sides = sides[:, ::-1]
        basis = np.stack([local.right, local.down, local.direction])
        dual = np.stack([cross(basis[i - 2], basis[i - 1]) for i in range(3)]) / volume_of(local)
        numbers = [
            *local.origin,
            *local.direction,
            *local.right,
            *local.down,
            middle,
            *dual.ravel(),
        ]
        arguments = {
            "viewpoint": device.put(np.array(numbers)),
            "sides": device.put(sides),
            "middle": middle,
            "lamp": local.light(),
            "right_square": dot(local.right, local.right),
            "down_square": dot(local.down, local.down),
            "width": width,
            "height": height,
        }
        decisions = {"PERSPECTIVE": local.perspective, "EXACT": exact}
        return Viewpoint(local, arguments, {name: 1 for name, on in decisions.items() if on})


def volume_of(rays: Rays) -> float:
    """Return the volume that right, down and direction span, negative in a mirrored picture."""
    return float(dot(cross(rays.right, rays.down), rays.direction))


def are_skewed(rays: Rays) -> bool:
    """Return True if right, down and direction are not perpendicular to each other within SKEWED,
    or the direction is no unit vector."""
    right, down, way = unit(rays.right), unit(rays.down), rays.direction
    products = dot(right, down), dot(right, way), dot(down, way), dot(way, way) - 1
    return bool(max(map(abs, products)) > SKEWED)


def set_up_cells(volume: DeviceVolume, shown: ShownCells, view: Viewpoint, slots: int) -> Array:
    """Return the records of cells for a viewpoint, (T, 4 (slots + 1)) float32: the exit faces and
    the scalar as functions of the pixel."""
    device = volume.device
    with device.stage("cell setup"):
        records = device.empty(4 * (slots + 1) * volume.cells, np.float32)
        arguments = {**volume.arguments, **view.arguments, "kept": shown.flags}
        set_up = volume.kernel("set_up_cells", **view.options)
        set_up(volume.cells, **arguments, slots=slots, records=records)
    return records


def ray_entries(
    volume: DeviceVolume, shown: ShownCells, view: Viewpoint, projected: Array, max_entries: int
) -> tuple[Array, Array]:
    """Return where rays enter the drawn cells, as `ends` and `entries`: those of pixel p are
    entries[ends[p - 1]] to entries[ends[p]], sorted by depth; entries, (n, 2) uint32, have the bits
    of the depth in float32, and the cell.

    Raises
    ------
    MemoryLimitError : more than `max_entries`, or the device has no memory for them.
    """
    device, (width, height) = volume.device, view.rays.size
    pixels, faces = width * height, shown.exposed.size
    with device.stage("ray entries"):
        ends = device.zeros(pixels + 1, np.uint32)
        arguments = {
            **volume.arguments,
            **view.arguments,
            "exposed": shown.exposed,
            "projected": projected,
        }
        volume.kernel("count_entries", **view.options)(faces, **arguments, counts=ends)
        found = int(ends.get(0, pixels).sum(dtype=np.uint64))
        if found > max_entries:
            raise MemoryLimitError(
                f"rays enter the volume {found} times, at most {max_entries} fit: choose a "
                "smaller picture"
            )
        exclusive_scan(ends, pixels)
        entries = device.empty(2 * found, np.uint32)
        list_entries = volume.kernel("list_entries", **view.options)
        list_entries(faces, **arguments, starts=ends, entries=entries)
        volume.kernel("sort_entries", **view.options)(pixels, ends=ends, entries=entries)
    return ends, entries


def part_of(volume: TetVolume, kept: np.ndarray) -> TetVolume:
    """Return the volume of the blocks of cells that are kept, at least one; the last few results
    are reused. Its cells and vertices keep their order, so its pictures are those of the volume."""
    parts, key = _PARTS.setdefault(volume, OrderedDict()), kept.tobytes()
    if key not in parts:
        cells = kept_cells(volume, kept)
        corners = volume.cells[cells]
        used = np.zeros(len(volume.vertices), bool)
        used[corners] = True
        numbers, places = (np.cumsum(flags, dtype=np.int32) - 1 for flags in (used, cells))
        places = np.append(np.where(cells, places, -1), -1).astype(np.int32)  # -1 is the last
        if len(parts) == MAX_SHOWN:
            parts.popitem(last=False)
        parts[key] = replace(
            volume,
            vertices=volume.vertices[used],
            cells=numbers[corners],
            neighbours=places[volume.neighbours[cells]],
            normals=volume.normals[:, cells],
            gradients=volume.gradients[cells],
            anchors=None if volume.anchors is None else numbers[volume.anchors[cells]],
            ranges=volume.ranges[kept],
            heights=None if volume.heights is None else volume.heights[cells],
        )
    return parts[key]


_PARTS: WeakKeyDictionary[TetVolume, OrderedDict[bytes, TetVolume]] = WeakKeyDictionary()


def kept_cells(volume: TetVolume, kept: np.ndarray) -> np.ndarray:
    """Return which cells are in the blocks that are kept, (T,) bool."""
    return np.repeat(kept, BLOCK)[: len(volume.cells)]


def eye_cells(volume: TetVolume, shown: ShownCells, view: Viewpoint) -> dict[str, Any]:
    """Return the drawn cells that contain the eye, as arguments of kernels."""
    found = cells_at(volume, view.rays.origin) if view.inside else np.zeros(0, np.int64)
    found = found[shown.kept[found // BLOCK]].astype(np.uint32)
    return {"eye_cells": shown.flags.device.put(found), "eye_count": len(found)}


def cells_at(volume: TetVolume, point: np.ndarray) -> np.ndarray:
    """Return the cells that contain a local point within ON_PLANE, (n,) int64, the one that
    contains it deepest first."""
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
