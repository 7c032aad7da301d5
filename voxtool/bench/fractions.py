"""Fractions of voxels, beside sampling at 1,000 points a voxel, and the binary solid."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench.timing import by_turns
from voxtool.choices import FRACTION_TYPES
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.attribution.fraction import FractionJob, plan_fractions
from voxtool.svo.octree.layout import BRICK_VOXELS
from voxtool.svo.octree.stored_volume import stored_volume
from voxtool.svo.voxelization.voxelize import plan_voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.svo.octree.octree import Octree

WORK = "mesh to fractions of voxels"
POINTS = 10  # along each side of a voxel
SAMPLED_DIM = 64  # up to which voxels are sampled
SLAB = 8  # voxels along z that are sampled at once
REFERENCE = {"rms": "the others are compared with these fractions"}
TOO_LARGE = {"rms": f"voxels are compared up to dim {SAMPLED_DIM}"}


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model: fractions of each type, and of faces, points and the solid; the
    root mean square of the errors of cut voxels, and the error of the volume. For fractions, the
    figure "by the lattice" is the share of the volume that rounding of the vertices changes."""
    mesh = load_mesh(bench.model)
    for dim in bench.request.dims:
        grid = Grid.fit(mesh, dim)
        job = plan_fractions(mesh, grid, device=bench.timed)
        octree = job.run()
        cut = np.nonzero(masked(octree)) if dim <= SAMPLED_DIM else None
        exact = dense_of(octree)[cut] if cut else np.empty(0)
        row = partial(
            bench.point, WORK, label=f"dim {dim}", size=octree.count, size_of="voxels",
            asked={"dims": dim}, setting={"rule": octree.fill},
        )  # fmt: skip
        for kind, faces in (*((kind, False) for kind in FRACTION_TYPES), (FRACTION_TYPES[0], True)):
            plan = partial(plan_fractions, mesh, grid, kind=kind, faces=faces)
            made = plan(device=bench.timed).run()
            errors = {"volume": error_of(stored_volume(made), job)}
            if kind != FRACTION_TYPES[0] and cut:
                errors["rms"] = rms(dense_of(made)[cut], exact)
            yield row(
                f"fractions{' and faces' * faces}, {kind}",
                run=lambda device, plan=plan: plan(device=device).run(),
                errors=errors, bytes=made.nbytes + sum(one.nbytes for one in made.attributes),
                figures={"by the lattice": error_of(job.volumes.lattice, job)},
                absent=REFERENCE if kind == FRACTION_TYPES[0] else {} if cut else TOO_LARGE,
            )  # fmt: skip
        plan = partial(plan_voxelize, mesh, grid, fill=octree.fill)
        solid = plan(device=bench.timed).run()
        errors = {"volume": error_of(solid.count, job)}
        if cut:
            errors["rms"] = rms(solid.to_dense()[cut], exact)
        yield row(
            "binary solid", run=lambda device, plan=plan: plan(device=device).run(),
            errors=errors, bytes=solid.nbytes, absent={} if cut else TOO_LARGE,
        )  # fmt: skip
        if cut:
            sample = partial(sampled, mesh, grid, octree.fill, bench.timed)
            found = sample()
            errors = {"volume": error_of(float(found.sum()), job)}
            errors["rms"] = rms(found[cut], exact)
            runs = by_turns(bench.request, sample)[0]
            yield row(f"{POINTS**3:,} points a voxel", runs=runs, errors=errors, bytes=found.nbytes)


def masked(octree: Octree) -> np.ndarray:
    """Return the voxels that have a fraction of their own, (nx, ny, nz) bool."""
    masks = octree.attribute("fraction").held(octree.bricks)
    bits = np.unpackbits(masks.view(np.uint8), bitorder="little").reshape(-1, len(BRICK_VOXELS))
    return _scattered(octree, np.zeros(octree.grid.shape, bool), bits)


def dense_of(octree: Octree) -> np.ndarray:
    """Return the fractions of all voxels, (nx, ny, nz) float64."""
    values = octree.values("fraction").of_bricks(slice(None))
    most = 1 if values.dtype.kind == "f" else np.iinfo(values.dtype).max
    return _scattered(octree, octree.to_dense().astype(np.float64), values / most)


def _scattered(octree: Octree, dense: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the array with the values of the voxels of bricks, (n, 64), that lie in it."""
    places = octree.levels()[-1].cells[:, None] + BRICK_VOXELS
    held = (places < octree.grid.shape).all(axis=2)
    dense[tuple(places[held].T)] = values[held]
    return dense


def sampled(mesh: Mesh, grid: Grid, fill: str, device: Device) -> np.ndarray:
    """Return the shares of points of each voxel that are inside, (nx, ny, nz) float64: those of the
    centres of voxels POINTS times finer, in slabs."""
    nx, ny, nz = grid.shape
    x, y, z = grid.pitch
    pitch = x / POINTS, y / POINTS, z / POINTS
    fine = Grid((POINTS * nx, POINTS * ny, POINTS * nz), grid.origin, pitch)
    found = np.empty(grid.shape)
    for k in range(0, nz, SLAB):
        deep = min(SLAB, nz - k)
        window: Any = (0, 0, POINTS * k), (POINTS * nx, POINTS * ny, POINTS * deep)
        octree = plan_voxelize(mesh, fine, fill=fill, window=window, device=device).run()
        points = octree.to_dense().reshape(nx, POINTS, ny, POINTS, deep, POINTS)
        found[:, :, k : k + deep] = points.sum(axis=(1, 3, 5), dtype=np.uint16) / POINTS**3
    return found


def rms(found: np.ndarray, exact: np.ndarray) -> float:
    """Return the root mean square of errors; 0 of none."""
    return float(np.sqrt(np.mean((found - exact) ** 2))) if len(exact) else 0.0


def error_of(voxels: float, job: FractionJob) -> float:
    """Return the error of a volume in voxels, relative to the mesh's, whose vertices are not
    rounded."""
    return abs(voxels / job.volumes.mesh - 1) if job.volumes.mesh else 0.0
