"""The voxels of a HyperTreeGrid of VTKHDF: see vtkhdf.py."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from voxtool.errors import FileError
from voxtool.files.grids.voxels import Boxes, Cubes, Frame, Stored
from voxtool.files.storage import hdf5
from voxtool.files.storage.streams import PACKED
from voxtool.grid import MAX_DIM, Grid
from voxtool.limits import bounded_memory
from voxtool.memory import check_memory

COVERAGE = "coverage"
OCTANTS = np.indices((2, 2, 2)).reshape(3, -1).T[:, ::-1]  # x runs fastest
SMALL = 8  # cells of more voxels a side are passed on as cubes, by their values
BOXES = 1 << 16  # boxes that are passed on at once

h5py: Any = hdf5.h5py


class Tree(NamedTuple):
    """The trees of a file, their cells in the order of the file."""

    roots: tuple[int, int, int]  # trees along each axis
    ids: np.ndarray  # (t,) places of the trees, x fastest
    depths: np.ndarray  # (t,) their depths
    cells: np.ndarray  # the cells of each depth of each tree
    refined: np.ndarray  # bits of all cells but those of each tree's last depth
    masked: np.ndarray  # bits of all cells, or empty
    values: np.ndarray
    side: int  # voxels along a side of a tree


def read(file: BinaryIO, size: int) -> Stored:
    """Return the voxels of the cell array `coverage`, or of the only one."""
    try:
        with hdf5.opened(file) as h5:
            with bounded_memory(hdf5.METADATA):
                group = _group(h5, "VTKHDF")
            frame, tree = _tree(group, size)
    except (KeyError, RuntimeError, TypeError, OSError) as error:  # of the library
        raise FileError(f"damaged .vtkhdf: {str(error)[:160]}") from None
    return Stored(frame, _pieces(tree))


def _tree(group: Any, size: int) -> tuple[Frame, Tree]:
    """Return the place of the voxels and the trees."""
    kind = group.attrs.get("Type", b"")
    if bytes(kind).rstrip(b"\0") != b"HyperTreeGrid":
        raise FileError("is no HyperTreeGrid: voxels are read from that type of .vtkhdf alone")
    if _attribute(group, "BranchFactor", 1)[0] != 2 or group.attrs.get("TransposedRootIndexing"):
        raise FileError("its trees have no 2 x 2 x 2 children, or are transposed")
    lines = [_array(group, f"{axis}Coordinates", size) for axis in "XYZ"]
    if any(len(line) < 2 for line in lines):
        raise FileError("a grid of two dimensions: voxels have three")
    if [len(line) for line in lines] != _attribute(group, "Dimensions", 3).tolist():
        raise FileError("its coordinates do not fit its dimensions")
    ids, depths = (_whole(group, name, size) for name in ("TreeIds", "DepthPerTree"))
    cells = _whole(group, "NumberOfCellsPerTreeDepth", size)
    total = _check_counts(group, ids, depths, cells, lines, size)
    depth = int(depths.max(initial=1))
    frame, side = _frame(group, lines, 1 << (depth - 1))
    refined, masked = (_bits(group, name, size) for name in ("Descriptors", "Mask"))
    if 0 < len(masked) < total:
        raise FileError("its mask holds too few bits")
    values = _values(_group(group, "CellData"), total, size)
    a, b, c = (len(line) - 1 for line in lines)
    return frame, Tree((a, b, c), ids, depths, cells, refined, masked, values, side)


def _check_counts(
    group: Any,
    ids: np.ndarray,
    depths: np.ndarray,
    cells: np.ndarray,
    lines: list[np.ndarray],
    size: int,
) -> int:
    """Return the number of all cells; FileError if the counts of a file contradict each other."""
    if len(_whole(group, "NumberOfTrees", size)) != 1:
        raise FileError("it is in several parts: write it as one")
    most = MAX_DIM.bit_length() + 1
    if len(ids) != len(depths) or (depths < 1).any() or (depths > most).any():
        raise FileError(f"its trees and their depths, from 1 to {most}, do not fit each other")
    roots = math.prod(len(line) - 1 for line in lines)
    if (ids < 0).any() or (ids >= roots).any() or depths.sum() != len(cells):
        raise FileError("its trees are not in its grid, or their depths not those of its cells")
    if (cells < 0).any() or (cells > PACKED * size).any():
        raise FileError("it counts more cells than the file can hold")
    return int(cells.sum())


def _frame(group: Any, lines: list[np.ndarray], side: int) -> tuple[Frame, int]:
    """Return the place of the voxels, and the number of them along a side of a tree, `side` unless
    voxtool's own attributes say more."""
    for line in lines:
        steps = np.diff(line)
        if not (np.isfinite(line).all() and (np.abs(steps - steps[0]) <= 1e-6 * steps[0]).all()):
            raise FileError("its trees are not equal in size along an axis: resample it first")
    low = np.array([line[0] for line in lines])
    length = np.array([line[1] - line[0] for line in lines])
    if "voxtool_pitch" in group.attrs:
        pitch, origin = (_attribute(group, f"voxtool_{name}", 3) for name in ("pitch", "origin"))
        shape = _attribute(group, "voxtool_shape", 3)
        with np.errstate(all="ignore"):
            whole = np.rint(length / pitch)
            same = np.allclose(pitch * whole, length) and np.allclose(low, origin)
        if same and (whole == whole[0]).all() and math.log2(whole[0]).is_integer():
            place = [tuple(values.tolist()) for values in (shape, origin, pitch)]
            return Frame(Grid(*place)), int(whole[0])  # pyright: ignore
    shape = [(len(line) - 1) * side for line in lines]
    place = [tuple(values) for values in (shape, low.tolist(), (length / side).tolist())]
    return Frame(Grid(*place)), side  # pyright: ignore


