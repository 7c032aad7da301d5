"""Ablations of what plans leave out, on the generated scenes."""

from __future__ import annotations

from helpers.cli import fail, told

from voxtool.bench.ablation import FIELD, VOXELIZE
from voxtool.bench.plans import FIELDS, KINDS, VOLUMES, VOXELS
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.mesh.topology import check_surface


def test_scenes() -> None:
    """Ten of each wing, which are what their names say."""
    assert (len(VOXELS), len(FIELDS), len(VOLUMES), len(KINDS)) == (10, 10, 10, 30)
    for scenes in (VOXELS, FIELDS):
        for name, (shape, *_) in scenes.items():
            found = check_surface(mesh_from_arrays(*shape()))
            assert found.closed == (name not in ("needles", "ball-with-hole")), name


def test_what_is_left_out_is_forced() -> None:
    found = told("bench plans voxels-cube field-cube --repeat 1 --json -q")
    assert found["points"] == []
    by_model = {"voxels-cube": set(), "field-cube": set()}
    for one in found["savings"]:
        by_model[one["model"]].add(one["what"])
        assert len(one["runs"]) == len(one["forced"]) == 1
        assert one["same"] or one["what"] in FIELD
    assert {"128-bit predicates", "64-bit Morton codes"} <= by_model["voxels-cube"] & set(VOXELIZE)
    assert "winding numbers" in by_model["field-cube"]
    saved = {one["what"]: one["saved_bytes"] for one in found["savings"]}
    assert saved["64-bit Morton codes"] > 0
    assert saved["128-bit predicates"] == 0  # a kernel's private numbers: no buffer


def test_transparent_cells_of_a_volume() -> None:
    (one,) = told("bench plans volume-corner --repeat 1 --json -q")["savings"]
    assert one["what"] == "transparent cells"
    assert one["same"]
    assert one["saved_bytes"] > 1e6
    assert not told("bench plans volume-whole --repeat 1 --json -q")["savings"]


def test_an_unknown_scene() -> None:
    assert "no scene is 'voxels-x': choose voxels-cube, " in fail("bench plans voxels-x")
