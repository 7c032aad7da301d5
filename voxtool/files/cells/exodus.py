"""Exodus II: meshes of cells in HDF5 (netCDF-4) or in classic netCDF [Schoof 1994].

Only the variables that are needed are opened. Those that vary in time are read at the first step.
Their bytes are compared with the file and with free memory beforehand.
"""

from __future__ import annotations

import os
import re
import warnings
from importlib import import_module
from math import prod
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from voxtool.errors import FileError, MeshWarning, VoxtoolError, human, one_line
from voxtool.files.cells import netcdf
from voxtool.files.cells.netcdf import Variable
from voxtool.files.storage import hdf5
from voxtool.files.storage.schema import Attribute
from voxtool.files.storage.streams import PACKED
from voxtool.limits import bounded_memory
from voxtool.memory import check_memory

h5py: Any = import_module("h5py")

# Memory that reading may take: a fixed part, and bytes for each byte of the arrays.
FIXED, PER_BYTE = 16 << 20, 4


# The variables that are needed: patterns of names, kinds of numpy's types, numbers of dimensions.
NEEDED: tuple[tuple[str, str, tuple[int, ...]], ...] = (
    (r"coord", "iuf", (2,)),
    (r"coord[xyz]", "iuf", (1,)),
    (r"connect[1-9]\d{0,8}", "iu", (2,)),
    (r"name_(nod|elem)_var", "S", (2,)),
    (r"vals_nod_var([1-9]\d{0,8})?", "iuf", (2, 3)),
    (r"vals_elem_var[1-9]\d{0,8}eb[1-9]\d{0,8}", "iuf", (2,)),
)
IN_TIME = "vals_"  # begins the names of variables whose rows are steps in time
# The kinds of cells by the first letters of their names, as VTK takes them, and the nodes of the
# plain kind. The corners come first, in VTK's order.
KINDS = {
    "TET": ("tetra", 4),
    "HEX": ("hexahedron", 8),
    "WED": ("wedge", 6),
    "PYR": ("pyramid", 5),
    "TRI": ("triangle", 3),
    "QUA": ("quad", 4),
    "SHE": ("quad", 4),
    **dict.fromkeys(("BEA", "BAR", "TRU", "EDG"), ("line", 2)),
    **dict.fromkeys(("SPH", "CIR"), ("vertex", 1)),
}
VECTORS = (("X", "Y", "Z"), ("_R", "_Z"))  # ends of the names of components


class Block(NamedTuple):
    """Cells of one kind, by meshio's name, and the points of each, (N, k) int64 from 0."""

    type: str
    data: np.ndarray


class ExodusMesh(NamedTuple):
    """The content of a file; its fields have the names of meshio's.

    points : (P, 1 to 3) float.
    cells : list of Block.
    point_data : arrays (P,) or (P, k) by name.
    cell_data : for each block an array (N,), or None where it has none, by name.
    """

    points: np.ndarray
    cells: list[Block]
    point_data: dict[str, np.ndarray]
    cell_data: dict[str, list[np.ndarray | None]]


def read(name: str, file: BinaryIO, max_memory: int | None) -> ExodusMesh:
    """Return the mesh in a file that is open at its start; a warning says that others of its time
    steps are not read.

    Raises
    ------
    FileError : the file is damaged, hostile or of another format.
    MemoryLimitError : it takes more memory than is allowed or free.
    """
    size = os.fstat(file.fileno()).st_size
    try:
        if file.read(len(netcdf.MAGIC)) == netcdf.MAGIC:
            variables = netcdf.read_variables(file)
            mesh = _mesh(_needed(variables, size), max_memory)
        else:
            with hdf5.opened(file) as h5:
                with bounded_memory(hdf5.METADATA):
                    variables = _variables(h5)
                mesh = _mesh(_needed(variables, PACKED * size), max_memory)
    except VoxtoolError as error:
        raise type(error)(f"{name}: {error}") from None
    except Exception as error:  # of the library: the file is damaged
        raise FileError(
            f"{name}: not readable as Exodus: {one_line(error)}: it may be damaged: export it again"
        ) from None
    steps = max((v.shape[0] for key, v in variables.items() if key.startswith(IN_TIME)), default=0)
    if steps > 1:
        text = f"{name}: has {steps} time steps, of which the first is read"
        warnings.warn(text, MeshWarning, stacklevel=4)
    return mesh


# ---- variables


def _variables(h5: Any) -> dict[str, Variable]:
    """Return the variables of an HDF5 file that may be needed."""
    names = [key.decode("utf-8", "replace") for key in h5.id]
    return {name: _variable(h5, name) for name in names if _expected(name)}


def _variable(h5: Any, name: str) -> Variable:
    dataset = h5py.Dataset(hdf5.open_dataset(h5, name))
    return Variable(
        dataset.shape or (),
        dataset.dtype,
        prod(dataset.chunks or (0,)) * dataset.dtype.itemsize,
        lambda key: hdf5.read_attribute(dataset, Attribute(key, str, "", netcdf.MOST_LETTERS)),
        lambda count: dataset[:count],
    )


