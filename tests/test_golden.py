"""Golden digests: the same content on every device, and from one change to the next."""

from __future__ import annotations

import json

import golden_adf
import golden_distance
import golden_mesh
import golden_picture
import golden_report
import golden_svo
import pytest
from conftest import model

import voxtool

GOLDEN = json.loads(golden_svo.GOLDEN.read_text(encoding="utf-8"))
FIELDS = json.loads(golden_adf.GOLDEN.read_text(encoding="utf-8"))
DISTANCES = json.loads(golden_distance.GOLDEN.read_text(encoding="utf-8"))
PICTURES = json.loads(golden_picture.GOLDEN.read_text(encoding="utf-8"))
SURFACES = json.loads(golden_mesh.GOLDEN.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", golden_svo.OWN)
def test_own_meshes(device, name: str) -> None:
    mesh = golden_svo.own_mesh(name)
    assert dict(golden_svo.digests(mesh, golden_svo.DIMS, device)) == GOLDEN[name]


@pytest.mark.parametrize("name", golden_svo.REAL)
def test_real_models(device, name: str) -> None:
    mesh = voxtool.load_mesh(model(f"{name}.obj"))
    assert dict(golden_svo.digests(mesh, golden_svo.REAL_DIMS, device)) == GOLDEN[f"{name}.obj"]


def test_closed_models_have_no_odd_column(device) -> None:
    """A closed mesh's rows are outside again beyond it, at every resolution."""
    mesh = voxtool.load_mesh(model("armadillo.obj"))
    for dim in (64, 100, 257):
        grid = voxtool.Grid.fit(mesh, dim)
        dense = voxtool.voxelize(mesh, grid, fill="parity", device=device).to_dense()
        assert dense.any()
        assert not dense[-min(4, dim // 8) :].any()


@pytest.mark.parametrize("name", golden_svo.OWN)
def test_surfaces_of_own_meshes(device, name: str) -> None:
    mesh = golden_svo.own_mesh(name)
    assert dict(golden_mesh.digests(mesh, golden_mesh.DIMS, device)) == SURFACES[name]


@pytest.mark.parametrize("name", golden_svo.REAL)
def test_surfaces_of_real_models(device, name: str) -> None:
    mesh = voxtool.load_mesh(model(f"{name}.obj"))
    found = dict(golden_mesh.digests(mesh, golden_mesh.REAL_DIMS, device))
    assert found == SURFACES[f"{name}.obj"]


@pytest.mark.parametrize("name", golden_distance.OWN)
def test_distances_to_own_meshes(device, name: str) -> None:
    assert dict(golden_distance.digests(golden_svo.own_mesh(name), device)) == DISTANCES[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", golden_adf.OWN)
def test_fields_of_own_meshes(device, name: str) -> None:
    deepest = {k: r for k, r in golden_adf.REQUESTS.items() if r["max_level"] == 5}
    found = dict(golden_adf.digests(golden_svo.own_mesh(name), deepest, device))
    assert found == {k: FIELDS[name][k] for k in deepest}


@pytest.mark.soak
@pytest.mark.parametrize("wing", golden_report.WINGS)
def test_every_digest_of_own_meshes(device, wing: str) -> None:
    golden = json.loads((golden_svo.GOLDEN.parent / f"{wing}.json").read_text(encoding="utf-8"))
    for name, digests in golden_report.WINGS[wing].items():
        assert dict(digests(device)) == golden[name], name


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.soak] * (name in golden_adf.LARGE))
        for name in golden_svo.REAL
    ],
)
def test_fields_of_real_models(device, name: str) -> None:
    mesh = voxtool.load_mesh(model(f"{name}.obj"))
    found = dict(golden_adf.digests(mesh, golden_adf.REAL_REQUESTS, device))
    assert found == FIELDS[f"{name}.obj"]


@pytest.mark.slow
@pytest.mark.parametrize("name", golden_picture.OWN)
def test_pictures_of_surfaces(device, name: str) -> None:
    mesh = golden_svo.own_mesh(name)
    assert dict(golden_picture.surfaces(mesh, device)) == PICTURES[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", golden_picture.VOLUMES)
def test_pictures_of_volumes(device, name: str) -> None:
    volume = golden_picture.own_volume(name)
    assert dict(golden_picture.volume_pictures(volume, device)) == PICTURES[name]


def test_pictures_of_a_real_volume(device) -> None:
    volume = voxtool.build_tet(voxtool.read_unstructured(model("bluntfin.vtu")))
    found = dict(golden_picture.volume_pictures(volume, device, golden_picture.REAL_VIEWS))
    assert found == PICTURES["bluntfin.vtu"]
