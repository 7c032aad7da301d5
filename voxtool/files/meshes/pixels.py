"""Pictures of textures to pixels: PNG and JPEG, by Pillow."""

from __future__ import annotations

import hashlib
import io
import warnings

import numpy as np

from voxtool.errors import MeshError, VoxtoolError, one_line
from voxtool.memory import check_memory

FORMATS = ("PNG", "JPEG")  # the only decoders that run
MOST_SIDE = 1 << 14  # and as many pixels as Pillow lets through, 178,956,970
# A PNG of one bit a pixel, packed best: 8 pixels times 1032. A JPEG has at most 512 a byte.
MOST_PIXELS = 8 * 1032
PIXEL_BYTES = 16  # bytes of memory while a picture is decoded
DEEP = ("I", "I;16", "I;16B", "I;16L")  # modes of 16 bits


class Pictures:
    """The pictures of a mesh, each decoded once.

    Parameters
    ----------
    max_memory : int, optional
        Bytes that all of them may take.
    """

    def __init__(self, max_memory: int | None) -> None:
        self.max_memory, self.found, self.pixels = max_memory, {}, 0

    def read(self, where: str, data: bytes) -> np.ndarray:
        """Return the pixels of a PNG or a JPEG, (H, W, 4) uint8: red, green, blue in sRGB, and
        opacity.

        Its size is known before memory is taken. PNG is decoded alike everywhere; the last bits of
        a JPEG are those of the decoder of Pillow.

        Parameters
        ----------
        where : str
            The file and the texture, for messages.

        Raises
        ------
        MeshError
            If Pillow is missing, or the data is no such picture, damaged or too large.
        MemoryLimitError
            If it does not fit in memory.
        """
        key = hashlib.sha256(data).digest()
        if key not in self.found:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of large pictures: they are checked here
                    self.found[key] = self._decoded(where, data)
            except VoxtoolError:
                raise
            except Exception as error:  # DecompressionBombError, or whatever a decoder raises
                reason = one_line(error)[:120]
                raise MeshError(
                    f"{where}: not readable as PNG or JPEG: {reason}: save it as a smaller PNG"
                ) from None
        return self.found[key]

    def _decoded(self, where: str, data: bytes) -> np.ndarray:
        try:
            from PIL import Image
        except ImportError:
            raise MeshError(
                f"{where}: textures need Pillow: pip install 'voxtool[pictures]'"
            ) from None
        with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
            width, height = picture.size
            if max(width, height) > MOST_SIDE or width * height > MOST_PIXELS * len(data):
                raise MeshError(
                    f"{where}: {width} x {height} pixels, more than {MOST_SIDE} a side or than its "
                    f"{len(data):,} bytes can hold: make it smaller"
                )
            self.pixels += width * height
            check_memory(
                PIXEL_BYTES * self.pixels, f"{where}: the pixels of all textures",
                "make them smaller", self.max_memory,
            )  # fmt: skip
            if picture.mode in DEEP:
                grey = (np.asarray(picture).astype(np.int64) >> 8).astype(np.uint8)
                return np.array(Image.fromarray(grey).convert("RGBA"))
            return np.array(picture.convert("RGBA"))
