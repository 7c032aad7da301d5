"""Grids of NanoVDB, .nvdb, uncompressed: the tree of a .vdb, laid out for reading in place.

The grid is that of vdb.py: the same cells, tiles and map, of float32; nvdb_levels.py writes that of
vdb_levels.py. Labels, areas and fractions are grids of their own. A file has a header, a table of
the grids, and the grids: grid, tree, root, then all upper nodes, lower nodes and leaves.
An entry of a node's table is a tile's value or the distance in bytes to a child.
[NanoVDB: Museth 2021, doi 10.1145/3450623.3464653; files of version 32.6]
"""

from __future__ import annotations

import struct
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.files.grids import vdb
from voxtool.files.grids.vdb_attributes import AttributeGrid
from voxtool.files.grids.vdb_encode import (
    CELLS,
    KEY_SHIFTS,
    LEAF_SIDE,
    LOWER,
    LOWER_SIDE,
    UPPER,
    UPPER_SIDE,
    Inside,
    Leaves,
    bits_of,
    corners_of,
    groups_of,
    keys_of,
    parents_of,
    tiles_of,
    upper_corners,
)
from voxtool.grid import check_single
from voxtool.svo.images.attribute_image import attributes_of
from voxtool.svo.images.image import VoxelImage

MAGIC, GRID_MAGIC = b"NanoVDB0", b"NanoVDB1"  # of version 32.6: of files, and of grids in new ones
VERSION = 32 << 21 | 6 << 10
UNKNOWN, LEVEL_SET, FOG_VOLUME = 0, 1, 2  # classes of grids
BREADTH_FIRST, HAS_BOX = 1 << 5, 2
FLOAT = 1  # the type of the values
HEADER, TABLE, GRID, TREE, ROOT, TILE = 16, 176, 672, 64, 64, 32  # bytes
UNCHECKED = (1 << 64) - 1  # instead of a checksum
CHUNK = 1 << 14  # leaves that are written at once
BOX = [("low", "<i4", 3), ("high", "<i4", 3), ("flags", "<u8")]
LEAF_HEAD = [("low", "<i4", 3), ("extent", "u1", 3), ("flags", "u1"), ("mask", "u1", 64)]


