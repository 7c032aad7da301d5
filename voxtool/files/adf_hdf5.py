"""Distance fields as HDF5, format `voxtool-adf`: docs/formats.md has it exactly.

The datasets are the textures of section 3.2 of the text, as a GPU program would upload them. A file
is not trusted (hdf5.py), and the field is validated.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from voxtool.adf.field import MAX_LEVEL, DistanceField
from voxtool.adf.hashing import SpatialHash
from voxtool.choices import SIGNS
from voxtool.errors import FileError
from voxtool.files import hdf5
from voxtool.files.head import (
    FLOAT,
    INT,
    JSON_LIMIT,
    TEXT,
    VERSION_LIMIT,
    Layout,
    check_source,
    check_texts,
    expect,
    json_text,
    parse_json,
)
from voxtool.version import __version__

if TYPE_CHECKING:
    from collections.abc import Mapping

FORMAT = "voxtool-adf"
FORMAT_VERSION = "1.0"
DISTANCE = np.dtype("<f4")
WORD = np.dtype("<u4")
CODE = np.dtype("u1")
SMALL, LARGE = np.dtype("u1"), np.dtype("<u2")  # offsets where m < 256, and elsewhere

LAYOUT: Layout = {
    "format_version": (TEXT, VERSION_LIMIT),
    "creator": (TEXT, 128),
    "depth": (INT, 1),
    "m": (INT, 1),
    "r": (INT, 1),
    "origin": (FLOAT, 3),
    "side": (FLOAT, 1),
    "sign": (TEXT, 32),
    "tolerance": (FLOAT, 1),
    "max_level": (INT, 1),
    "band": (FLOAT, 1),
    "continuous": (INT, 1),
    "lipschitz": (FLOAT, 1),
    "units": (TEXT, 64),
    "source_sha256": (TEXT, 64),
    "reached": (TEXT, JSON_LIMIT),
    "plan": (TEXT, JSON_LIMIT),
}


def write(field: DistanceField, file: BinaryIO) -> None:
    """Write a field into an empty file that is open for reading and writing.

    Raises
    ------
    FileError : an attribute of the field is out of range, or does not fit.
    OSError : the file cannot be written.
    """
    head = {
        "format_version": FORMAT_VERSION,
        "creator": f"voxtool {__version__}",
        "depth": field.depth,
        "m": field.hash.m,
        "r": field.hash.r,
        "origin": field.origin,
        "side": field.side,
        "sign": field.sign,
        "tolerance": field.tolerance,
        "max_level": field.max_level,
        "band": field.band,
        "continuous": int(field.continuous),
        "lipschitz": field.lipschitz,
        "units": field.units,
        "source_sha256": field.source_sha256,
        "reached": json_text("reached", field.reached),
        "plan": json_text("plan", field.plan),
    }
    _check_head(head)
    arrays = {
        "voxels": np.ascontiguousarray(field.voxels, DISTANCE),
        "cells": np.ascontiguousarray(field.cells, WORD),
        "hash": np.ascontiguousarray(field.hash.offsets, SMALL if field.hash.m < 256 else LARGE),
    }
    if field.bounds is not None:
        arrays["bounds"] = np.ascontiguousarray(field.bounds, CODE)
    hdf5.write(file, FORMAT, head, LAYOUT, arrays)


def read(file: BinaryIO, size: int) -> DistanceField:
    """Read a field from a file of `size` bytes.

    Raises
    ------
    FileError : the file is damaged, hostile or of another kind.
    """
    return hdf5.read(file, size, _read_open)


def _read_open(h5: Any, size: int) -> DistanceField:
    mend = "build a field first: voxtool adf-build MESH"
    hdf5.check_format(h5, FORMAT, FORMAT_VERSION, "distance field", mend)
    head = {name: hdf5.attribute(h5, name, *LAYOUT[name]) for name in LAYOUT}
    _check_head(head)
    m, r = head["m"], head["r"]
    found = {
        "voxels": hdf5.dataset(h5, "voxels", (None, 3, 3, 3), DISTANCE, size),
        "cells": hdf5.dataset(h5, "cells", (m, m, m, (2, 3)), WORD, size),
        "hash": hdf5.dataset(h5, "hash", (r, r, r, (3, 4)), SMALL if m < 256 else LARGE, size),
    }
    if hdf5.has_dataset(h5, "bounds"):
        blocks = found["voxels"].shape[0]
        found["bounds"] = hdf5.dataset(h5, "bounds", (blocks, 2, 2, 2), CODE, size)
    return _build(head, {name: hdf5.load(dataset) for name, dataset in found.items()})


def _build(head: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> DistanceField:
    field = DistanceField(
        arrays["voxels"],
        arrays["cells"],
        SpatialHash(head["m"], head["r"], arrays["hash"]),
        arrays.get("bounds"),
        origin=head["origin"],
        side=head["side"],
        sign=head["sign"],
        tolerance=head["tolerance"],
        max_level=head["max_level"],
        band=head["band"],
        continuous=bool(head["continuous"]),
        lipschitz=head["lipschitz"],
        reached=parse_json("reached", head["reached"]),
        plan=parse_json("plan", head["plan"]),
        source_sha256=head["source_sha256"],
        units=head["units"],
    )
    field.validate()
    expect("depth", head["depth"], (field.depth,))
    return field


def _check_head(head: Mapping[str, Any]) -> None:
    """Check every attribute that has the right type and count.

    Raises
    ------
    FileError : names the one that is out of range.
    """
    check_texts(head, LAYOUT)
    check_source(head["source_sha256"])
    expect("sign", head["sign"], SIGNS)
    expect("continuous", head["continuous"], (0, 1))
    for name in ("depth", "max_level"):
        if not 1 <= head[name] <= MAX_LEVEL:
            raise FileError(
                f"attribute {name} is {head[name]}: leaves have levels 1 to {MAX_LEVEL}"
            )
    if not all(map(math.isfinite, head["origin"])):
        raise FileError(f"attribute origin {head['origin']} is not finite")
    if not 0 < head["side"] < math.inf:
        raise FileError(f"attribute side is {head['side']}: a positive number is expected")
    for name in ("tolerance", "lipschitz"):
        if not 0 <= head[name] < math.inf:
            raise FileError(f"attribute {name} is {head[name]}: a finite number from 0 is expected")
    if not head["band"] >= 0:
        raise FileError(f"attribute band is {head['band']}: a number from 0 is expected")
