"""Morphology of the octree of a mesh by a ball, beside SciPy's exact distance transform of a dense
array; its connected components, beside SciPy's; and its resampling to half the dim."""

from __future__ import annotations

import importlib.util
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench.timing import by_turns
from voxtool.choices import MORPHOLOGY
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.labels import plan_components
from voxtool.svo.sets.morphology import plan_morph
from voxtool.svo.sets.resample import plan_resample
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench

WORK = "octree to octree, by a ball of 4 voxels"
LABELS, HALF = "octree to components", "octree to octree of half the dim"
RADIUS = 4
HALF_OF_EIGHT = 4  # voxels that cover half of one twice their size
PAD = 2 * RADIUS  # voxels beyond the grid, on each side of the dense array
DENSE_DIM = 128  # up to which SciPy has dense arrays
TOO_LARGE = {"wrong": f"dense arrays are compared up to dim {DENSE_DIM}"}
NO_SCIPY = {"wrong": "SciPy is not installed"}


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model."""
    mesh = load_mesh(bench.model)
    scipy = importlib.util.find_spec("scipy") is not None
    for dim in bench.request.dims:
        octree = voxelize(mesh, Grid.fit(mesh, dim), device=bench.timed)
        absent = NO_SCIPY if not scipy else TOO_LARGE if dim > DENSE_DIM else {}
        dense = None if absent else np.pad(octree.to_dense(), PAD)
        yield from _components(octree, dense, absent, bench)
        yield _halved(octree, dense, absent, bench)
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


def _components(
    octree: Octree, dense: np.ndarray | None, absent: dict[str, str], bench: Bench
) -> Iterator[Point]:
    """Yield the points of the components of an octree, of voxels that share faces."""
    dim = octree.grid.dim
    row = partial(
        bench.point, LABELS, label=f"dim {dim}", asked={"dims": dim}, size=octree.count,
        size_of="voxels", absent=absent,
    )  # fmt: skip
    found, errors = plan_components(octree).run(), {}
    if dense is not None:
        sizes = np.sort(sizes_of(dense))[::-1]
        held = np.zeros((2, max(len(sizes), len(found.sizes))), np.int64)
        held[0, : len(sizes)], held[1, : len(found.sizes)] = sizes, found.sizes
        errors["wrong"] = int(np.abs(held[0] - held[1]).sum()) / dim**3
    runs = by_turns(bench.request, lambda: plan_components(octree).run())[0]
    yield row(method="components", runs=runs, errors=errors)
    if dense is not None:
        runs = by_turns(bench.request, lambda: sizes_of(dense))[0]
        yield row(method="SciPy, components", runs=runs, errors={"wrong": 0.0}, peer=True)


def sizes_of(dense: np.ndarray) -> np.ndarray:
    """Return the voxels of each component of a dense array, across faces."""
    from scipy.ndimage import label

    labelled: Any = label(dense)
    return np.bincount(labelled[0].ravel())[1:]


def _halved(
    octree: Octree, dense: np.ndarray | None, absent: dict[str, str], bench: Bench
) -> Point:
    """Return the point of resampling to voxels twice as large, of which half is covered."""
    grid = octree.grid
    shape = tuple(-(-n // 2) for n in grid.shape)
    half = Grid(shape, grid.origin, tuple(2 * p for p in grid.pitch))  # pyright: ignore[reportArgumentType]
    found, errors = plan_resample(octree, half, device=bench.timed).run(), {}
    if dense is not None:
        own = dense[tuple(slice(PAD, PAD + 2 * n) for n in shape)]
        x, y, z = shape
        covered = own.reshape(x, 2, y, 2, z, 2).sum(axis=(1, 3, 5)) >= HALF_OF_EIGHT
        errors["wrong"] = int(np.count_nonzero(found.to_dense() != covered)) / half.dim**3
    return bench.point(
        HALF, "resample", f"dim {grid.dim}", asked={"dims": grid.dim}, errors=errors,
        size=octree.count, size_of="voxels", absent=absent, bytes=found.nbytes,
        run=lambda device: plan_resample(octree, half, device=device).run(),
    )  # fmt: skip


def by_distances(voxels: np.ndarray, operation: str) -> np.ndarray:
    """Return the result of an operation on a dense array, by squared distances as whole numbers."""
    if operation == "dilate":
        return dilated(voxels)
    if operation == "close":
        return ~dilated(~dilated(voxels))
    near = dilated(~voxels)
    if operation == "shell":
        return voxels & near
    return ~near if operation == "erode" else dilated(~near)


def dilated(voxels: np.ndarray) -> np.ndarray:
    """Return the voxels within RADIUS of a set one."""
    from scipy.ndimage import distance_transform_edt

    if not voxels.any():
        return voxels
    distances: Any = distance_transform_edt(~voxels)
    return np.rint(distances * distances) <= RADIUS**2


def wrong(found: Octree, octree: Octree, expected: np.ndarray) -> int:
    """Return the number of voxels in which an octree differs from an array that is padded by PAD
    around the grid of another octree."""
    shift = np.subtract(found.grid.origin, octree.grid.origin) / octree.grid.pitch
    held = np.zeros_like(expected)
    held[tuple((found.occupied() + np.rint(shift).astype(int) + PAD).T)] = True
    return int(np.count_nonzero(held != expected))
