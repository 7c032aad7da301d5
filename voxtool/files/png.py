"""One slice of an octree as .png, drawn by voxtool.plots.octree_slice."""

from __future__ import annotations

from typing import TYPE_CHECKING, BinaryIO

from voxtool.files.picture import check_writer, write_png
from voxtool.plots.octree_slice import draw_octree_slice, palette

if TYPE_CHECKING:
    from voxtool.svo.octree import Octree


def write(octree: Octree, file: BinaryIO, axis: str = "z", value: int | None = None) -> None:
    """Write the slice of voxels whose index along `axis` is `value` (default: the middle).

    Raises
    ------
    GridError : no such axis, or an index outside the grid.
    FileError : Pillow is missing.
    MemoryLimitError : the picture does not fit in memory.
    OSError : the file cannot be written.
    """
    check_writer(8)
    write_png(draw_octree_slice(octree, axis, value), file, palette())
