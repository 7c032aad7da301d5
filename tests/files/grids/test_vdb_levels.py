"""Level sets in .vdb: OpenVDB's library, and the import, against the field at every sample."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.field import level_sets, plain_field
from helpers.octree import ball
from helpers.openvdb import openvdb

import voxtool
from voxtool.adf.surface import narrow_band
from voxtool.errors import VoxtoolError

CASES = level_sets()
SPHERE, SIDE = CASES["default"][0], CASES["default"][0].side


def test_every_sample(tmp_path: Path) -> None:
    """The values and the active samples, also where no leaf is; place, class and statistics."""
    paths = {name: (tmp_path / f"{name}.vdb", tmp_path / f"{name}.npz") for name in CASES}
    for name, (field, options, _) in CASES.items():
        job = voxtool.plan_export(field, paths[name][0], **options)
        assert job.run() <= job.plan.size
    openvdb([("read", *paths[name], *shape) for name, (_, _, shape) in CASES.items()])
    for name, (field, options, shape) in CASES.items():
        read = np.load(paths[name][1])
        facts, values = json.loads(str(read["facts"])), read["values"]
        spacing = options.get("spacing", field.side / 32)
        background = np.float32(options.get("band", 3) * spacing)
        steps = np.indices(shape).reshape(3, -1).T
        first = np.array(field.origin) + spacing / 2
        distances = voxtool.query_adf(field, first + spacing * steps).distance.astype(np.float32)
        assert np.array_equal(values.ravel(), distances.clip(-background, background)), name
        assert (facts["type"], facts["class"]) == ("FloatGrid", "level set")
        assert np.float32(facts["background"]) == background
        assert np.allclose(facts["corners"][0], first, rtol=0, atol=1e-14)
        assert np.allclose(facts["corners"][2], first + spacing * np.array(shape), atol=1e-13)
        if name == "half":
            assert values[0, 0, 0] == -background
            continue
        assert facts["active"] == np.count_nonzero(abs(distances) < background)
        assert facts["metadata"]["file_voxel_count"] == facts["active"]
        octree = voxtool.read_voxels(paths[name][0])
        assert octree.grid == voxtool.Grid(shape, field.origin, (spacing,) * 3)
        assert np.array_equal(octree.to_dense(), (distances < 0).reshape(shape))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"band": 0.5}, "a band of 0.5 voxels"),
        ({"spacing": 1.0}, "a spacing of 1: for this field"),
        ({"spacing": SIDE / 300}, "takes more than 64 blocks"),
        ({"level": 1}, "take no level"),
        ({"spacing": (0.1, 0.1, 0.2)}, "choose it by a band and one spacing"),
    ],
)
def test_refusals(
    options: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(narrow_band, "MOST_BOXES", 64)
    with pytest.raises(VoxtoolError, match=message):
        voxtool.export(SPHERE, tmp_path / "a.vdb", **options)


def test_what_has_no_inside_is_refused(tmp_path: Path) -> None:
    with pytest.raises(VoxtoolError, match="has an inside, and this field has none"):
        voxtool.export(plain_field(sign="none"), tmp_path / "a.vdb")
    with pytest.raises(VoxtoolError, match="go with a distance field"):
        voxtool.export(voxtool.Octree.from_dense(ball((9, 9, 9))), tmp_path / "a.vdb", band=3)
