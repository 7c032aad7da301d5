"""Voxels of other programs: what a reader returns, and the octree that it becomes.

A reader returns Stored: where the array lies, and its values in pieces, which are read one after
the other. Sizes are checked before memory is taken: `dense_pieces` for arrays that lie in a file as
they are, otherwise by the reader.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from math import ceil, isfinite, prod
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np

from voxtool.adf.queries.samples import FieldSamples
from voxtool.errors import FileError, GridError, human
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.memory import check_memory
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.from_pieces import Collector
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.labels import Labels

PIECE = 1 << 24  # bytes of a piece of a dense array
Dense: TypeAlias = (
    VoxelImage | FieldSamples | Labels | AttributeImage
)  # what is written as a dense array


class Frame(NamedTuple):
    """The place of an array: its grid, in world axes, and how the array's own axes run.

    Axis a of the array is the world's axis `axes[a]`, against it where `flips[a]`.
    """

    grid: Grid
    axes: tuple[int, int, int] = (0, 1, 2)
    flips: tuple[bool, bool, bool] = (False, False, False)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along the array's own axes."""
        a, b, c = (self.grid.shape[axis] for axis in self.axes)
        return a, b, c


class Readable(Protocol):
    """A file, or a stream of bytes."""

    def read(self, size: int, /) -> bytes:
        """Return the next `size` bytes, fewer at the end."""
        ...


class Boxes(NamedTuple):
    """Boxes of one shape."""

    corners: np.ndarray  # (n, 3) int: their low voxels, by the array's axes
    values: np.ndarray  # (n, a, b, c), by the array's axes


class Cubes(NamedTuple):
    """Cubes, each of one value."""

    corners: np.ndarray  # (n, 3) int: their low voxels, by the array's axes
    side: int  # a power of two
    values: np.ndarray  # (n,)


