"""Morphology of the octree of a mesh by a ball, beside SciPy's exact distance transform of a dense
array."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench.timing import by_turns
from voxtool.choices import MORPHOLOGY
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.morphology import plan_morph
from voxtool.svo.octree import Octree
from voxtool.svo.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench

WORK = "octree to octree, by a ball of 4 voxels"
RADIUS = 4
PAD = 2 * RADIUS  # voxels beyond the grid, on each side of the dense array
DENSE_DIM = 128  # up to which SciPy has dense arrays
TOO_LARGE = {"wrong": f"dense arrays are compared up to dim {DENSE_DIM}"}
NO_SCIPY = {"wrong": "SciPy is not installed"}


def measure(bench: Bench) -> Iterator[Point]:
    """The points of a model."""
    mesh = load_mesh(bench.model)
    scipy = importlib.util.find_spec("scipy") is not None
    for dim in bench.request.dims:
        octree = voxelize(mesh, Grid.fit(mesh, dim), device=bench.timed)
        absent = NO_SCIPY if not scipy else TOO_LARGE if dim > DENSE_DIM else {}
        dense = None if absent else np.pad(octree.to_dense(), PAD)
        for operation in MORPHOLOGY:
            found = plan_morph(octree, operation, RADIUS, device=bench.timed).run()
            fields = {
                "asked": {"dims": dim}, "setting": {"operation": operation},
                "size": found.count, "size_of": "voxels",
            }  # fmt: skip
            errors = {}
            if dense is not None:
                expected = by_distances(dense, operation)
                errors["wrong"] = wrong(found, octree, expected) / octree.grid.dim**3
            yield bench.point(
                WORK, operation, f"dim {dim}", bytes=found.nbytes, errors=errors, absent=absent,
                run=lambda device, op=operation, octree=octree: plan_morph(
                    octree, op, RADIUS, device=device
                ).run(),
                **fields,
            )  # fmt: skip
            if dense is not None:
                runs = by_turns(
                    bench.request, lambda op=operation, dense=dense: by_distances(dense, op)
                )[0]
                yield bench.point(
                    WORK, f"SciPy, {operation}", f"dim {dim}", runs=runs, errors={"wrong": 0.0},
                    bytes=dense.nbytes, peer=True, **fields,
                )  # fmt: skip


def by_distances(voxels: np.ndarray, operation: str) -> np.ndarray:
    """The result of an operation on a dense array, by squared distances as whole numbers."""
    if operation == "dilate":
        return dilated(voxels)
    if operation == "close":
        return ~dilated(~dilated(voxels))
    near = dilated(~voxels)
    if operation == "shell":
        return voxels & near
    return ~near if operation == "erode" else dilated(~near)


def dilated(voxels: np.ndarray) -> np.ndarray:
    """The voxels within RADIUS of a set one."""
    from scipy.ndimage import distance_transform_edt

    if not voxels.any():
        return voxels
    distances: Any = distance_transform_edt(~voxels)
    return np.rint(distances * distances) <= RADIUS**2


def wrong(found: Octree, octree: Octree, expected: np.ndarray) -> int:
    """The number of voxels in which an octree differs from an array that is padded by PAD around
    the grid of another octree."""
    shift = np.subtract(found.grid.origin, octree.grid.origin) / octree.grid.pitch
    held = np.zeros_like(expected)
    held[tuple((found.occupied() + np.rint(shift).astype(int) + PAD).T)] = True
    return int(np.count_nonzero(held != expected))
