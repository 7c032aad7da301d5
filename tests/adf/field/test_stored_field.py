"""Fields that stay in their files: the same values as in memory."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.cli import fail, told
from helpers.files import DATA

import voxtool
from voxtool.adf.field import stored_field
from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.stored_field import StoredField
from voxtool.files import open_adf, read_adf, write_adf

ALL = {"gradient": True, "bounds": True, "cell": True}


@pytest.fixture
def field(here: Path) -> DistanceField:
    built = voxtool.build_adf("bunny.obj", tolerance=1e-3, max_level=6, measure=False)
    write_adf(built, "a.adf.h5")
    return built


def points_of(field: DistanceField) -> np.ndarray:
    """Return points in and around the cube of a field, and some that are not finite."""
    random = np.random.default_rng(4)
    low, side = np.array(field.origin), field.side
    points = low + side * random.uniform(-0.1, 1.1, (4000, 3))
    points[5, 1], points[9, 2], points[11] = np.nan, np.inf, low
    return points


def test_values_are_those_of_the_field(field: DistanceField, monkeypatch) -> None:
    points = points_of(field)
    whole = field.query(points, **ALL)
    for layers in (1, 3, 16):
        monkeypatch.setattr(stored_field, "LAYERS", layers)
        with open_adf("a.adf.h5") as stored:
            assert isinstance(stored, StoredField)
            assert stored.depth == field.depth
            for name, asked in (("all", ALL), ("distance", {})):
                found = stored.query(points, **asked)
                for one in ("distance", *(("gradient", "bound", "level", "cell") if asked else ())):
                    expected = getattr(whole, one)
                    np.testing.assert_array_equal(getattr(found, one), expected, err_msg=name)
                np.testing.assert_array_equal(found.outside, whole.outside)


def test_the_command_reads_what_it_needs(field: DistanceField, here: Path) -> None:
    np.save("points.npy", points_of(field))
    asked = "adf-query a.adf.h5 points.npy --gradient --bounds --cell --json"
    whole = told(f"{asked} -o whole.npy")
    read = 100_000
    assert read < (here / "a.adf.h5").stat().st_size
    part = told(f"{asked} -o part.npy --max-memory {read}")
    assert (here / "part.npy").read_bytes() == (here / "whole.npy").read_bytes()
    same = ("points", "outside", "nan")
    assert {name: part[name] for name in same} == {name: whole[name] for name in same}


def test_fields_without_bounds_and_of_version_1(here: Path) -> None:
    write_adf(voxtool.build_adf("bunny.obj", max_level=3, bounds=False), "a.adf.h5")
    np.save("points.npy", np.zeros((3, 3)))
    assert "no bounds" in fail("adf-query a.adf.h5 points.npy --bounds --max-memory 1k -o x.npy", 3)
    old = DATA / "v1.0.adf.h5"
    with open_adf(old) as found:
        assert isinstance(found, DistanceField)
        assert found == read_adf(old)


@pytest.mark.parametrize("name", ["beyond", "empty", "shape"])
def test_damage_is_one_line(field: DistanceField, name: str) -> None:
    np.save("points.npy", np.zeros((3, 3)))
    with h5py.File("a.adf.h5", "r+") as h5:
        cells = h5["cells"][...]
        if name == "beyond":
            cells[cells[..., 0] != 0, -1] = 0xFFFFFFFF
        elif name == "empty":
            cells[...] = 0
        else:
            voxels = h5["voxels"][...]
            del h5["voxels"]
            h5["voxels"] = np.ascontiguousarray(voxels[:-1])
        h5["cells"][...] = cells
    wrong = {"beyond": "a pointer leads beyond", "empty": "where 0 is expected", "shape": "shape"}
    assert wrong[name] in fail("adf-query a.adf.h5 points.npy --max-memory 1k -o x.npy", 3)
