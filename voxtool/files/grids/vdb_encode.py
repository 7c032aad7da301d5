"""Trees of OpenVDB, 5-4-3, as bytes: blocks of 8 x 8 x 8 cells and cubes of one value.

A leaf has 8 cells a side, a lower node 16 leaves, an upper node 32 lower nodes; the root lists the
upper nodes. A node holds its children's bits, its tiles' bits and its tiles' values; z runs
fastest in nodes and leaves. First comes the topology of all nodes, then the values of the leaves.
[OpenVDB: Museth 2013, doi 10.1145/2487228.2487235; files of version 224]
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from voxtool.morton import distinct

LEAF, LOWER, UPPER = 3, 4, 5  # powers of two: children along a side of a node
LEAF_SIDE = 1 << LEAF
CELLS = 1 << 3 * LEAF  # of a leaf
LOWER_SIDE, UPPER_SIDE = LEAF_SIDE << LOWER, LEAF_SIDE << (LOWER + UPPER)  # in cells
MASK_BYTES = CELLS // 8
FLOAT = np.dtype("<f4")
ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4  # flags of a grid's compression
# How the inactive values of a node are stored; + and - are of the background's sign.
ALL_PLUS, ALL_MINUS, ONE_VALUE, PLUS_OR_MINUS, PLUS_OR_VALUE, TWO_VALUES, EVERY_VALUE = range(7)
ROOT_BITS = 7  # bits of the coordinates of an upper node in a key
CHUNK = 1 << 16  # leaves that are written at once
KEY_SHIFTS = {  # the low bit of the coordinates of a node in a key, and how many there are
    "leaf": (0, LOWER),
    "lower": (3 * LOWER, UPPER),
    "upper": (3 * (LOWER + UPPER), ROOT_BITS),
}


class Inside(NamedTuple):
    """The tiles of a tree: what they hold, whether they are active, and the type of all values."""

    value: Any  # of all tiles; or of each by the name of the node, (n, ...) in the order of keys
    active: bool
    dtype: np.dtype = FLOAT

    def of(self, unit: str, part: slice) -> np.ndarray:
        """Return the values of some of the tiles of a node, leaf, lower or upper."""
        if isinstance(self.value, dict):
            return self.value[unit][part]
        return np.full(part.stop - part.start, self.value, self.dtype)


@dataclass
class Leaves:
    """The leaves of a tree, in the order of the file.

    Attributes
    ----------
    keys : (n,) int64
        Places, ascending; see `keys_of`.
    masks : (n, 64) uint8
        Bits of the active cells.
    values : list of (n,) bytes, optional
        What follows the mask of each leaf in the buffers; None in a tree of bool.
    """

    keys: np.ndarray
    masks: np.ndarray
    values: list[bytes] | None = None

    @classmethod
    def ordered(cls, keys: np.ndarray, masks: np.ndarray, values: list[bytes] | None) -> Leaves:
        """Return the leaves, given in any order."""
        order = np.argsort(keys, kind="stable")
        chosen = None if values is None else [values[i] for i in order.tolist()]
        return cls(keys[order], masks[order], chosen)


def keys_of(corners: np.ndarray) -> np.ndarray:
    """Return the places of leaves by their low cells, (n, 3) int from 0: (n,) int64 that ascend in
    the order of the file."""
    x, y, z = np.asarray(corners, np.int64).T >> LEAF
    keys, low = np.zeros(len(x), np.int64), 0
    for shift, bits in KEY_SHIFTS.values():
        mask = (1 << bits) - 1
        for a, axis in enumerate((z, y, x)):
            keys |= ((axis >> low) & mask) << (shift + a * bits)
        low += bits
    return keys


def corners_of(keys: np.ndarray) -> np.ndarray:
    """Return the low cells, (n, 3) int32, of leaves at these places."""
    corners, low = np.zeros((len(keys), 3), "<i4"), LEAF
    for shift, bits in KEY_SHIFTS.values():
        for a in range(3):
            part = (keys >> (shift + (2 - a) * bits)) & ((1 << bits) - 1)
            corners[:, a] |= (part << low).astype(np.int32)
        low += bits
    return corners


def tiles_of(cubes: Iterable[tuple[np.ndarray, int]]) -> dict[str, np.ndarray]:
    """Return the places of the tiles that cubes of 8 or more cells a side make, ascending keys of
    leaves, lower and upper nodes by the name of the node."""
    return tiles_with(((corners, side, np.empty((len(corners), 0))) for corners, side in cubes))[0]


def tiles_with(
    cubes: Iterable[tuple[np.ndarray, int, np.ndarray]], row: tuple[int, ...] = (0,)
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the places of the tiles of cubes, and their values, given those of the cubes, (n,
    *row)."""
    places: dict[str, list[np.ndarray]] = {name: [np.empty(0, np.int64)] for name in KEY_SHIFTS}
    values: dict[str, list[np.ndarray]] = {name: [] for name in KEY_SHIFTS}
    sides = {"upper": UPPER_SIDE, "lower": LOWER_SIDE, "leaf": LEAF_SIDE}
    for corners, side, each in cubes:
        name, unit = next((name, unit) for name, unit in sides.items() if side >= unit)
        steps = keys_of(np.indices((side // unit,) * 3).reshape(3, -1).T * unit)
        keys = (keys_of(corners)[:, None] | steps).ravel()  # the corners are multiples of the side
        places[name].append(keys >> KEY_SHIFTS[name][0])
        values[name].append(np.repeat(each, len(steps), axis=0))
    keys = {name: np.concatenate(parts) for name, parts in places.items()}
    orders = {name: np.argsort(part) for name, part in keys.items()}
    found = {
        name: np.concatenate(parts)[orders[name]] if parts else np.empty((0, *row))
        for name, parts in values.items()
    }
    return {name: part[orders[name]] for name, part in keys.items()}, found


def parents_of(leaves: np.ndarray, tiles: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of the lower and of the upper nodes, ascending; `leaves` is ascending."""
    lower = distinct(np.concatenate([leaves, tiles["leaf"]]) >> 3 * LOWER)
    return lower, distinct(np.concatenate([lower, tiles["lower"]]) >> 3 * UPPER)


# ---- values


def packed(data: bytes) -> bytes:
    """Return values as a grid with zip holds them: their bytes, negative if not compressed."""
    found = zlib.compress(data)
    if len(found) < len(data):
        return struct.pack("<q", len(found)) + found
    return struct.pack("<q", -len(data)) + data


def node_values(
    power: int, children: np.ndarray, tiles: np.ndarray, values: np.ndarray, active: bool
) -> bytes:
    """Return the masks and values of a node of 2**power children a side; the children and tiles
    are given by their places in the node."""
    held = bits_of(children, power)
    chosen = bits_of(tiles, power)
    if not active and len(tiles):  # inside is the background, negative
        outside = (~np.frombuffer(chosen, np.uint8)).tobytes()
        selection = bytes([PLUS_OR_MINUS]) + outside
        return held + bytes(len(held)) + selection + stored(values[:0])
    return held + chosen + bytes([ALL_PLUS]) + stored(values)


def stored(values: np.ndarray) -> bytes:
    """Return the values of active cells or tiles, as the file holds them."""
    data = values.tobytes()
    return data if values.dtype.kind == "b" else packed(data)


def bits_of(places: np.ndarray, power: int) -> bytes:
    """Return the bits of children at these places in a node."""
    bits = np.zeros(1 << 3 * power, bool)
    bits[places] = True
    return np.packbits(bits, bitorder="little").tobytes()


# ---- the tree


def write_tree(
    file: BinaryIO, leaves: Leaves, tiles: dict[str, np.ndarray], inside: Inside, background: Any
) -> int:
    """Write the topology of a tree, then the buffers of its leaves; return where those start."""
    if leaves.values is None:
        inside = inside._replace(dtype=np.dtype(bool))
    lower, upper = parents_of(leaves.keys, tiles)
    file.write(struct.pack("<I", 1))  # buffers of a leaf
    file.write(np.array(background, inside.dtype).tobytes())
    file.write(struct.pack("<II", len(tiles["upper"]), len(upper)))
    flat = inside.of("upper", slice(0, len(tiles["upper"])))
    for corner, value in zip(upper_corners(tiles["upper"]), flat, strict=True):
        file.write(corner.tobytes() + value.tobytes() + bytes([inside.active]))
    tops = zip(
        upper_corners(upper),
        groups_of(upper, lower, 3 * UPPER),
        groups_of(upper, tiles["lower"], 3 * UPPER),
        strict=True,
    )
    below = zip(
        groups_of(lower, leaves.keys, 3 * LOWER),
        groups_of(lower, tiles["leaf"], 3 * LOWER),
        strict=True,
    )
    for corner, children, flat in tops:
        mask = (1 << 3 * UPPER) - 1
        held, places = lower[children] & mask, tiles["lower"][flat] & mask
        values = inside.of("lower", flat)
        file.write(corner.tobytes() + node_values(UPPER, held, places, values, inside.active))
        mask = (1 << 3 * LOWER) - 1
        for _ in range(children.stop - children.start):
            held, flat = next(below)
            keys, places = leaves.keys[held] & mask, tiles["leaf"][flat] & mask
            node = node_values(LOWER, keys, places, inside.of("leaf", flat), inside.active)
            file.write(node + leaves.masks[held].tobytes())
    start = file.tell()
    _write_buffers(file, leaves)
    return start


def upper_corners(keys: np.ndarray) -> np.ndarray:
    """Return the low cells, (n, 3) int32, of upper nodes at these places."""
    return corners_of(keys << KEY_SHIFTS["upper"][0])


def groups_of(parents: np.ndarray, keys: np.ndarray, shift: int) -> Sequence[slice]:
    """Return which keys lie in each parent."""
    starts = np.searchsorted(keys >> shift, parents).tolist()
    ends = np.searchsorted(keys >> shift, parents, side="right").tolist()
    return [slice(a, b) for a, b in zip(starts, ends, strict=True)]


def _write_buffers(file: BinaryIO, leaves: Leaves) -> None:
    """Write the values of all leaves: of bool their mask, low cell and bits, else their mask and
    values."""
    for first in range(0, len(leaves.keys), CHUNK):
        chosen = slice(first, first + CHUNK)
        masks = leaves.masks[chosen]
        if leaves.values is None:
            corners = corners_of(leaves.keys[chosen]).view(np.uint8)
            file.write(np.concatenate([masks, corners, masks], axis=1).data)
        else:
            rows = masks.tobytes()
            parts = []
            for i, values in enumerate(leaves.values[chosen]):
                parts += rows[i * MASK_BYTES : (i + 1) * MASK_BYTES], values
            file.write(b"".join(parts))
