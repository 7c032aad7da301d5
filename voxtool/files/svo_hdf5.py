"""Octrees as HDF5, format `voxtool-svo`, specified in docs/formats.md.

The XML of svo_xml.py has the same attributes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, BinaryIO

from voxtool.arrays import Slices
from voxtool.choices import OCTREE_MODES
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
    transform_since,
    without,
)
from voxtool.grid import Grid
from voxtool.memory import check_memory
from voxtool.svo.content import StoredOctree
from voxtool.svo.layout import NODE
from voxtool.svo.merged import MergedOctree, unpack_links
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


def grid_of(stored: Mapping[str, Any]) -> Grid:
    """The grid of stored attributes; FileError or GridError if they give none."""
    grid = Grid(stored["shape"], stored["origin"], stored["pitch"])
    expect("dim", stored["dim"], (grid.dim,))
    expect("depth", stored["depth"], ((grid.side // 4).bit_length(),))
    return grid


OWN = (
    Attribute("dim", int, "voxels along the longest side", at="grid.dim"),
    Attribute("depth", int, "number of levels"),
    Attribute("shape", int, "voxels along x, y and z", 3, at="grid.shape"),
    Attribute("mode", str, MODE, 32, choices=OCTREE_MODES),
    Attribute("fill", str, FILL, 32, rule=RULE_NAME),
    Attribute("origin", float, "low corner of voxel (0, 0, 0); finite", 3, at="grid.origin"),
    Attribute("pitch", float, "voxel size along x, y and z; 1e-95 to 1e90", 3, at="grid.pitch"),
    UNITS,
    SOURCE,
    PLAN,
)
TRANSFORMED = transform_since("1.1")


def _content_of(values: dict[str, Any]) -> dict[str, Any]:
    """The values of an octree, of stored ones."""
    others = without(values, "dim", "depth", "shape", "origin", "pitch")
    return {"grid": grid_of(values), **others}


# --- version 2: merged subtrees


def _build_merged(values: dict[str, Any], arrays: dict[str, Any]) -> MergedOctree:
    if isinstance(arrays["masks"], Slices):
        check_memory(sum(len(a) * 8 for a in arrays.values()), "its datasets")
        arrays = {name: array[:] for name, array in arrays.items()}
    arrays["links"] = unpack_links(arrays.pop("links"), arrays)
    return MergedOctree(**arrays, **_content_of(values))


MERGED = Schema(
    format="voxtool-svo",
    version="2.0",
    what="octree",
    hint="voxelize a mesh first: voxtool voxelize MESH",
    own=(
        *OWN,
        Attribute("root", int, "0 empty, 1 full, 2 refined", choices=(0, 1, 2)),
        transform_since("2.1"),
    ),
    datasets=(
        Dataset("starts", "<u4", (lambda sizes: sizes["depth"],)),
        Dataset("masks", "<u2", ("R",)),
        Dataset("links", "u1", ("L",), at="packed_links"),
        Dataset("leaves", "<u8", ("M",)),
    ),
    build=_build_merged,
    sliced=True,
    agree=grid_of,
)


# --- version 1: all nodes


def _build(values: dict[str, Any], arrays: dict[str, Any]) -> Octree | StoredOctree:
    kind = StoredOctree if isinstance(arrays["nodes"], Slices) else Octree
    return kind(**arrays, **_content_of(values))


SCHEMA = Schema(
    format=MERGED.format,
    version="1.0",
    what=MERGED.what,
    hint=MERGED.hint,
    own=(*OWN, TRANSFORMED),
    datasets=(
        Dataset("offsets", "<u4", (lambda sizes: sizes["depth"] + 1,)),
        Dataset("nodes", "<u4", ("N", 2), rows=NODE),
        Dataset("bricks", "<u8", ("M",)),
    ),
    build=_build,
    sliced=True,
    agree=grid_of,
    newer=(MERGED,),
)


def write(octree: Octree | MergedOctree, file: BinaryIO) -> None:
    """Write an octree; a merged one as version 2."""
    hdf5.write(MERGED if isinstance(octree, MergedOctree) else SCHEMA, octree, file)
