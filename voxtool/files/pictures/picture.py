"""Pictures as PNG of 8 or 16 bits, or as arrays (.npy).

A picture is (H, W, 4) float32, top row first: red, green and blue times opacity, and opacity, from
0 to 1. PNG stores a value v as the integer floor(v (2**bits - 1) + 1/2), computed in float64; there
is no gamma. Over a background B the colour is C + (1 - A) B. Without a background, the straight
colour C / A is stored, and 0 where the opacity rounds to 0.

Pillow writes 8 bits a channel only; pypng writes 16.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any, BinaryIO

import numpy as np

from voxtool.choices import WHITE
from voxtool.errors import FileError, VoxtoolError
from voxtool.files.grids import npy
from voxtool.files.storage.streams import PathLike, open_output

FORMATS = ("png", "npy")
BITS = {8: np.uint8, 16: np.uint16}
BAND = 64  # rows that are rounded at once, to bound the memory of their float64


def write_picture(
    picture: np.ndarray,
    path: PathLike,
    clobber: bool = True,
    format: str = "png",
    *,
    bits: int = 8,
    background: Sequence[float] | None = WHITE,
) -> None:
    """Write a picture; `-` writes stdout.

    Parameters
    ----------
    picture
        (H, W, 4) float32, premultiplied.
    bits, background
        of a png: 8 or 16 a value, and red, green and blue from 0 to 1, or None for
        a transparent picture.
    clobber
        False refuses an existing file.
    format
        "png", or "npy" for the array.

    Raises
    ------
    FileError
        Pillow or pypng is missing, or the file cannot be written.
    VoxtoolError
        it is no picture.
    """
    check_picture(picture)
    if format == "png":
        check_writer(bits)
    with open_output(path, clobber=clobber) as file:
        if format == "npy":
            npy.save(file, picture)
        else:
            write_png(rounded(picture, bits, background), file)


def check_picture(picture: np.ndarray) -> None:
    """Raise VoxtoolError unless an array is a picture."""
    if picture.ndim != 3 or picture.shape[2] != 4 or picture.dtype != np.float32:
        raise VoxtoolError(
            f"an array of shape {picture.shape} and type {picture.dtype} is no picture: those are "
            "(height, width, 4) float32"
        )
    if not np.isfinite(picture).all():
        raise VoxtoolError("a picture with values that are not finite: report what made it")


def check_writer(bits: int) -> None:
    """Raise FileError, before any work, if Pillow or for 16 bits pypng is missing."""
    library, module = ("Pillow", "PIL") if bits == 8 else ("pypng", "png")
    try:
        import_module(module)
    except ImportError:
        raise FileError(
            f"pictures of {bits} bits need {library}: pip install 'voxtool[pictures]'"
        ) from None


def rounded(
    picture: np.ndarray, bits: int = 8, background: Sequence[float] | None = WHITE
) -> np.ndarray:
    """Return the integers that PNG stores: (H, W, 3) uint8 or uint16 over the background, or (H, W,
    4) with straight alpha where that is None."""
    height, width, _ = picture.shape
    pixels = np.empty((height, width, 3 if background is not None else 4), BITS[bits])
    for first in range(0, height, BAND):
        band = picture[first : first + BAND].astype(np.float64)
        colour, opacity = band[..., :3], np.clip(band[..., 3:], 0, 1)
        if background is not None:
            values = colour + (1 - opacity) * np.asarray(background, np.float64)
        else:
            seen = _integers(opacity, bits) > 0
            values = np.zeros_like(band)
            np.divide(colour, opacity, out=values[..., :3], where=seen)
            values[..., 3:] = opacity
        pixels[first : first + BAND] = _integers(values, bits)
    return pixels


def _integers(values: np.ndarray, bits: int) -> np.ndarray:
    """Return values from 0 to 1 as integers; halves are rounded up."""
    return np.floor(np.clip(values, 0, 1) * ((1 << bits) - 1) + 0.5)


def write_png(pixels: np.ndarray, file: BinaryIO, palette: Sequence[int] | None = None) -> None:
    """Write pixels as PNG: (H, W, 3 or 4) uint8 or uint16, or (H, W) uint8 numbers of a palette, a
    list of the red, green and blue of each number."""
    height, width = pixels.shape[:2]
    if pixels.dtype == np.uint8:
        from PIL import Image

        if palette is None:
            image = Image.fromarray(pixels)
        else:
            image = Image.frombytes("P", (width, height), pixels.tobytes())
            image.putpalette(palette)
        image.save(file, "PNG", optimize=palette is not None)
        return
    import png

    kind: Any = {"greyscale": False, "alpha": pixels.shape[2] == 4, "bitdepth": 16}
    writer = png.Writer(width, height, **kind)
    writer.write_packed(file, (row.astype(">u2").tobytes() for row in pixels))
