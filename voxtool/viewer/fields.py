"""Distance fields in pages: the textures of the file, which the fragment shader searches."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.field.packing import CHILDREN, pack_blocks, pack_cells
from voxtool.adf.pictures.raycast import COLOUR, checked_offset
from voxtool.viewer.content import PageContent

if TYPE_CHECKING:
    from voxtool.adf.field.field import DistanceField

LOOKUP = "lookup.glsl"  # the code of docs/formats.md


def field_content(field: DistanceField) -> PageContent:
    """Return the content of a page that shows a distance field: its textures as in a file, with a
    block of zeros for bounds that it does not have."""
    no_bounds = np.zeros((1, *(CHILDREN,) * 3), np.uint8)
    arrays = {
        "voxels": pack_blocks(field.voxels),
        "cells": pack_cells(field.cells),
        "hash": field.hash.offsets,
        "bounds": pack_blocks(no_bounds if field.bounds is None else field.bounds),
    }
    defines = [name for name, has in
               (("WIDE", arrays["cells"].shape[-1] == 3), ("HAS_W", arrays["hash"].shape[-1] == 4))
               if has]  # fmt: skip
    facts = {
        "origin": list(field.origin),
        "side": field.side,
        "depth": field.depth,
        "range": [field.side * float(v) for v in (field.voxels.min(), field.voxels.max())],
        "least": checked_offset(field, 0.0),
        "units": field.units,
        "bounds": field.bounds is not None,
        "colour": list(COLOUR),
        "textures": {name: _described(array) for name, array in arrays.items()},
    }
    smaller_by = partial(_smaller_by, field)
    return PageContent("field", facts, arrays, smaller_by, (LOOKUP,), tuple(defines))


def _described(array: np.ndarray) -> dict[str, object]:
    """Return the format of a texture and its texels along x, y and z."""
    channels = array.shape[3] if array.ndim == 4 else 1
    kind = array.dtype.str[1:]
    return {"format": f"{kind}x{channels}", "size": list(array.shape[2::-1])}


def _smaller_by(field: DistanceField, share: float) -> str:
    """Return the options that build a field of which this share fits."""
    blocks = np.cumsum(field.cells_by_level())  # of fields that end at each next level
    level = int(np.searchsorted(blocks, share * blocks[-1], "right"))
    words = f"build it with --max-level {max(level, 1)}"
    over = field.reached.get("missed") or field.reached.get("medial")
    if field.tolerance and not over:
        # where the tolerance decides, it is inverse to the number of leaves on a smooth surface
        words += f" or --tolerance {_rounded_up(field.tolerance / share)}"
    return words


def _rounded_up(value: float) -> str:
    """Return two digits of a number, rounded up."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.ceil(value / unit) * unit:.2g}"
