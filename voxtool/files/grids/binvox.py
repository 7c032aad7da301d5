"""binvox: a cube of voxels in runs, y fastest, then z, then x.

The centre of voxel i lies at scale (i + 1/2) / side + translate. A grid that is no cube is exported
as one, with empty voxels at the high ends; voxels must be cubes.
https://www.patrickmin.com/binvox/binvox.html
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from voxtool.errors import FileError, shown
from voxtool.files.grids.voxels import Boxes, Frame, Stored, check_length
from voxtool.files.storage.text_numbers import real
from voxtool.grid import Grid
from voxtool.memory import check_memory
from voxtool.svo.images.image import VoxelImage

HEADER = 256  # bytes of the header, at most
RUN = 255  # voxels of the longest run
ORDER = (0, 2, 1)  # of axes, slow to fast
PAIRS = 1 << 15  # runs that are read at once


def size(image: VoxelImage) -> int:
    """Return the bytes of the file, of which a mixed cell begins a run at most; FileError if voxels
    are no cubes."""
    if len(set(image.pitch)) > 1:
        raise FileError(
            "a .binvox has voxels of equal sides, and these have not: choose another format"
        )
    side = max(image.shape)
    return HEADER + 2 * (side**3 // RUN + side**2) + 2 * image.mixed


def write(image: VoxelImage, file: BinaryIO) -> None:
    """Write the cells as runs."""
    image = image.with_dtype(bool)
    side = max(image.shape)
    lines = (
        "#binvox 1",
        f"dim {side} {side} {side}",
        f"translate {' '.join(map(repr, image.origin))}",
        f"scale {_scale(image.pitch[0], side)!r}",
        "data",
        "",
    )
    file.write("\n".join(lines).encode())
    value, length = False, 0
    for layers in _padded(image, side):
        flat = layers.ravel()
        starts = np.flatnonzero(flat[1:] != flat[:-1]) + 1
        bounds = np.concatenate([[0], starts, [len(flat)]])
        values, lengths = flat[bounds[:-1]], np.diff(bounds)
        if values[0] == value:
            lengths[0] += length
        else:
            values, lengths = np.append(value, values), np.append(length, lengths)
        _write_runs(file, values[:-1], lengths[:-1])
        value, length = bool(values[-1]), int(lengths[-1])
    _write_runs(file, np.array([value]), np.array([length]))


def _scale(pitch: float, side: int) -> float:
    """Return the scale that, divided by the side, gives the size of a voxel, if there is one."""
    near = pitch * side
    both = (near, np.nextafter(near, 0), np.nextafter(near, np.inf))
    return float(next((scale for scale in both if scale / side == pitch), near))


def _padded(image: VoxelImage, side: int) -> Iterator[np.ndarray]:
    """Yield the layers along x of the cube."""
    check_memory(4 * side * side, f"layers of {side} x {side} cells")
    count = 0
    for slab in image.slabs(ORDER):
        count += len(slab)
        yield np.pad(slab, [(0, 0), *((0, side - n) for n in slab.shape[1:])])
    for _ in range(count, side):
        yield np.zeros((1, side, side), bool)


def _write_runs(file: BinaryIO, values: np.ndarray, lengths: np.ndarray) -> None:
    """Write runs of any length as pairs of a value and at most RUN voxels."""
    pairs = -(-lengths // RUN)
    found = np.full((int(pairs.sum()), 2), RUN, np.uint8)
    found[:, 0] = np.repeat(values, pairs)
    ends = np.cumsum(pairs)[pairs > 0] - 1
    found[ends, 1] = ((lengths - 1) % RUN + 1)[pairs > 0]
    file.write(found.data)


def read(file: BinaryIO, size: int) -> Stored:
    """Return the voxels of runs; they fill the unit cube if there is no translate and scale."""
    if not file.readline(64).startswith(b"#binvox "):
        raise FileError("is no .binvox file")
    found = {"translate": [0.0] * 3, "scale": [1.0], "dim": [0.0] * 3}
    while (line := file.readline(HEADER)).strip() != b"data":
        name, *words = line.decode("ascii", "replace").split() or [""]
        if name.startswith("#"):
            continue
        if name not in found or len(words) != len(found[name]):
            raise FileError(f"a header line that is unknown: {shown(line)}")
        found[name] = [real(word) for word in words]
    (scale,) = found["scale"]
    a, b, c = found["dim"]
    if not a == b == c or not a.is_integer():
        raise FileError(f"dim {a:g} {b:g} {c:g}: a .binvox is a cube of whole voxels")
    a = int(a)
    x, y, z = found["translate"]
    pitch = scale / max(a, 1)
    frame = Frame(Grid((a, a, a), (x, y, z), (pitch, pitch, pitch)), ORDER)
    check_length(-(-(a**3) // RUN) * 2, size - file.tell())
    return Stored(frame, _pieces(file, a))


def _pieces(file: BinaryIO, side: int) -> Iterator[Boxes]:
    """Yield the layers along x."""
    check_memory(8 * side * side, f"layers of {side} x {side} voxels")
    parts: list[np.ndarray] = []
    held = first = 0
    while first < side:
        data = np.frombuffer(file.read(2 * PAIRS), np.uint8)
        if len(data) % 2 or not len(data):
            raise FileError("it ends before its runs fill its cube")
        parts.append(np.repeat(data[::2], data[1::2]))
        held += len(parts[-1])
        layers = min(held // side**2, side - first)
        if first + layers < side:
            layers -= layers % 4
        if layers:
            flat = np.concatenate(parts)
            cut = layers * side**2
            corner = np.array([[first, 0, 0]])
            yield Boxes(corner, flat[:cut].reshape(1, layers, side, side))
            parts, held, first = [flat[cut:]], held - cut, first + layers
    if held:
        raise FileError("its runs are longer than its cube")
