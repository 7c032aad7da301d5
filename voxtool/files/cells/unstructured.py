"""Unstructured meshes of volume cells with a scalar: Exodus, and what meshio reads (the extra
`tets`).

exodus.py and through_meshio.py guard against hostile files. voxtool.tets.volume.mesh, which any
mesh passes, checks the cells and the scalars themselves.
"""

from __future__ import annotations

import hashlib
import os
from math import prod
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.arrays import float64
from voxtool.errors import FileError, count_of, printable
from voxtool.files.cells import exodus
from voxtool.files.cells.through_meshio import read_mesh
from voxtool.files.formats import VOLUME_FORMATS
from voxtool.files.storage.streams import STREAM, PathLike, read_error
from voxtool.tets.volume.mesh import UnstructuredMesh, is_volume

if TYPE_CHECKING:
    from typing import BinaryIO

AXES = ("x", "y", "z")
MAGNITUDE = "magnitude"
SHOWN, LETTERS = 20, 60  # names, at most, that a message lists, and letters of each


def read(
    path: PathLike, scalar: str | None, component: str | int | None, max_memory: int | None = None
) -> UnstructuredMesh:
    """Return the unstructured mesh of a file and one of its arrays; see
    voxtool.read_unstructured."""
    if path == STREAM:
        raise FileError("a volume cannot be read from stdin: name a file, such as mesh.vtu")
    path = os.fspath(path)
    name = printable(PurePath(path).name)
    try:
        with open(path, "rb") as file:
            if not os.fstat(file.fileno()).st_size:
                raise FileError(f"{name} is empty")
            kind = _kind(name, file)
            file.seek(0)
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            file.seek(0)
            if kind == "exodus":
                found = exodus.read(name, file, max_memory)
            else:
                found = read_mesh(name, path, kind, max_memory)
    except OSError as error:
        raise read_error(name, error) from error
    points = float64(found.points)
    if points.ndim == 2 and points.shape[1] == 2:
        points = np.pad(points, ((0, 0), (0, 1)))
    chosen, parts, at_points = _array(name, found, scalar)
    arrays = parts if at_points else _complete(name, chosen, parts, found.cells)
    numbers, label = _scalars(name, chosen, arrays, component)
    return UnstructuredMesh(
        points,
        [(block.type, np.asarray(block.data)) for block in found.cells],
        numbers[0] if at_points else numbers,
        label,
        source_sha256=digest,
        name=name,
    )


def _kind(name: str, file: BinaryIO) -> str:
    """Return the name that meshio has for the format of a file."""
    extension = PurePath(name).suffix.lower()
    if name.lower().endswith((".tet.h5", ".svo.h5", ".adf.h5")):
        raise FileError(f"{name} is no mesh: name the file that it was made from")
    if extension not in VOLUME_FORMATS:
        known = ", ".join(VOLUME_FORMATS)
        raise FileError(f"{name}: no mesh of volume cells has this ending: give one of {known}")
    kind = VOLUME_FORMATS[extension]
    if kind == "abaqus" and not file.read(4096).lstrip().startswith(b"*"):
        return "avsucd"  # the same ending
    return kind


# ---- arrays


def _array(name: str, read: Any, scalar: str | None) -> tuple[str, list[np.ndarray], bool]:
    """Return the name of the array, its parts, and whether it is one at points."""
    arrays = {key: (list(parts), False) for key, parts in read.cell_data.items()}
    arrays |= {key: ([values], True) for key, values in read.point_data.items()}
    there = _listed([printable(key) for key in sorted(arrays)], ", ")
    if not arrays:
        raise FileError(f"{name}: holds no arrays, only cells: export it with its scalars")
    if scalar is None and len(arrays) > 1:
        raise FileError(f"{name}: which array? Name one of {there} (--scalar)")
    chosen = next(iter(arrays)) if scalar is None else scalar
    if chosen not in arrays:
        raise FileError(f"{name}: has no array {chosen!r}: name one of {there} (--scalar)")
    return printable(chosen), *arrays[chosen]


def _complete(name: str, chosen: str, parts: list[Any], blocks: list[Any]) -> list[np.ndarray]:
    """Return the parts of an array, zeros for those blocks of flat cells that have none."""
    for number, (part, block) in enumerate(zip(parts, blocks, strict=True), 1):
        if part is None and is_volume(block.type, block.data):
            raise FileError(
                f"{name}: {chosen} has no values for block {number} of the cells "
                f"({count_of(len(block.data), f'{block.type} cell')}): leave the block out, or "
                "name another array (--scalar)"
            )
    return [
        np.zeros(len(block.data)) if part is None else part
        for part, block in zip(parts, blocks, strict=True)
    ]


def _scalars(
    name: str, chosen: str, arrays: list[np.ndarray], component: str | int | None
) -> tuple[list[np.ndarray], str]:
    """Return one float64 an item of the arrays, which are the parts of one; and what they are
    called."""
    arrays = [np.asarray(array) for array in arrays]
    if any(array.dtype.kind not in "biuf" for array in arrays):
        raise FileError(f"{name}: {chosen} holds no real numbers ({arrays[0].dtype})")
    rows = [float64(array.reshape(len(array), prod(array.shape[1:]))) for array in arrays]
    count = max((array.shape[1] for array in rows if len(array)), default=1)
    if any(array.shape[1] != count for array in rows if len(array)):
        raise FileError(f"{name}: {chosen} has not the same number of components everywhere")
    if count == 1:
        if component is not None:
            raise FileError(f"{name}: {chosen} is a scalar: leave --component out")
        return [array.reshape(-1) for array in rows], chosen
    named = [*AXES[: count if count <= len(AXES) else 0], *map(str, range(count)), MAGNITUDE]
    if component is None or str(component) not in named:
        asked = "which component" if component is None else f"no component {component!r}"
        names = _listed(named, "|")
        raise FileError(f"{name}: {chosen} has {count} components, {asked}: --component {names}")
    label = f"{chosen} {component}"
    if component == MAGNITUDE:
        return [np.sqrt(sum(column * column for column in array.T)) for array in rows], label
    column = AXES.index(component) if component in AXES else int(component)
    return [array[:, column] if len(array) else array[:, 0] for array in rows], label


def _listed(names: list[str], between: str) -> str:
    """Return the names in a message, the beginnings of long ones: the first and the last of
    many."""
    few = names if len(names) <= SHOWN else [*names[: SHOWN - 2], "...", names[-1]]
    return between.join(name[:LETTERS] for name in few)
