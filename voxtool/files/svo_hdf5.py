"""Octrees as HDF5, format `voxtool-svo`: docs/formats.md has it exactly.

A file is not trusted (hdf5.py), and the octree is validated.
"""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np

from voxtool.errors import FileError
from voxtool.files import hdf5
from voxtool.files.svo_head import FORMAT, FORMAT_VERSION, LAYOUT, build, check_head, head_of
from voxtool.svo.octree import BRICK, NODE, Octree, check_offsets

WORD = np.dtype("<u4")


def write(octree: Octree, file: BinaryIO) -> None:
    """Write an octree into an empty file that is open for reading and writing.

    Raises
    ------
    OSError : the file cannot be written.
    """
    nodes = np.ascontiguousarray(octree.nodes, NODE).view(WORD).reshape(-1, 2)
    arrays = {
        "offsets": np.ascontiguousarray(octree.offsets, WORD),
        "nodes": nodes,
        "bricks": np.ascontiguousarray(octree.bricks, BRICK),
    }
    hdf5.write(file, FORMAT, head_of(octree), LAYOUT, arrays)


def read(file: BinaryIO, size: int) -> Octree:
    """Read an octree from a file of `size` bytes.

    Raises
    ------
    FileError : the file is damaged, hostile or of another kind.
    """
    return hdf5.read(file, size, _read_open)


def _read_open(h5: Any, size: int) -> Octree:
    mend = "voxelize a mesh first: voxtool voxelize MESH"
    hdf5.check_format(h5, FORMAT, FORMAT_VERSION, "octree", mend)
    head = {name: hdf5.attribute(h5, name, *LAYOUT[name]) for name in LAYOUT}
    grid = check_head(head)
    found = {
        "offsets": hdf5.dataset(h5, "offsets", (head["depth"] + 1,), WORD, size),
        "nodes": hdf5.dataset(h5, "nodes", (None, 2), WORD, size),
        "bricks": hdf5.dataset(h5, "bricks", (None,), BRICK, size),
    }
    offsets = hdf5.load(found["offsets"])
    check_offsets(grid, offsets)
    nodes, bricks = int(offsets[-1]), int(offsets[-1] - offsets[-2])
    for name, expected in (("nodes", nodes), ("bricks", bricks)):
        if found[name].shape[0] != expected:
            raise FileError(
                f"dataset {name} has {found[name].shape[0]} rows where offsets say {expected}"
            )
    words = hdf5.load(found["nodes"])
    return build(grid, head, offsets, words.view(NODE).reshape(-1), hdf5.load(found["bricks"]))