# ---- its arrays, which are not trusted


def _group(parent: Any, name: str) -> Any:
    link = parent.get(name, getlink=True) if name in iter(parent) else None
    if not isinstance(link, h5py.HardLink) or parent.get(name, getclass=True) is not h5py.Group:
        raise FileError(f"holds no group {name}: expected a HyperTreeGrid of VTKHDF")
    return parent[name]


def _attribute(group: Any, name: str, count: int) -> np.ndarray:
    if name not in group.attrs or group.attrs.get_id(name).shape not in ((), (count,)):
        raise FileError(f"its attribute {name} is missing, or is not {count} numbers")
    return np.atleast_1d(group.attrs[name])


def _array(group: Any, name: str, size: int) -> np.ndarray:
    """Return an array of numbers of one axis."""
    dataset = hdf5.open_dataset(group, name)
    if len(dataset.shape) != 1 or dataset.dtype.kind not in "iuf" or dataset.dtype.itemsize > 8:
        raise FileError(f"dataset {name} is no list of numbers")
    needed = dataset.shape[0] * dataset.dtype.itemsize
    stored = dataset.get_storage_size()
    if stored > size or needed > PACKED * stored:
        raise FileError(f"dataset {name} needs {needed} bytes that the file does not have")
    check_memory(2 * needed, f"dataset {name}", "choose a smaller file")
    return hdf5.load(dataset)


def _whole(group: Any, name: str, size: int) -> np.ndarray:
    values = _array(group, name, size)
    if values.dtype.kind == "f":
        raise FileError(f"dataset {name} is not of whole numbers")
    return values.astype(np.int64)


def _bits(group: Any, name: str, size: int) -> np.ndarray:
    """Return the bits of a dataset, the highest of a byte first; none if it is missing."""
    if name == "Mask" and name not in iter(group):
        return np.empty(0, np.uint8)
    return np.unpackbits(_array(group, name, size).astype(np.uint8))


def _values(data: Any, total: int, size: int) -> np.ndarray:
    names = list(data.keys())
    name = COVERAGE if COVERAGE in names else names[0] if len(names) == 1 else ""
    if not name:
        raise FileError(f"holds {len(names)} cell arrays: name one of them {COVERAGE}")
    values = _array(data, name, size)
    if len(values) != total:
        raise FileError(f"its array {name[:40]} holds {len(values)} values for {total} cells")
    return values


# ---- the voxels


def _pieces(tree: Tree) -> Iterator[Boxes | Cubes]:
    """Yield the leaves of all trees."""
    bit = cell = row = 0
    for number, depth in zip(tree.ids.tolist(), tree.depths.tolist(), strict=True):
        a, b, _ = tree.roots
        corners = np.array([[number % a, number // a % b, number // (a * b)]])
        side = tree.side
        for level in range(depth):
            count, wanted = int(tree.cells[row + level]), len(corners)
            if count != wanted or cell + count > len(tree.values):
                raise FileError(f"a depth has {count} cells where {wanted} are expected")
            last = level == depth - 1
            bits = np.zeros(count, np.uint8) if last else tree.refined[bit : bit + count]
            if len(bits) < count:
                raise FileError("its descriptors hold too few bits")
            here = slice(cell, cell + count)
            leaves = bits == 0
            if len(tree.masked):
                leaves &= tree.masked[here] == 0
            yield from _leaves(corners[leaves] * side, tree.values[here][leaves], side)
            cell, bit = cell + count, bit + (0 if last else count)
            if not last and (side := side // 2) < 1:
                raise FileError("its trees are deeper than its voxels")
            check_memory(8 * 24 * int(bits.sum(dtype=np.int64)), "the cells of a depth")
            corners = (2 * corners[bits != 0, None] + OCTANTS).reshape(-1, 3)
        row += depth


def _leaves(corners: np.ndarray, values: np.ndarray, side: int) -> Iterator[Boxes | Cubes]:
    """Yield leaves of one size, given by their low voxels."""
    if side > SMALL:
        yield Cubes(corners, side, values)
        return
    for first in range(0, len(corners), BOXES):
        chosen = slice(first, first + BOXES)
        found = values[chosen, None, None, None]
        yield Boxes(corners[chosen], np.broadcast_to(found, (len(found), side, side, side)))
