"""OME-Zarr (OME-NGFF 0.4): a pyramid of coverages, each an array of chunks, indexed [z, y, x].

Array 0 has the cells of the image, each further one cells twice as large, until one chunk holds
them all. Values are the share of a cell's voxels that are set; chunks of zeros are not stored. A
transformation places the centre of a cell; the group's attribute GRID has the exact grid. Labels
of voxels are the label image labels/label with names and colours; other attributes are images of
their own in the folder, colours, normals and faces with channels first.
https://ngff.openmicroscopy.org/0.4/
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from voxtool.errors import FileError, VoxtoolError, human, one_line
from voxtool.files.grids.voxels import (
    Boxes,
    Stored,
    check_values,
    exactly,
    frame_of,
    grid_of_text,
    grid_text,
)
from voxtool.files.storage.streams import PACKED
from voxtool.files.storage.unpacked import check_unpacked
from voxtool.memory import check_memory
from voxtool.palette import palette
from voxtool.svo.images.attribute_image import AttributeImage, attributes_of
from voxtool.svo.images.image import VoxelImage

CHUNK = 64  # cells along a side
MOST_CHUNKS = 1 << 22  # that are looked for
CHUNK_FILE = re.compile(r"(/c)?([/.]\d{1,9})+")  # in the folder of an array
GRID = "voxtool_grid"
CHUNK_BYTES, ARRAY_BYTES = 4096, 8192  # of the disk, beyond the values
NAME_BYTES = 200  # bytes of what is said of a label, beyond the letters of its name
# What stores numbers and runs no code; others, such as pickle, are refused.
CODECS = {"blosc", "zstd", "zlib", "gzip", "lz4", "bz2", "lzma", "bytes", "transpose", "crc32c",
          "sharding_indexed", "endian", "shuffle", "bitround", "delta"}  # fmt: skip
UNITS = {"um": "micrometer", "mm": "millimeter", "cm": "centimeter", "m": "meter", "in": "inch",
         "ft": "foot"}  # fmt: skip


def size(image: VoxelImage) -> int:
    """Return the bytes of the folder, in which cells far inside or far outside take few. Coarser
    arrays take a seventh of the finest."""
    each = 8 if image.dtype == np.float64 else 4
    found = 0
    for one in (each, *(attribute.cell_bytes for attribute in attributes_of(image))):
        chunks = prod(-(-n // CHUNK) for n in image.shape)
        finest = one * (image.mixed + image.cells // (PACKED // 4)) + CHUNK_BYTES * chunks
        found += finest * 8 // 7 + ARRAY_BYTES * 20
    return found + sum(NAME_BYTES + 6 * len(n) for a in attributes_of(image) for n in a.names)


def write(image: VoxelImage, folder: Path) -> None:
    """Write the coverages, in float64 if that is the image's dtype, otherwise in float32."""
    import zarr

    dtype = np.float64 if image.dtype == np.float64 else np.float32
    images = list(_pyramid(image.with_dtype(dtype)))
    group: Any = zarr.open_group(str(folder), mode="w", zarr_format=2)
    _write(group, images, images, "coverage")
    for attribute in attributes_of(image):
        # of the cells that hold a set voxel
        levels = [AttributeImage(level, attribute.name) for level in images]
        where = "labels/label" if attribute.names else attribute.name
        own: Any = group.create_group(where)
        _write(own, images, levels, attribute.name)
        if attribute.names:
            group["labels"].attrs.update({"labels": ["label"]})
            own.attrs.update({"image-label": _label_image(attribute.names)})


def _label_image(names: tuple[str, ...]) -> dict[str, Any]:
    """Return what a label image says of its labels."""
    colours = palette(len(names) - 1).tolist()
    return {
        "version": "0.4",
        "colors": [
            {"label-value": number, "rgba": [*colour, 255]}
            for number, colour in enumerate(colours, 1)
        ],
        "properties": [
            {"label-value": number, "name": name} for number, name in enumerate(names) if number
        ],
        "source": {"image": "../../"},
    }


