"""Tetrahedral volumes as HDF5, format `voxtool-tet`: docs/formats.md has it exactly.

The datasets are the textures of section 4.1 of the text, as a GPU program would upload them. A file
is not trusted (hdf5.py), and the volume is validated.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from voxtool.choices import LAYOUTS
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
from voxtool.tets.volume import BLOCK, FACES, TetVolume
from voxtool.version import __version__

if TYPE_CHECKING:
    from collections.abc import Mapping

FORMAT = "voxtool-tet"
FORMAT_VERSION = "1.0"
REAL = np.dtype("<f4")
INDEX = np.dtype("<i4")

LAYOUT: Layout = {
    "format_version": (TEXT, VERSION_LIMIT),
    "creator": (TEXT, 128),
    "layout": (TEXT, 32),
    "origin": (FLOAT, 3),
    "scale": (FLOAT, 1),
    "scalar": (TEXT, 256),
    "scalar_range": (FLOAT, 2),
    "constant": (INT, 1),
    "units": (TEXT, 64),
    "source_sha256": (TEXT, 64),
    "plan": (TEXT, JSON_LIMIT),
    "report": (TEXT, JSON_LIMIT),
}


def write(volume: TetVolume, file: BinaryIO) -> None:
    """Write a volume into an empty file that is open for reading and writing.

    Raises
    ------
    FileError : an attribute of the volume is out of range, or does not fit.
    OSError : the file cannot be written.
    """
    head = {
        "format_version": FORMAT_VERSION,
        "creator": f"voxtool {__version__}",
        "layout": volume.layout,
        "origin": volume.origin,
        "scale": volume.scale,
        "scalar": volume.scalar,
        "scalar_range": volume.scalar_range,
        "constant": int(volume.constant),
        "units": volume.units,
        "source_sha256": volume.source_sha256,
        "plan": json_text("plan", volume.plan),
        "report": json_text("report", volume.report),
    }
    _check_head(head)
    arrays = {
        name: np.ascontiguousarray(array, REAL if array.dtype.kind == "f" else INDEX)
        for name, array in volume.arrays().items()
    }
    hdf5.write(file, FORMAT, head, LAYOUT, arrays)


def read(file: BinaryIO, size: int) -> TetVolume:
    """Read a volume from a file of `size` bytes.

    Raises
    ------
    FileError : the file is damaged, hostile or of another kind.
    """
    return hdf5.read(file, size, _read_open)


def _read_open(h5: Any, size: int) -> TetVolume:
    mend = "build its textures first: voxtool tet-build MESH"
    hdf5.check_format(h5, FORMAT, FORMAT_VERSION, "tetrahedral volume", mend)
    head = {name: hdf5.attribute(h5, name, *LAYOUT[name]) for name in LAYOUT}
    _check_head(head)
    layout = head["layout"]
    faces, floats = len(FACES[layout]), 3 if layout == "projection" else 4
    cells = hdf5.dataset(h5, "cells", (None, 8 if layout == "hexahedra" else 4), INDEX, size)
    count = cells.shape[0]
    found = {
        "vertices": hdf5.dataset(h5, "vertices", (None, 4), REAL, size),
        "cells": cells,
        "neighbours": hdf5.dataset(h5, "neighbours", (count, faces), INDEX, size),
        "normals": hdf5.dataset(h5, "normals", (faces, count, floats), REAL, size),
        "gradients": hdf5.dataset(h5, "gradients", (count, floats), REAL, size),
        "ranges": hdf5.dataset(h5, "ranges", (-(-count // BLOCK), 2), REAL, size),
    }
    if layout == "projection":
        found["anchors"] = hdf5.dataset(h5, "anchors", (count, 2), INDEX, size)
    return _build(head, {name: hdf5.load(dataset) for name, dataset in found.items()})


def _build(head: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> TetVolume:
    volume = TetVolume(
        head["layout"],
        arrays["vertices"],
        arrays["cells"],
        arrays["neighbours"],
        arrays["normals"],
        arrays["gradients"],
        arrays.get("anchors"),
        arrays["ranges"],
        origin=head["origin"],
        scale=head["scale"],
        scalar_range=head["scalar_range"],
        scalar=head["scalar"],
        constant=bool(head["constant"]),
        units=head["units"],
        source_sha256=head["source_sha256"],
        plan=parse_json("plan", head["plan"]),
        report=parse_json("report", head["report"]),
    )
    volume.validate()
    return volume


def _check_head(head: Mapping[str, Any]) -> None:
    """Check every attribute that has the right type and count.

    Raises
    ------
    FileError : names the one that is out of range.
    """
    check_texts(head, LAYOUT)
    check_source(head["source_sha256"])
    expect("layout", head["layout"], LAYOUTS)
    expect("constant", head["constant"], (0, 1))
    for name in ("origin", "scalar_range"):
        if not all(map(math.isfinite, head[name])):
            raise FileError(f"attribute {name} {head[name]} is not finite")
    if not 0 < head["scale"] < math.inf:
        raise FileError(f"attribute scale is {head['scale']}: a positive number is expected")