def _expected(name: str) -> tuple[str, tuple[int, ...]] | None:
    """Return the types and numbers of dimensions of a variable that is needed; None for another
    one."""
    found = (rest for pattern, *rest in NEEDED if re.fullmatch(pattern, name))
    return next(found, None)  # pyright: ignore[reportReturnType]


def _needed(variables: dict[str, Variable], most: int) -> dict[str, Variable]:
    """Return the variables that are needed, checked; together they have at most `most` bytes."""
    needed = {}
    for name, found in variables.items():
        expected = _expected(name)
        if expected is None or (name.startswith(IN_TIME) and found.shape[:1] == (0,)):
            continue
        kinds, sides = expected
        if found.dtype.kind not in kinds or (kinds == "S" and found.dtype.itemsize != 1):
            raise FileError(f"{name} has the type {found.dtype}: it is damaged")
        if len(found.shape) not in sides:
            raise FileError(f"{name} has the shape {found.shape}: it is damaged")
        needed[name] = found
    if _bytes(needed) > most:
        size = human(_bytes(needed))
        raise FileError(f"declares {size} that the file cannot hold: it is damaged")
    return needed


def _rows(name: str, variable: Variable) -> int:
    return 1 if name.startswith(IN_TIME) else variable.shape[0]


def _bytes(needed: dict[str, Variable]) -> int:
    """Return the bytes of what is read."""
    return sum(
        max(found.piece, prod((_rows(name, found), *found.shape[1:], found.dtype.itemsize)))
        for name, found in needed.items()
    )


# ---- the mesh


def _mesh(needed: dict[str, Variable], max_memory: int | None) -> ExodusMesh:
    """Return the mesh of checked variables."""
    size = PER_BYTE * _bytes(needed)
    check_memory(size, "its arrays", "free some memory, or raise --max-memory", max_memory)
    with bounded_memory(FIXED + size):
        arrays = {name: found.rows(_rows(name, found)) for name, found in needed.items()}
    arrays |= {name: array[0] for name, array in arrays.items() if name.startswith(IN_TIME)}
    blocks = sorted(int(name[7:]) for name in arrays if name.startswith("connect"))
    cells = [_block(needed[f"connect{k}"], arrays.pop(f"connect{k}")) for k in blocks]
    return ExodusMesh(_points(arrays), cells, _at_points(arrays), _at_cells(arrays, blocks))


def _block(variable: Variable, nodes: np.ndarray) -> Block:
    """Return a block of cells, whose nodes are numbered from 1."""
    name = variable.text("elem_type").strip()
    count = nodes.shape[1]
    kind, plain = KINDS.get(name[:3].upper(), (name.lower(), count))
    points = np.subtract(nodes, 1, dtype=np.int64, casting="unsafe")
    return Block(kind if count == plain else f"{kind}{count}", points)


def _points(arrays: dict[str, np.ndarray]) -> np.ndarray:
    axes = [arrays[name] for name in ("coordx", "coordy", "coordz") if name in arrays]
    axes = [*arrays.get("coord", axes)]
    if not axes:
        raise FileError("has no coordinates (coord, or coordx, coordy and coordz)")
    with np.errstate(invalid="ignore"):  # of signalling NaN
        return np.stack(axes, axis=1)


def _names(arrays: dict[str, np.ndarray], name: str) -> list[str]:
    rows = [row.tobytes().partition(b"\0")[0] for row in arrays.get(name, ())]
    return [row.decode("utf-8", "replace").rstrip() for row in rows]


def _at_points(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays at points: one each, or (in old files) one for all; components joined."""
    table = np.atleast_2d(arrays.get("vals_nod_var", np.empty((0, 0))))
    found = {}
    for number, name in enumerate(_names(arrays, "name_nod_var")):
        if f"vals_nod_var{number + 1}" in arrays:
            found[name] = arrays[f"vals_nod_var{number + 1}"]
        elif number < len(table):
            found[name] = table[number]
    for first, *others in VECTORS:
        for name in [name for name in found if name.endswith(first)]:
            vector = name.removesuffix(first)
            parts = [name, *(vector + end for end in others)]
            if vector and all(part in found for part in parts):
                found[vector] = np.stack([found.pop(part) for part in parts], axis=1)
    return found


def _at_cells(
    arrays: dict[str, np.ndarray], blocks: list[int]
) -> dict[str, list[np.ndarray | None]]:
    """Return the arrays at cells: for each block one, or none."""
    found = {}
    for number, name in enumerate(_names(arrays, "name_elem_var")):
        parts = [arrays.get(f"vals_elem_var{number + 1}eb{block}") for block in blocks]
        if any(part is not None for part in parts):
            found[name] = parts
    return found
