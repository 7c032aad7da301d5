"""Octrees as a HyperTreeGrid of VTKHDF, .vtkhdf, which ParaView opens; by h5py alone.

The tree of the file is that of the octree, one tree of 2 x 2 x 2 children, which goes on in mixed
bricks down to the cells of the image; uniform bricks are leaves. The cell array `coverage` is 0
where a cell is empty, 255 where it is wholly set and from 1 to 254 between (an image of float32:
the share); `inside` is 1 where a cell is wholly set. Attributes of voxels are cell arrays of their
own; where they differ, full bricks have children, too. The names of labels are the field data
`label_names`. Empty leaves are masked. The attributes voxtool_shape, voxtool_origin and
voxtool_pitch of the group hold the grid without rounding.
https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/ (HyperTreeGrid, version 2.4)
"""

from __future__ import annotations

import zlib
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.files.grids.vtkhdf_cells import Cells, TreeCells
from voxtool.files.grids.vtkhdf_read import COVERAGE
from voxtool.files.grids.vtkhdf_read import read as read
from voxtool.grid import Grid
from voxtool.svo.images.attribute_image import attributes_of
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.from_pieces import Collector
from voxtool.svo.octree.octree import Octree

VERSION = (2, 4)
CHUNK = 1 << 20  # values of a chunk of a dataset
DEFLATE = 4  # zlib's level: a tenth more bytes than by VTK's 5, in two thirds of the time
EXTRA = 1 << 16  # bytes of the structure of the file
NAME_BYTES = 48  # bytes of a name of a label, beyond its letters
FULL = 255  # the coverage of a cell that is wholly set


def size(image: VoxelImage) -> int:
    """Return a bound of the bytes of the file."""
    source = _source(image)
    attributes = attributes_of(image)
    cells = sum(TreeCells(source.octree, source.level, attributes).by_depth)
    each = 1 + source.values.itemsize + sum(attribute.cell_bytes for attribute in attributes)
    named = sum(NAME_BYTES + len(name.encode()) for one in attributes for name in one.names)
    streams = (2 + len(attributes)) * 4 * CHUNK
    return EXTRA + cells * each + cells // 4 + named + streams


def write(image: VoxelImage, file: BinaryIO) -> None:
    """Write the octree of an image."""
    import h5py

    octree, level, values = _source(image)
    attributes = attributes_of(image)
    tree = TreeCells(octree, level, attributes)
    sizes = tree.by_depth
    total = sum(sizes)
    with h5py.File(file, "w") as h5:
        group: Any = h5.create_group("VTKHDF")
        _describe(group, octree, level, sizes)
        data = group.create_group("CellData")
        arrays = [_Stream(data, COVERAGE, total, values), _Stream(data, "inside", total, "u1")]
        arrays += [_Stream(data, one.name, total, one.dtype, one.row) for one in attributes]
        refined, masked = [], []
        done = 0
        for cells in tree.depths():
            columns = [_coverage(cells, values), (cells.counts == cells.most).view(np.uint8)]
            for array, column in zip(arrays, [*columns, *cells.values], strict=True):
                array.add(column)
            masked.append(_packed(cells.counts == 0))
            if cells.refined is not None:
                refined.append(_packed(cells.refined))
            done += len(cells.counts)
            image.progress(done / total)
        for array in arrays:
            array.close()
        for one in attributes:
            if one.names:
                fields = group.create_group("FieldData")
                names = [name.encode() for name in one.names]
                # VTK reads no strings that say they are UTF-8, and shows others as UTF-8
                fields.create_dataset("label_names", data=names, dtype=h5py.string_dtype("ascii"))
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
    """A dataset whose chunks are packed by other threads while others are made."""

    def __init__(
        self, group: Any, name: str, count: int, dtype: Any, row: tuple[int, ...] = ()
    ) -> None:
        self.chunk, self.row = min(CHUNK, count), row
        self.dataset = group.create_dataset(
            name,
            (count, *row),
            dtype,
            chunks=(self.chunk, *row),
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
            padding = [(0, self.chunk - len(rest)), *[(0, 0)] * len(self.row)]
            self._pack(np.pad(rest, padding))
        self._write()
        self._pool.shutdown()

    def _pack(self, values: np.ndarray) -> None:
        self._packing.append(self._pool.submit(zlib.compress, values.tobytes(), DEFLATE))

    def _write(self) -> None:
        for packing in self._packing:
            at = (self._written, *[0] * len(self.row))
            self.dataset.id.write_direct_chunk(at, packing.result())
            self._written += self.chunk
        self._packing = []
