"""NanoVDB's own code, in Warp, for tests of .nvdb; they are skipped where Warp is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

wp: Any = pytest.importorskip("warp")
wp.config.quiet = True


@wp.kernel
def look_up(volume: wp.uint64, cells: wp.array(dtype=wp.vec3i), found: wp.array(dtype=float)):  # pyright: ignore
    i = wp.tid()
    c = cells[i]
    found[i] = wp.volume_lookup_f(volume, c[0], c[1], c[2])


def grids_of(path: Path) -> dict[str, Any]:
    """The grids of a file, by name."""
    grid, found = wp.Volume.load_from_nvdb(path.read_bytes(), device="cpu"), {}
    while grid is not None:
        found[grid.get_grid_info().name] = grid
        grid = grid.load_next_grid()
    return found


def values_at(volume: Any, cells: np.ndarray) -> np.ndarray:
    """The values of a grid at cells, (n,) float32."""
    places = wp.array(cells.astype(np.int32), dtype=wp.vec3i, device="cpu")
    found = wp.zeros(len(cells), dtype=float, device="cpu")
    wp.launch(look_up, len(cells), [volume.id, places, found], device="cpu")
    return found.numpy()
