"""A slice of an octree as a picture: its voxels, and the cells of its leaves.

Dark blue is a voxel set in a brick. A leaf that lies completely inside the solid is lighter, the
coarser it is. Thin lines bound the leaves. The two remaining axes run right and up in the order x,
y, z.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import GridError
from voxtool.memory import check_memory
from voxtool.svo.layers import Leaves, paint, sorted_leaves

if TYPE_CHECKING:
    from voxtool.svo.octree import Octree

AXES = "xyz"
TARGET = 1024  # pixels along the longer side
LEAST_CELL = 8  # pixels: smaller cells get no lines
LINE = 16  # added to a colour's number where a line crosses it

PAPER, PAPER_LINE = (252, 252, 250), (212, 217, 222)
BLUES = [(24, 62, 120), (108, 156, 208), (146, 186, 226), (178, 208, 238), (204, 225, 245)]
BLUE_LINES = [(62, 102, 160), (82, 131, 188), (118, 163, 209), (150, 187, 224), (176, 205, 233)]


def palette() -> list[int]:
    """Return red, green and blue of each colour number: OUTSIDE, SET + level, and these + LINE."""
    plain = [PAPER, *BLUES, *BLUES[-1:] * LINE][:LINE]
    crossed = [PAPER_LINE, *BLUE_LINES, *BLUE_LINES[-1:] * LINE][:LINE]
    return [component for colour in (*plain, *crossed) for component in colour]


def draw_octree_slice(octree: Octree, axis: str = "z", value: int | None = None) -> np.ndarray:
    """Return a picture of a slice of an octree, as colour numbers of `palette`.

    Parameters
    ----------
    axis : "x", "y" or "z", the normal of the slice.
    value : index of the voxels along that axis; None takes the middle of what is set.

    Returns
    -------
    (height, width) uint8, top row first.

    Raises
    ------
    GridError : no such axis, or an index outside the grid.
    MemoryLimitError : the picture does not fit in memory.
    """
    if axis not in AXES or len(axis) != 1:
        raise GridError(f"axis {axis!r} is unknown: choose x, y or z")
    normal = AXES.index(axis)
    count = octree.grid.shape[normal]
    value = _middle(octree, normal) if value is None else value
    if not 0 <= value < count:
        raise GridError(f"slice {axis}={value} lies outside the grid: choose 0 to {count - 1}")
    right, up = (a for a in range(3) if a != normal)
    width, height = octree.grid.shape[right], octree.grid.shape[up]
    scale = max(1, round(TARGET / max(width, height)))
    needed = 4 * octree.grid.side**2 + 4 * scale * scale * width * height
    check_memory(needed, f"a picture of {width} x {height} voxels and its layers")
    order = (normal, up, right)
    leaves = sorted_leaves(octree, order)
    slab = paint(leaves, value - value % 4, order, octree.grid.shape)
    voxels = slab[value % 4, :height, :width]
    picture = np.pad(voxels.repeat(scale, 0).repeat(scale, 1), (0, 1))  # a pixel closes the frame
    picture[-1], picture[:, -1] = LINE, LINE
    for level in leaves:
        _outline(picture, level, level.touching(value), scale)
    return picture[::-1]


def _middle(octree: Octree, axis: int) -> int:
    """Return the layer in the middle of the set voxels, or of the grid if there are none."""
    low, high = octree.grid.shape[axis], 0
    for level in octree.levels():
        held = level.inside if level.number else octree.bricks != 0
        cells = level.cells[held, axis]
        if len(cells):
            low, high = min(low, int(cells.min())), max(high, int(cells.max()) + level.side)
    return min(low + high, 2 * octree.grid.shape[axis] - 1) // 2


def _outline(picture: np.ndarray, level: Leaves, chosen: slice, scale: int) -> None:
    """Draw a line along the low sides of each leaf; the other sides are those of neighbours."""
    if level.side * scale < LEAST_CELL:
        return
    height, width = picture.shape
    side = level.side * scale
    for row, column in (level.corners[chosen, 1:] * scale).tolist():
        if row < height and column < width:
            for edge in (picture[row, column:][:side], picture[row:, column][:side]):
                edge[edge < LINE] += LINE
