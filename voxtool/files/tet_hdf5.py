"""Tetrahedral volumes as HDF5, format `voxtool-tet`, specified in docs/formats.md.

The datasets are the textures of [TetVol, section 4.1, tables 4 and 5].
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from voxtool.choices import LAYOUTS
from voxtool.files import hdf5
from voxtool.files.schema import (
    FINITE,
    JSON_LIMIT,
    PLAN,
    POSITIVE,
    SOURCE,
    UNITS,
    Attribute,
    Dataset,
    Schema,
    Sizes,
)
from voxtool.tets.volume import BLOCK, FACES, TetVolume

if TYPE_CHECKING:
    import numpy as np


CONSTANT = "1 if the scalar is one a cell, else 0; 0 for `projection`, 1 for `hexahedra`"


def _corners(sizes: Sizes) -> int:
    return 8 if sizes["layout"] == "hexahedra" else 4


def _faces(sizes: Sizes) -> int:
    return len(FACES[sizes["layout"]])


def _floats(sizes: Sizes) -> int:
    return 3 if sizes["layout"] == "projection" else 4


def _build(values: dict[str, Any], arrays: dict[str, np.ndarray]) -> TetVolume:
    return TetVolume(anchors=arrays.pop("anchors", None), **arrays, **values)


SCHEMA = Schema(
    format="voxtool-tet",
    version="1.0",
    what="tetrahedral volume",
    hint="build its textures first: voxtool tet-build MESH",
    own=(
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
    ),
    datasets=(
        Dataset("vertices", "<f4", ("V", 4)),
        Dataset("cells", "<i4", ("T", _corners)),
        Dataset("neighbours", "<i4", ("T", _faces)),
        Dataset("normals", "<f4", (_faces, "T", _floats)),
        Dataset("gradients", "<f4", ("T", _floats)),
        Dataset("ranges", "<f4", (lambda sizes: -(-sizes["T"] // BLOCK), 2)),
        Dataset(
            "anchors", "<i4", ("T", 2), needed=lambda sizes, _: sizes["layout"] == "projection"
        ),
    ),
    build=_build,
)

write = partial(hdf5.write, SCHEMA)
