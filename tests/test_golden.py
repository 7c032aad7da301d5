"""Golden digests: the same content on every device, and from one change to the next."""

from __future__ import annotations

import json

import pytest
from conftest import model
from golden import adf as golden_adf
from golden import mesh as golden_mesh
from golden import picture as golden_picture
from golden import svo as golden_svo
from golden.report import WINGS

import voxtool

pytestmark = pytest.mark.every_driver
GOLDEN = {
    wing: json.loads((golden_svo.GOLDEN.parent / f"{wing}.json").read_text(encoding="utf-8"))
    for wing in WINGS
}
# slow wings; make test has some of the requests of fields and of cells of one scalar, make soak all
MARKS = {"adf": [pytest.mark.soak], "picture": [pytest.mark.slow]}


def marks_of(wing: str, name: str) -> list[pytest.MarkDecorator]:
    constant = wing == "picture" and name in golden_picture.CONSTANT
    return [*MARKS.get(wing, ()), *[pytest.mark.soak] * constant]


REAL = {
    "svo": (golden_svo.digests, golden_svo.REAL_DIMS),
    "mesh": (golden_mesh.digests, golden_mesh.REAL_DIMS),
    "adf": (golden_adf.digests, golden_adf.REAL_REQUESTS),
}


@pytest.mark.parametrize(
    ("wing", "name"),
    [
        pytest.param(wing, name, marks=marks_of(wing, name))
        for wing, names in WINGS.items()
        for name in names
    ],
)
def test_own(device, wing: str, name: str) -> None:
    assert dict(WINGS[wing][name](device)) == GOLDEN[wing][name]


@pytest.mark.slow
@pytest.mark.parametrize("name", golden_adf.OWN)
def test_deepest_fields_of_own_meshes(device, name: str) -> None:
    deepest = {k: r for k, r in golden_adf.REQUESTS.items() if r["max_level"] == 5}
    found = dict(golden_adf.digests(golden_svo.own_mesh(name), deepest, device))
    assert found == {k: GOLDEN["adf"][name][k] for k in deepest}


@pytest.mark.parametrize(
    ("wing", "name"),
    [
        pytest.param(wing, name, marks=MARKS["adf"] * (wing == "adf" and name in golden_adf.LARGE))
        for wing in REAL
        for name in golden_svo.REAL
    ],
)
def test_real_models(device, wing: str, name: str) -> None:
    mesh = voxtool.load_mesh(model(f"{name}.obj"))
    digests, requests = REAL[wing]
    assert dict(digests(mesh, requests, device)) == GOLDEN[wing][f"{name}.obj"]


def test_pictures_of_a_real_volume(device) -> None:
    volume = voxtool.build_tet(voxtool.read_unstructured(model("bluntfin.vtu")))
    found = dict(golden_picture.volume_pictures(volume, device, golden_picture.REAL_VIEWS))
    assert found == GOLDEN["picture"]["bluntfin.vtu"]


@pytest.mark.slow
@pytest.mark.parametrize("name", golden_picture.CONSTANT)
def test_pictures_of_cells_of_one_scalar(device, name: str) -> None:
    volume, golden = golden_picture.own_volume(name), GOLDEN["picture"][name]
    for ending, integrators in golden_picture.PAIRS.items():
        views = [view for view in golden_picture.VIEWS if view.endswith(ending)]
        found = dict(golden_picture.volume_pictures(volume, device, views, integrators))
        assert len(found) == 2 * len(views) * len(integrators) == 12
        assert found == {key: golden[key] for key in found}


def test_closed_models_have_no_odd_column(device) -> None:
    """A closed mesh's rows are outside again beyond it, at every resolution."""
    mesh = voxtool.load_mesh(model("armadillo.obj"))
    for dim in (64, 100, 257):
        grid = voxtool.Grid.fit(mesh, dim)
        dense = voxtool.voxelize(mesh, grid, fill="parity", device=device).to_dense()
        assert dense.any()
        assert not dense[-min(4, dim // 8) :].any()
