"""Meshes in a unit cube and a unit ball, held against trimesh's bounds and rational arithmetic."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.cli import fail, run, told

import voxtool
from voxtool import files
from voxtool.errors import MeshError, VoxtoolError

POINTS = [(3.0, -1.0, 10.0), (5.0, 3.0, 11.0), (4.0, 0.5, 10.25), (90.0, 90.0, 90.0)]
MESH = voxtool.mesh_from_arrays(POINTS, [(0, 1, 2)], units="mm")  # the last vertex is unused


def test_the_longest_side_becomes_one() -> None:
    placed = voxtool.normalize(MESH)
    assert placed.bounds.tolist() == [[0.25, 0, 0.375], [0.75, 1, 0.625]]
    assert placed.transform == (0.25, -0.5, 0.25, -2.125)
    assert placed.units == ""


def test_the_farthest_vertex_comes_to_the_sphere() -> None:
    placed = voxtool.normalize(MESH, "sphere")
    low, high = placed.bounds
    assert np.abs(low + high).max() < 1e-15
    # vertices 0 and 1 are at (1, 2, 0.5) from the centre: squared 5.25
    scale = placed.transform[0]
    assert abs(Fraction(scale) ** 2 * Fraction(21, 4) - 1) < Fraction(1, 1 << 50)
    assert np.linalg.norm(placed.vertices[:3], axis=1).max() == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize("into", ["unit", "sphere"])
def test_the_transform_gives_the_vertices_exactly(into: str) -> None:
    """Normalized vertices are scale times vertex plus offset; so is the grid, up to rounding."""
    rng = np.random.default_rng(7)
    mesh = voxtool.mesh_from_arrays(rng.normal(5, 3, (60, 3)), np.arange(60).reshape(20, 3))
    placed = voxtool.normalize(mesh, into)
    scale, *offset = placed.transform
    assert np.array_equal(placed.vertices, mesh.vertices * scale + np.array(offset))
    one, other = voxtool.Grid.fit(mesh, 64), voxtool.Grid.fit(placed, 64)
    assert np.allclose(np.array(one.origin) * scale + offset, other.origin, rtol=0, atol=1e-14)


def test_refusals() -> None:
    with pytest.raises(VoxtoolError, match="normalize 'cube' is unknown: choose one of unit, sph"):
        voxtool.normalize(MESH, "cube")
    with pytest.raises(MeshError, match="it has been normalized before"):
        voxtool.normalize(voxtool.normalize(MESH))
    for size in (1e200, 1e-200):
        with pytest.raises(MeshError, match="is not within 1e±150: scale it first"):
            voxtool.normalize(([(0, 0, 0), (size, 0, 0), (0, size, 0)], [(0, 1, 2)]))


@pytest.mark.parametrize("extension", ["svo.h5", "svo.xml", "svo.xml.gz"])
def test_the_transform_is_stored(extension: str, here: Path) -> None:
    """svo-info shows the transform, and every format stores it; the digest leaves it out."""
    name = f"box.{extension}"
    run(f"voxelize bunny.obj --dim 16 --normalize sphere -o {name}")
    octree = voxtool.voxelize(voxtool.normalize("bunny.obj", "sphere"), dim=16)
    read = voxtool.read_svo(name)
    assert read == octree
    assert read.transform == octree.transform
    assert told(f"svo-info --json {name}")["transform"] == list(octree.transform)
    assert "\nnormalized   original * " in run(f"svo-info {name}").stdout


def test_a_plain_octree_is_written_as_before(here: Path) -> None:
    run("voxelize bunny.obj --dim 16 -o box.svo.xml")
    text = Path("box.svo.xml").read_text()
    assert 'format_version="1.0"' in text
    assert "transform=" not in text
    assert told("svo-info box.svo.xml --json")["transform"] == []


def test_a_transform_that_is_none_is_refused(here: Path) -> None:
    run("voxelize bunny.obj --dim 16 --normalize unit -o box.svo.xml")
    text = Path("box.svo.xml").read_text()
    start = text.index('transform="') + len('transform="')
    end = text.index('"', start)
    for value, message in (("0.0 1.0 1.0 1.0", "a scale above 0 and three"), ("1.0", "4 of float")):
        Path("bad.svo.xml").write_text(text[:start] + value + text[end:])
        assert message in fail("svo-info bad.svo.xml")


@pytest.mark.parametrize("options", ["--units mm", "--scale 2"])
def test_a_scale_of_ones_own_contradicts(options: str, here: Path) -> None:
    message = fail(f"voxelize bunny.obj --normalize unit {options}", code=2)
    assert message.startswith("--normalize sets the scale and leaves no unit: drop --units and -")


def test_exports_keep_the_transform(here: Path) -> None:
    octree = voxtool.voxelize(voxtool.normalize("bunny.obj", "unit"), dim=16)
    voxtool.export(octree, "box.npz")
    assert np.load("box.npz")["transform"].tolist() == list(octree.transform)
    assert voxtool.read_voxels("box.npz").grid == octree.grid
    voxtool.export(octree, "box.vtkhdf", bbox=(0, 0, 0, 0.5, 1, 1))
    with h5py.File("box.vtkhdf") as file:
        found = np.asarray(file["VTKHDF"].attrs["voxtool_transform"])
    assert found.tolist() == list(octree.transform)
    voxtool.export(octree, "box.nrrd")
    line = next(li for li in Path("box.nrrd").read_bytes().splitlines() if b"transform" in li)
    text = json.loads(line.partition(b":=")[2])
    assert [float.fromhex(v) for v in text["transform"]] == list(octree.transform)
    voxtool.export(octree, "box.vdb")
    assert " ".join(map(repr, octree.transform)).encode() in Path("box.vdb").read_bytes()


def test_a_field_keeps_the_transform(here: Path) -> None:
    told_of = told("adf-build bunny.obj --normalize sphere --max-level 4 -o ball.adf.h5 --json")
    mesh = voxtool.normalize("bunny.obj", "sphere")
    assert told_of["transform"] == list(mesh.transform)
    field = files.read_adf("ball.adf.h5")
    assert field.transform == mesh.transform
    assert field.digest() == voxtool.build_adf(mesh, max_level=4).digest()
    with h5py.File("ball.adf.h5") as stored:
        assert stored.attrs["format_version"] == b"2.1"
    assert "\nnormalized   original * " in run("adf-info ball.adf.h5").stdout
    run("adf-build bunny.obj --max-level 4 -o plain.adf.h5")
    with h5py.File("plain.adf.h5") as stored:
        assert stored.attrs["format_version"] == b"2.0"
        assert "transform" not in stored.attrs
    with h5py.File("ball.adf.h5", "r+") as stored:
        stored.attrs["transform"] = [-1.0, 0.0, 0.0, 0.0]
    assert "a scale above 0 and three offsets" in fail("adf-info ball.adf.h5")


def test_distances_of_a_normalized_mesh(here: Path) -> None:
    cube = "--dim 16 --bbox 0 0 0 1 1 1"
    facts = told(f"distance bunny.obj --normalize unit {cube} -o sdf.npy --json")
    mesh = voxtool.normalize("bunny.obj")
    assert facts["transform"] == list(mesh.transform)
    assert facts["origin"] == [0, 0, 0]
    expected = voxtool.distance_grid(mesh, voxtool.Grid.fit(mesh, 16, bbox=(0, 0, 0, 1, 1, 1)))
    np.testing.assert_array_equal(np.load("sdf.npy"), expected)
