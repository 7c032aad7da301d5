"""TIFF stacks, .tif: one page a layer of cells, [z, y, x] without mirroring, deflated.

Cells of bool have one bit. The description is OME-XML, which says the spacing; a private tag has
the exact grid. Colours have four samples a pixel, normals three, faces six; the names of labels are
an annotation of the OME-XML. BigTIFF where 4 GiB may not do.
https://docs.openmicroscopy.org/ome-model/6.3.1/ome-tiff/specification.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from math import prod
from typing import Any, BinaryIO
from xml.etree import ElementTree
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from voxtool.errors import FileError, GridError, VoxtoolError, one_line
from voxtool.files.grids.voxels import (
    Boxes,
    Dense,
    Frame,
    Stored,
    check_length,
    check_values,
    dense_pieces,
    exactly,
    grid_of_text,
    grid_text,
)
from voxtool.files.storage.streams import PACKED
from voxtool.files.storage.unpacked import check_unpacked
from voxtool.grid import Grid
from voxtool.memory import check_memory
from voxtool.svo.images.slabs import Order

# Axes of pages, of rows and of columns, by the axis along which the layers follow each other.
ORDERS: dict[str, Order] = {"x": (0, 2, 1), "y": (1, 2, 0), "z": (2, 1, 0)}
GRID, PAGE_BYTES = 65123, 400  # a private tag; bytes of a page's directory, at most
CLASSIC_BYTES = (1 << 32) - (1 << 24)
XMLNS = "http://www.openmicroscopy.org/Schemas/OME/2016-06"
OME = (
    '<?xml version="1.0" encoding="UTF-8"?><OME xmlns="{xmlns}"><Image ID="Image:0">'
    '<Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="{type}" SizeX="{x}" SizeY="{y}" '
    'SizeZ="{z}" SizeC="{c}" SizeT="1"{spacing}><Channel ID="Channel:0:0" SamplesPerPixel="{c}"/>'
    '<TiffData IFD="0" PlaneCount="{z}"/></Pixels>{link}</Image>{names}</OME>'
)
LINK = '<AnnotationRef ID="Annotation:0"/>'
NAMES = (
    '<StructuredAnnotations><MapAnnotation ID="Annotation:0" Namespace="voxtool.labels"><Value>'
    "{rows}</Value></MapAnnotation></StructuredAnnotations>"
)
NAME_BYTES = 64  # bytes of a name in the XML, beyond its letters
TYPES = {"bool": "bit", "float32": "float", "float64": "double"}


def size(image: Dense) -> int:
    """Return the bytes of the file, in which cells far inside or far outside take few."""
    mixed = image.mixed // 4 if image.dtype == bool else image.mixed * image.dtype.itemsize
    named = sum(NAME_BYTES + 6 * len(name.encode()) for name in getattr(image, "names", ()))
    return mixed + _raw(image) // (PACKED // 4) + PAGE_BYTES * max(image.shape) + named


def _raw(image: Dense) -> int:
    """Return the bytes of all pages, unpacked."""
    return image.nbytes // 4 if image.dtype == bool else image.nbytes


def write(image: Dense, file: BinaryIO, axis: str = "z", dpi: float | None = None) -> None:
    """Write the image as layers along `axis`, "x", "y" or "z"; `dpi`: pixels an inch on paper.

    Raises
    ------
    GridError
        If there is no such axis.
    """
    import tifffile

    order = order_of(axis)
    z, y, x = shape = tuple(image.shape[a] for a in order)
    channels = getattr(image, "channels", 1)
    names = _annotation(getattr(image, "names", ()))
    spacing = "".join(
        f' PhysicalSize{name}="{image.pitch[a]!r}"'
        + (f" PhysicalSize{name}Unit={quoteattr(image.units)}" if image.units else "")
        for name, a in zip("ZYX", order, strict=True)
    )
    kind = TYPES.get(image.dtype.name, image.dtype.name)
    text = OME.format(
        xmlns=XMLNS, type=kind, x=x, y=y, z=z, c=channels, spacing=spacing,
        names=names, link=LINK if names else "",
    )  # fmt: skip
    shape += (channels,) if channels > 1 else ()
    # tifffile wants one page at a time, and one strip a page
    tifffile.imwrite(
        file,
        (layer for slab in image.slabs(order) for layer in slab),
        shape=shape, dtype=image.dtype, photometric="rgb" if channels in (3, 4) else "minisblack",
        planarconfig=None if channels == 1 else "contig", compression="zlib",
        extrasamples=["unassalpha"] if channels == 4 else None,
        rowsperstrip=y, metadata=None, description=text.encode(), software="voxtool",
        bigtiff=_raw(image) + PAGE_BYTES * z > CLASSIC_BYTES,
        resolution=(dpi, dpi) if dpi else None, resolutionunit="INCH" if dpi else None,
        extratags=[(GRID, "s", 0, f"{axis} {grid_text(image)}", True)],
    )  # fmt: skip


def _annotation(names: tuple[str, ...]) -> str:
    """Return the element of names of labels, by number."""
    rows = "".join(
        f'<M K="{number}">{escape(name)}</M>' for number, name in enumerate(names) if number
    )
    return NAMES.format(rows=rows) if names else ""


def order_of(axis: str) -> Order:
    """Return the axes of layers, rows and columns; GridError if there is no such axis."""
    if axis not in ORDERS:
        raise GridError(f"axis {axis!r} is unknown: choose x, y or z")
    return ORDERS[axis]


# ---- in


def read(file: BinaryIO, size: int) -> Stored:
    """Return the voxels of a stack of pages, in grey."""
    try:
        return _read(file, size)
    except (VoxtoolError, OSError, MemoryError):
        raise
    except Exception as error:  # damage shows in any of tifffile's errors
        raise _damaged(error) from error


def _damaged(error: Exception) -> FileError:
    return FileError(f"is no TIFF, or damaged: {one_line(error) or type(error).__name__}")


def _read(file: BinaryIO, size: int) -> Stored:
    import logging

    import tifffile

    logging.getLogger("tifffile").addHandler(logging.NullHandler())  # errors say what is wrong
    _check_directories(file, size)
    tif = tifffile.TiffFile(file)
    if not tif.series:
        raise FileError("holds no images")
    series = tif.series[0]
    shape, dtype = tuple(series.shape), np.dtype(series.dtype)
    if len(shape) == 2:
        shape = (1, *shape)
    check_values(dtype, shape)
    if not series.axes.endswith("YX"):
        raise FileError(f"axes {series.axes}: voxels are a stack of grey pages: choose one channel")
    check_length(prod(shape) // 8, PACKED * size)
    check_unpacked(prod(shape) * dtype.itemsize // (8 if dtype.kind == "b" else 1), size)
    check_memory(4 * prod(shape[1:]) * dtype.itemsize, "a page of its stack")
    tag = tif.pages[0].tags.get(GRID)  # pyright: ignore[reportAttributeAccessIssue]
    axis, _, text = str(tag.value).partition(" ") if tag else ("z", "", "")
    order = ORDERS.get(axis, ORDERS["z"])
    pitch, units = _spacing(tif)
    placed = np.empty(3, int), np.empty(3)
    placed[0][list(order)], placed[1][list(order)] = shape, pitch
    grid = Grid(*(tuple(v.tolist()) for v in (placed[0], np.zeros(3), placed[1])))  # pyright: ignore
    exact = grid_of_text(text)
    if exact is not None:  # the origin is nowhere else
        grid = Grid(grid.shape, exact.origin, grid.pitch)
    frame = exactly(Frame(grid, order), exact)
    whole = (shape[0], shape[1], shape[2])
    if series.dataoffset is not None and dtype.kind != "b":  # of ImageJ, without a directory a page
        check_length(prod(shape) * dtype.itemsize, size - series.dataoffset)
        file.seek(series.dataoffset)
        raw = dtype.newbyteorder(tif.byteorder)
        return Stored(frame, dense_pieces(file, raw, whole, fortran=False), units)
    return Stored(frame, _pieces(series, whole), units)


def _check_directories(file: BinaryIO, size: int) -> None:
    """Refuse pages whose directories overlap or repeat, which would be read again and again."""
    head = file.read(16)
    order = ">" if head.startswith(b"MM") else "<"
    big = head[2:4] in (b"+\0", b"\0+")
    count, entry, link = ("Q", 20, "Q") if big else ("H", 12, "I")
    (at,) = struct.unpack_from(order + link, head, 8 if big else 4)
    held = 0
    while at:
        file.seek(at)
        (entries,) = struct.unpack(order + count, file.read(struct.calcsize(count)))
        held += entries * entry + struct.calcsize(count) + struct.calcsize(link)
        if held > size:
            raise FileError("the directories of its pages overlap: it is damaged")
        file.seek(entries * entry, 1)
        (at,) = struct.unpack(order + link, file.read(struct.calcsize(link)))
    file.seek(0)


def _pieces(series: Any, shape: tuple[int, int, int]) -> Iterator[Boxes]:
    """Yield each page as a box; a page that is missing holds nothing."""
    for number in range(shape[0]):
        try:
            page = series.pages[number]
            values = None if page is None else page.asarray()
        except (OSError, MemoryError):
            raise
        except Exception as error:
            raise _damaged(error) from error
        if values is not None:
            if values.shape != shape[1:]:
                raise FileError(f"page {number} has {values.shape} pixels, not {shape[1:]}")
            yield Boxes(np.array([[number, 0, 0]]), values[None, None])


def _spacing(tif: Any) -> tuple[list[float], str]:
    """Return the sizes of a voxel along pages, rows and columns, and their unit; 1 if unknown."""
    found, units = dict.fromkeys("ZYX", 1.0), ""
    if tif.is_ome:
        pixels = ElementTree.fromstring(tif.ome_metadata).find(".//{*}Pixels")
        if pixels is not None:
            found = {name: float(pixels.get(f"PhysicalSize{name}", 1)) for name in found}
            units = pixels.get("PhysicalSizeXUnit", "")[:64]
    elif tif.is_imagej:
        about = tif.imagej_metadata or {}
        found["Z"] = float(about.get("spacing", 1))
        units = str(about.get("unit", ""))[:64].replace("\\u00B5", "µ")
        for name, tag in (("X", "XResolution"), ("Y", "YResolution")):
            if (resolution := tif.pages[0].tags.get(tag)) and min(resolution.value) > 0:
                found[name] = resolution.value[1] / resolution.value[0]
    return list(found.values()), units
