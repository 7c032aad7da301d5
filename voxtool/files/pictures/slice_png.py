"""One slice of voxels as .png, drawn by voxtool.pictures.slices."""

from __future__ import annotations

from typing import BinaryIO

from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.octree import Octree


def size(image: VoxelImage) -> int:
    """Return the bytes of the file, at most: those of the largest slice."""
    shape = image.octree.grid.shape
    return max(shape[0] * shape[1], shape[1] * shape[2], shape[2] * shape[0])


def write(image: VoxelImage, file: BinaryIO, axis: str = "z", value: int | None = None) -> None:
    """Write the slice of voxels whose index along `axis` is `value` (default: the middle).

    Raises
    ------
    GridError : no such axis, or an index outside the grid.
    FileError : Pillow is missing.
    MemoryLimitError : the picture does not fit in memory.
    """
    from voxtool.files.pictures import picture
    from voxtool.pictures.slices import draw_octree_slice, palette

    picture.check_writer(8)
    assert isinstance(image.octree, Octree)
    picture.write_png(draw_octree_slice(image.octree, axis, value), file, palette())
