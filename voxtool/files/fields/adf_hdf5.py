"""Distance fields as HDF5, format `voxtool-adf`, specified in docs/formats.md.

The datasets are the three textures of [ADF, section 3.2] and the error bounds. Version 1 has the
blocks one after another instead of packed in 3-D textures; it is read, and no longer written.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.packing import CHILDREN, VERTICES, layers_of, pack_cells, unpack
from voxtool.adf.field.spatial_hash import SpatialHash
from voxtool.choices import FIELD_SIGNS, GIVEN, MAX_LEVEL
from voxtool.files.storage import hdf5
from voxtool.files.storage.schema import (
    FINITE,
    FROM_ZERO,
    JSON_LIMIT,
    PLAN,
    POSITIVE,
    SOURCE,
    UNITS,
    Attribute,
    Dataset,
    Rule,
    Schema,
    Sizes,
    expect,
    transform_since,
    without,
)

if TYPE_CHECKING:
    import numpy as np

LEVEL = Rule(
    lambda level: 1 <= level <= MAX_LEVEL, f"is {{value}}: leaves have levels 1 to {MAX_LEVEL}"
)
BAND = Rule(lambda x: x >= 0, "is {value}: a number from 0 is expected")
SIGN = (
    "rule of the sign: `pseudonormal`, `winding`, `none` (no distance is negative), or `given` (by "
    "the image that the field was made of)"
)
WITHIN = "distance, in sides, up to which the tolerance holds; infinite: everywhere"
CONTINUOUS = (
    "1 if neighbours of different levels agree on shared faces and edges, to 2 ulp of the largest "
    "corner distance of the coarser one; else 0"
)


def _offset_type(sizes: Sizes) -> str:
    return "u1" if sizes["m"] < 256 else "<u2"


def _bounds_side(voxels: str) -> Callable[[Sizes], int]:
    return lambda sizes: sizes[voxels] // VERTICES * CHILDREN


def _build(values: dict[str, Any], arrays: dict[str, np.ndarray]) -> DistanceField:
    field = DistanceField(
        arrays["voxels"],
        arrays["cells"],
        SpatialHash(values["m"], values["r"], arrays["hash"]),
        arrays.get("bounds"),
        **without(values, "depth", "m", "r"),
    )
    expect("depth", values["depth"], (field.depth,))
    return field


def _unpack(values: dict[str, Any], arrays: dict[str, np.ndarray]) -> DistanceField:
    voxels, cells, bounds = unpack(arrays["voxels"], arrays["cells"], arrays.get("bounds"))
    unpacked = {"voxels": voxels, "cells": cells, "hash": arrays["hash"]}
    return _build(values, unpacked if bounds is None else {**unpacked, "bounds": bounds})


OWN = (
    Attribute("depth", int, "deepest level of a leaf", rule=LEVEL),
    Attribute("m", int, "slots along each axis of `cells`", at="hash.m"),
    Attribute("r", int, "entries along each axis of `hash`", at="hash.r"),
    Attribute("origin", float, "low corner of the cube, in world units", 3, rule=FINITE),
    Attribute("side", float, "side of the cube, in world units", rule=POSITIVE),
    Attribute("sign", str, SIGN, 32, choices=(*FIELD_SIGNS, GIVEN)),
    Attribute("tolerance", float, "error asked for, in sides", rule=FROM_ZERO),
    Attribute(
        "max_level", int, f"deepest level allowed for a leaf, at most {MAX_LEVEL}", rule=LEVEL
    ),
    Attribute("band", float, WITHIN, rule=BAND),
    Attribute("continuous", bool, CONTINUOUS),
    Attribute("lipschitz", float, "largest slope of the field", rule=FROM_ZERO),
    UNITS,
    SOURCE,
    Attribute("reached", dict, "errors and counts that the build reached", JSON_LIMIT),
    PLAN,
)
CELLS = Dataset("cells", "<u4", ("m", "m", "m", (2, 3)))
HASH = Dataset("hash", _offset_type, ("r", "r", "r", (3, 4)), at="hash.offsets")
BOUNDS = Dataset("bounds", "u1", ("n", 2, 2, 2), needed=lambda sizes, there: there)


VERSION_1 = Schema(
    format="voxtool-adf",
    version="1.0",
    what="distance field",
    hint="build a field first: voxtool adf-build MESH",
    own=OWN,
    datasets=(Dataset("voxels", "<f4", ("n", 3, 3, 3)), CELLS, HASH, BOUNDS),
    build=_build,
)
SCHEMA = replace(
    VERSION_1,
    version="2.0",
    own=(*OWN, transform_since("2.1")),
    datasets=(
        Dataset("voxels", "<f4", ("Z", "Y", "X"), pack=layers_of),
        replace(CELLS, pack=pack_cells),
        HASH,
        replace(BOUNDS, shape=tuple(map(_bounds_side, "ZYX")), pack=layers_of),
    ),
    build=_unpack,
    older=(VERSION_1,),
)

write = partial(hdf5.write, SCHEMA)
