"""The arrays in VTK's XML files of images: where they lie, and their bytes as a stream.

A file is parsed up to its appended data, which need not be XML. An array is a header, the number of
its bytes, and the bytes; or, compressed, the number of blocks, the size of a block and of the last
one, the compressed sizes, and the blocks. base64 may end with a padding after the header.
"""

from __future__ import annotations

import base64
import io
import lzma
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO
from xml.parsers import expat

import numpy as np

from voxtool.errors import FileError, printable, shown
from voxtool.files.grids.voxels import Readable, check_length
from voxtool.files.storage.text_numbers import array_of_text, real, whole
from voxtool.files.storage.unpacked import unpacking
from voxtool.memory import check_memory

SCAN = 1 << 16  # bytes of XML at a time

KINDS = {"Int": "i", "UInt": "u", "Float": "f"}
PLACES = ("CellData", "PointData")
MOST_ARRAYS = 1000
DEEPEST = 64  # elements inside elements
MOST_TOKEN = 1 << 20  # bytes of one tag
LZMA_MEMORY = 1 << 27  # twice what its highest setting takes


def _unzip(data: bytes, size: int) -> bytes:
    return zlib.decompressobj().decompress(data, size)


def _unlzma(data: bytes, size: int) -> bytes:
    return lzma.LZMADecompressor(memlimit=LZMA_MEMORY).decompress(data, size)


def _unlz4(data: bytes, size: int) -> bytes:
    try:
        from numcodecs.lz4 import decompress
    except ImportError:
        raise FileError("is packed by LZ4, which needs numcodecs: pip install numcodecs") from None
    return bytes(decompress(struct.pack("<I", size) + data))  # which stores the size before


UNPACKERS: dict[str, Callable[[bytes, int], bytes]] = {
    "vtkZLibDataCompressor": _unzip,
    "vtkLZMADataCompressor": _unlzma,
    "vtkLZ4DataCompressor": _unlz4,
}


@dataclass
class Image:
    """A VTK image, and its array that is read."""

    file: BinaryIO
    extent: tuple[int, ...] = ()  # the first and last point along each axis
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)
    spacing: tuple[float, ...] = (1.0, 1.0, 1.0)
    direction: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    place: str = ""  # CellData or PointData
    dtype: np.dtype = field(default_factory=lambda: np.dtype("u1"))
    header: np.dtype = field(default_factory=lambda: np.dtype("<u4"))
    compressor: str = ""  # of UNPACKERS, or none
    format: str = ""  # ascii, binary or appended
    encoding: str = ""  # of appended data: raw or base64
    start: int = 0  # of an appended array in the file
    text: str = ""  # of an inline array

    def stream(self, needed: int) -> Readable:
        """Return the array as a stream of bytes; FileError if it does not have `needed` of them."""
        if self.format == "ascii":
            check_memory(100 * len(self.text), "an array of text")
            values = array_of_text(self.text.encode(), self.dtype)
            check_length(needed, values.nbytes)
            return io.BytesIO(values.tobytes())
        if self.format == "appended":
            self.file.seek(self.start)
            source: Readable = self.file
        else:
            source = io.BytesIO("".join(self.text.split()).encode())
        if self.format == "binary" or self.encoding == "base64":
            source = _Stream(_decoded(source))
        if self.compressor:
            return _Stream(self._inflated(source, needed))
        (held,) = self._numbers(source, 1)
        check_length(needed, held)
        return source

    def _numbers(self, source: Readable, count: int) -> list[int]:
        """Return the next numbers of a header."""
        data = source.read(count * self.header.itemsize)
        check_length(count * self.header.itemsize, len(data))
        return np.frombuffer(data, self.header).tolist()

    def _inflated(self, source: Readable, needed: int) -> Iterator[bytes]:
        """Yield the blocks of a compressed array; the last one may be shorter, then `last` is its
        size, otherwise 0."""
        blocks, size, last = self._numbers(source, 3)
        whole_blocks = blocks - (last > 0)
        if whole_blocks * size + last != needed or last > size or blocks > needed:
            raise FileError("its compressed blocks are not those of its array")
        check_memory(3 * min(size, needed), "a compressed block of its array")
        for number, packed in enumerate(self._numbers(source, blocks)):
            content = size if number < whole_blocks else last
            if packed > 2 * content + 1024:
                raise FileError("a compressed block is longer than its content")
            data = source.read(packed)
            check_length(packed, len(data))
            with unpacking(f"compressed block {number}"):
                found = UNPACKERS[self.compressor](data, content)
            check_length(content, len(found))
            yield found


class _Stream:
    """Parts of bytes as one stream."""

    def __init__(self, parts: Iterator[bytes]) -> None:
        self._parts = parts
        self._part, self._at = b"", 0

    def read(self, size: int, /) -> bytes:
        """Return the next `size` bytes, fewer at the end."""
        found, count = [], 0
        while count < size:
            if self._at == len(self._part):
                if (part := next(self._parts, None)) is None:
                    break
                self._part, self._at = part, 0
            piece = self._part[self._at : self._at + size - count]
            self._at += len(piece)
            count += len(piece)
            found.append(piece)
        return b"".join(found)


def _decoded(source: Readable) -> Iterator[bytes]:
    """Yield the bytes of base64, in which a padding may stand within."""
    while data := source.read(SCAN):
        data, mark, _ = data.partition(b"<")  # the end of appended data
        data = data.strip() if mark else data
        while data:
            end = data.find(b"=")
            end = len(data) if end < 0 else end // 4 * 4 + 4
            with unpacking("base64"):
                yield base64.b64decode(data[:end], validate=True)
            data = data[end:]
        if mark:
            return


