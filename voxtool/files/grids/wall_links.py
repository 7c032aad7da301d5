"""Links of a lattice that cross the wall, as .npz or HDF5.

Arrays: directions (Q, 3) int8, voxels (N, 3) int32, places (N, Q) float32, flags (N, Q) uint8, as
svo/solvers/wall_links.py describes them; in a .npz also the grid, shape (3,) int64, origin and
pitch (3,) float64. In HDF5 the grid, the lattice and what is fluid are attributes of the root.
"""

from __future__ import annotations

import zipfile
from importlib import import_module
from typing import Any, BinaryIO

import numpy as np

from voxtool.files.grids.npz import GRID, write_entry
from voxtool.svo.solvers.wall_links import WallLinks
from voxtool.version import __version__

FORMAT, VERSION = "voxtool-links", "1.0"
ARRAYS = ("directions", "voxels", "places", "flags")


def write_npz(links: WallLinks, file: BinaryIO) -> None:
    """Write the arrays and the grid; the bytes depend on the content alone."""
    with zipfile.ZipFile(file, "w") as packed:
        grid = {name: np.array(getattr(links.grid, name), kind) for name, kind in GRID.items()}
        arrays = {name: getattr(links, name) for name in ARRAYS}
        for name, array in {**arrays, **grid}.items():
            write_entry(packed, name, array.dtype, array.shape, iter([array]))


def write_h5(links: WallLinks, file: BinaryIO) -> None:
    """Write the arrays as datasets, contiguous and uncompressed, and the rest as attributes."""
    h5py: Any = import_module("h5py")  # its low-level modules have no types
    with h5py.File(file, "w", track_order=False) as h5:
        texts = {
            "format": FORMAT,
            "format_version": VERSION,
            "creator": f"voxtool {__version__}",
            "lattice": links.lattice,
            "fluid": links.fluid,
            "source_sha256": links.source_sha256,
            "units": links.units,
        }
        for name, text in texts.items():
            data = text.encode()
            h5.attrs.create(name, data, dtype=h5py.string_dtype("utf-8", max(1, len(data))))
        for name, kind in GRID.items():
            h5.attrs.create(name, getattr(links.grid, name), dtype=np.dtype(kind))
        for name in ARRAYS:
            h5.create_dataset(name, data=getattr(links, name), track_times=False)
