"""The tables of [voCCeL]: its totals are sums of its stages, and our figures stand beside them."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers_cli import told, write_obj
from helpers_tets import write_vtu

from voxtool.adf.build import plan_adf
from voxtool.adf.cells import cell_of, key_of
from voxtool.bench import text_fields, text_methods
from voxtool.bench.request import KINDS, Request
from voxtool.bench.text_rows import MISPRINT, Row
from voxtool.bench.text_voxels import LEVEL_0, nearest
from voxtool.bench.timing import Bench
from voxtool.bench.voccel_tables import DIMS, HARDWARE, MISPRINTS, STAGES, SURFACES, TOTALS
from voxtool.choices import SEARCHES
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import open_device
from voxtool.selftest.shapes import octahedron
from voxtool.svo.surface.plan import COMPACTIONS


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
    tables = {row["table"].removeprefix("[voCCeL] ") for row in rows}
    assert tables == {
        *(f"table 7.{i}" for i in (1, 2, 3)),
        "figure 7.1",
        "figure 7.2",
        "section 4.1",
        "section 7.1",
        "algorithm 2",
    }
    assert all(row["voxtool"] >= 0 or row["unit"] == "%" for row in rows)
    assert all(row["hardware"] == HARDWARE for row in rows)
    assert nearest("a/Dragon.obj", 5) == "dragon"
    found = {(row["what"], row["setting"]): row for row in rows}
    for dim in DIMS[:2]:
        text = STAGES["bunny"][dim]
        whats = ["active nodes", "building the octree", *(f"level 0, {mode}" for mode in LEVEL_0),
                 "propagation along x", "size"]  # fmt: skip
        assert tuple(found[what, f"dim {dim}"]["text"] for what in whats) == text
        assert all(found[what, f"dim {dim}"]["voxtool"] > 0 for what in whats)


def test_each_method_stands_beside_what_the_plan_takes(device, here: Path) -> None:
    vertices, faces = octahedron(np.zeros(3), 1)
    write_obj(Path("octahedron.obj"), vertices, faces)
    request = Request(repeat=1, seconds=0.0)
    profiled = open_device(str(device.info.index), profile=True)
    bench = Bench(request, device, profiled, "texts", "octahedron.obj")
    rows = list(text_methods.rows_of(bench, True))
    for dim in DIMS[:2]:
        for mode, methods in text_methods.METHODS.items():
            for method in methods:
                found = {row.what: row for row in rows if row.setting == f"dim {dim}, {mode}"}
                planned = found[f"{method.what}: {method.planned}"]
                assert planned.voxtool > 0
                assert "octree" not in planned.ours
                for way in method.ways:
                    forced = found[f"{method.what}: {way}"]
                    assert forced.voxtool > 0
                    assert forced.ours.endswith(": the same octree")
        ways = [row for row in rows if row.setting == f"dim {dim}, marching cubes"]
        assert [row.what for row in ways] == [f"marching cubes: {name}" for name in COMPACTIONS]
        assert all(row.voxtool > 0 for row in ways)
        assert all(row.ours.endswith(": the same surface") for row in ways[1:])
        *times, saved = (row for row in rows if row.setting == f"dim {dim}")
        sparse, naive = (row.voxtool for row in times)
        assert saved.voxtool == pytest.approx(100 * (1 - sparse / naive))
        assert saved.ours.endswith(": the same surface")


def test_fields_have_the_figures_of_the_text_and_their_own(here: Path) -> None:
    write_obj(Path("octahedron.obj"), *octahedron(np.zeros(3), 1))
    rows = told("bench texts octahedron.obj --quick --json")["rows"]
    rows = [row for row in rows if row["reference"] == "[ADF]"]
    found = {row["what"]: row for row in rows}
    shared, implicit = found["shared samples"], found["implicit leaves"]
    assert shared["voxtool"] == pytest.approx(100 * (1 - 27 / 64))
    assert (shared["text"], implicit["text"]) == (57, 87)
    assert shared["unit"] == implicit["unit"] == "%"
    printed = found["elements of a texture"]
    assert (printed["text"], printed["voxtool"], printed["note"]) == (562_912, None, MISPRINT)
    assert 0 < found["load"]["voxtool"] <= 100
    kinds = {f"{search} search, {kind}" for search in SEARCHES for kind in KINDS}
    assert kinds < found.keys()
    assert all(found[kind]["voxtool"] > 0 and found[kind]["text"] is None for kind in kinds)
    linear, coherent = (found[f"{s} search, rays"]["voxtool"] for s in ("linear", "coherent"))
    faster = found["coherent over linear, rays"]["voxtool"]
    assert 1 + faster / 100 == pytest.approx(linear / coherent)


def test_keys_that_no_offset_separates_are_counted_one_by_one(device) -> None:
    request = Request(
        repeat=1, seconds=0.0, levels=(3,), points=64, searches=("linear", "coherent")
    )
    vertices, faces = octahedron(np.zeros(3), 1)
    mesh = Mesh(vertices, faces.astype(np.int32))
    field = plan_adf(mesh, tolerance=1e-2, max_level=3, measure=False, device=device).run()
    row = partial(Row, model="", setting="")
    rows = {r.what: r for r in text_fields._hash(row, field, Bench(request, device, device))}
    keys = [tuple(k) for k in key_of(*cell_of(field.blocks)).tolist()]
    m, r = field.hash.m, field.hash.r
    seen = {tuple(x % m for x in key) + tuple(x % r for x in key) for key in keys}
    assert rows["hash without w"].voxtool == len(keys) - len(seen)
    assert rows["load"].voxtool == pytest.approx(100 * len(keys) / m**3)


def test_volumes_have_the_bytes_of_the_tables(here: Path) -> None:
    write_vtu(Path("volume.vtu"))
    rows = told("bench texts volume.vtu --scalar density --quick --json")["rows"]
    assert {row["reference"] for row in rows} == {"[TetVol]"}
    found = {(row["what"], row["setting"]): row for row in rows}
    raycast = found["textures of the table", "raycast"]
    assert raycast["text"] == raycast["voxtool"] == 96
    projection = found["textures of the table", "projection"]
    vertices = float(projection["ours"].split()[0])  # a cell
    assert projection["voxtool"] == pytest.approx(68 + 16 * vertices, abs=0.01)
    assert found["bytes of hexahedra", "hexahedra"]["voxtool"] == (6 + 1) * 16 + 6 * 4
    assert found["bytes of hexahedra", "raycast"]["voxtool"] == 6 * 96
    exact, table = (row["voxtool"] for row in rows if row["unit"] == "of a colour")
    assert exact < table
    assert found["compositing", "front to back"]["note"] == MISPRINT


def test_a_report_has_a_section_for_each_table_and_escapes_names(here: Path) -> None:
    name = "<script>alert(1)<&.vtu"
    write_vtu(Path("volume.vtu"))
    Path("volume.vtu").rename(name)
    told(f"bench texts '{name}' --scalar density --quick --json -o report")
    page = Path("report/report.html").read_text(encoding="utf-8")
    rows = json.loads(Path("report/report.json").read_text(encoding="utf-8"))["rows"]
    tables = {(row["table"], row["model"]) for row in rows}
    assert page.count("<h2>") == page.count("<table>") == len(tables)
    assert page.count("<tr>") == len(rows) + len(tables)
    assert "<script" not in page
    assert "&lt;script&gt;alert(1)&lt;&amp;.vtu" in page
