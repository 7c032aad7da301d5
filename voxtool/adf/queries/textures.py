"""The textures of a distance field on a device, for the kernels that look up points in them.

Kernels: kernels/adf/queries/query.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.packing import arrangement, pack_blocks
from voxtool.choices import SEARCHES
from voxtool.errors import VoxtoolError
from voxtool.opencl import Array, Device
from voxtool.opencl.images import Image, check_filter, image_of

SOURCE = "adf/queries/query.cl"
TOP_LEVEL = 5  # down to which a table has the cells of points: it fits caches


@dataclass(frozen=True)
class Shape:
    """The assignment of points to work-items: options of query.cl, and the size of a work-group."""

    lanes: int
    batch: int
    run: int
    group: int

    def padded(self, n: int) -> int:
        """Return n rounded up to whole work-groups."""
        whole = self.batch * self.run * self.group
        return -(-n // whole) * whole

    def options(self) -> dict[str, int]:
        return {"LANES": self.lanes, "BATCH": self.batch, "RUN": self.run}


CPU = Shape(lanes=16, batch=64, run=16, group=4)
GPU = Shape(lanes=1, batch=1, run=1, group=64)
GPU_COHERENT = Shape(lanes=1, batch=1, run=16, group=64)


class Textures(NamedTuple):
    """Arguments, by name, and -D options of kernels that include kernels/adf/queries/search.h."""

    arguments: dict[str, Any]
    options: dict[str, int | str]


def textures_of(field: DistanceField, device: Device) -> Textures:
    """Return the textures of a field on a device: uploaded by the first call, then kept."""

    def upload() -> Textures:
        table, (full, deepest) = field.hash, levels_to_search(field)
        options: dict[str, int | str] = {
            "OFFSET": {1: "uchar", 2: "ushort"}[table.offsets.dtype.itemsize],
            **({"W": 1} if table.has_w else {}),
            **({"WIDE": 1} if field.cells.shape[-1] == 3 else {}),
        }
        top = min(TOP_LEVEL, deepest)
        arguments: dict[str, Any] = {
            "voxels": voxels_of(field, device),
            "cells": _upload(field.cells, device),
            "offsets": _upload(table.offsets, device),
            "inverses": device.put(inverses(max(table.m, table.r))),
            "m": table.m,
            "r": table.r,
            "full": full,
            "deepest": deepest,
            "top": top,
        }
        return Textures(arguments | {"tops": _tops(device, top, arguments, options)}, options)

    return device.keep(field, "textures", search_bytes(field), upload)


def search_bytes(field: DistanceField) -> int:
    """Return the bytes of the textures that searches read, on the device."""
    return field.cells.nbytes + field.hash.nbytes + 8 * 8**TOP_LEVEL


def check_search(search: str) -> None:
    """Raise VoxtoolError if there is no such search."""
    if search not in SEARCHES:
        raise VoxtoolError(f"search {search!r} is unknown: choose {', '.join(SEARCHES)}")


def constant_of(search: str) -> str:
    """Return the name of a search in kernels."""
    return search.upper().replace("-", "_")


def _tops(
    device: Device, top: int, arguments: dict[str, Any], options: dict[str, int | str]
) -> Array:
    """Return the block and the level of the deepest cell down to level `top` that has a block, for
    each cell of this level, (8**top, 2) uint32 by x, y, z."""
    shape, n = CPU if device.lanes > 1 else GPU, 8**top
    padded = shape.padded(n)
    tops = device.empty(2 * padded, np.uint32)
    find_tops = device.kernel(SOURCE, "find_tops", SEARCH="BINARY", **shape.options(), **options)
    size = padded // (shape.batch * shape.run)
    find_tops(size, tops=tops, local=shape.group, **arguments)
    return tops


def voxels_of(field: DistanceField, device: Device) -> Array:
    """Return the blocks of a field on a device: uploaded by the first call, then kept."""
    voxels = field.voxels
    return device.keep(field, "voxels", voxels.nbytes, lambda: _upload(voxels, device))


def bounds_of(field: DistanceField, device: Device) -> Array:
    """Return the bounds texture of a field on a device: uploaded by the first call, then kept."""
    bounds = field.bounds
    assert bounds is not None
    return device.keep(field, "bounds", bounds.nbytes, lambda: _upload(bounds, device))


def filtered_of(field: DistanceField, device: Device) -> dict[str, Any]:
    """Return the arguments of the kernel for distances by the device's filter: the image of the
    voxels, uploaded by the first call and then kept, and its blocks along x and y."""
    across = arrangement(len(field.voxels))[:2]
    nbytes = field.voxels.nbytes

    def upload() -> Image:
        check_filter(device)
        return image_of(pack_blocks(field.voxels), device)

    return {"image": device.keep(field, "image", nbytes, upload), "across": across}


def _upload(texture: np.ndarray, device: Device) -> Array:
    """Return a texture on the device; on a CPU in large pages, which suit random reads."""
    with device.stage("upload"):
        array = device.empty(texture.size, texture.dtype)
        device.write(array, texture)
    return array


def levels_to_search(field: DistanceField) -> tuple[int, int]:
    """Return the level down to which all cells have blocks, and the deepest with a block."""
    counts = field.cells_by_level()
    partial = next(level for level, count in enumerate(counts) if count < 8**level)
    return partial - 1, field.depth - 1


def inverses(most: int) -> np.ndarray:
    """Return the inverse of each number up to `most`, rounded to nearest; 0 for 0."""
    numbers = np.arange(1, most + 1, dtype=np.float32)
    return np.concatenate([np.zeros(1, np.float32), 1 / numbers])
