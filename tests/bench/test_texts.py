"""The tables of [voCCeL]: its totals are sums of its stages, and our figures stand beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers_cli import told, write_obj

from voxtool.bench.text_voxels import LEVEL_0, nearest
from voxtool.bench.voccel_tables import DIMS, HARDWARE, MISPRINTS, STAGES, SURFACES, TOTALS
from voxtool.selftest.shapes import octahedron


def test_figures_agree_with_each_other_but_for_the_misprints() -> None:
    for column, (mode, totals) in enumerate(TOTALS.items(), 2):
        for model, numbers in totals.items():
            for dim, total in zip(DIMS, numbers, strict=True):
                row = STAGES[model][dim]
                whole = row[0] + row[1] + row[column] + (row[5] if mode == "solid" else 0)
                same = whole == pytest.approx(total, abs=2e-3)
                assert same == ((model, dim, mode) not in MISPRINTS)
    for rows in SURFACES.values():
        for dim, (null, cubes, both, visited, share) in rows.items():
            assert null + cubes == pytest.approx(both, abs=2e-3)
            assert 100 * visited / (dim // 4) ** 3 == pytest.approx(share, abs=0.02)


def test_each_figure_stands_beside_that_of_the_text(here: Path) -> None:
    write_obj(Path("octahedron.obj"), *octahedron(np.zeros(3), 1))
    rows = told("bench texts octahedron.obj --quick --json")["rows"]
    rows = [row for row in rows if row["reference"] == "[voCCeL]"]
    assert {row["table"][-3:] for row in rows} == {"7.1", "7.2", "7.3"}
    assert all(row["voxtool"] >= 0 and row["hardware"] == HARDWARE for row in rows)
    assert nearest("a/Dragon.obj", 5) == "dragon"
    found = {(row["what"], row["setting"]): row for row in rows}
    for dim in DIMS[:2]:
        text = STAGES["bunny"][dim]
        whats = ["active nodes", "building the octree", *(f"level 0, {mode}" for mode in LEVEL_0),
                 "propagation along x", "size"]  # fmt: skip
        assert tuple(found[what, f"dim {dim}"]["text"] for what in whats) == text
        assert all(found[what, f"dim {dim}"]["voxtool"] > 0 for what in whats)
