"""Layers of cells as pictures of one bit, layers/0000.png and so on: one pixel a cell, white where
at least half of the cell is set.

As in other pictures of slices, the two remaining axes run right and up in the order x, y, z. The
lowest layer has the number 0.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from voxtool.files.grids.tiff import order_of
from voxtool.files.pictures import picture
from voxtool.svo.images.image import VoxelImage

NAME, NUMBER = "%04d.png", re.compile(r"%0?(\d*)d")
PICTURE_BYTES = 4200  # bytes of a picture beyond its pixels, with the block of a disk that it takes


def size(image: VoxelImage) -> int:
    """Return the bytes of all pictures, at most."""
    return image.cells // 4 + PICTURE_BYTES * max(image.shape)


def write(
    image: VoxelImage, folder: Path, axis: str = "z", dpi: float | None = None, pattern: str = NAME
) -> None:
    """Write a picture of each layer along `axis`, "x", "y" or "z".

    Parameters
    ----------
    dpi : float, optional
        Pixels an inch, which the pictures then say.
    pattern : str
        Names of the pictures; %04d stands for the number of the layer, with four digits.

    Raises
    ------
    GridError
        If there is no such axis.
    FileError
        If Pillow is missing.
    """
    picture.check_writer(8)
    from PIL import Image

    before, digits, after = NUMBER.split(pattern, maxsplit=1)
    more = {} if dpi is None else {"dpi": (dpi, dpi)}
    number = 0
    for slab in image.with_dtype(bool).slabs(order_of(axis)):
        for layer in slab:
            path = folder / f"{before}{number:0{digits or 1}}{after}"
            Image.fromarray(np.ascontiguousarray(layer[::-1])).save(path, "PNG", **more)
            number += 1
