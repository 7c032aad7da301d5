"""Level sets of NanoVDB, .nvdb: the grid of vdb_levels.py, laid out as nvdb.py does.

The samples that are not active, and the tiles, hold the background, negative inside.
"""

from __future__ import annotations

from math import prod
from typing import BinaryIO

import numpy as np

from voxtool.adf.surface.narrow_band import LevelSet
from voxtool.files.grids import nvdb, vdb_levels
from voxtool.files.grids.vdb_encode import UPPER_SIDE, Inside, tiles_of


def size(image: LevelSet) -> int:
    """Return a bound of the bytes of the file."""
    tiles = prod(-(-n // UPPER_SIDE) for n in image.shape)  # of the root, at most
    return nvdb.size_of(image.corners, tiles_of([])) + nvdb.TILE * tiles


def write(image: LevelSet, file: BinaryIO) -> None:
    """Write one grid of float32."""
    background = np.float32(image.background)

    def encoded(distances: np.ndarray, active: np.ndarray, is_minus: np.ndarray) -> bytes:
        far = np.where(is_minus, -background, background)
        return np.where(active, distances, far).astype("<f4").tobytes()

    leaves, cubes = vdb_levels.tree_of(image, encoded)
    low, high, count = vdb_levels.extent_of(leaves)
    content = nvdb.Content(
        nvdb.LEVEL_SET, image.middle, np.array(image.pitch), leaves, tiles_of(cubes), (low, high),
        count, Inside(-float(background), False), float(background), whole=True,
    )  # fmt: skip
    nvdb.write_grids([content], file)