def node_type(power: int) -> np.dtype:
    """Return the layout of an upper or a lower node."""
    count = 8**power
    masks = [("active", "u1", count // 8), ("child", "u1", count // 8)]
    return np.dtype([*BOX, *masks, ("statistics", "u1", 32), ("table", "<i8", count)])


LEAF_TYPE = np.dtype([*LEAF_HEAD, ("statistics", "u1", 16), ("values", "<f4", CELLS)])
SIZES = (LEAF_TYPE.itemsize, node_type(LOWER).itemsize, node_type(UPPER).itemsize)


class Content(NamedTuple):
    """A grid: its class, its place in the world, and its tree.

    The values of the leaves are the bytes of their active cells, or of all with `whole`; None where
    all active ones are one. Cells in neither a leaf nor a tile have the background.
    """

    kind: int
    middle: np.ndarray  # (3,) world coordinates of the sample of index 0
    pitch: np.ndarray  # (3,) world units
    leaves: Leaves
    tiles: dict[str, np.ndarray]
    box: tuple[np.ndarray, np.ndarray]  # first and last of the active cells, (3,) int each
    active: int  # number of active cells
    inside: Inside = Inside(1, True)
    background: float = 0.0
    whole: bool = False
    name: str = vdb.GRID_NAME


def _floats(image: VoxelImage) -> VoxelImage:
    """Return an image of float32, whose voxels are 1 where they are set."""
    if image.dtype == np.float32:
        return image
    if image.level or image.dtype != bool:
        raise VoxtoolError(
            f".nvdb holds float32, not {image.dtype.name}: leave out --dtype, --isovalue"
        )
    return image.with_dtype("float32")


def size(image: VoxelImage) -> int:
    """Return a bound of the bytes of the file."""
    image = _floats(image)
    corners, _ = image.block_nodes(LEAF_SIDE)
    grids = 1 + len(image.attributes)
    return grids * size_of(corners, tiles_of(image.cubes(LEAF_SIDE)))


def size_of(corners: np.ndarray, tiles: dict[str, np.ndarray]) -> int:
    """Return the bytes of a grid with leaves at these low cells, (n, 3), and these tiles."""
    lower, upper = parents_of(np.sort(keys_of(corners)), tiles)
    nodes = len(lower) * node_type(LOWER).itemsize + len(upper) * (TILE + node_type(UPPER).itemsize)
    fixed = HEADER + TABLE + len(vdb.GRID_NAME) + 1 + GRID + TREE + ROOT
    leaves = len(corners) * LEAF_TYPE.itemsize
    return fixed + nodes + leaves + TILE * len(tiles["upper"])


def write(image: VoxelImage, file: BinaryIO) -> None:
    """Write a grid of float32, and one for each attribute."""
    image = _floats(image)
    leaves, cubes = vdb.tree_of(image, pack=False)
    pitch, (low, high, count) = np.array(image.pitch), vdb.extent_of(leaves, cubes)
    middle = np.array(image.corner) + pitch / 2
    voxels = Content(FOG_VOLUME, middle, pitch, leaves, tiles_of(cubes), (low, high), count)
    more = (AttributeGrid.of(one, leaves, pack=False) for one in attributes_of(image))
    attributes = [
        voxels._replace(
            kind=UNKNOWN, leaves=one.leaves, tiles=one.tiles, inside=one.inside, name=one.name
        )
        for one in more
    ]
    write_grids([voxels, *attributes], file)


def write_grids(contents: list[Content], file: BinaryIO) -> None:
    """Write a file of some grids."""
    file.write(struct.pack("<8sIHH", MAGIC, VERSION, len(contents), 0))
    for content in contents:
        _write_table(content, file)
    for number, content in enumerate(contents):
        _write_grid(content, file, (number, len(contents)))


class Layout(NamedTuple):
    """The layout of a grid: where its nodes lie."""

    lower: np.ndarray  # places of the lower and the upper nodes, and what the root lists
    upper: np.ndarray
    roots: np.ndarray
    counts: tuple[int, int, int]  # leaves, lower and upper nodes
    first: tuple[int, int, int]  # where each of these begins, bytes from the start of the tree
    total: int  # bytes of the grid

    @classmethod
    def of(cls, content: Content) -> Layout:
        lower, upper = parents_of(content.leaves.keys, content.tiles)
        roots = np.sort(np.concatenate([upper, content.tiles["upper"]]))
        counts = (len(content.leaves.keys), len(lower), len(upper))
        first_upper = TREE + ROOT + TILE * len(roots)
        first_lower = first_upper + counts[2] * SIZES[2]
        first_leaf = first_lower + counts[1] * SIZES[1]
        total = GRID + first_leaf + counts[0] * SIZES[0]
        return cls(lower, upper, roots, counts, (first_leaf, first_lower, first_upper), total)


def _write_grid(content: Content, file: BinaryIO, place: tuple[int, int]) -> None:
    """Write a grid, which is the `place[0]`-th of `place[1]`."""
    layout, tiles, (low, high) = Layout.of(content), content.tiles, content.box
    lower, upper, roots, counts, (first_leaf, first_lower, first_upper), total = layout
    _write_head(content, file, total, place)
    tree = struct.pack("<4Q", first_leaf, first_lower, first_upper, TREE)
    tree += struct.pack("<6IQ", *counts, *_flat(content), content.active)
    root = struct.pack("<7I", *_signed(low), *_signed(high), len(roots))
    file.write(tree + (root + struct.pack("<f", content.background)).ljust(ROOT, b"\0"))
    _write_roots(content, file, roots, upper, first_upper - TREE)
    step = (first_lower - first_upper, SIZES[2], SIZES[1])
    _write_nodes(content, file, UPPER, (upper, lower, tiles["lower"]), step)
    step = (first_leaf - first_lower, SIZES[1], SIZES[0])
    _write_nodes(content, file, LOWER, (lower, content.leaves.keys, tiles["leaf"]), step)
    _write_leaves(content, file)


def _flat(content: Content) -> list[int]:
    """Return the numbers of tiles of lower, upper and root nodes."""
    return [len(content.tiles[name]) for name in KEY_SHIFTS]


def _words(values: Any) -> np.ndarray:
    """Return the bits of values in the table of a node."""
    return np.asarray(values, "<f4").view("<u4")


def _signed(cells: np.ndarray) -> list[int]:
    return [int(n) & 0xFFFFFFFF for n in cells]


def _world(content: Content) -> bytes:
    """Return the box of the active cells in the world."""
    pitch, center, box = content.pitch, content.middle, content.box
    return np.array([center + pitch * box[0], center + pitch * (box[1] + 1)], "<f8").tobytes()


def _write_table(content: Content, file: BinaryIO) -> None:
    """Write the entry of a grid in the table of the file."""
    name, layout = content.name.encode() + b"\0", Layout.of(content)
    file.write(struct.pack("<4Q", layout.total, layout.total, 0, content.active))
    file.write(struct.pack("<2I", FLOAT, content.kind))
    file.write(_world(content) + np.array(content.box, "<i4").tobytes())
    file.write(content.pitch.astype("<f8").tobytes())
    file.write(struct.pack("<4I", len(name), *layout.counts))
    file.write(struct.pack("<4I", 1, *_flat(content)))
    file.write(struct.pack("<HHI", 0, 0, VERSION) + name)


def _write_head(content: Content, file: BinaryIO, total: int, place: tuple[int, int]) -> None:
    """Write a grid up to its tree."""
    pitch = content.pitch
    file.write(struct.pack("<8sQIIIIQ", MAGIC, UNCHECKED, VERSION, BREADTH_FIRST, *place, total))
    file.write((content.name.encode() + b"\0").ljust(256, b"\0"))
    # the map: matrix, its inverse, translation, taper
    parts = [np.diag(pitch).ravel(), np.diag(1 / pitch).ravel(), content.middle, [1.0]]
    numbers = np.concatenate(parts)
    check_single(".nvdb", pitch, numbers, "write .vdb")
    for dtype in ("<f4", "<f8"):
        file.write(numbers.astype(dtype).tobytes())
    file.write(_world(content) + pitch.astype("<f8").tobytes())
    file.write(struct.pack("<2IqI", content.kind, FLOAT, total, 0))
    file.write(bytes(12) + GRID_MAGIC)


def _write_roots(
    content: Content, file: BinaryIO, roots: np.ndarray, upper: np.ndarray, first: int
) -> None:
    """Write the table of the root; `first` counts the bytes from the root to the upper nodes."""
    places = dict(zip(upper.tolist(), range(len(upper)), strict=True))
    values = iter(_words(content.inside.of("upper", slice(0, len(content.tiles["upper"])))))
    for key, corner in zip(roots.tolist(), upper_corners(roots).tolist(), strict=True):
        x, y, z = (n // UPPER_SIDE for n in corner)
        place = places.get(key)
        child = 0 if place is None else first + place * SIZES[2]
        flat = place is None
        state, value = flat and content.inside.active, next(values) if flat else 0
        row = struct.pack("<QqII", x << 42 | y << 21 | z, child, state, value)
        file.write(row.ljust(TILE, b"\0"))


def _write_nodes(
    content: Content,
    file: BinaryIO,
    power: int,
    keys: tuple[np.ndarray, np.ndarray, np.ndarray],
    step: tuple[int, int, int],
) -> None:
    """Write the upper or the lower nodes.

    `keys` are the places of the nodes, their children and their tiles; `step` the bytes from the
    first node to the first child, of a node and of a child.
    """
    parents, children, tiles = keys
    first, own, each = step
    unit, below = ("upper", "lower") if power == UPPER else ("lower", "leaf")
    side = UPPER_SIDE if power == UPPER else LOWER_SIDE
    low = corners_of(parents << KEY_SHIFTS[unit][0])
    mask = 8**power - 1
    parts = (groups_of(parents, places, 3 * power) for places in (children, tiles))
    for i, (held, flat) in enumerate(zip(*parts, strict=True)):
        node = np.zeros(1, node_type(power))
        node["low"], node["high"] = low[i], low[i] + side - 1
        node["child"][0] = np.frombuffer(bits_of(children[held] & mask, power), np.uint8)
        if content.inside.active:
            node["active"][0] = np.frombuffer(bits_of(tiles[flat] & mask, power), np.uint8)
        distances = first - i * own + each * np.arange(held.start, held.stop)
        node["table"] = _words(content.background)
        node["table"][0, children[held] & mask] = distances
        node["table"][0, tiles[flat] & mask] = _words(content.inside.of(below, flat))
        file.write(node.tobytes())


def _write_leaves(content: Content, file: BinaryIO) -> None:
    """Write the leaves."""
    leaves = content.leaves
    for first in range(0, len(leaves.keys), CHUNK):
        chosen = slice(first, first + CHUNK)
        rows = np.zeros(len(leaves.keys[chosen]), LEAF_TYPE)
        rows["low"] = corners_of(leaves.keys[chosen])
        rows["extent"], rows["flags"] = LEAF_SIDE - 1, HAS_BOX
        rows["mask"] = leaves.masks[chosen]
        active = np.unpackbits(leaves.masks[chosen], axis=1, bitorder="little") != 0
        rows["values"] = active
        if leaves.values is not None:
            rows["values"][active | content.whole] = np.frombuffer(
                b"".join(leaves.values[chosen]), "<f4"
            )
        file.write(rows.tobytes())
