"""Animations as GIF, WebP, MP4 or numbered pictures.

Pillow encodes GIF and WebP, and x264 (through PyAV) the video of MP4, so their bytes depend on the
versions of both libraries. Numbered pictures are PNG.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Iterator
from fractions import Fraction
from importlib import import_module
from typing import Any, BinaryIO

import numpy as np

from voxtool.errors import FileError
from voxtool.files.pictures.picture import write_png
from voxtool.files.storage.atomic import alone
from voxtool.files.storage.streams import STREAM, PathLike, open_output

FORMATS = ("gif", "webp", "mp4", "png")
SECONDS = 6  # of a whole turn, if no rate is named
LONGEST = {"gif": 65_535, "webp": 16_383, "mp4": 16_384}  # pixels along a side
MOST = 50  # frames a second: players slow down what is faster
QUALITY = 92  # of WebP, of 100
ENCODER = "libx264"
# Options of x264: the constant rate factor, at which no loss is seen but that of 4:2:0. Its bytes
# depend on the number of threads.
ENCODING = {"crf": "17", "preset": "medium", "threads": "1"}


def write_animation(
    frames: Iterable[np.ndarray],
    path: PathLike,
    clobber: bool = True,
    format: str = "gif",
    *,
    rate: Fraction,
) -> None:
    """Write frames as an endless animation, a video, or numbered pictures; `-` writes stdout.

    Parameters
    ----------
    frames
        (H, W, 3 or 4) uint8 each, (H, W, 3) for a video, which are taken one after the other.
    path
        For numbered pictures with a place for the number, as in spin%03d.png.
    clobber
        False refuses an existing file.
    format
        "gif", "webp", "mp4" or "png".
    rate
        Frames a second, but of numbered pictures. GIF counts hundredths of a second a frame, WebP
        thousandths.

    Raises
    ------
    FileError
        If a file cannot be written, the frames are too large for the format, or PyAV is missing.
    """
    if format == "png":
        with alone(path):
            for number, frame in enumerate(frames):
                with open_output(numbered(path, number), clobber=clobber) as file:
                    write_png(frame, file)
        return
    frames = iter(frames)
    first = next(frames)
    height, width = first.shape[:2]
    if max(height, width) > LONGEST[format]:
        raise FileError(
            f"{path}: frames of {width} x {height} pixels: .{format} has {LONGEST[format]} along a "
            "side: choose less, or numbered pictures as .png"
        )
    with open_output(path, clobber=clobber) as file:
        if format == "mp4":
            _write_video(first, frames, file, rate)
        else:
            _write_loop(first, frames, file, rate, format.upper())


def rate_of(count: int) -> Fraction:
    """Return the frames a second at which `count` frames are a turn of six seconds, or MOST."""
    return min(Fraction(count, SECONDS), Fraction(MOST))


def check_video() -> None:
    """Raise FileError, before any work, if PyAV is missing."""
    try:
        import_module("av")
    except ImportError:
        raise FileError(
            "a video as .mp4 needs PyAV: pip install 'voxtool[video]', or write .webp or .gif"
        ) from None


def _write_loop(
    first: np.ndarray, more: Iterator[np.ndarray], file: BinaryIO, rate: Fraction, kind: str
) -> None:
    """Write an endless GIF or WEBP."""
    from PIL import Image

    how: dict[str, Any] = {"quality": QUALITY} if kind == "WEBP" else {"disposal": 2}
    rest = map(Image.fromarray, more)
    Image.fromarray(first).save(
        file, kind, save_all=True, append_images=rest, loop=0, duration=round(1000 / rate), **how
    )


def _write_video(
    first: np.ndarray, more: Iterator[np.ndarray], file: BinaryIO, rate: Fraction
) -> None:
    """Write H.264 in MP4, 4:2:0 in the colours of BT.709, which all players know. Both sides must
    be even there: the last column or row of an odd one is repeated."""
    check_video()
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    colours: Any = {"dst_colorspace": Colorspace.ITU709, "dst_color_range": ColorRange.MPEG}
    height, width = first.shape[:2]
    odd = ((0, height % 2), (0, width % 2), (0, 0))
    whole = io.BytesIO()  # PyAV hides the errors of a file
    with av.open(whole, "w", format="mp4") as film:
        stream = film.add_stream(ENCODER, rate=rate, options=ENCODING, pix_fmt="yuv420p")
        stream.width, stream.height = width + width % 2, height + height % 2
        told = stream.codec_context
        told.colorspace, told.color_range = Colorspace.ITU709, ColorRange.MPEG
        told.color_primaries, told.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
        for frame in itertools.chain([first], more):
            image = av.VideoFrame.from_ndarray(np.pad(frame, odd, "edge"), format="rgb24")
            film.mux(stream.encode(image.reformat(format="yuv420p", **colours)))
        film.mux(stream.encode())
    file.write(whole.getbuffer())


def numbered(path: PathLike, number: int) -> str:
    """Return the name of a numbered picture; FileError if the path has no place for the number."""
    try:
        name = str(path) % number
    except (TypeError, ValueError):
        name = str(path)
    if path == STREAM or name == str(path):
        raise FileError(
            f"{path}: frames as .png need a place for their number, as in spin%03d.png; or write "
            ".gif, .webp or .mp4"
        )
    return name
