"""MagicaVoxel's .vox: models of at most 256 voxels a side, which a tree of nodes places.

Axes are ours, voxel (i, j, k) at (x, y, z); in MagicaVoxel z is up. A model turns and moves about
the corner floor(size / 2) of its voxels: the voxel of centre v + 1/2 gets to floor(R (v + 1/2 -
floor(size / 2)) + t). The root node's attributes, which other programs pass over, keep the grid.
https://github.com/ephtracy/voxel-model, MagicaVoxel-file-format-vox.txt and -extension.txt
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import groupby
from math import prod
from typing import BinaryIO, NamedTuple, Self

import numpy as np

from voxtool.choices import MIN_DIM
from voxtool.errors import FileError
from voxtool.files.grids.vox_colours import BLOCK, Paint
from voxtool.files.grids.voxels import Boxes, Frame, Stored, grid_of_text, grid_text
from voxtool.files.storage.streams import PACKED
from voxtool.files.storage.text_numbers import whole
from voxtool.grid import Grid
from voxtool.svo.images.image import VoxelImage

MAGIC, VERSION = b"VOX ", 150
MODEL_SIDE = 256  # voxels along a side of a model, at most
SPARSE = 64  # voxels of a model for each that is set, from which on they are passed on one by one
LAYERS = 16  # of a model that are listed at once
WORLD_SIDE = 2000  # voxels along a side of MagicaVoxel's world
MOST_BYTES = (1 << 31) - 1  # that a chunk counts
NODE_BYTES = 200  # bytes of the two nodes and the chunks of a model, at most
COLOURS = 256  # of a palette, of which the last is not used
# Attributes of the root node: the grid, its low voxel in the scene, and the unit.
GRID, LOW, UNITS = "voxtool_grid", "voxtool_low", "voxtool_units"
DEEPEST = 64  # nodes inside nodes


# ---- out


def size(image: VoxelImage) -> int:
    """Return the bytes of the file, at most."""
    image = image.with_dtype(bool)
    sides = [(len(cubes.corners), cubes.side) for cubes in image.cubes(BLOCK)]
    full = sum(count * side**3 for count, side in sides if side >= MODEL_SIDE)
    models = np.prod([-(-n // MODEL_SIDE) + 1 for n in image.shape])
    voxels = image.count - full + (MODEL_SIDE**3 if full else 0)
    return 4 * voxels + NODE_BYTES * int(models) + 4 * COLOURS + 1000


def write(image: VoxelImage, file: BinaryIO) -> None:
    """Write the cells of which at least half is set, in their colours or those of their labels, or
    in one colour.

    Raises
    ------
    FileError
        If the image is larger than MagicaVoxel's world, or the file than the format allows.
    """
    longest = max(image.shape)
    if longest > WORLD_SIDE:
        coarser = image.level + (-(-longest // WORLD_SIDE) - 1).bit_length()
        raise FileError(
            f".vox has {WORLD_SIDE} voxels a side and this image {longest}: choose --level "
            f"{coarser}, or a part by --bbox"
        )
    if size(image) > MOST_BYTES:
        raise FileError(".vox holds 2 GiB at most: choose a higher --level, or a part by --bbox")
    scene = _Scene(file, image.with_dtype(bool))
    scene.write_models()
    scene.write_nodes()
    end = file.tell()
    file.seek(16)
    file.write(struct.pack("<i", end - 20))


class _Scene:
    """A file that is written: models first, then the nodes that place them."""

    def __init__(self, file: BinaryIO, image: VoxelImage) -> None:
        self.file, self.image = file, image
        x, y, z = image.shape
        # The middle of x and y is 0, and the lowest voxel stands on the ground while there is room.
        self.low = np.array([-(x // 2), -(y // 2), min(0, WORLD_SIDE // 2 - z)])
        self.paint = Paint.of(image)
        self.models = 0
        self.placed: list[tuple[int, np.ndarray]] = []  # a model, and its translation
        file.write(struct.pack("<4si4sii", MAGIC, VERSION, b"MAIN", 0, 0))

    def write_models(self) -> None:
        low, high = np.array(self.image.low), np.add(self.image.low, self.image.shape)
        full: dict[int, int] = {}  # models by their colour, shown wherever such a block is full
        for corner, values in self.blocks():
            start, stop = np.maximum(corner, low), np.minimum(corner + MODEL_SIDE, high)
            if isinstance(values, np.ndarray):
                part = tuple(map(slice, start - corner, stop - corner))
                self.place(self.model(values[part]), start, stop - start)
                continue
            if values not in full:
                full[values] = self.model(np.full((MODEL_SIDE,) * 3, values, np.uint8))
            self.place(full[values], start, stop - start)
        if not self.placed:  # a scene has at least one model
            extent = np.minimum(high - low, MODEL_SIDE)
            self.place(self.model(np.zeros(extent, np.uint8)), low, extent)

    def blocks(self) -> Iterator[tuple[np.ndarray, np.ndarray | int]]:
        """Yield the low cell of each block of MODEL_SIDE cells a side that is not empty, and the
        numbers of its colours, or one of them where all cells are set and have it."""
        inside: dict[tuple[int, ...], list[tuple[np.ndarray, int, int]]] = {}
        for corners, side, numbers in self.paint.cubes():
            if side >= MODEL_SIDE:
                steps = np.indices((side // MODEL_SIDE,) * 3).reshape(3, -1).T * MODEL_SIDE
                for corner, number in zip(corners, numbers.tolist(), strict=True):
                    yield from ((c, number) for c in corner + steps)
                continue
            for corner, number in zip(corners, numbers.tolist(), strict=True):
                inside.setdefault(_block(corner), []).append((corner, side, number))
        for key, pieces in groupby(self.paint.blocks(), lambda piece: _block(piece[0])):
            yield self.block(key, pieces, inside.pop(key, []))  # in Morton order
        for key, cubes in inside.items():
            yield self.block(key, [], cubes)

    def block(
        self,
        key: tuple[int, ...],
        pieces: Iterable[tuple[np.ndarray, np.ndarray]],
        cubes: list[tuple[np.ndarray, int, int]],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a block's low cell, and its cells put together."""
        low, values = np.array(key) * MODEL_SIDE, np.zeros((MODEL_SIDE,) * 3, np.uint8)
        for corner, part in pieces:
            values[tuple(slice(n, n + BLOCK) for n in corner - low)] = part
        for corner, side, number in cubes:
            values[tuple(slice(n, n + side) for n in corner - low)] = number
        return low, values

    def model(self, values: np.ndarray) -> int:
        """Write a model of the numbers of colours that are not 0, and return its number."""
        self.chunk(b"SIZE", struct.pack("<3i", *values.shape))
        count = int(np.count_nonzero(values))
        self.open_chunk(b"XYZI", 4 + 4 * count)
        self.file.write(struct.pack("<i", count))
        for first in range(0, len(values), LAYERS):
            layers = values[first : first + LAYERS]
            x, y, z = np.nonzero(layers)
            voxels = np.empty((len(x), 4), np.uint8)
            voxels[:, 0], voxels[:, 1], voxels[:, 2] = x + first, y, z
            voxels[:, 3] = layers[x, y, z]
            self.file.write(voxels.data)
        self.models += 1
        return self.models - 1

    def place(self, model: int, start: np.ndarray, extent: np.ndarray) -> None:
        """Put a model where its low voxel is `start`, counted from the grid's corner."""
        self.placed.append((model, start - self.image.low + self.low + extent // 2))

    def write_nodes(self) -> None:
        image = self.image
        low = " ".join(map(str, self.low.tolist()))
        about = {GRID: grid_text(image), LOW: low, UNITS: image.units}
        self.chunk(b"nTRN", _transform(0, 1, _dict(about), {}))
        shapes = [2 + 2 * n for n in range(len(self.placed))]
        group = struct.pack(f"<{2 + len(shapes)}i", 0, len(shapes), *shapes)
        self.chunk(b"nGRP", struct.pack("<i", 1) + group)
        for node, (model, place) in zip(shapes, self.placed, strict=True):
            frame = {"_t": " ".join(map(str, place.tolist()))}
            self.chunk(b"nTRN", _transform(node, node + 1, _dict({}), frame))
            self.chunk(b"nSHP", struct.pack("<5i", node + 1, 0, 1, model, 0))
        self.chunk(b"RGBA", self.paint.rgba(COLOURS))

    def open_chunk(self, name: bytes, size: int) -> None:
        self.file.write(struct.pack("<4sii", name, size, 0))

    def chunk(self, name: bytes, *content: bytes) -> None:
        self.open_chunk(name, sum(map(len, content)))
        for part in content:
            self.file.write(part)


def _block(cell: np.ndarray) -> tuple[int, ...]:
    """Return the number of the block along each axis that holds a cell."""
    return tuple((cell // MODEL_SIDE).tolist())


def _dict(items: dict[str, str]) -> bytes:
    """Return attributes as the format stores them."""
    texts = [text.encode() for pair in items.items() for text in pair]
    parts = [struct.pack("<i", len(text)) + text for text in texts]
    return struct.pack("<i", len(items)) + b"".join(parts)


def _transform(node: int, child: int, attributes: bytes, frame: dict[str, str]) -> bytes:
    """Return the content of a transform node."""
    head = struct.pack("<i", node) + attributes
    return head + struct.pack("<4i", child, -1, -1, 1) + _dict(frame)


# ---- in


class Placing(NamedTuple):
    """A rotation about the origin, which permutes and mirrors axes, then a translation.

    Axis i of the result is `signs[i]` times axis `axes[i]`, plus `moved[i]`.
    """

    axes: tuple[int, ...] = (0, 1, 2)
    signs: tuple[int, ...] = (1, 1, 1)
    moved: tuple[int, ...] = (0, 0, 0)

    @classmethod
    def of(cls, frame: dict[str, str]) -> Self:
        """Return that of the attributes of a frame."""
        bits = whole(frame.get("_r", "4"))
        first, second = bits & 3, bits >> 2 & 3
        if not 0 <= bits < 128 or 3 in (first, second) or first == second:
            raise FileError(f"rotation {bits} is no rotation: it is damaged")
        axes = first, second, 3 - first - second
        signs = tuple(-1 if bits >> bit & 1 else 1 for bit in (4, 5, 6))
        moved = tuple(map(whole, frame.get("_t", "0 0 0").split()))
        if len(moved) != 3 or max(map(abs, moved)) > 1 << 30:
            raise FileError("a translation is no three numbers: it is damaged")
        return cls(axes, signs, moved)

    def then(self, outer: Placing) -> Placing:
        """Return this placing followed by the outer one."""
        axes = tuple(self.axes[a] for a in outer.axes)
        signs = tuple(s * self.signs[a] for s, a in zip(outer.signs, outer.axes, strict=True))
        moved = tuple(
            s * self.moved[a] + m
            for s, a, m in zip(outer.signs, outer.axes, outer.moved, strict=True)
        )
        return Placing(axes, signs, moved)

    def low(self, extent: tuple[int, ...]) -> np.ndarray:
        """Return the low voxel of a placed model."""
        sizes = [extent[axis] for axis in self.axes]
        steps = zip(sizes, self.signs, self.moved, strict=True)
        return np.array([m - n // 2 if s > 0 else m - (n - n // 2) for n, s, m in steps])

    def turned(self, values: np.ndarray) -> np.ndarray:
        """Return the values of a model along the axes of the scene."""
        return values.transpose(self.axes)[tuple(slice(None, None, s) for s in self.signs)]

    def places(self, voxels: np.ndarray, extent: tuple[int, ...]) -> np.ndarray:
        """Return the voxels of a model, (n, 3), along the axes of the scene, from its low one."""
        along = voxels[:, self.axes].astype(np.int64)
        last = np.array(extent)[list(self.axes)] - 1
        return np.where(np.array(self.signs) > 0, along, last - along)


class Model(NamedTuple):
    """A model: its voxels along each axis, and where the file lists those that are set."""

    extent: tuple[int, ...]
    offset: int
    count: int


@dataclass
class Content:
    """The models of a file, and its nodes by their numbers."""

    models: list[Model] = field(default_factory=list)
    transforms: dict[int, tuple[dict[str, str], int, Placing]] = field(default_factory=dict)
    groups: dict[int, list[int]] = field(default_factory=dict)
    shapes: dict[int, int] = field(default_factory=dict)

    def placed(self) -> list[tuple[Model, Placing]]:
        """Return the models where the scene puts them; each at 0 if there is no scene."""
        if 0 not in self.transforms:
            return [
                (model, Placing(moved=tuple(n // 2 for n in model.extent))) for model in self.models
            ]
        found: list[tuple[Model, Placing]] = []
        seen: set[int] = set()
        todo = [(0, Placing(), 0)]
        while todo:
            node, outer, depth = todo.pop()
            if node in seen or depth > DEEPEST:
                raise FileError(f"its scene is no tree: node {node} is in it twice or too deep")
            seen.add(node)
            if node in self.transforms:
                _, child, placing = self.transforms[node]
                todo.append((child, placing.then(outer), depth + 1))
            elif node in self.groups:
                todo += [(child, outer, depth + 1) for child in self.groups[node][::-1]]
            elif node in self.shapes:
                number = self.shapes[node]
                if not 0 <= number < len(self.models):
                    raise FileError(f"node {node} shows model {number} of {len(self.models)}")
                found.append((self.models[number], outer))
            else:
                raise FileError(f"its scene lacks node {node}")
        return found


def read(file: BinaryIO, size: int) -> Stored:
    """Return the colours of the voxels, 1 to 255, of all models that the scene shows: hidden ones,
    too, and those of the first frame of animations."""
    content = _content(file, size)
    placed = content.placed()
    if not placed:
        raise FileError("no model is in it: save a scene with voxels")
    if sum(model.count for model, _ in placed) > PACKED * size:
        raise FileError("its scene repeats models more often than its size allows")
    lows = np.array([placing.low(model.extent) for model, placing in placed])
    highs = lows + [[model.extent[a] for a in placing.axes] for model, placing in placed]
    grid, low, units = _grid(content, lows.min(axis=0), highs.max(axis=0))
    return Stored(Frame(grid), _pieces(file, placed, lows - low), units)


def _grid(content: Content, low: np.ndarray, high: np.ndarray) -> tuple[Grid, np.ndarray, str]:
    """Return the grid of an export, or of the box around all models, its low voxel in the scene,
    and the units."""
    attributes = content.transforms[0][0] if 0 in content.transforms else {}
    grid = grid_of_text(attributes.get(GRID, ""))
    if grid is not None and LOW in attributes:
        stored = Placing.of({"_t": attributes[LOW]})
        return grid, np.array(stored.moved), attributes.get(UNITS, "")[:64]
    shape = (high - low).tolist()
    if max(shape) < MIN_DIM:
        shape[0] = MIN_DIM
    origin = tuple(map(float, low.tolist()))
    return Grid(tuple(shape), origin, (1.0, 1.0, 1.0)), low, ""  # pyright: ignore


def _pieces(
    file: BinaryIO, placed: list[tuple[Model, Placing]], lows: np.ndarray
) -> Iterator[Boxes]:
    """Yield each model as a box, or, if it has few voxels, as boxes of one voxel."""
    if lows.min() < 0:
        raise FileError("a model lies outside of the grid that voxtool stored")
    for (model, placing), low in zip(placed, lows, strict=True):
        file.seek(model.offset)
        voxels = np.frombuffer(file.read(4 * model.count), np.uint8).reshape(-1, 4)
        if (voxels[:, :3] >= model.extent).any():
            raise FileError("a voxel lies outside of its model")
        if SPARSE * model.count < prod(model.extent):
            voxels = voxels[np.unique(voxels[:, :3], axis=0, return_index=True)[1]]
            yield Boxes(low + placing.places(voxels, model.extent), voxels[:, 3, None, None, None])
            continue
        values = np.zeros(model.extent, np.uint8)
        values[tuple(voxels[:, :3].T)] = voxels[:, 3]
        yield Boxes(low[None], placing.turned(values)[None])


def _content(file: BinaryIO, size: int) -> Content:
    """Return what the chunks hold; voxels are not read yet."""
    if file.read(4) != MAGIC:
        raise FileError("is no .vox file: save it with MagicaVoxel")
    file.seek(8)
    content, extent = Content(), (0, 0, 0)
    while (at := file.tell()) < size:
        name, length, inside = struct.unpack("<4sii", file.read(12))
        if length < 0 or inside < 0 or at + 12 + length + (name == b"MAIN") * inside > size:
            raise FileError(f"it ends within a chunk, at byte {at}: copy it again")
        if name == b"SIZE":
            extent = struct.unpack("<3i", file.read(12))
            if not all(1 <= n <= MODEL_SIDE for n in extent):
                raise FileError(f"a model of {extent} voxels: each side has 1 to {MODEL_SIDE}")
        elif name == b"XYZI":
            (count,) = struct.unpack("<i", file.read(4))
            if not 0 <= 4 * count <= length - 4 or not all(extent):
                raise FileError(f"the model at byte {at} has more voxels than bytes, or no size")
            content.models.append(Model(extent, at + 16, count))
        elif name in (b"nTRN", b"nGRP", b"nSHP"):
            _add_node(content, name, _Words(file.read(length)))
        file.seek(at + 12 + length)
    return content


def _add_node(content: Content, name: bytes, words: _Words) -> None:
    """Add a node of the scene."""
    node, attributes = words.number(), words.dict()
    if name == b"nTRN":
        child, _, _, frames = (words.number() for _ in range(4))
        placing = Placing.of(words.dict() if frames > 0 else {})
        content.transforms[node] = attributes, child, placing
    elif name == b"nGRP":
        content.groups[node] = [words.number() for _ in range(words.number())]
    elif words.number() > 0:
        content.shapes[node] = words.number()


class _Words:
    """The numbers and texts of a chunk, one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def number(self) -> int:
        (number,) = struct.unpack_from("<i", self.data, self.at)
        self.at += 4
        return number

    def text(self) -> str:
        length = self.number()
        if not 0 <= length <= len(self.data) - self.at:
            raise FileError("a text is longer than its chunk: the file is damaged")
        self.at += length
        return self.data[self.at - length : self.at].decode("utf-8", "replace")

    def dict(self) -> dict[str, str]:
        return {self.text(): self.text() for _ in range(self.number())}
