"""The textures of a field on a device, kept there for the next call."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from voxtool.adf.field import DistanceField
    from voxtool.opencl import Array, Device


@dataclass(frozen=True)
class Textures:
    """Arguments, by name, and -D options of kernels that include kernels/adf/search.h."""

    arguments: dict[str, Any]
    options: dict[str, int | str]


def textures_of(field: DistanceField, device: Device) -> Textures:
    """Return the textures of a field on a device: uploaded by the first call, then kept."""
    nbytes = sum(field.sizes().values())
    return device.keep(field, "textures", nbytes, lambda: _upload_textures(field, device))


def bounds_of(field: DistanceField, device: Device) -> Array:
    """Return the bounds texture of a field on a device: uploaded by the first call, then kept."""
    bounds = field.bounds
    assert bounds is not None
    return device.keep(field, "bounds", bounds.nbytes, lambda: _upload(bounds, device))


def _upload_textures(field: DistanceField, device: Device) -> Textures:
    table, (full, deepest) = field.hash, levels_to_search(field)
    arguments = {
        "voxels": _upload(field.voxels, device),
        "cells": _upload(field.cells, device),
        "offsets": _upload(table.offsets, device),
        "inverses": device.put(inverses(max(table.m, table.r))),
        "m": table.m,
        "r": table.r,
        "full": full,
        "deepest": deepest,
    }
    options: dict[str, int | str] = {
        "OFFSET": {1: "uchar", 2: "ushort"}[table.offsets.dtype.itemsize],
        **({"W": 1} if table.has_w else {}),
        **({"WIDE": 1} if field.cells.shape[-1] == 3 else {}),
    }
    return Textures(arguments, options)


def _upload(texture: np.ndarray, device: Device) -> Array:
    """Return a texture on the device; on a CPU in large pages, which suit random reads."""
    with device.stage("upload"):
        array = device.empty(texture.size, texture.dtype)
        device.write(array, texture)
    return array


def levels_to_search(field: DistanceField) -> tuple[int, int]:
    """Return the level down to which all cells have blocks, and the deepest with a block."""
    deepest, full = field.depth - 1, 0
    identifiers = field.identifiers
    while full < deepest:
        level = 3 * (full + 1)  # bits of its Morton codes
        there = (identifiers >= 1 << level) & (identifiers < 2 << level)
        if np.count_nonzero(there) < 1 << level:
            break
        full += 1
    return full, deepest


def inverses(most: int) -> np.ndarray:
    """Return the inverse of each number up to `most`, rounded to nearest; 0 for 0."""
    numbers = np.arange(1, most + 1, dtype=np.float32)
    return np.concatenate([np.zeros(1, np.float32), 1 / numbers])
