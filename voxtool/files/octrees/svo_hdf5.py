"""Octrees as HDF5, format `voxtool-svo`, specified in docs/formats.md.

The XML of svo_xml.py has the same attributes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from voxtool.arrays import Slices
from voxtool.choices import OCTREE_MODES
from voxtool.errors import FileError
from voxtool.files.storage import hdf5
from voxtool.files.storage.schema import (
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
from voxtool.svo.octree.attributes import KINDS
from voxtool.svo.octree.attributes import Attribute as VoxelAttribute
from voxtool.svo.octree.content import StoredAttributedOctree, StoredOctree
from voxtool.svo.octree.layout import NODE
from voxtool.svo.octree.octree import Octree

if TYPE_CHECKING:
    from voxtool.svo.dag.merged import MergedOctree

RULE_NAME = Rule(  # any name will do: it changes nothing here
    lambda text: re.fullmatch(r"[a-z][a-z0-9+-]*", text), "is {value!r}, which names no rule"
)
MODE = "`surface26`, `surface6`, `solid`, `solid+surface26` or `solid+fraction`"
FILL = (
    "rule that decided what is inside: `parity`, `nonzero`, `winding`, `flood`, `flood+gapN`; "
    "`none` for a surface, for other programs' voxels and for combinations; matches "
    "`[a-z][a-z0-9+-]*`"
)


def grid_of(stored: Mapping[str, Any]) -> Grid:
    """Return the grid of stored attributes; FileError or GridError if they give none."""
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
    """Return the values of an octree, of stored ones."""
    others = without(values, "dim", "depth", "shape", "origin", "pitch")
    return {"grid": grid_of(values), **others}


# --- version 2: merged subtrees


def _build_merged(values: dict[str, Any], arrays: dict[str, Any]) -> MergedOctree:
    if isinstance(arrays["masks"], Slices):
        check_memory(sum(len(a) * 8 for a in arrays.values()), "its datasets")
        arrays = {name: array[:] for name, array in arrays.items()}
    from voxtool.svo.dag.merged import MergedOctree, unpack_links

    arrays["links"] = unpack_links(arrays.pop("links"), arrays)
    return MergedOctree(**arrays, **_content_of(values))


PLAIN = (
    Dataset("offsets", "<u4", (lambda sizes: sizes["depth"] + 1,)),
    Dataset("nodes", "<u4", ("N", 2), rows=NODE),
    Dataset("bricks", "<u8", ("M",)),
)
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


# --- version 3: attributes of voxels


def _head_of(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return the description of each attribute in a file, checked; FileError if it is not sound."""
    heads = ATTRIBUTES.decode(stored["attributes"])
    for name, head in heads.items():
        if name not in KINDS or not isinstance(head, dict) or set(head) != HEAD:
            raise FileError(
                f"attribute attributes: {name[:40]!r} is not described as one of octrees"
            )
        expect(f"attributes: {name} dtype", head["dtype"], KINDS[name].dtypes)
        expect(f"attributes: {name} masked", head["masked"], (True, False))
        numbers = head["default"] if KINDS[name].channels else [head["default"]]
        right = isinstance(numbers, list) and len(numbers) == max(KINDS[name].channels, 1)
        dtype = np.dtype(head["dtype"])
        most = 1 if dtype.kind == "f" else int(np.iinfo(dtype).max)
        if not right or not all(type(x) in (int, float) and 0 <= x <= most for x in numbers):
            raise FileError(f"attribute attributes: {name} has no such default")
    return heads


def _datasets_of(name: str, channels: int) -> tuple[Dataset, ...]:
    """Return the datasets of an attribute."""

    def dtype(sizes: Mapping[str, Any]) -> str:
        return "<" + _head_of(sizes)[name]["dtype"]

    def needed(sizes: Mapping[str, Any], there: bool) -> bool:
        return name in _head_of(sizes)

    def masked(sizes: Mapping[str, Any], there: bool) -> bool:
        return needed(sizes, there) and _head_of(sizes)[name]["masked"]

    row = (channels,) if channels else ()
    names = (Dataset("label_names", "u1", ("T",), needed=needed),) if name == "label" else ()
    return (
        Dataset(f"{name}_masks", "<u8", ("M",), needed=masked),
        Dataset(f"{name}_values", dtype, (f"V{name}", *row), needed=needed),
        Dataset(f"{name}_leaves", dtype, (f"L{name}", *row), needed=needed),
        *names,
    )


def _build_attributed(
    values: dict[str, Any], arrays: dict[str, Any]
) -> Octree | StoredAttributedOctree:
    stored_in = Octree if isinstance(arrays["nodes"], np.ndarray) else StoredAttributedOctree
    heads = values.pop("attributes")
    found = []
    for name, head in heads.items():
        masks, stored, leaves = (
            arrays.pop(f"{name}_{a}", None) for a in ("masks", "values", "leaves")
        )
        assert stored is not None
        assert leaves is not None
        default = tuple(head["default"]) if KINDS[name].channels else head["default"]
        names = _names(arrays.pop("label_names")[:]) if name == "label" else ()
        found.append(VoxelAttribute(name, stored, leaves[:], masks, default, names))
    return stored_in(**arrays, **_content_of(values), attributes=tuple(found))


def _names(stored: np.ndarray) -> tuple[str, ...]:
    """Return the names of labels, each followed by a zero byte."""
    try:
        *names, rest = stored.tobytes().decode().split("\0")
    except UnicodeDecodeError:
        raise FileError("dataset label_names is not UTF-8 text") from None
    if rest or not all(map(str.isprintable, names)):
        raise FileError("dataset label_names: a name is not ended, or cannot be printed")
    return tuple(names)


def _flat(octree: Octree) -> SimpleNamespace:
    """Return an octree, also in blocks, with its attributes under the names of their datasets."""
    flat = SimpleNamespace(**{item.name: getattr(octree, item.name) for item in fields(Octree)})
    flat.depth, flat.attributes = octree.depth, {one.name: one.head for one in octree.attributes}
    for name in KINDS:
        one = next((one for one in octree.attributes if one.name == name), None)
        for part in ("masks", "values", "leaves"):
            setattr(flat, f"{name}_{part}", getattr(one, part, None))
        if name == "label":
            text = "".join(f"{label}\0" for label in one.names).encode() if one else None
            flat.label_names = None if text is None else np.frombuffer(text, np.uint8)
    return flat


HEAD = {"dtype", "masked", "default"}
ATTRIBUTES = Attribute(
    "attributes",
    dict,
    "by name, the dtype, whether masks say which voxels have values, and the default of the others",
    4096,
)
ATTRIBUTED = Schema(
    format=MERGED.format,
    version="3.0",
    what=MERGED.what,
    hint=MERGED.hint,
    own=(*OWN, ATTRIBUTES, transform_since("3.1")),
    datasets=(
        *PLAIN,
        *(one for name, kind in KINDS.items() for one in _datasets_of(name, kind.channels)),
    ),
    build=_build_attributed,
    sliced=True,
    agree=lambda stored: (grid_of(stored), _head_of(stored)),
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
    datasets=PLAIN,
    build=_build,
    sliced=True,
    agree=grid_of,
    newer=(MERGED, ATTRIBUTED),
)


def write(octree: Any, file: BinaryIO) -> None:
    """Write an octree; a merged one as version 2, one with attributes as version 3."""
    if hasattr(octree, "root"):  # a MergedOctree
        hdf5.write(MERGED, octree, file)
    elif octree.attributes:
        hdf5.write(ATTRIBUTED, _flat(octree), file)
    else:
        hdf5.write(SCHEMA, octree, file)
