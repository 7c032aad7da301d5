"""Benchmarks of repair: our rows are closed, and the errors tell a solid from a crust."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.cli import write_obj

from voxtool.bench import peers, repair
from voxtool.bench.references import Reference
from voxtool.bench.request import Request
from voxtool.bench.timing import Bench
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh, mesh_from_arrays


@pytest.fixture
def ball() -> Mesh:
    return mesh_from_arrays(*meshes.icosphere(2))


def test_the_row_is_closed_and_near(tmp_path: Path, ball: Mesh) -> None:
    write_obj(tmp_path / "ball.obj", ball.vertices, ball.faces)
    device = opened(usable_devices()[0][0])
    request = Request(dims=(24,), repeat=1, seconds=0, samples=1000)
    bench = Bench(request, device, device, "repair", str(tmp_path / "ball.obj"))
    (point,) = repair.measure(bench)
    assert point.errors["not closed"] == 0
    assert point.errors["volume"] < 0.03
    assert (point.figures["triangles"] or 0) > 1000


def test_the_damage_is_as_described(ball: Mesh) -> None:
    kept = np.delete(ball.faces, np.arange(0, len(ball.faces), 17), axis=0)
    found = repair.damage(ball).faces
    turned = (found != kept).any(axis=1)
    assert (np.flatnonzero(turned) == np.arange(0, len(kept), 5)).all()
    assert (np.sort(found, axis=1) == np.sort(kept, axis=1)).all()


def test_a_crust_and_an_open_mesh_are_errors(ball: Mesh) -> None:
    against = Reference(ball, 0, 100, opened(usable_devices()[0][0]))
    inner = ball.faces[:, ::-1] + len(ball.vertices)
    crust = mesh_from_arrays(
        np.concatenate([ball.vertices, 0.99 * ball.vertices]), np.concatenate([ball.faces, inner])
    )
    errors = repair.described(crust, against)["errors"]
    assert errors["hausdorff"] < 0.01
    assert errors["volume"] > 0.9
    assert errors["area"] > 0.9
    assert errors["not closed"] == 0
    opened_up = mesh_from_arrays(ball.vertices, ball.faces[1:])
    assert repair.described(opened_up, against)["errors"]["not closed"] == 1
    empty = Mesh(ball.vertices, ball.faces[:0], name="")
    assert not repair.described(empty, against)["errors"]


def test_the_other_tool_closes_a_hole(ball: Mesh) -> None:
    bad = mesh_from_arrays(ball.vertices, ball.faces[1:])
    ((name, work),) = peers.of_repair(bad, Grid.fit(bad, 24)).items()
    assert name.startswith("PyMeshLab")
    against = Reference(ball, 0, 100, opened(usable_devices()[0][0]))
    errors = repair.described(mesh_from_arrays(*work()), against)["errors"]
    assert errors["not closed"] == 0
    assert errors["volume"] < 0.3
