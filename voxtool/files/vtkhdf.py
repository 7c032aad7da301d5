"""Octrees as a HyperTreeGrid of VTKHDF, .vtkhdf, which ParaView opens; by h5py alone.

The tree of the file is that of the octree, one tree of 2 x 2 x 2 children, which goes on in mixed
bricks down to the cells of the image; uniform bricks are leaves. The cell array `coverage` is 0
where a cell is empty, 255 where it is wholly set and from 1 to 254 between (an image of float32:
the share); `inside` is 1 where a cell is wholly set. Empty leaves are masked. The attributes
voxtool_shape, voxtool_origin and voxtool_pitch of the group hold the grid without rounding.
https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/ (HyperTreeGrid, version 2.4)
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.files.vtkhdf_read import COVERAGE
from voxtool.files.vtkhdf_read import read as read
from voxtool.grid import Grid
from voxtool.svo.collect import Collector
from voxtool.svo.content import OctreeContent
from voxtool.svo.counts import Counts, counts_of
from voxtool.svo.image import VoxelImage
from voxtool.svo.octree import Octree
from voxtool.svo.prune import ALL_VOXELS

VERSION = (2, 4)
CHUNK = 1 << 20  # values of a chunk of a dataset
DEFLATE = 4  # zlib's level: a tenth more bytes than by VTK's 5, in two thirds of the time
BRICKS = 1 << 18  # bricks that are unpacked at once
EXTRA = 1 << 16  # bytes of the structure of the file
FULL = 255  # the coverage of a cell that is wholly set
COARSEST_IN_BRICKS = 2  # the level of bricks as cells


class Cells(NamedTuple):
    """Some cells of one depth, in the order of the file."""

    counts: np.ndarray  # (n,) voxels that are set
    most: int  # voxels of a cell
    refined: np.ndarray | None  # (n,) bool, whether they have children; None in the last depth


def size(image: VoxelImage) -> int:
    """A bound of the bytes of the file."""
    source = _source(image)
    cells = sum(cells_by_depth(source.octree, source.level))
    return EXTRA + cells * (1 + source.values.itemsize) + cells // 4 + 4 * CHUNK


def write(image: VoxelImage, file: BinaryIO) -> None:
    """Write the octree of an image."""
    import h5py

    octree, level, values = _source(image)
    sizes = cells_by_depth(octree, level)
    total = sum(sizes)
    with h5py.File(file, "w") as h5:
        group: Any = h5.create_group("VTKHDF")
        _describe(group, octree, level, sizes)
        data = group.create_group("CellData")
        arrays = [_Stream(data, COVERAGE, total, values), _Stream(data, "inside", total, "u1")]
        refined, masked = [], []
        done = 0
        for cells in depths_of(octree, level):
            arrays[0].add(_coverage(cells, values))
            arrays[1].add((cells.counts == cells.most).view(np.uint8))
            masked.append(_packed(cells.counts == 0))
            if cells.refined is not None:
                refined.append(_packed(cells.refined))
            done += len(cells.counts)
            image.progress(done / total)
        for array in arrays:
            array.close()
        inner = total - sizes[-1]  # the last depth has no children
        _pack(group, "Descriptors", _joined(refined, inner))
        group["DescriptorsSize"] = np.array([inner], "<i8")
        _pack(group, "Mask", _joined(masked, total))


class _Source(NamedTuple):
    octree: OctreeContent
    level: int
    values: np.dtype  # of the coverage


def _source(image: VoxelImage) -> _Source:
    """Return the octree of an image, the level of its cells and the type of their coverage."""
    whole = image.shape == image.all_cells and not image.invert
    if image.dtype == bool:
        if whole and image.level == 0:
            return _Source(image.octree, 0, np.dtype("u1"))
        return _Source(_octree_of(image), 0, np.dtype("u1"))
    if image.dtype != np.float32 or not whole:
        raise VoxtoolError(
            ".vtkhdf holds a part or what is not set as bool, and coverage as float32 of the whole "
            "grid: choose --dtype bool"
        )
    return _Source(image.octree, image.level, np.dtype("<f4"))


def _octree_of(image: VoxelImage) -> Octree:
    """Return the octree of the cells that are set, with the grid of the image."""
    collector = Collector(Grid(image.shape, image.origin, image.pitch))
    for cells in image.coordinates():
        collector.add_cubes(cells.astype(np.int64), 1)
    return replace(collector.octree(image.units), transform=image.octree.transform)


def _describe(group: Any, octree: OctreeContent, level: int, sizes: list[int]) -> None:
    """Write what the group says of the tree; `sizes` counts the cells by depth."""
    grid = octree.grid
    group.attrs.create("Version", VERSION, dtype="<i8")
    group.attrs.create("Type", np.bytes_("HyperTreeGrid"))
    group.attrs.create("BranchFactor", 2, dtype="<i8")
    group.attrs.create("Dimensions", [2, 2, 2], dtype="<i4")
    for name, low, pitch in zip("XYZ", grid.origin, grid.pitch, strict=True):
        group[f"{name}Coordinates"] = np.array([low, low + grid.side * pitch], "<f8")
    group["NumberOfCellsPerTreeDepth"] = np.array(sizes, "<i8")
    whole = {"NumberOfTrees": 1, "TreeIds": 0, "DepthPerTree": len(sizes)}
    for name, value in {**whole, "NumberOfDepths": len(sizes), "NumberOfCells": sum(sizes)}.items():
        group[name] = np.array([value], "<i8")
    side = 1 << level
    shape = [-(-n // side) for n in grid.shape]
    group.attrs.create("voxtool_shape", shape, dtype="<i8")
    group.attrs.create("voxtool_origin", grid.origin, dtype="<f8")
    group.attrs.create("voxtool_pitch", [p * side for p in grid.pitch], dtype="<f8")
    if octree.transform:
        group.attrs.create("voxtool_transform", octree.transform, dtype="<f8")


# ---- the cells


def cells_by_depth(octree: OctreeContent, level: int) -> list[int]:
    """Return the number of cells of each depth, from the root down to those of 2**level voxels."""
    nodes = np.diff(octree.offsets).astype(np.int64).tolist()
    if level >= COARSEST_IN_BRICKS:
        return nodes[: len(nodes) - (level - COARSEST_IN_BRICKS)]
    mixed, parts = 0, 0
    for bricks in _mixed(octree):
        mixed += len(bricks)
        if level == 0:
            eighths = bricks.view(np.uint8)
            parts += int(np.count_nonzero((eighths != 0) & (eighths != 255)))
    sizes = [*nodes, 8 * mixed, *([8 * parts] if level == 0 else [])]
    return [n for n in sizes if n]


def depths_of(octree: OctreeContent, level: int) -> Iterator[Cells]:
    """Yield the cells from the root down to those of 2**level voxels, a depth in one piece or more
    of 8 n cells."""
    counts = Counts(octree, 0) if isinstance(octree, Octree) else counts_of(octree, level)
    last = max(level - COARSEST_IN_BRICKS, 0)
    for nodes in counts.levels[:last:-1]:
        yield Cells(counts.of_nodes[nodes.number], nodes.side**3, nodes.refined)
    if level >= COARSEST_IN_BRICKS:
        yield Cells(counts.of_nodes[last], counts.levels[last].side ** 3, None)
        return
    assert isinstance(octree, Octree)
    sizes = len(cells_by_depth(octree, level)) - octree.depth
    for bricks in _pieces(octree.bricks):
        refined = (bricks != 0) & (bricks != ALL_VOXELS)
        yield Cells(np.bitwise_count(bricks), 64, refined if sizes else None)
    for bricks in _mixed(octree) if sizes else ():
        eighths = bricks.view(np.uint8)
        refined = (eighths != 0) & (eighths != 255)
        yield Cells(np.bitwise_count(eighths), 8, refined if sizes > 1 else None)
    for bricks in _mixed(octree) if sizes > 1 else ():
        eighths = bricks.view(np.uint8)
        eighths = eighths[(eighths != 0) & (eighths != 255)]
        yield Cells(np.unpackbits(eighths, bitorder="little"), 1, None)


def _pieces(bricks: np.ndarray) -> Iterator[np.ndarray]:
    for first in range(0, len(bricks), BRICKS):
        yield bricks[first : first + BRICKS]


def _mixed(octree: OctreeContent) -> Iterator[np.ndarray]:
    """Yield the bricks that are neither empty nor full."""
    for bricks in _pieces(octree.bricks):
        yield bricks[(bricks != 0) & (bricks != ALL_VOXELS)]


def _coverage(cells: Cells, dtype: np.dtype) -> np.ndarray:
    """Return the values of the array `coverage`."""
    if dtype.kind == "f":
        return (cells.counts / dtype.type(cells.most)).astype(dtype)
    if cells.most == 1:
        return cells.counts * np.uint8(FULL)
    counts = cells.counts.astype(np.int64)
    shares = np.clip((counts * FULL + cells.most // 2) // cells.most, 1, FULL - 1)
    shares[counts == 0] = 0
    shares[counts == cells.most] = FULL
    return shares.astype(np.uint8)


# ---- the file


def _packed(bits: np.ndarray) -> bytes:
    """Return bits, the first one highest; those of the root, which is alone, in the last place."""
    return np.packbits(np.pad(bits, (-len(bits) % 8, 0))).tobytes()


def _joined(parts: list[bytes], count: int) -> np.ndarray:
    """Return the bits of all depths as a dataset holds them: after the root's there is no gap."""
    packed = np.frombuffer(b"".join(parts) + bytes(1), np.uint8)
    return (packed << 7 | np.roll(packed, -1) >> 1)[: -(-count // 8)]


def _pack(group: Any, name: str, values: np.ndarray) -> None:
    """Write a dataset of one axis, deflated unless it is empty."""
    packed = {"compression": "gzip", "compression_opts": DEFLATE} if len(values) else {}
    group.create_dataset(name, data=values, **packed)


class _Stream:
    """A dataset of one axis whose chunks are packed by other threads while others are made."""

    def __init__(self, group: Any, name: str, count: int, dtype: Any) -> None:
        self.chunk = min(CHUNK, count)
        self.dataset = group.create_dataset(
            name,
            (count,),
            dtype,
            chunks=(self.chunk,),
            compression="gzip",
            compression_opts=DEFLATE,
        )
        self._kept: list[np.ndarray] = []
        self._length = 0
        self._pool = ThreadPoolExecutor(2)
        self._packing: list[Future[bytes]] = []
        self._written = 0

    def add(self, values: np.ndarray) -> None:
        """Append values."""
        self._kept.append(values)
        self._length += len(values)
        if self._length >= self.chunk:
            whole = np.concatenate(self._kept)
            for first in range(0, len(whole) - self.chunk + 1, self.chunk):
                self._pack(whole[first : first + self.chunk])
            self._kept = [whole[len(whole) // self.chunk * self.chunk :].copy()]
            self._length = len(self._kept[0])
            self._write()

    def close(self) -> None:
        """Write what is left."""
        rest = np.concatenate(self._kept)
        if len(rest):
            self._pack(np.pad(rest, (0, self.chunk - len(rest))))
        self._write()
        self._pool.shutdown()

    def _pack(self, values: np.ndarray) -> None:
        self._packing.append(self._pool.submit(zlib.compress, values.tobytes(), DEFLATE))

    def _write(self) -> None:
        for packing in self._packing:
            self.dataset.id.write_direct_chunk((self._written,), packing.result())
            self._written += self.chunk
        self._packing = []
