"""The bench of growth: subdivided volumes are what they were, and sizes and exponents are given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.cli import told, write_obj
from helpers.tets import assert_matched, six_volumes, split, tet_grid, tet_mesh

from voxtool.bench.growth import eighths, whole
from voxtool.opencl import default_device
from voxtool.selftest.shapes import octahedron


@pytest.mark.parametrize("constant", [False, True])
def test_eighths_fill_the_volume_and_share_their_faces(constant: bool) -> None:
    points, cells = tet_grid((2, 2, 1), seed=3)
    scalars = [np.arange(len(cells)) * 1.0] if constant else points @ [1.0, 2.0, 4.0]
    mesh = whole(tet_mesh(points, cells, scalars), default_device())
    made = eighths(mesh)
    volumes = [six_volumes(one.points, one.cells[0][1]) for one in (mesh, made)]
    np.testing.assert_allclose(volumes[1], np.repeat(volumes[0] / 8, 8), rtol=1e-9)
    outside = [assert_matched(split(one)) for one in (mesh, made)]
    assert outside[1] == 4 * outside[0]
    if constant:
        assert np.array_equal(made.scalars[0], np.repeat(mesh.scalars[0], 8))
    else:
        np.testing.assert_allclose(made.scalars, made.points @ [1.0, 2.0, 4.0], atol=1e-12)


def test_each_work_has_its_sizes_and_its_exponent(here: Path) -> None:
    write_obj(Path("octahedron.obj"), *octahedron(np.zeros(3), 1))
    command = "bench growth octahedron.obj volume.vtu --scalar density --triangles 32 "
    command += "--cells 1 --dims 16,32 --levels 2,3 --tolerances 1e-2 --sizes 8,16 "
    command += "--repeat 1 --json -q"
    points = told(command)["points"]
    of_mesh = [p for p in points if p["work"] == "subdivided mesh"]
    assert [p["size"] for p in of_mesh] == [8] * 5 + [32] * 5
    assert {p["method"] for p in points if p["size_of"] == "cells"} == {
        "textures",
        "frame, 256 x 256",
    }
    sizes = {kind: [p["size"] for p in points if p["size_of"] == kind] for kind in
             ("dim", "leaves", "pixels")}  # fmt: skip
    assert sizes["dim"] == [16] * 5 + [32] * 5
    assert sizes["pixels"] == [64, 64, 256, 256]
    assert len(sizes["leaves"]) == 4
    assert sizes["leaves"][0] < sizes["leaves"][2]
    assert all(p["runs"] and "other benches" in p["absent"]["rms"] for p in points)
