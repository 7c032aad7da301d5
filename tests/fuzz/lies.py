"""Own HDF5 files that lie: their attributes and datasets are changed together and written anew as
voxtool lays them out, so that types, shapes and counts still fit each other.

The reader's first checks pass such files; what they hold is nevertheless wrong, or merely odd.
"""

from __future__ import annotations

import io
import json
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np

from voxtool.svo.octree.layout import INSIDE, LINK, VALID

REALS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-30, -1e-30, 1e30, -1e30, 1e-40, 3e38, np.inf, np.nan)
FACTORS = (0.0, -1.0, 0.5, 2.0, 1e-3, 1e3, 1e-20, 1e20)
WORDS = {
    "mode": ("surface26", "surface6", "solid", "solid+surface26", "solid+fraction"),
    "fill": ("none", "parity", "winding", "flood", "flood+gap3", "nonzero"),
    "sign": ("pseudonormal", "winding", "none", "given"),
    "layout": ("raycast", "projection", "hexahedra"),
    "format_version": ("1.0", "1.1", "1.9", "2.0", "2.1", "3.0", "3.1"),
    "units": ("mm", "", "m", "x"),
}


@dataclass
class Content:
    """The attributes and datasets of a file."""

    attributes: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, data: bytes) -> Content:
        with h5py.File(io.BytesIO(data), "r") as h5:
            attributes = {name: h5.attrs[name] for name in h5.attrs}
            return cls(attributes, {name: h5[name][()] for name in h5})  # pyright: ignore

    def data(self) -> bytes:
        """The file: text of fixed length, datasets in one piece."""
        file = io.BytesIO()
        with h5py.File(file, "w") as h5:
            for name, value in self.attributes.items():
                if isinstance(value, str | bytes):
                    text = value.encode() if isinstance(value, str) else value
                    kind = h5py.string_dtype("utf-8", max(1, len(text)))
                    h5.attrs.create(name, text, dtype=kind)
                else:
                    h5.attrs.create(name, value, dtype=np.asarray(value).dtype)
            for name, array in self.arrays.items():
                h5.create_dataset(name, data=np.ascontiguousarray(array), track_times=False)
        return file.getvalue()


Lie = Callable[[Content, random.Random], None]


def lying(data: bytes, rng: random.Random) -> bytes:
    """A file with one to four lies."""
    content = Content.of(data)
    lies = LIES + (OCTREE_LIES if "nodes" in content.arrays else [])
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        with np.errstate(all="ignore"):
            rng.choice(lies)(content, rng)
    return content.data()


def _array(content: Content, rng: random.Random) -> np.ndarray:
    """A dataset that is not empty, which may be changed in place."""
    name = rng.choice([name for name, array in content.arrays.items() if array.size])
    content.arrays[name] = array = content.arrays[name].copy()
    return array