def _write(
    group: Any, images: list[VoxelImage], levels: Sequence[VoxelImage | AttributeImage], name: str
) -> None:
    """Write a pyramid of an image's own values or of an attribute."""
    row = getattr(levels[0], "row", ())
    for number, level in enumerate(levels):
        array: Any = group.create_array(
            str(number), shape=(*row, *level.shape[::-1]), chunks=(*row, *(CHUNK,) * 3),
            dtype=level.dtype, fill_value=0,
            chunk_key_encoding={"name": "v2", "separator": "/"},
        )  # fmt: skip
        _fill(array, images[number], level)
    image = images[0]
    unit = {"unit": UNITS[image.units]} if image.units in UNITS else {}
    datasets = [
        {
            "path": str(number),
            "coordinateTransformations": [
                {"type": "scale", "scale": [*[1.0] * len(row), *level.pitch[::-1]]},
                {
                    "type": "translation",
                    "translation": [*[0.0] * len(row), *_center(level)[::-1]],
                },
            ],
        }
        for number, level in enumerate(images)
    ]
    axes = [{"name": "c", "type": "channel"}] if row else []
    axes += [{"name": axis, "type": "space", **unit} for axis in "zyx"]
    scales = {"version": "0.4", "name": name, "axes": axes, "datasets": datasets}
    group.attrs.update({"multiscales": [scales], GRID: grid_text(image)})


