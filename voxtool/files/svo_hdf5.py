"""Octrees as HDF5, format `voxtool-svo`, specified in docs/formats.md.

The XML of svo_xml.py has the same attributes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import partial
from typing import Any

from voxtool.arrays import Slices
from voxtool.choices import MODES
from voxtool.files import hdf5
from voxtool.files.schema import (
    PLAN,
    SOURCE,
    UNITS,
    Attribute,
    Dataset,
    Rule,
    Schema,
    expect,
    without,
)
from voxtool.grid import Grid
from voxtool.svo.content import StoredOctree
from voxtool.svo.layout import NODE
from voxtool.svo.octree import Octree

RULE_NAME = Rule(  # any name will do: it changes nothing here
    lambda text: re.fullmatch(r"[a-z][a-z0-9+-]*", text), "is {value!r}, which names no rule"
)
MODE = "`surface26`, `surface6`, `solid` or `solid+surface26`"
FILL = (
    "rule that decided what is inside: `parity`, `nonzero`, `winding`, `flood`, `flood+gapN`; "
    "`none` for a surface, for other programs' voxels and for combinations; matches "
    "`[a-z][a-z0-9+-]*`"
)

SCALED = Rule(
    lambda numbers: len(numbers) == 4 and all(map(math.isfinite, numbers)) and numbers[0] > 0,
    "is {value}: a scale above 0 and three offsets are expected, all finite",
)
TRANSFORM = (
    "of a normalized mesh, scale and offset x, y, z: world = original · scale + offset; "
    "files with it are `1.1`, others `1.0`"
)


def grid_of(stored: Mapping[str, Any]) -> Grid:
    """The grid of stored attributes; FileError or GridError if they give none."""
    grid = Grid(stored["shape"], stored["origin"], stored["pitch"])
    expect("dim", stored["dim"], (grid.dim,))
    expect("depth", stored["depth"], ((grid.side // 4).bit_length(),))
    return grid


def _build(values: dict[str, Any], arrays: dict[str, Any]) -> Octree | StoredOctree:
    others = without(values, "dim", "depth", "shape", "origin", "pitch")
    kind = StoredOctree if isinstance(arrays["nodes"], Slices) else Octree
    return kind(grid_of(values), **arrays, **others)


SCHEMA = Schema(
    format="voxtool-svo",
    version="1.0",
    what="octree",
    hint="voxelize a mesh first: voxtool voxelize MESH",
    own=(
        Attribute("dim", int, "voxels along the longest side", at="grid.dim"),
        Attribute("depth", int, "number of levels"),
        Attribute("shape", int, "voxels along x, y and z", 3, at="grid.shape"),
        Attribute("mode", str, MODE, 32, choices=(*MODES, "solid+surface26")),
        Attribute("fill", str, FILL, 32, rule=RULE_NAME),
        Attribute("origin", float, "low corner of voxel (0, 0, 0); finite", 3, at="grid.origin"),
        Attribute("pitch", float, "voxel size along x, y and z; 1e-95 to 1e90", 3, at="grid.pitch"),
        UNITS,
        SOURCE,
        PLAN,
        Attribute("transform", float, TRANSFORM, 4, rule=SCALED, since="1.1"),
    ),
    datasets=(
        Dataset("offsets", "<u4", (lambda sizes: sizes["depth"] + 1,)),
        Dataset("nodes", "<u4", ("N", 2), rows=NODE),
        Dataset("bricks", "<u8", ("M",)),
    ),
    build=_build,
    agree=grid_of,
)

write = partial(hdf5.write, SCHEMA)
