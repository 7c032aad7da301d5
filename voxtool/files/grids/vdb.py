"""Trees of OpenVDB, .vdb, which Blender, Houdini and others open: bool or float grids.

Index (i, j, k) is the centre of cell (i, j, k), counted from the low corner of the octree's grid:
world = translation + scale * index, and translation = corner + half a cell. Cells that are set are
active, with their coverage as the value; wholly set cubes are tiles. The metadata origin, low and
shape hold the grid without rounding, each name after "voxtool_". Attributes are grids of their own
(vdb_attributes.py).
[OpenVDB: Museth 2013, doi 10.1145/2487228.2487235; files of version 224]
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable
from typing import Any, BinaryIO, NamedTuple
from uuid import UUID

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.files.grids.vdb_attributes import AttributeGrid
from voxtool.files.grids.vdb_encode import (
    ACTIVE_MASK,
    CELLS,
    LEAF_SIDE,
    LOWER,
    MASK_BYTES,
    UPPER,
    ZIP,
    Inside,
    Leaves,
    corners_of,
    keys_of,
    packed,
    parents_of,
    stored,
    tiles_of,
    write_tree,
)
from voxtool.files.grids.vdb_read import MAGIC
from voxtool.files.grids.vdb_read import OWN as GRID_NAME
from voxtool.files.grids.vdb_read import read as read
from voxtool.svo.images.attribute_image import attributes_of
from voxtool.svo.images.block_masks import block_masks
from voxtool.svo.images.image import VoxelImage
from voxtool.version import __version__

FILE_VERSION, LIBRARY = 224, (10, 0)  # of the library whose files these are like
NAMES = {"bool": "Tree_bool_5_4_3", "float32": "Tree_float_5_4_3"}
BEYOND = 1 << 30  # a cell that no grid has
EXTRA = 4096  # bytes of the header and the metadata
POSITIONS = struct.Struct("<qqq")


class Meta(NamedTuple):
    """An entry of metadata."""

    type: str
    data: bytes

    @classmethod
    def text(cls, value: str) -> Meta:
        return cls("string", value.encode())

    @classmethod
    def whole(cls, *values: int) -> Meta:
        """Return three numbers of 32 bits, or one of 64."""
        form, name = ("<3i", "vec3i") if len(values) == 3 else ("<q", "int64")
        return cls(name, struct.pack(form, *values))

    @classmethod
    def real(cls, *values: float) -> Meta:
        return cls("vec3d", struct.pack("<3d", *values))


def size(image: VoxelImage) -> int:
    """Return a bound of the bytes of the file."""
    _check_type(image)
    corners, _ = image.block_nodes(LEAF_SIDE)
    tiles = tiles_of(image.cubes(LEAF_SIDE))
    lower, upper = parents_of(keys_of(corners), tiles)
    nodes = sum(
        len(keys) * (2 * 8**power // 8 + 64) for keys, power in ((lower, LOWER), (upper, UPPER))
    )
    values = sum(map(len, tiles.values())) * image.dtype.itemsize
    leaf = 3 * MASK_BYTES + 12
    if image.dtype != bool:
        leaf = 2 * MASK_BYTES + 9 + (CELLS * image.dtype.itemsize if image.level else 48)
    more = attributes_of(image)
    for attribute in more:
        values += sum(map(len, tiles.values())) * 4 * attribute.channels
        leaf += 2 * MASK_BYTES + 9 + CELLS * 4 * attribute.channels
    names = sum(len(json.dumps(attribute.names)) for attribute in more)
    return (EXTRA + nodes) * (1 + len(more)) + names + values + len(corners) * leaf


def write(image: VoxelImage, file: BinaryIO) -> None:
    """Write a grid of bool or float32, and one for each attribute."""
    _check_type(image)
    leaves, cubes = tree_of(image)
    low, high, count = extent_of(leaves, cubes)
    flags = ACTIVE_MASK if image.dtype == bool else ACTIVE_MASK | ZIP
    corner, pitch = image.corner, image.pitch
    metadata = {
        "class": Meta.text("fog volume"),
        "creator": Meta.text(f"voxtool {__version__}"),
        "file_bbox_max": Meta.whole(*high.tolist()),
        "file_bbox_min": Meta.whole(*low.tolist()),
        "file_voxel_count": Meta.whole(count),
        "name": Meta.text(GRID_NAME),
        "voxtool_low": Meta.whole(*image.low),
        "voxtool_origin": Meta.real(*corner),
        "voxtool_shape": Meta.whole(*image.shape),
        "voxtool_units": Meta.text(image.units),
    }
    if image.octree.transform:
        metadata["voxtool_transform"] = Meta.text(" ".join(map(repr, image.octree.transform)))
    middle = tuple(c + p / 2 for c, p in zip(corner, pitch, strict=True))
    more = attributes_of(image)
    file.write(header_of(content_id(image), 1 + len(more)))
    write_grid(
        file, NAMES[image.dtype.name], flags, metadata, middle, pitch, leaves, tiles_of(cubes),
        Inside(1, True), 0,
    )  # fmt: skip
    for attribute in more:
        grid = AttributeGrid.of(attribute, leaves)
        own = {"class": Meta.text("unknown"), "name": Meta.text(grid.name)}
        if attribute.names:
            own["voxtool_label_names"] = Meta.text(json.dumps(attribute.names))
        write_grid(
            file, grid.type, ACTIVE_MASK | ZIP, metadata | own, middle, pitch, grid.leaves,
            grid.tiles, grid.inside, grid.background,
        )  # fmt: skip


def _check_type(image: VoxelImage) -> None:
    if image.dtype.name not in NAMES:
        raise VoxtoolError(f".vdb holds bool or float32, not {image.dtype.name}: choose --dtype")


def tree_of(image: VoxelImage, pack: bool = True) -> tuple[Leaves, list[tuple[np.ndarray, int]]]:
    """Return the leaves of an image, which hold the cells that are not zero and their values, and
    the cubes that are wholly set. Without `pack`, the values are the bytes of the active cells, or
    None where all are one."""
    keys, masks, values = [np.empty(0, np.int64)], [np.empty((0, MASK_BYTES), np.uint8)], []
    cubes: list[tuple[np.ndarray, int]] = [*image.cubes(LEAF_SIDE)]
    ones = [bytes(1) + stored(np.ones(n, image.dtype)) for n in range(CELLS + 1)]
    for blocks in block_masks(image):
        whole = (blocks.bits == 255).all(axis=1)
        if blocks.values is not None:
            whole &= (blocks.values == 1).all(axis=1)
        cubes.append((blocks.corners[whole], LEAF_SIDE))
        keys.append(keys_of(blocks.corners[~whole]))
        masks.append(blocks.bits[~whole])
        if blocks.values is not None:
            rows = blocks.values[~whole]
            data = (row[row != 0].tobytes() for row in rows)
            values += (bytes(1) + packed(part) for part in data) if pack else data
        elif pack and image.dtype != bool:
            counts = np.bitwise_count(masks[-1]).sum(axis=1, dtype=np.int64)
            values += [ones[n] for n in counts.tolist()]
    found = values if image.dtype != bool and (pack or image.level) else None
    leaves = Leaves.ordered(np.concatenate(keys), np.concatenate(masks), found)
    return leaves, cubes


def extent_of(
    leaves: Leaves, cubes: list[tuple[np.ndarray, int]]
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the first and the last cell of the box of the active cells, (3,) int, and their
    number."""
    count = int(np.bitwise_count(leaves.masks).sum(dtype=np.int64))
    low, high = np.full(3, BEYOND), np.full(3, -1)
    for corners, side in cubes:
        if len(corners):
            low, high = np.minimum(low, corners.min(0)), np.maximum(high, corners.max(0) + side - 1)
            count += len(corners) * side**3
    corners = corners_of(leaves.keys)
    for axis in range(3 if len(corners) else 0):
        least, most = (_held(leaves, corners, axis, pick) for pick in (np.min, np.max))
        low[axis], high[axis] = min(low[axis], least[0]), max(high[axis], most[-1])
    return (low if count else 0 * low), high, count


