"""The voxels of a grid of a .vdb file, which any program may have written: see vdb.py."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import numpy as np

from voxtool.errors import FileError, printable
from voxtool.files.grids.vdb_decode import MOST_TEXT, Source, Tree, read_matrix
from voxtool.files.grids.vdb_encode import LEAF_SIDE
from voxtool.files.grids.voxels import Boxes, Cubes, Frame, Rule, Stored, frame_of
from voxtool.grid import MAX_DIM, Grid

MAGIC = 0x56444220
OLDEST = 222  # the version whose nodes hold what these modules read
TYPES = {"bool": "?", "float": "<f4", "double": "<f8", "int32": "<i4", "int64": "<i8"}
TYPE = re.compile(r"Tree_(\w+)_5_4_3(_HalfFloat)?")
OWN = "voxels"  # the first grid of voxtool's files, before those of attributes
INSTANCES = "\x1e"  # before the number of a name that a file holds twice
LEVEL_SET = Rule(below=0.0)  # inside is negative


class Entry(NamedTuple):
    """A grid of a file."""

    name: str
    type: str
    parent: str  # the grid whose tree it shares, or ""
    start: int


def read(file: BinaryIO, size: int, grid: str | None = None) -> Stored:
    """Return the voxels of a grid: the active cells, and of a level set what is inside."""
    source = Source(file, size)
    entry = _chosen(_entries(source), grid)
    found = TYPE.fullmatch(entry.type)
    if not found or found[1] not in TYPES:
        raise FileError(
            f"grid {printable(entry.name)} is a {printable(entry.type)[:40]}: voxels are bool, "
            "int32, int64, float or double"
        )
    if entry.parent:
        raise FileError(f"grid {printable(entry.name)} is an instance of another: choose that one")
    source.go(entry.start)
    flags = source.number("I")
    metadata = _metadata(source)
    matrix, translation = read_matrix(source)
    tree = Tree(np.dtype(TYPES[found[1]]), found[2] is not None, flags)
    tree.read_topology(source)
    is_level_set = metadata.get("class") == b"level set"
    low, frame = _place(tree, metadata, matrix, translation, is_level_set, entry.name)
    units = metadata.get("voxtool_units", b"").decode(errors="replace")
    pieces = _pieces(tree, source, low, is_level_set)
    return Stored(frame, pieces, units, LEVEL_SET if is_level_set else Rule())


# ---- the opening of the file


def _entries(source: Source) -> list[Entry]:
    """Return the grids of a file."""
    magic, version = source.numbers("qI")
    if magic != MAGIC:
        raise FileError("is no .vdb: it does not begin as one")
    if version < OLDEST:
        raise FileError(f"of version {version}: save it by OpenVDB 2 or newer ({OLDEST})")
    source.numbers("2I")  # the library's version
    has_places = source.number("B")
    source.take(36)  # an identifier
    _metadata(source)
    found = []
    for _ in range(source.number("I")):
        name, type, parent = (source.text() for _ in range(3))
        start, _, end = source.numbers("3q")
        found.append(
            Entry(name.split(INSTANCES)[0], type, parent, start if start else source.place)
        )
        if not has_places:
            break  # the others begin where this one ends
        source.go(end)
    return found


def _chosen(entries: list[Entry], name: str | None) -> Entry:
    """Return the grid of a name, or the only one, or in voxtool's own files that of the voxels."""
    names = printable(", ".join(dict.fromkeys(entry.name for entry in entries)))[:200] or "none"
    chosen = [entry for entry in entries if name is None or entry.name == name]
    if not chosen:
        raise FileError(f"holds no grid {name or ''}: its grids are {names}")
    if name is None and len(chosen) > 1 and chosen[0].name != OWN:
        raise FileError(f"holds {len(chosen)} grids: choose one of {names}")
    return chosen[0]


def _metadata(source: Source) -> dict[str, bytes]:
    """Return the entries of metadata, their values as they are stored."""
    found = {}
    for _ in range(source.number("I")):
        name, type, length = source.text(), source.text(), source.number("I")
        data = source.take(length) if length <= MOST_TEXT else b""
        if length > MOST_TEXT:
            source.check(length)
            source.go(source.place + length)
        if type:
            found[name] = data
    return found


# ---- the place of the voxels


def _place(
    tree: Tree,
    metadata: dict[str, bytes],
    matrix: np.ndarray,
    translation: np.ndarray,
    is_level_set: bool,
    name: str,
) -> tuple[np.ndarray, Frame]:
    """Return the index of the first voxel, and the frame of the voxels from there on."""
    exact = _own_grid(metadata, matrix, translation)
    if exact is not None:
        return exact
    corners = [(corners, LEAF_SIDE) for corners in tree.corners if len(corners)]
    for held, side, values, active in tree.tiles:
        is_set = values < 0 if is_level_set else active
        if is_set.any():
            corners.append((held[is_set], side))
    if not corners:
        raise FileError(f"grid {printable(name)} has no active voxel")
    low = np.min([held.min(axis=0) for held, _ in corners], axis=0)
    shape = np.max([held.max(axis=0) + side for held, side in corners], axis=0) - low
    if shape.max() > MAX_DIM:
        size = " x ".join(map(str, shape.tolist()))
        raise FileError(f"its voxels span {size}, of {MAX_DIM} a side allowed: crop it first")
    with np.errstate(all="ignore"):  # what is not finite is refused
        return low, frame_of(shape.tolist(), matrix, translation + matrix @ low)


def _own_grid(
    metadata: dict[str, bytes], matrix: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, Frame] | None:
    """Return the same from voxtool's own metadata, if it is there and agrees with the transform."""
    try:
        low, shape = (struct.unpack("<3i", metadata[f"voxtool_{n}"]) for n in ("low", "shape"))
        origin = np.array(struct.unpack("<3d", metadata["voxtool_origin"]))
    except (KeyError, struct.error):
        return None
    pitch = np.diag(matrix)
    with np.errstate(all="ignore"):  # numbers that are not finite agree with nothing
        center = origin + pitch / 2
    if not (matrix == np.diag(pitch)).all() or not (center == translation).all():
        return None
    if min(low) < 0 or min(shape) < 1 or max(shape) > MAX_DIM:
        return None
    place = tuple(float(v) for v in pitch * low + origin)
    grid = Grid(shape, place, tuple(pitch.tolist()))  # pyright: ignore
    return np.array(low), Frame(grid)


# ---- the voxels


def _pieces(
    tree: Tree, source: Source, low: np.ndarray, is_level_set: bool
) -> Iterator[Boxes | Cubes]:
    """Yield tiles and leaves, counted from the first voxel; inactive cells are 0 but in a level
    set."""
    for corners, side, values, active in tree.tiles:
        chosen = values < 0 if is_level_set else active
        yield Cubes(_inside(corners[chosen] - low), side, values[chosen])
    for corners, values, active in tree.leaves(source):
        if not is_level_set:
            values[~active] = 0
        boxes = values.reshape(-1, *[LEAF_SIDE] * 3)
        if not (low % LEAF_SIDE).any():
            yield Boxes(_inside(corners - low), boxes)
            continue
        held = np.argwhere(boxes < 0 if is_level_set else boxes != 0)
        cells = corners[held[:, 0]] + held[:, 1:] - low
        yield Boxes(_inside(cells), boxes[tuple(held.T)][:, None, None, None])


def _inside(corners: np.ndarray) -> np.ndarray:
    """Return corners; FileError if one is negative, which only metadata that lie can bring."""
    if (corners < 0).any():
        raise FileError("its voxels are not in the grid that its metadata name")
    return corners
