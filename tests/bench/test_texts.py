"""The tables of [voCCeL]: its totals are sums of its stages, and our figures stand beside them."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.cli import ROOT, told, write_obj
from helpers.tets import write_vtu

from voxtool.adf.construction.build import plan_adf
from voxtool.adf.field.cells import cell_of, key_of
from voxtool.bench import text_fields, text_methods, texts
from voxtool.bench.request import KINDS, Request
from voxtool.bench.text_layout import as_text, sections
from voxtool.bench.text_rows import MISPRINT, SOURCES, TITLES, Row
from voxtool.bench.text_voxels import LEVEL_0, beside
from voxtool.bench.timing import Bench
from voxtool.bench.voccel_tables import (
    DIMS,
    HARDWARE,
    MISPRINTS,
    STAGES,
    SURFACES,
    TOTALS,
    TRIANGLES,
    UNEVEN_CUBES,
)
from voxtool.choices import SEARCHES
from voxtool.errors import VoxtoolError
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
    steep = [
        (model, dim)
        for model, rows in SURFACES.items()
        for dim in DIMS[2:]
        if not 3 < rows[dim][3] / rows[dim // 2][3] < 5
    ]
    assert {*steep} == UNEVEN_CUBES | {(model, 2 * dim) for model, dim in UNEVEN_CUBES} | {
        ("dragon", 256)  # 6.3 times the cubes of 128, and 512 has 2.2 times as many
    }


def test_each_figure_stands_beside_that_of_the_text(here: Path) -> None:
    write_obj(Path("octahedron.obj"), *octahedron(np.zeros(3), 1))
    rows = told("bench texts octahedron.obj --quick --json")["rows"]
    rows = [row for row in rows if row["reference"] == "[voCCeL]"]
    tables = dict.fromkeys(row["table"] for row in rows)
    assert tables.keys() == {table for table in TITLES if table.startswith("[voCCeL]")}
    assert all(row["hardware"] == HARDWARE for row in rows)
    for model, printed in STAGES.items():
        mine = [row for row in rows if row["text_model"].split(",")[0] == model]
        found = {(row["table"][-3:], row["what"], row["setting"]): row for row in mine}
        whats = ["active nodes", "building the octree", *(f"level 0, {mode}" for mode in LEVEL_0),
                 "propagation along x", "size"]  # fmt: skip
        for dim in DIMS[:2]:
            stages = [found["7.1", what, f"dim {dim}"] for what in whats]
            assert tuple(row["text"] for row in stages) == printed[dim]
            assert all(row["voxtool"] > 0 for row in stages)
            for mode, totals in TOTALS.items():
                assert found["7.2", mode, f"dim {dim}"]["text"] == totals[model][DIMS.index(dim)]
        columns = ("finding the cubes", "extraction", "in total", "cubes visited", "of all cubes")
        surfaces = [found["7.3", what, "dim 128"] for what in columns]
        assert tuple(row["text"] for row in surfaces) == SURFACES[model][128]
        assert all(row["voxtool"] > 0 for row in surfaces)


def test_every_model_of_the_text_has_the_nearest_beside_it() -> None:
    every = list(TRIANGLES)
    assert beside({"a/other.obj": 8}) == {"a/other.obj": every}
    bunny = {"stanford-bunny.obj": 69_451, "Dragon.ply": 8}
    assert beside(bunny) == {
        "stanford-bunny.obj": ["bunny", "armadillo", "tyrannosaurus"],
        "Dragon.ply": ["dragon"],
    }
    assert beside({"x.obj": 210_000, **bunny}) == {
        "x.obj": ["armadillo", "tyrannosaurus"],
        "stanford-bunny.obj": ["bunny"],
        "Dragon.ply": ["dragon"],
    }
    several = {"x.obj": 200_000, "y.obj": 8, "z.obj": 10**7}
    assert beside(several) == {"x.obj": every, "y.obj": ["bunny"], "z.obj": ["armadillo"]}


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
                what = f"{method.what}, {mode}"
                found = {r.way: r for r in rows if r.setting == f"dim {dim}" and r.what == what}
                planned = found[method.planned]
                assert planned.voxtool
                assert planned.voxtool > 0
                assert "octree" not in planned.ours
                for way in method.ways:
                    forced = found[way]
                    assert forced.voxtool
                    assert forced.voxtool > 0
                    assert forced.ours.endswith(": the same octree")
        measured = [row for row in rows if row.setting == f"dim {dim}"]
        times = [row for row in measured if row.table.endswith("4.1") and row.unit == "ms"]
        assert len(times) == len(COMPACTIONS)
        assert all(row.voxtool and row.voxtool > 0 for row in times)
        assert all(row.ours.endswith(": the same surface") for row in times[1:])
        sizes = [row.voxtool or 0 for row in measured if row.unit == "numbers a value"]
        assert len(sizes) == len(COMPACTIONS) - 1
        assert sizes == sorted(sizes, reverse=True)
        *times, saved = (row for row in measured if row.table.endswith("7.2"))
        sparse, naive = (row.voxtool or 0.0 for row in times)
        assert saved.voxtool == pytest.approx(100 * (1 - sparse / naive))
        assert saved.ours.endswith(": the same surface")


def test_fields_have_the_figures_of_the_text_and_their_own(here: Path) -> None:
    write_obj(Path("octahedron.obj"), *octahedron(np.zeros(3), 1))
    rows = told("bench texts octahedron.obj --quick --json")["rows"]
    rows = [row for row in rows if row["reference"] == "[ADF]"]
    found = {(row["what"], row["way"]): row for row in rows}
    shared, implicit = found["shared samples", ""], found["implicit leaves", ""]
    assert shared["voxtool"] == pytest.approx(100 * (1 - 27 / 64))
    assert (shared["text"], implicit["text"]) == (57, 87)
    assert shared["unit"] == implicit["unit"] == "% smaller"
    printed = found["elements of a texture", ""]
    assert (printed["text"], printed["voxtool"], printed["note"]) == (562_912, None, MISPRINT)
    assert 0 < found["load", ""]["voxtool"] <= 100
    assert all(found["build", way]["voxtool"] > 0 for way in ("with w", "offsets alone"))
    kinds = {(what, search) for what in text_fields.POINTS.values() for search in SEARCHES}
    assert text_fields.POINTS.keys() == {*KINDS}
    assert kinds < found.keys()
    assert all(found[kind]["voxtool"] > 0 and found[kind]["text"] is None for kind in kinds)
    along = text_fields.POINTS["rays"]
    linear, coherent = (found[along, s]["voxtool"] for s in ("linear", "coherent"))
    faster = found["coherent over linear", ""]["voxtool"]
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
    assert rows["keys equal to another"].voxtool == len(keys) - len(seen)
    many = np.random.default_rng(7).permutation(32**3)[:500]
    many = np.stack(np.unravel_index(many, (32,) * 3), axis=1) + 1
    for m, r in ((3, 2), (4, 6), (9, 9), (31, 1), (2, 16)):
        seen = {(*(key % m), *(key % r)) for key in many}
        assert text_fields._alike(many, m, r) == len(many) - len(seen)


def test_volumes_have_the_bytes_of_the_tables(here: Path) -> None:
    write_vtu(Path("volume.vtu"))
    rows = told("bench texts volume.vtu --scalar density --quick --json")["rows"]
    assert {row["reference"] for row in rows} == {"[TetVol]"}
    found = {(row["table"], row["what"], row["way"]): row for row in rows}
    four, five, hexahedra, integration = (f"[TetVol] {name}" for name in (
        "table 4", "table 5", "section 4.1", "section 4.2"))  # fmt: skip
    raycast = found[five, "textures of the table", ""]
    assert raycast["text"] == raycast["voxtool"] == 96
    projection = found[four, "textures of the table", ""]
    vertices = float(projection["ours"].split()[0])  # a cell
    assert projection["voxtool"] == pytest.approx(68 + 16 * vertices, abs=0.01)
    printed = {row["text"] for row in rows if row["text"]}
    assert printed == {71, 48, 119, 912, 96, 144, 76}
    assert found[hexahedra, "textures", "whole"]["voxtool"] == (6 + 1) * 16 + 6 * 4
    assert found[hexahedra, "textures", "split"]["voxtool"] == 6 * 96
    assert found[hexahedra, "pictures", ""]["voxtool"] < 1e-5
    ways = ("exact segments", "pre-integration")
    errors = (found[integration, "root mean square error", way]["voxtool"] for way in ways)
    assert 0 < next(errors) < next(errors)
    changes = [found[integration, "change of the transfer function", way] for way in ways]
    assert all(row["voxtool"] > 0 for row in changes)
    assert found[integration, "compositing", ""]["note"] == MISPRINT


def test_all_models_are_read_first_and_steps_are_told(here: Path) -> None:
    write_obj(Path("octahedron.obj"), *octahedron(np.zeros(3), 1))
    models = ["octahedron.obj", "absent.vtu"]
    told_steps: list[str] = []
    with pytest.raises(VoxtoolError, match=r"absent\.vtu"):
        texts.rows_of(models, None, True, progress=told_steps.append)
    assert not told_steps
    write_vtu(Path("absent.vtu"))
    texts.rows_of([*models, models[0]], None, True, "density", told_steps.append)
    assert told_steps == texts.steps_of([*models, models[0]])
    assert len(told_steps) == 4


def test_a_report_has_a_section_for_each_table_and_escapes_names(here: Path) -> None:
    name = "<script>alert(1)<&.vtu"
    write_vtu(Path("volume.vtu"))
    Path("volume.vtu").rename(name)
    told(f"bench texts '{name}' --scalar region --quick --json -o report")
    page = Path("report/report.html").read_text(encoding="utf-8")
    rows = json.loads(Path("report/report.json").read_text(encoding="utf-8"))["rows"]
    (projection,) = (row for row in rows if row["text"] == 71)
    assert projection["voxtool"] is None  # the array is one a cell
    tables = {row["table"] for row in rows}
    assert page.count("<h2 ") == len(tables)
    assert page.count("<table ") == page.count("<thead>") >= len(tables)
    assert "<script" not in page
    assert "&lt;script&gt;alert(1)&lt;&amp;.vtu" in page


def test_a_table_has_a_column_for_each_setting_and_says_equal_words_once() -> None:
    row = partial(
        Row, "[voCCeL] table 7.2", "b.obj", "solid", unit="ms", text_model="a, 8 triangles"
    )
    rows = [
        row(setting="dim 64", text=0.51, voxtool=1234.5, ours="a call"),
        row(setting="dim 128", text=2, voxtool=0.25, ours="a call", note="misprint"),
        replace(row(setting="dim 64", text=None, voxtool=3, ours="a call"), what="surface6"),
    ]
    (section,) = sections(rows)
    lines = list(as_text([section], ["[voCCeL]"]))
    assert lines[-11:] == [
        "  text: a, 8 triangles; voxtool: b.obj",
        "                        dim 64  dim 128",
        "    solid, ms  text       0.51       2*",
        "               voxtool   1,234     0.25",
        "",
        "  text: a, 8 triangles; voxtool: b.obj",
        "                           dim 64",
        "    surface6, ms  voxtool       3",
        "",
        "  - voxtool: a call",
        "  - solid*: a dim 128: misprint",
    ]


def test_titles_and_sources_are_those_of_the_references() -> None:
    page = (ROOT / "docs/references.md").read_text(encoding="utf-8")
    assert all(f"| {key} |" in page for key in SOURCES)
    assert {table.split()[0] for table in TITLES} == SOURCES.keys()
