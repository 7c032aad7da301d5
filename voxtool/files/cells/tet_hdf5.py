"""Tetrahedral volumes as HDF5, format `voxtool-tet`, specified in docs/formats.md.

The datasets are the textures of [TetVol, section 4.1, tables 4 and 5]. Version 1 has one long row
of each instead of 2-D textures; it is read, and no longer written.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from voxtool.choices import LAYOUTS
from voxtool.files.storage import hdf5
from voxtool.files.storage.schema import (
    FINITE,
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
    without,
)
from voxtool.tets.volume.packing import (
    layers_for,
    pack_layers,
    pack_rows,
    rows_for,
    unpack_layers,
    unpack_rows,
    width_for,
)
from voxtool.tets.volume.volume import BLOCK, FACES, TetVolume

if TYPE_CHECKING:
    import numpy as np


COUNT = Rule(lambda count: 0 < count < 1 << 31, "is {value}: a number from 1 is expected")
CONSTANT = "1 if the scalar is one a cell, else 0; 0 for `projection`, 1 for `hexahedra`"


def _corners(sizes: Sizes) -> int:
    return 8 if sizes["layout"] == "hexahedra" else 4


def _faces(sizes: Sizes) -> int:
    return len(FACES[sizes["layout"]])


def _floats(sizes: Sizes) -> int:
    return 3 if sizes["layout"] == "projection" else 4


def _build(values: dict[str, Any], arrays: dict[str, np.ndarray]) -> TetVolume:
    optional = {name: arrays.pop(name, None) for name in ("anchors", "heights")}
    return TetVolume(**optional, **arrays, **values)


OWN = (
    Attribute("layout", str, "`raycast`, `projection` or `hexahedra`", 32, choices=LAYOUTS),
    Attribute("origin", float, "of local coordinates, in world units", 3, rule=FINITE),
    Attribute("scale", float, "world units a local unit, a power of two", rule=POSITIVE),
    Attribute("scalar", str, "name of the array, with its component", 256),
    Attribute("scalar_range", float, "low ≤ high", 2, rule=FINITE),
    Attribute("constant", bool, CONSTANT),
    UNITS,
    SOURCE,
    PLAN,
    Attribute("report", dict, "counts and errors of the build", JSON_LIMIT),
)
ANCHORS = Dataset(
    "anchors", "<i4", ("T", 2), needed=lambda sizes, _: sizes["layout"] == "projection"
)
VERSION_1 = Schema(
    format="voxtool-tet",
    version="1.0",
    what="tetrahedral volume",
    hint="build its textures first: voxtool tet-build MESH",
    own=OWN,
    datasets=(
        Dataset("vertices", "<f4", ("V", 4)),
        Dataset("cells", "<i4", ("T", _corners)),
        Dataset("neighbours", "<i4", ("T", _faces)),
        Dataset("normals", "<f4", (_faces, "T", _floats)),
        Dataset("gradients", "<f4", ("T", _floats)),
        Dataset("ranges", "<f4", (lambda sizes: -(-sizes["T"] // BLOCK), 2)),
        ANCHORS,
    ),
    build=_build,
)


# --- version 2: items in rows of 2-D textures


def _rows(count: Callable[[Sizes], int]) -> tuple[Callable[[Sizes], int], Callable[[Sizes], int]]:
    """Return the two sides of a texture of `count` items, as functions of the sizes."""
    return (lambda sizes: rows_for(count(sizes))), (lambda sizes: width_for(count(sizes)))


def _layered(name: str, numbers: Callable[[Sizes], int]) -> Dataset:
    """Return the dataset of a texture with `numbers` integers for each cell."""

    def layers(sizes: Sizes) -> int:
        return layers_for(numbers(sizes))

    def channels(sizes: Sizes) -> int:
        return numbers(sizes) // layers(sizes)

    return Dataset(name, "<i4", (layers, *CELLS, channels), pack=pack_layers)


def _blocks(sizes: Sizes) -> int:
    return -(-sizes["cell_count"] // BLOCK)


def _unpack(values: dict[str, Any], arrays: dict[str, np.ndarray]) -> TetVolume:
    count = values["cell_count"]
    arrays["vertices"] = unpack_rows(arrays["vertices"], values["vertex_count"])
    arrays["ranges"] = unpack_rows(arrays["ranges"], _blocks(values))
    for name in arrays.keys() & {"normals", "gradients", "anchors", "heights"}:
        arrays[name] = unpack_rows(arrays[name], count)
    for name in ("cells", "neighbours"):
        arrays[name] = unpack_layers(arrays[name], count)
    return _build(without(values, "cell_count", "vertex_count"), arrays)


CELLS = _rows(lambda sizes: sizes["cell_count"])
SCHEMA = replace(
    VERSION_1,
    version="2.0",
    own=(
        *OWN,
        Attribute("cell_count", int, "cells, T", rule=COUNT),
        Attribute("vertex_count", int, "vertices, V", rule=COUNT),
    ),
    datasets=(
        Dataset(
            "vertices", "<f4", (*_rows(lambda sizes: sizes["vertex_count"]), 4), pack=pack_rows
        ),
        _layered("cells", _corners),
        _layered("neighbours", _faces),
        Dataset("normals", "<f4", (_faces, *CELLS, _floats), pack=pack_rows),
        Dataset("gradients", "<f4", (*CELLS, _floats), pack=pack_rows),
        Dataset("ranges", "<f4", (*_rows(_blocks), 2), pack=pack_rows),
        replace(ANCHORS, shape=(*CELLS, 2), pack=pack_rows),
        Dataset("heights", "<f4", (*CELLS, 1), needed=lambda _, there: there, pack=pack_rows),
    ),
    build=_unpack,
    older=(VERSION_1,),
)

write = partial(hdf5.write, SCHEMA)