def _held(
    leaves: Leaves, corners: np.ndarray, axis: int, pick: Callable[[np.ndarray], Any]
) -> np.ndarray:
    """Return the layers along an axis that hold active cells, of the leaves at an end of it."""
    place = pick(corners[:, axis])
    bits = np.unpackbits(leaves.masks[corners[:, axis] == place], axis=1, bitorder="little")
    layers = bits.reshape(-1, LEAF_SIDE, LEAF_SIDE, LEAF_SIDE)
    others = tuple(a for a in range(4) if a != axis + 1)
    return place + np.flatnonzero(layers.any(axis=others))


# ---- the file


def content_id(image: VoxelImage) -> UUID:
    """Return an identifier that follows from the content."""
    part = (image.digest(), image.level, image.low, image.shape, image.invert, image.dtype)
    return UUID(bytes=hashlib.sha256(repr(part).encode()).digest()[:16])


def string(value: str | bytes) -> bytes:
    """Return a text after its length."""
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(data)) + data


def header_of(identifier: UUID, grids: int = 1) -> bytes:
    """Return the opening of a file, given the number of its grids."""
    fixed = struct.pack("<qIIIB", MAGIC, FILE_VERSION, *LIBRARY, True) + str(identifier).encode()
    return fixed + struct.pack("<II", 0, grids)


def metadata_of(entries: dict[str, Meta]) -> bytes:
    """Return entries of metadata, in the order of their names."""
    parts = [struct.pack("<I", len(entries))]
    for name, entry in sorted(entries.items()):
        parts += string(name), string(entry.type), string(entry.data)
    return b"".join(parts)


def transform_of(translation: Any, scale: Any) -> bytes:
    """Return the map from indices to the world."""
    s = np.array(scale, "<f8")
    name = "UniformScaleTranslateMap" if (s == s[0]).all() else "ScaleTranslateMap"
    rows = np.array([translation, s, abs(s), 1 / s, 1 / (s * s), 0.5 / s], "<f8")
    return string(name) + rows.tobytes()


def write_grid(
    file: BinaryIO,
    type: str,
    flags: int,
    metadata: dict[str, Meta],
    translation: Any,
    scale: Any,
    leaves: Leaves,
    tiles: dict[str, np.ndarray],
    inside: Inside,
    background: Any,
) -> None:
    """Write the next grid of a file; the metadata has its name."""
    names = "active values" if flags == ACTIVE_MASK else "zip + active values"
    metadata |= {
        "file_compression": Meta.text(names),
        "is_saved_as_half_float": Meta("bool", bytes(1)),
    }
    file.write(string(metadata["name"].data) + string(type) + string(""))
    places = file.tell()
    start = places + POSITIONS.size
    file.write(bytes(POSITIONS.size))
    file.write(struct.pack("<I", flags) + metadata_of(metadata) + transform_of(translation, scale))
    buffers = write_tree(file, leaves, tiles, inside, background)
    end = file.tell()
    file.seek(places)
    file.write(POSITIONS.pack(start, buffers, end))
    file.seek(end)
