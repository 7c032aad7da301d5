"""One slice of an octree as a picture: its voxels, and the cells of its leaves.

Dark blue is a voxel set in a brick, light blue one in a coarse leaf wholly inside the solid; fine
lines bound the leaves. The two axes that remain run right and up in the order x, y, z.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from voxtool.errors import FileError, GridError
from voxtool.files.layers import COARSE, FINE, OUTSIDE, Leaves, paint, sorted_leaves
from voxtool.files.memory import check_memory

if TYPE_CHECKING:
    from voxtool.svo.octree import Octree

AXES = "xyz"
TARGET = 1024  # pixels along the longer side
LEAST_CELL = 8  # pixels: smaller cells get no lines
LINE = 3  # added to a colour's number where a line crosses it

COLOURS = {
    OUTSIDE: (250, 250, 248),
    FINE: (29, 66, 122),
    COARSE: (150, 186, 222),
    OUTSIDE + LINE: (222, 224, 226),
    FINE + LINE: (66, 104, 158),
    COARSE + LINE: (126, 165, 206),
}


def size(octree: Octree) -> int:
    """Bytes that the file takes at most: next to nothing."""
    return 0


def write(octree: Octree, file: BinaryIO, axis: str = "z", value: int | None = None) -> None:
    """Write the slice of voxels whose index along `axis` is `value` (default: the middle).

    Raises
    ------
    GridError : no such axis, or an index outside the grid.
    FileError : Pillow is missing.
    MemoryLimitError : the picture does not fit in memory.
    OSError : the file cannot be written.
    """
    try:
        from PIL import Image
    except ImportError:
        raise FileError("pictures need Pillow: pip install 'voxtool[pictures]'") from None
    picture = Image.fromarray(draw(octree, axis, value), "P")
    picture.putpalette([c for number in sorted(COLOURS) for c in COLOURS[number]])
    picture.save(file, "PNG", optimize=True)


def draw(octree: Octree, axis: str = "z", value: int | None = None) -> np.ndarray:
    """The slice as (height, width) uint8 keys of COLOURS, the top row first."""
    if axis not in AXES or len(axis) != 1:
        raise GridError(f"axis {axis!r} is unknown: choose x, y or z")
    normal = AXES.index(axis)
    count = octree.grid.shape[normal]
    value = count // 2 if value is None else value
    if not 0 <= value < count:
        raise GridError(f"slice {axis}={value} lies outside the grid: choose 0 to {count - 1}")
    right, up = (a for a in range(3) if a != normal)
    width, height = octree.grid.shape[right], octree.grid.shape[up]
    scale = max(1, round(TARGET / max(width, height)))
    needed = 4 * octree.grid.side**2 + 3 * scale * scale * width * height
    check_memory(needed, f"a picture of {width} x {height} voxels and its layers")
    order = (normal, up, right)
    leaves = sorted_leaves(octree, order)
    slab = paint(leaves, value - value % 4, order, octree.grid.side)
    picture = slab[value % 4, :height, :width].repeat(scale, 0).repeat(scale, 1)
    for level in leaves:
        _outline(picture, level, level.touching(value), scale)
    return picture[::-1]


def _outline(picture: np.ndarray, level: Leaves, chosen: slice, scale: int) -> None:
    """A line along the low sides of each leaf; the neighbour draws the others."""
    if level.side * scale < LEAST_CELL:
        return
    height, width = picture.shape
    side = level.side * scale
    for row, column in (level.corners[chosen, 1:] * scale).tolist():
        if row < height and column < width:
            for edge in (
                picture[row, column : column + side],
                picture[row : row + side, column],
            ):
                edge[edge < LINE] += LINE
