"""Set operations on the octree of a mesh and that of its mirror image, and their comparison, beside
numpy on dense arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.bench.timing import by_turns
from voxtool.choices import OPERATIONS
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.svo.sets.booleans import combine
from voxtool.svo.sets.compare import COMPARE, compare
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.svo.octree.octree import Octree

WORK = "two octrees to one"
DENSE_DIM = 256  # up to which numpy has dense arrays
WITHOUT = {"wrong": f"dense arrays are compared up to dim {DENSE_DIM}"}
FUNCTIONS = {
    "union": np.logical_or,
    "intersection": np.logical_and,
    "difference": np.greater,
    "xor": np.not_equal,
}


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model."""
    mesh = load_mesh(bench.model)
    for dim in bench.request.dims:
        grid = Grid.fit(mesh, dim)
        octrees = [voxelize(each, grid, device=bench.timed) for each in (mesh, mirrored(mesh))]
        dense = [octree.to_dense() for octree in octrees] if dim <= DENSE_DIM else []
        for operation in OPERATIONS:
            found = combine(octrees, operation, device=bench.timed)
            fields = {
                "asked": {"dims": dim}, "setting": {"operation": operation},
                "size": found.count, "size_of": "voxels",
            }  # fmt: skip
            errors = {}
            if dense:
                function = FUNCTIONS[operation]
                expected = function(*dense)
                errors["wrong"] = np.count_nonzero(found.to_dense() != expected) / expected.size
            yield bench.point(
                WORK, operation, f"dim {dim}", bytes=found.nbytes, errors=errors,
                absent={} if dense else WITHOUT, **fields,
                run=lambda device, op=operation, octrees=octrees: combine(
                    octrees, op, device=device
                ),
            )  # fmt: skip
            if dense:
                runs = by_turns(bench.request, lambda f=function, dense=dense: f(*dense))[0]
                yield bench.point(
                    WORK, f"numpy, {operation}", f"dim {dim}", runs=runs, errors={"wrong": 0.0},
                    bytes=expected.nbytes, peer=True, **fields,
                )  # fmt: skip

        yield compared(bench, octrees, dense, dim)


def mirrored(mesh: Mesh) -> Mesh:
    """Return the mirror image of a mesh in its box, along z; most models are symmetric along x."""
    vertices = mesh.vertices.copy()
    vertices[:, 2] = mesh.bounds[:, 2].sum() - vertices[:, 2]
    return mesh_from_arrays(vertices, mesh.faces[:, ::-1])


def compared(bench: Bench, octrees: list[Octree], dense: list[np.ndarray], dim: int) -> Point:
    """Return the comparison of two octrees; `wrong` counts the voxels of all three parts."""
    found = compare(*octrees, device=bench.timed)
    errors = {}
    if dense:
        one, other = dense
        parts = (
            (found.first, one & ~other),
            (found.second, other & ~one),
            (found.both, one & other),
        )
        wrong = sum(np.count_nonzero(part.to_dense() != expected) for part, expected in parts)
        errors["wrong"] = wrong / one.size
    return bench.point(
        WORK, COMPARE, f"dim {dim}", bytes=sum(octree.nbytes for octree in octrees), errors=errors,
        absent={} if dense else WITHOUT, asked={"dims": dim}, setting={"operation": COMPARE},
        size=sum(octree.count for octree in octrees), size_of="voxels",
        run=lambda device: compare(*octrees, device=device),
    )  # fmt: skip
