"""Growth of time with the faces of degenerate meshes, in which many faces are at one place.

The meshes are those of voxtool/selftest/crowds.py, with ten times as many faces in each step. Work
whose exponent is 1 or little more takes time in proportion to the faces, except for a logarithm.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from voxtool.adf.construction.build import plan_adf
from voxtool.adf.construction.survey import cube_of
from voxtool.bench.timing import by_turns
from voxtool.choices import FILLS, MODES, SURFACE_NETS
from voxtool.diagnosis.report import diagnose
from voxtool.errors import VoxtoolError
from voxtool.grid import Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.selftest.crowds import CROWDS
from voxtool.spatial.sampling import sample_cube
from voxtool.spatial.signed_distance import SignedDistance
from voxtool.svo.surface.extract import extract
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

    Works = dict[str, Callable[[], object]]  # by method

LEAST, STEP = 1000, 10  # faces
DIM, POINTS, LEVEL, TOLERANCE = 64, 1 << 12, 4, 1e-2
KINDS = tuple(CROWDS)
NONE = {"rms": "the meshes have no shape to compare with"}


def check_kind(name: str) -> None:
    """Raise VoxtoolError if no kind of mesh has the name."""
    if name not in CROWDS:
        raise VoxtoolError(f"no kind of degenerate mesh is {name!r}: choose {', '.join(KINDS)}")


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a kind of mesh, which the model names."""
    of = CROWDS[bench.model]
    small = mesh_from_arrays(*of(LEAST))
    for work in works_on(small, bench.timed).values():  # compile the kernels
        work()
    count = LEAST
    while count <= max(bench.request.triangles, LEAST):
        for method, work in works_on(mesh_from_arrays(*of(count)), bench.timed).items():
            yield bench.point(
                "degenerate mesh", method, f"{count:,} triangles",
                runs=by_turns(bench.request, work)[0], absent=NONE,
                asked={"triangles": count}, size=count, size_of="triangles",
            )  # fmt: skip
        count *= STEP


def works_on(mesh: Mesh, device: Device) -> Works:
    """Return each kind of work on a mesh that the device does not have, by its name."""
    grid, (origin, side) = Grid.fit(mesh, DIM), cube_of(mesh)
    places = origin + side * sample_cube(POINTS)

    def octree(*mode: str, **options: Any) -> Any:
        return voxelize(replace(mesh), grid, *mode, **options, device=device)

    filled = octree(fill="flood")
    works: Works = {
        f"diagnose, dim {DIM}": lambda: diagnose(replace(mesh), grid, device=device),
        **{f"{mode}, dim {DIM}": partial(octree, mode) for mode in MODES if "surface" in mode},
        **{f"solid, {fill}, dim {DIM}": partial(octree, fill=fill) for fill in FILLS},
        f"{SURFACE_NETS} of dim {DIM}": lambda: extract(filled, style=SURFACE_NETS, device=device),
        **{
            f"distances, {sign}, at {POINTS:,} points": partial(
                lambda sign: SignedDistance(replace(mesh), sign, device)(places), sign
            )
            for sign in ("pseudonormal", "winding")
        },
        f"field, levels to {LEVEL}, tolerance {TOLERANCE:g}": lambda: plan_adf(
            replace(mesh), tolerance=TOLERANCE, max_level=LEVEL, measure=False, device=device
        ).run(),
    }
    return works