def number_becomes_another(content: Content, rng: random.Random) -> None:
    """A number becomes another one of its dataset, or one near it."""
    flat = _array(content, rng).reshape(-1)
    for _ in range(rng.choice((1, 1, 3, 50))):
        place = rng.randrange(len(flat))
        if rng.random() < 0.6:
            flat[place] = flat[rng.randrange(len(flat))]
        elif flat.dtype.kind == "f":
            flat[place] = rng.choice((*REALS, -flat[place], np.nextafter(flat[place], np.inf)))
        else:
            bits = 8 * flat.dtype.itemsize
            flipped = int(flat[place]) ^ 1 << rng.choice((0, 1, 3, bits // 2, bits - 2))
            flat[place] = flipped & (1 << (bits - 1)) - 1


def rows_move(content: Content, rng: random.Random) -> None:
    """Rows are swapped, turned around, shifted or repeated."""
    array = _array(content, rng)
    axis = rng.randrange(array.ndim)
    count = array.shape[axis]
    one, other = rng.randrange(count), rng.randrange(count)
    rows = np.moveaxis(array, axis, 0)
    match rng.randrange(5):
        case 0:
            rows[[one, other]] = rows[[other, one]]
        case 1:
            rows[:] = rows[::-1].copy()
        case 2:
            rows[:] = np.roll(rows, rng.choice((1, -1, 8, -8)), axis=0)
        case 3:
            rows[one:] = rows[one]
        case _:
            rows[one] = rows[other]


def all_numbers_change(content: Content, rng: random.Random) -> None:
    """All numbers of a dataset are scaled, made equal or sorted."""
    array = _array(content, rng)
    match rng.randrange(4):
        case 0 if array.dtype.kind == "f":
            array *= rng.choice(FACTORS)
        case 1:
            array[...] = rng.choice(array.reshape(-1).tolist())
        case 2:
            array[...] = np.sort(array, axis=0)
        case _:
            array[...] = 0


def sides_change(content: Content, rng: random.Random) -> None:
    """All sides of one length, of all datasets, become longer or shorter, and so do the attributes
    with that number."""
    lengths = sorted({n for array in content.arrays.values() for n in array.shape if n > 4})
    if not lengths:
        return
    old = rng.choice(lengths)
    new = max(old + rng.choice((-8, -1, 1, 8, -(old // 2), old)), 0)
    for name, array in content.arrays.items():
        for axis in [axis for axis, n in enumerate(array.shape) if n == old]:
            array = np.take(array, np.arange(new) % old, axis=axis)
        content.arrays[name] = array
    for name, value in content.attributes.items():
        if np.asarray(value).dtype.kind == "i" and np.ndim(value) == 0 and value == old:
            content.attributes[name] = np.int64(new)


def attribute_changes(content: Content, rng: random.Random) -> None:
    """A number of an attribute, or a word, becomes another that may stand there."""
    name = rng.choice(sorted(content.attributes))
    value = content.attributes[name]
    if name in WORDS:
        content.attributes[name] = rng.choice(WORDS[name])
        return
    array = np.array(value)
    if array.dtype.kind not in "if":
        return
    flat = array.reshape(-1)
    place = rng.randrange(len(flat))
    old = flat[place]
    if array.dtype.kind == "f":
        flat[place] = rng.choice((-old, 0.0, 1.0, 1e-90, 1e89, 1e-300, old * 2, old / 3, old + 1))
    else:
        flat[place] = rng.choice((0, 1, 2, old + 1, old - 1, 2 * old, old // 2, 65536))
    if rng.random() < 0.2:
        flat[:] = flat[::-1].copy()
    content.attributes[name] = array if array.ndim else array[()]


def grid_changes(content: Content, rng: random.Random) -> None:
    """The shape of an octree changes together with dim and depth; of others an attribute."""
    if "shape" not in content.attributes:
        attribute_changes(content, rng)
        return
    shape = np.array(content.attributes["shape"])
    factor = rng.choice((1, 1, 2, 4))
    shape = np.maximum(shape * factor + rng.choice((-7, -1, 0, 1, 7)), 1)
    shape[rng.randrange(3)] = rng.choice((1, int(shape.max()), 8))
    dim = int(shape.max())
    content.attributes |= {
        "shape": shape,
        "dim": np.int64(dim),
        "depth": np.int64(((1 << (dim - 1).bit_length()) // 4).bit_length()),
    }


def head_changes(content: Content, rng: random.Random) -> None:
    """Heads of attributes of voxels change, with the types of their datasets."""
    if "attributes" not in content.attributes:
        attribute_changes(content, rng)
        return
    heads = json.loads(content.attributes["attributes"])
    name = rng.choice(sorted(heads))
    match rng.randrange(4):
        case 0:
            kind = heads[name]["dtype"] = rng.choice(("uint8", "uint16", "uint32", "float32"))
            for part in ("values", "leaves"):
                old = content.arrays[f"{name}_{part}"]
                content.arrays[f"{name}_{part}"] = old.astype(f"<{np.dtype(kind).str[1:]}")
        case 1:
            heads[name]["masked"] = not heads[name]["masked"]
            content.arrays.setdefault(f"{name}_masks", content.arrays["bricks"].copy())
        case 2:
            default = heads[name]["default"]
            one = rng.choice((0, 1, 255, 65535))
            heads[name]["default"] = [one] * len(default) if isinstance(default, list) else one
        case _:
            del heads[name]
    content.attributes["attributes"] = json.dumps(heads)


LIES: list[Lie] = [
    number_becomes_another, number_becomes_another, number_becomes_another, rows_move, rows_move,
    all_numbers_change, sides_change, attribute_changes, grid_changes, head_changes,
]  # fmt: skip


# ---- octrees whose nodes are all there


def links_change(content: Content, rng: random.Random) -> None:
    """A link leads elsewhere: both ways, one way, to another level, or nowhere."""
    nodes = content.arrays["nodes"] = content.arrays["nodes"].copy()
    one, other = rng.randrange(len(nodes)), rng.randrange(len(nodes))
    match rng.randrange(6):
        case 0:
            nodes[[one, other]] = nodes[[other, one]]
        case 1:
            nodes[one, 1] = nodes[other, 1]
        case 2:
            nodes[one, 0] = nodes[other, 0]
        case 3:  # inside and refined, or a leaf
            nodes[one, 1] ^= rng.choice((INSIDE, VALID, INSIDE | VALID))
        case 4:
            nodes[one, 1] = VALID | np.uint32(rng.randrange(len(nodes)) // 8 * 8)
        case _:
            nodes[one, rng.randrange(2)] = rng.choice((0, LINK, VALID, INSIDE, VALID | LINK))


def children_go(content: Content, rng: random.Random) -> None:
    """Eight children go, with the links and offsets of all others right; those of refined ones stay
    behind."""
    nodes, offsets = content.arrays["nodes"].copy(), content.arrays["offsets"].copy()
    first = 8 * rng.randrange(max(len(nodes) // 8, 1))
    if len(nodes) < 8:
        return
    parent = nodes[first, 0] & LINK
    if nodes[first, 0] & VALID and parent < len(nodes):
        nodes[parent, 1] = rng.choice((0, INSIDE))
    level0 = int(offsets[-2])
    links = nodes & LINK
    valid = (nodes & VALID) != 0
    valid[level0:, 1] = False  # of bricks
    nodes = np.where(valid & (links >= first + 8), nodes - np.uint32(8), nodes)
    content.arrays["nodes"] = np.delete(nodes, np.s_[first : first + 8], axis=0)
    offsets[offsets >= first + 8] -= 8
    content.arrays["offsets"] = offsets


def levels_move(content: Content, rng: random.Random) -> None:
    """The border between two levels moves."""
    offsets = content.arrays["offsets"] = content.arrays["offsets"].copy()
    place = rng.randrange(len(offsets))
    offsets[place] += np.uint32(rng.choice((8, 1, 2**32 - 8, 2**32 - 1)))


def bricks_change(content: Content, rng: random.Random) -> None:
    """Bricks become full, empty or random: beyond the shape, too."""
    bricks = content.arrays["bricks"] = content.arrays["bricks"].copy()
    if len(bricks):
        start = rng.randrange(len(bricks))
        stop = rng.choice((start + 1, len(bricks)))
        bricks[start:stop] = rng.choice((0, (1 << 64) - 1, rng.getrandbits(64)))


OCTREE_LIES: list[Lie] = [links_change, links_change, children_go, levels_move, bricks_change] * 2
