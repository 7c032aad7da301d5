"""The tables of [voCCeL]: its totals are sums of its stages, and our figures stand beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers_cli import told, write_obj

from voxtool.bench.texts import nearest
from voxtool.bench.voccel_tables import DIMS, MISPRINTS, STAGES, SURFACES, TOTALS
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
    assert {row["table"] for row in rows} == {"7.1", "7.2", "7.3"}
    assert len(rows) == 10
    assert all(row["voxtool"] > 0 and row["text_model"] == "bunny" for row in rows)
    assert nearest("a/Dragon.obj", 5) == "dragon"
