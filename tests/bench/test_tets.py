"""The bench of pictures: what is compared, through which transfer functions, and other tools."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers.cli import run
from selftest.test_reference import TETRAHEDRON, constant_of, five, kuhn, look, ramp, steps

from voxtool.bench import ablation, peers, tets
from voxtool.bench.references import ReferencePicture
from voxtool.bench.request import TRANSFERS, Request
from voxtool.bench.timing import Bench
from voxtool.choices import METHODS
from voxtool.opencl import open_device
from voxtool.pictures.rendering import plan_render
from voxtool.selftest.reference import reference
from voxtool.tets.construction.conforming import tetrahedra
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.volume.mesh import UnstructuredMesh, volume_cells

REQUEST = Request(sizes=(6, 12), pixels=6, transfers=("x10",), scalar="heat", repeat=1, seconds=0,
                  integrators=("linear", "sampled:1"), ablations=False, peers=True)  # fmt: skip


class GreyTool:
    """A tool whose picture is grey, and whose rays are exact."""

    @staticmethod
    def of_volume(vertices, cells, scalars, transfer, rays, constant):
        width, height = rays.size
        return [
            peers.PicturePeer(
                "Grey 1.0", lambda: None, lambda: np.full((height, width, 4), 0.5),
                lambda pixels: reference(vertices, cells, scalars, transfer, rays, pixels),
            )
        ]  # fmt: skip


@pytest.fixture
def cube(tmp_path: Path) -> str:
    """A cube with one point and one cell array."""
    meshio = pytest.importorskip("meshio")
    vertices, cells = kuhn(2, 0.2)
    values = np.random.default_rng(6).uniform(1, 3, len(vertices))
    meshio.write_points_cells(
        tmp_path / "cube.vtu", vertices, {"tetra": cells}, point_data={"heat": values},
        cell_data={"part": [np.arange(len(cells)) % 3.0]},
    )  # fmt: skip
    return str(tmp_path / "cube.vtu")


def test_points(cube: str) -> None:
    index = usable_devices()[0][0]
    profiled = open_device(str(index), profile=True)
    *ours, shown, rays = tets.measure(
        Bench(REQUEST, opened(index), profiled, "tets", cube, GreyTool)
    )
    surfaces, ours = ours[: len(METHODS)], ours[len(METHODS) :]
    assert [(p.work, p.method) for p in surfaces] == [("frames of isosurfaces", m) for m in METHODS]
    for point in surfaces:
        assert point.errors["max"] < 1e-5
        assert 0.5 <= point.figures["largest alpha"] < 1
    drawn = [(p.setting["sizes"], p.setting["methods"], p.setting["integrators"]) for p in ours]
    assert drawn == [
        *((6, method, "linear") for method in METHODS),
        *((12, method, integrator) for method in METHODS for integrator in REQUEST.integrators),
    ]
    for point in ours:
        assert point.first > 0
        assert bool(point.errors) == (point.setting["sizes"] == 12)
        if point.errors:
            assert (point.errors["max"] < 1e-5) == (point.setting["integrators"] == "linear")
            assert 5 < point.figures["pixels compared"] <= 36
            assert 0 < point.figures["largest alpha"] <= 1
        else:
            assert point.absent["rms"] == "pictures of 12 x 12 are compared"
    assert (shown.method, rays.method) == ("Grey 1.0, linear, shown", "Grey 1.0, linear, rays")
    assert shown.errors["max"] == pytest.approx(0.5)
    assert rays.errors["max"] == 0
    assert shown.runs == rays.runs


@pytest.mark.parametrize("method", METHODS)
def test_transparent_cells_are_forced_in(device, method: str) -> None:
    vertices, cells = kuhn(8)
    mesh = UnstructuredMesh(vertices, [("tetra", cells)], vertices[:, 0], "s")
    points = ramp(5)
    transfer = replace(points, scalars=points.scalars / 4 + 0.75)  # half of the blocks are below
    job = plan_render(build_tet(mesh, method), look(12, 12), transfer=transfer, method=method,
                      device=device)  # fmt: skip
    bench = Bench(Request(repeat=1, seconds=0), device, device)
    (one,) = ablation.of_picture(job, bench, "frames")
    assert one.same
    assert "transparent" in one.what


def test_constant_cells(cube: str) -> None:
    words = "--scalar part --transfers x10 --sizes 12 --pixels 6 --integrators linear --repeat 1"
    points = json.loads(run(f"bench tets {cube} {words} --json").stdout)["points"]
    assert [point["method"] for point in points] == [f"{method}, linear" for method in METHODS]
    assert max(point["errors"]["max"] for point in points) < 1e-5


# ---- figures


def test_errors_are_of_pixels_with_something_in_them() -> None:
    expected = np.array([(0, 0, 0, 0), (0.5, 0, 0, 0.5), (0, 0, 0, 0)])
    view = ReferencePicture(look(3, 1), np.array([(0, 0), (1, 0), (2, 0)]), expected)
    assert view.compared(expected)["errors"] == {"rms": 0, "max": 0}
    found = expected + np.array([(0, 0, 0, 0), (0, 0, 0, 0.25), (0, 0, 0, 0)])
    assert view.compared(found)["errors"] == {"rms": 0.125, "max": 0.25}
    found[2, 3] = 0.5  # that should be empty
    assert view.compared(found) == {
        "errors": {"rms": np.sqrt((0.25**2 + 0.5**2) / 8), "max": 0.5},
        "figures": {"pixels compared": 1, "largest alpha": 0.5},
    }
    picture = np.arange(3)[None, :, None] * np.ones(4)
    assert view.of(picture)[:, 0].tolist() == [0, 1, 2]


def test_transfer_functions() -> None:
    vertices, cells = kuhn()
    mesh = UnstructuredMesh(vertices, [("tetra", cells)], 3 + vertices[:, 0], "s")
    mesh = tetrahedra(opened(0), volume_cells(mesh)).on_host()
    opaque = {name: tets.transfer_of(name, mesh) for name in TRANSFERS}
    most = tets.DEPTH / np.sqrt(3)
    for name, factor in (("x1", 1), ("x10", 10), ("x100", 100)):
        assert opaque[name].scalars.tolist() == [3, 3.25, 3.5, 3.75, 4]
        assert opaque[name].extinctions.max() == pytest.approx(factor * most)
    jumps = np.diff(opaque["steps"].extinctions)[np.diff(opaque["steps"].scalars) == 0]
    assert jumps == pytest.approx(100 * most * np.array([1, -1, 1, -1]))


# ---- another tool, where it is installed


@pytest.mark.parametrize("points", [constant_of(1), ramp(2), five(), five(100), steps()])
@pytest.mark.parametrize("constant", [False, True])
def test_a_tool_finds_what_the_reference_does(points, constant: bool) -> None:
    pytest.importorskip("vtk")
    size = (40, 30)
    rays = look(*size, eye=(3, 4, 5), target=(0.25, 0.25, 0.25), height=1.4)
    scalars = np.array([0.47]) if constant else np.array([0, 1, 0.3, 0.7])
    cells = np.array([(0, 1, 2, 3)])
    (peer,) = peers.of_volume(TETRAHEDRON, cells, scalars, points, rays, constant=constant)
    peer.draw()
    row, column = np.divmod(np.arange(40 * 30), 40)
    expected = reference(TETRAHEDRON, cells, scalars, points, rays, constant=constant)
    assert np.count_nonzero(expected[:, 3]) > 200
    found = peer.at(np.stack([column, row], axis=1))
    assert np.abs(found - expected).max() < 2e-6
    shown = peer.picture()
    assert shown.shape == (30, 40, 4)
    smooth = expected.reshape(30, 40, 4)[8:-8, 14:-14]  # its texture is a bit too large
    assert np.abs(shown[8:-8, 14:-14] - smooth).mean() < 0.02


def test_no_tool_is_right_in_perspective() -> None:
    rays = look(fov=30.0)
    cells = np.array([(0, 1, 2, 3)])
    assert peers.of_volume(TETRAHEDRON, cells, np.zeros(4), ramp(1), rays) == []