def _pyramid(image: VoxelImage) -> Iterator[VoxelImage]:
    """Yield the image, then cells twice as large, each of all its voxels, until one chunk holds
    them."""
    yield image
    while max(image.shape) > CHUNK and image.level <= image.octree.depth:
        low = tuple(n // 2 for n in image.low)
        high = tuple(-(-(n + m) // 2) for n, m in zip(image.low, image.shape, strict=True))
        shape = tuple(b - a for a, b in zip(low, high, strict=True))
        image = replace(image, level=image.level + 1, low=low, shape=shape)
        image = replace(image, progress=lambda share: None)
        yield image


def _center(image: VoxelImage) -> list[float]:
    """Return the world coordinates of the centre of the first cell."""
    return [o + p / 2 for o, p in zip(image.origin, image.pitch, strict=True)]


def _fill(array: Any, image: VoxelImage, own: VoxelImage | AttributeImage) -> None:
    """Write the cells of an image that are not zero: its values, or those of an attribute."""
    if isinstance(own, AttributeImage):
        _fill_attribute(array, image, own)
        return
    first = np.array(image.low)
    for part in image.parts(least=CHUNK):
        low, high = np.array(part.low), np.add(part.low, part.shape)
        for cubes in part.cubes(CHUNK):
            for corner in cubes.corners - first:
                array[tuple(slice(n, n + cubes.side) for n in corner[::-1].tolist())] = 1
        for blocks in part.blocks(CHUNK):
            for corner, values in zip(*blocks, strict=True):
                start, stop = np.maximum(corner, low), np.minimum(corner + CHUNK, high)
                held = values[tuple(map(slice, start - corner, stop - corner))]
                ends = (start - first)[::-1].tolist(), (stop - first)[::-1].tolist()
                array[tuple(map(slice, *ends))] = held.transpose(2, 1, 0)


def _fill_attribute(array: Any, image: VoxelImage, own: AttributeImage) -> None:
    """Write the values of an attribute."""
    first = np.array(image.low)
    for part in own.parts(least=CHUNK):
        low, high = np.array(part.image.low), np.add(part.image.low, part.image.shape)
        for corners, side, values in part.cubes(CHUNK):
            for corner, value in zip(corners - first, values, strict=True):
                box = tuple(slice(n, n + side) for n in corner[::-1].tolist())
                array[..., *box] = np.broadcast_to(
                    value[..., None, None, None], (*own.row, *(side,) * 3)
                )
        for blocks in part.blocks(CHUNK):
            for corner, values in zip(*blocks, strict=True):
                start, stop = np.maximum(corner, low), np.minimum(corner + CHUNK, high)
                held = values[tuple(map(slice, start - corner, stop - corner))]
                ends = (start - first)[::-1].tolist(), (stop - first)[::-1].tolist()
                array[..., *map(slice, *ends)] = held.T  # channels first, then z, y, x


# ---- in


def read(folder: Path, size: int) -> Stored:
    """Return the voxels of the finest array of the first image."""
    try:
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
            return _read(
                folder, size
            )  # zarr, in a thread of its own, warns of a fill value's overflow
    except (VoxtoolError, OSError, MemoryError):
        raise
    except Exception as error:  # damage shows in any of zarr's errors
        raise _damaged(error) from error


def _damaged(error: Exception) -> FileError:
    return FileError(f"is no OME-Zarr, or damaged: {one_line(error) or type(error).__name__}")


def _read(folder: Path, size: int) -> Stored:
    import zarr

    group: Any = zarr.open_group(str(folder), mode="r")
    attributes = dict(group.attrs)
    scales = dict(attributes.get("ome", attributes))["multiscales"][0]
    array: Any = group[scales["datasets"][0]["path"]]
    axes = [axis["name"] for axis in scales.get("axes", [{"name": n} for n in "tczyx"])]
    if len(axes) != array.ndim or not {*"xyz"} <= {*axes}:
        raise FileError(f"axes {axes}: voxels have x, y and z".replace("'", "")[:99])
    space = [axes.index(name) for name in axes if name in "xyz"]
    if any(n != 1 for axis, n in enumerate(array.shape) if axis not in space):
        raise FileError("it has several times or channels: choose one volume of it")
    shape = tuple(array.shape[axis] for axis in space)
    check_values(array.dtype, shape)
    _check_codecs(array.metadata.to_dict())
    chunks = tuple(array.chunks[axis] for axis in space)
    each = prod(array.chunks) * array.dtype.itemsize
    check_memory(4 * each, f"a chunk of {human(each)}")
    starts, chunks_held = _starts(folder / array.path, array, space)
    check_unpacked(chunks_held * each, size)
    scale, move = _placing(scales, array.ndim)
    matrix = np.zeros((3, 3))
    for column, axis in enumerate(space):
        matrix["xyz".index(axes[axis]), column] = scale[axis]
    center = np.array([move[axes.index(name)] for name in "xyz"])
    frame = exactly(frame_of(shape, matrix, center), grid_of_text(str(attributes.get(GRID, ""))))
    return Stored(frame, _pieces(array, space, starts, chunks), _unit(scales))


def _placing(scales: dict[str, Any], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the scale and the translation of the first array, along its axes."""
    scale, move = np.ones(count), np.zeros(count)
    steps = [
        *scales["datasets"][0].get("coordinateTransformations", []),
        *scales.get("coordinateTransformations", []),
    ]
    for step in steps:
        if step["type"] == "scale":
            scale, move = scale * step["scale"], move * step["scale"]
        elif step["type"] == "translation":
            move = move + step["translation"]
        elif step["type"] != "identity":
            raise FileError("a transformation that is no scale or translation")
    return scale, move


def _unit(scales: dict[str, Any]) -> str:
    """Return the unit of the last axis, by its short name if it has one."""
    unit = str(scales.get("axes", [{}])[-1].get("unit", ""))
    return next((short for short, name in UNITS.items() if name == unit), unit)[:64]


def _check_codecs(about: Any) -> None:
    """Raise FileError if a chunk would be decoded by something else than CODECS."""
    found: list[Any] = [about.get("compressor"), *(about.get("filters") or [])]
    found += about.get("codecs") or []
    for codec in found:
        if codec is None:
            continue
        codec = codec if isinstance(codec, dict) else codec.get_config()
        name = str(codec.get("id", codec.get("name", "")))
        if name not in CODECS:
            raise FileError(f"its chunks are coded as {name[:40]!r}, which is not decoded here")
        _check_codecs(codec.get("configuration") or {})


def _starts(folder: Path, array: Any, space: list[int]) -> tuple[Iterable[tuple[int, ...]], int]:
    """Return the low cells of the chunks that may hold something, and their number: those of the
    files in the array's folder, or all chunks if missing ones are not 0."""
    shape, chunks = ([sizes[axis] for axis in space] for sizes in (array.shape, array.chunks))
    whole = [array.shards[axis] for axis in space] if array.shards else chunks  # of a file
    if array.fill_value:
        files, whole = [(0,) * len(shape)], shape
    else:
        indices = (
            CHUNK_FILE.fullmatch(f"/{path.relative_to(folder)}") for path in folder.rglob("*")
        )
        found = (re.findall(r"\d+", index[0]) for index in indices if index)
        places = [[int(i[axis]) for axis in space] for i in found if len(i) == array.ndim]
        files = sorted(tuple(np.multiply(place, whole).tolist()) for place in places)
    count = len(files) * prod(-(-n // c) for n, c in zip(whole, chunks, strict=True))
    if count > MOST_CHUNKS:
        raise FileError(f"it has more than {MOST_CHUNKS:,} chunks: store larger ones")
    sizes = list(zip(whole, shape, chunks, strict=True))
    return (
        start
        for low in files
        for start in product(
            *(range(a, min(a + w, n), c) for a, (w, n, c) in zip(low, sizes, strict=True))
        )
    ), count


def _pieces(
    array: Any, space: list[int], starts: Iterable[tuple[int, ...]], chunks: tuple[int, ...]
) -> Iterator[Boxes]:
    """Yield each chunk as a box."""
    for start in starts:
        chosen: list[Any] = [0] * array.ndim
        for axis, low, side in zip(space, start, chunks, strict=True):
            chosen[axis] = slice(low, low + side)
        try:
            values = np.asarray(array[tuple(chosen)])
        except (OSError, MemoryError):
            raise
        except Exception as error:
            raise _damaged(error) from error
        yield Boxes(np.array([start]), values[None])