def read_image(file: BinaryIO, size: int) -> Image:
    """Return the image of a .vti file, with its active scalars or its first array of one number.

    Raises
    ------
    FileError
        If it is no image of one piece, or has no such array, or is compressed by another method.
    """
    parser = _Parser(file)
    parser.parse(size)
    if not parser.image.extent:
        raise FileError("is no VTK image (ImageData)")
    if parser.pieces != 1:
        raise FileError(f"has {parser.pieces} pieces: save it as one")
    parser.choose()
    return parser.image


class _Parser:
    """Collects the elements of a .vti file, up to its appended data."""

    def __init__(self, file: BinaryIO) -> None:
        self.image = Image(file)
        self.pieces = 0
        self.arrays: list[tuple[str, dict[str, str], list[str]]] = []  # place, attributes, text
        self.active: dict[str, str] = {}  # names of the active scalars, by place
        self.place, self.depth = "", 0
        self.order = "<"
        self.text: list[str] | None = None
        self.data = -1  # where appended data begin
        self.expat = expat.ParserCreate()
        self.expat.StartElementHandler = self.start
        self.expat.EndElementHandler = self.end
        self.expat.CharacterDataHandler = self.characters
        self.expat.EntityDeclHandler = self.entity
        self.expat.buffer_text = True

    def parse(self, size: int) -> None:
        file = self.image.file
        try:
            while self.data < 0 and (part := file.read(SCAN)):
                self.expat.Parse(part)
                if file.tell() - max(self.expat.CurrentByteIndex, 0) > MOST_TOKEN:
                    raise FileError(f"a tag of more than {MOST_TOKEN >> 20} MiB: it is damaged")
        except expat.ExpatError as error:
            if self.data < 0:
                raise FileError(f"is no XML: {error}") from None
        if self.data >= 0:
            file.seek(self.data)
            opening = file.read(SCAN)
            mark = opening.find(b"_", opening.find(b">"))
            if mark < 0:
                raise FileError("its appended data do not begin with _")
            self.data += mark + 1

    def start(self, name: str, attributes: dict[str, str]) -> None:
        image = self.image
        if self.data >= 0:
            return
        self.depth += 1
        if self.depth > DEEPEST:
            raise FileError(f"elements inside more than {DEEPEST} others: it is damaged")
        if name == "VTKFile":
            self.order = ">" if attributes.get("byte_order") == "BigEndian" else "<"
            image.compressor = attributes.get("compressor", "")
            if image.compressor and image.compressor not in UNPACKERS:
                raise FileError(
                    f"is packed by {printable(image.compressor)[:40]}: save it with zlib"
                )
            image.header = dtype_of(attributes.get("header_type", "UInt32"), self.order)
        elif name == "ImageData":
            image.extent = tuple(map(whole, _words(attributes.get("WholeExtent", ""), 6)))
            for key in ("Origin", "Spacing", "Direction"):
                if key in attributes:
                    words = _words(attributes[key], 9 if key == "Direction" else 3)
                    setattr(image, key.lower(), tuple(map(real, words)))
        elif name == "Piece":
            self.pieces += 1
            words = tuple(map(whole, _words(attributes.get("Extent", ""), 6)))
            if image.extent and words != image.extent:
                raise FileError("its piece is not the whole image: save it as one")
        elif name in PLACES:
            self.place = name
            self.active[name] = attributes.get("Scalars", "")
        elif name == "DataArray" and self.place and len(self.arrays) < MOST_ARRAYS:
            self.text = []
            self.arrays.append((self.place, attributes, self.text))
        elif name == "AppendedData":
            image.encoding = attributes.get("encoding", "base64")
            self.data = self.expat.CurrentByteIndex

    def end(self, name: str) -> None:
        self.depth -= 1
        if name in PLACES:
            self.place = ""
        elif name == "DataArray":
            self.text = None

    def characters(self, text: str) -> None:
        if self.text is not None and self.data < 0:
            self.text.append(text)

    def entity(self, *_: object) -> None:
        raise FileError("declares entities, which no image needs")

    def choose(self) -> None:
        """Choose the array: the active scalars, or else the first one of one number."""
        found = [a for a in self.arrays if a[1].get("NumberOfComponents", "1") == "1"]
        if not found:
            raise FileError("has no array of one number a cell or point")
        active = [a for a in found if a[1].get("Name") == self.active.get(a[0])]
        image = self.image
        image.place, attributes, text = (active or sorted(found, key=lambda a: a[0]))[0]
        image.dtype = dtype_of(attributes.get("type", ""), self.order)
        image.format, image.text = attributes.get("format", "ascii"), "".join(text)
        if image.format not in ("ascii", "binary", "appended"):
            raise FileError(f"an array of format {shown(image.format.encode())} is unknown")
        if image.format == "appended":
            if self.data < 0:
                raise FileError("its appended data are missing")
            image.start = self.data + whole(attributes.get("offset", "0"))


def _words(text: str, count: int) -> list[str]:
    words = text.split()
    if len(words) != count:
        raise FileError(f"expected {count} numbers, found {shown(text.encode())}")
    return words


def dtype_of(name: str, order: str) -> np.dtype:
    """Return the dtype of a VTK type, such as UInt8."""
    word = name.rstrip("0123456789")
    bits = name[len(word) :]
    if word not in KINDS or bits not in ("8", "16", "32", "64"):
        raise FileError(f"values of type {shown(name.encode())}: expected integers or floats")
    return np.dtype(f"{order}{KINDS[word]}{int(bits) // 8}")
