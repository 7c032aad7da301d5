"""Repair of models with faces missing and reversed, beside other tools.

Every seventeenth face is removed, and every fifth of the others reversed: the same each time. The
result is compared with the model as it was, its holes closed. The distances alone do not tell a
solid from a crust, which follows the surface on both sides; volume and area do.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench.references import Reference, capped
from voxtool.bench.timing import Peers
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.mesh.topology import check_surface
from voxtool.repairing.job import plan_repair

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench

WORK = "a mesh with faces missing and reversed to a closed one"
REMOVED, REVERSED = 17, 5


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model."""
    mesh, asked, peers = load_mesh(bench.model), bench.request, Peers(bench.request.repeat)
    damaged = damage(mesh)
    against = Reference(*capped(mesh), asked.samples, bench.timed)
    for dim in asked.dims:
        grid = Grid.fit(mesh, dim)
        plan = partial(plan_repair, damaged, grid)
        found = plan(device=bench.timed).run()
        row = partial(
            bench.point, WORK, label=f"dim {dim}", size=dim, size_of="dim",
            asked={"dims": dim, "samples": asked.samples}, setting={"against": against.words},
        )  # fmt: skip
        yield row(
            method="voxtool",
            run=lambda device, plan=plan: plan(device=device).run(),
            bytes=found.surface.points.nbytes + found.faces.nbytes,
            **described(found.mesh(), against),
        )
        for name, work in bench.tools.of_repair(damaged, grid).items() if asked.peers else ():
            runs, made = peers.times(name, work)
            if runs:
                yield row(
                    method=name, runs=runs, peer=True, **described(mesh_from_arrays(*made), against)
                )


def damage(mesh: Mesh) -> Mesh:
    """Return the mesh with faces missing and reversed."""
    faces = np.delete(mesh.faces, np.s_[::REMOVED], axis=0)
    faces[::REVERSED] = faces[::REVERSED, ::-1]
    return mesh_from_arrays(mesh.vertices, faces, name=mesh.name)


def described(result: Mesh, against: Reference) -> dict[str, Any]:
    """Return the `errors`, `absent` and `figures` of a Point for a repaired mesh."""
    found: dict[str, Any] = against.errors_of(result)
    if found["errors"]:
        checked = check_surface(result, weld=False)
        found["errors"]["not closed"] = float(not (checked.watertight and checked.manifold))
    return {**found, "figures": {"triangles": float(len(result.faces))}}