class Rule(NamedTuple):
    """The rule that says which voxels are set; by default those that are neither 0 nor NaN."""

    threshold: float | None = None  # or those of this value and more
    label: float | None = None  # or those of this value
    below: float | None = None  # or those less than this value

    @property
    def text(self) -> str:
        """The rule in words, after "a voxel is set if its value"."""
        if self.threshold is not None:
            return f"is {self.threshold:g} or more"
        if self.label is not None:
            return f"is {self.label:g}"
        return "is neither 0 nor NaN" if self.below is None else f"is below {self.below:g}"

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return which of the values are set, bool of the same shape."""
        if self.threshold is not None:
            return values >= _least(self.threshold, values.dtype)
        if self.label is not None:
            return values == _exactly(self.label, values.dtype)
        if self.below is not None:
            return values < self.below
        found = values != 0
        return found & (values == values) if values.dtype.kind == "f" else found


def _least(threshold: float, dtype: np.dtype) -> float:
    """Return a threshold as a number that compares exactly with values of a type: numpy would
    compare 64-bit integers with a float as float64."""
    return ceil(threshold) if dtype.kind in "iu" and isfinite(threshold) else threshold


def _exactly(label: float, dtype: np.dtype) -> float:
    """Return a label as a number that compares exactly with values of a type."""
    return int(label) if dtype.kind in "iu" and float(label).is_integer() else label


class Stored(NamedTuple):
    """The voxels of a file. What no piece holds is unset."""

    frame: Frame
    pieces: Iterable[Boxes | Cubes]
    units: str = ""
    rule: Rule = Rule()  # unless the caller has one


def octree_of(
    stored: Stored,
    rule: Rule,
    progress: Callable[[float], None] = lambda share: None,
    most: int | None = None,
) -> Octree:
    """Return the octree of the voxels that are set; MemoryLimitError if collecting them takes more
    than `most` bytes, or than are free."""
    frame = stored.frame
    collector, done = Collector(frame.grid, most), 0
    for piece in stored.pieces:
        if isinstance(piece, Cubes):
            corners = piece.corners[rule(piece.values)]
            collector.add_cubes(_turned(corners, np.full(3, piece.side), frame), piece.side)
            continue
        corners = _turned(piece.corners, np.array(piece.values.shape[1:]), frame)
        collector.add_boxes(corners, _transposed(rule(piece.values), frame))
        done += piece.values.size
        progress(min(done / prod(frame.shape), 1.0))
    return collector.octree(stored.units)


def array_of(stored: Stored, most: int | None, progress: Callable[[float], None]) -> np.ndarray:
    """Return the values of an image as an array in world axes, float32 or float64.

    Parameters
    ----------
    most : int, optional
        Bytes that it may have.

    Raises
    ------
    FileError
        If the file does not hold a value for each voxel.
    MemoryLimitError
        If the array has more bytes, or does not fit in memory.
    """
    frame, values, done = stored.frame, np.empty(0), 0
    for piece in stored.pieces:
        if isinstance(piece, Cubes) or len(piece.values) > 1:
            break
        if not done:
            kind = np.result_type(piece.values.dtype, np.float32)
            needed = prod(frame.shape) * kind.itemsize
            check_memory(needed, "the samples of the image", "import a coarser one", most)
            values = np.empty(frame.grid.shape, kind)
        size = np.array(piece.values.shape[1:])
        low = _turned(piece.corners, size, frame)[0]
        box = _transposed(piece.values, frame)[0]
        values[tuple(map(slice, low, low + box.shape))] = box
        done += box.size
        progress(done / prod(frame.shape))
    if done != prod(frame.shape):
        raise FileError("does not hold a value for each voxel: a field is made of a dense image")
    return values


def _turned(corners: np.ndarray, size: np.ndarray, frame: Frame) -> np.ndarray:
    """Return the low voxels of boxes in world axes."""
    found = np.asarray(corners, np.int64)
    found = np.where(frame.flips, np.array(frame.shape) - size - found, found)
    return found[:, np.argsort(frame.axes)]


def _transposed(values: np.ndarray, frame: Frame) -> np.ndarray:
    """Return (n, a, b, c) values in world axes."""
    steps = (slice(None), *(slice(None, None, -1 if flip else 1) for flip in frame.flips))
    return values[steps].transpose(0, *(np.argsort(frame.axes) + 1))


# ---- for readers


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is refused
def frame_of(shape: Sequence[int], matrix: np.ndarray, center: np.ndarray) -> Frame:
    """Return the frame of an array of samples.

    Parameters
    ----------
    shape : (3,) int
        Voxels along the array's axes.
    matrix : (3, 3) float64
        Column a is the world vector from a voxel to the next along axis a.
    center : (3,) float64
        World coordinates of the centre of voxel (0, 0, 0).

    Raises
    ------
    FileError
        If the axes are not those of the world: if a side leaves its axis by 1/256 voxel or more.
    """
    matrix = np.asarray(matrix, np.float64)
    axes = np.abs(matrix).argmax(axis=0)
    if not np.isfinite(matrix).all() or sorted(axes) != [0, 1, 2]:
        raise FileError("its axes are no three directions, or not finite: the header is damaged")
    steps = matrix[axes, [0, 1, 2]]
    beside = np.abs(matrix).copy()
    beside[axes, [0, 1, 2]] = 0
    pitch = np.empty(3)
    pitch[axes] = np.abs(steps)
    if (beside * shape >= pitch[:, None] / (1 << FIXED_POINT_BITS)).any():
        raise FileError(
            "its axes are oblique: resample it to a grid along the world's axes first (Slicer: "
            "Resample Scalar Volume; SimpleITK: Resample)"
        )
    low, sizes = np.empty(3), np.empty(3, int)
    sizes[axes] = shape
    low[axes] = np.asarray(center)[axes] + np.where(steps < 0, steps * (np.array(shape) - 1), 0)
    place = [tuple(values.tolist()) for values in (sizes, low - pitch / 2, pitch)]
    flips = steps < 0
    return Frame(Grid(*place), tuple(axes.tolist()), tuple(flips.tolist()))  # pyright: ignore


def dense_pieces(
    file: Readable, dtype: np.dtype, shape: tuple[int, int, int], *, fortran: bool
) -> Iterator[Boxes]:
    """Yield an array that lies in a file, from where the file is, in pieces of some layers.

    Parameters
    ----------
    fortran : bool
        Whether the first axis runs fastest, instead of the last one.
    """
    order = (2, 1, 0) if fortran else (0, 1, 2)
    slow, *layer = (shape[axis] for axis in order)
    each = prod(layer) * dtype.itemsize
    count = max(PIECE // each // 4 * 4, 4)
    check_memory(3 * min(count, slow) * each, f"{count} layers of its array")
    for first in range(0, slow, count):
        layers = min(count, slow - first)
        data = file.read(layers * each)
        if len(data) < layers * each:
            raise FileError("it ends before its array does")
        values = np.frombuffer(data, dtype).reshape(1, layers, *layer)
        corner = np.zeros((1, 3), int)
        corner[0, order[0]] = first
        yield Boxes(corner, values.transpose(0, *(np.argsort(order) + 1)))


def check_length(needed: int, held: int) -> None:
    """Raise FileError if an array needs more bytes than a file holds."""
    if needed > held:
        raise FileError(f"its array needs {human(needed)}, but only {human(held)} are there")


def check_values(dtype: np.dtype, shape: Sequence[int]) -> None:
    """Raise FileError if an array does not hold one number for each voxel of three axes."""
    if dtype.kind not in "biuf" or dtype.itemsize > 8:
        raise FileError(f"values of type {dtype.str}: voxels are bool, integers or floats")
    if len(shape) != 3 or min(shape) < 1:
        size = " x ".join(map(str, shape))[:60] or "no axes"
        raise FileError(f"an array of {size}: voxels have three axes: choose one volume of it")


# ---- the exact grid, for formats whose own numbers are rounded or count from centres


def grid_text(image: Dense) -> str:
    """Return shape, origin and pitch of an image as JSON, without rounding, and the transform of a
    normalized mesh."""
    place = {name: [v.hex() for v in getattr(image, name)] for name in ("origin", "pitch")}
    if isinstance(image, VoxelImage | AttributeImage) and image.octree.transform:
        place["transform"] = [v.hex() for v in image.octree.transform]
    return json.dumps({"shape": list(image.shape), **place})


def names_text(image: Dense) -> str:
    """Return the names of labels as JSON, by number; "" if the image has none."""
    names = image.names if isinstance(image, AttributeImage) else ()
    numbered = {str(number): name for number, name in enumerate(names) if number}
    return json.dumps(numbered) if names else ""


def grid_of_text(text: str) -> Grid | None:
    """Return the grid of such a text; None if it is another one."""
    try:
        found = json.loads(text)
        place = [tuple(map(float.fromhex, found[name])) for name in ("origin", "pitch")]
        return Grid(tuple(map(int, found["shape"])), *place)  # pyright: ignore
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, GridError):
        return None


def exactly(frame: Frame, grid: Grid | None) -> Frame:
    """Return a frame with the exact grid in place of the rounded one; an exact grid that is not
    near the other, since another program has changed the numbers beside it, is left."""
    if grid is None or grid.shape != frame.grid.shape:
        return frame
    near = np.array(grid.pitch) / 256
    off = np.abs(np.subtract(grid.origin, frame.grid.origin)) > near
    wide = np.abs(np.subtract(grid.pitch, frame.grid.pitch)) * grid.shape > near
    return frame if off.any() or wide.any() else frame._replace(grid=grid)
