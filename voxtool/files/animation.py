"""Animations as GIF, WebP or numbered pictures.

Pillow encodes GIF and WebP, so their bytes depend on its version; numbered pictures are PNG.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np

from voxtool.errors import FileError
from voxtool.files.picture import write_png
from voxtool.files.streams import STREAM, PathLike, open_output

FORMATS = ("gif", "webp", "png")
SECONDS = 6.0  # of a whole turn
LEAST = 20  # milliseconds of a frame: players slow down what is faster
QUALITY = 92  # of WebP, of 100


def write_animation(
    frames: Iterable[np.ndarray],
    path: PathLike,
    clobber: bool = True,
    format: str = "gif",
    *,
    count: int,
) -> None:
    """Write frames as an endless animation, or as numbered pictures; `-` writes stdout.

    Parameters
    ----------
    frames
        (H, W, 3 or 4) uint8 each, which are taken one after the other.
    path
        For numbered pictures with a place for the number, as in spin%03d.png.
    clobber
        False refuses an existing file.
    format
        "gif", "webp" or "png".
    count
        How many frames there are, which make a whole turn.

    Raises
    ------
    FileError
        If a file cannot be written.
    """
    if format == "png":
        for number, frame in enumerate(frames):
            with open_output(numbered(path, number), clobber=clobber) as file:
                write_png(frame, file)
        return
    from PIL import Image

    images = map(Image.fromarray, frames)
    first = next(images)
    more: dict[str, Any] = {"quality": QUALITY} if format == "webp" else {"disposal": 2}
    with open_output(path, clobber=clobber) as file:
        first.save(
            file, format.upper(), save_all=True, append_images=itertools.chain(images), loop=0,
            duration=max(round(1000 * SECONDS / count), LEAST), **more,
        )  # fmt: skip


def numbered(path: PathLike, number: int) -> str:
    """Return the name of a numbered picture; FileError if the path has no place for the number."""
    try:
        name = str(path) % number
    except (TypeError, ValueError):
        name = str(path)
    if path == STREAM or name == str(path):
        raise FileError(
            f"{path}: frames as .png need a place for their number, as in spin%03d.png; or write "
            ".gif or .webp"
        )
    return name
