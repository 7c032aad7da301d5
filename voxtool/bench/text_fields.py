"""Rows of the hash, the searches and the sizes of [ADF], with figures of voxtool beside.

The chapter has no tables: its rows are statements, with the figures that they have.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.construction.build import plan_adf
from voxtool.adf.field.cells import cell_of, key_of
from voxtool.adf.field.hashing import KEYS_AN_OFFSET, build_hash
from voxtool.adf.queries.query import FieldQuery
from voxtool.bench import timing
from voxtool.bench.adf import points_of
from voxtool.bench.text_peers import field_rows
from voxtool.bench.text_rows import MISPRINT, Row
from voxtool.errors import MemoryLimitError
from voxtool.files.meshes.mesh import load_mesh

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.adf.field.field import DistanceField
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh

LEVELS = range(6, 13)
TOLERANCE = 1e-3
RUNS = 9  # of a search, which takes a millisecond
HASH, SEARCH = "[ADF] section 3.4", "[ADF] section 3.5"
BUILD = (
    "octrees of heights over 8: mostly hours without a result by offsets alone, as in [Lefebvre "
    "2006]; under a minute on average with w"
)
ALIKE = (
    "keys that are equal modulo both sides collide whatever the offsets; common in large domains, "
    "as of heights over 8; no figure"
)
SMALLER = "the offsets are nearly always smaller than the slots; no figure"
ELEMENTS, SIDE = 562_912, 45  # as printed
POINTS = {"random": "random points", "rays": "points along rays"}
SAID = {  # by kind of points
    "random": "level 8: binary as fast as linear on a CPU, slower on a GPU; no figures",
    "rays": "level 9: coherent some 30 % faster than linear",
}
FASTER, FASTER_LEVEL = 30.0, 9


def rows_of(bench: Bench, quick: bool) -> Iterator[Row]:
    """Yield the rows of a mesh: fields down to levels 6 to 12, or 6 alone."""
    mesh = load_mesh(bench.model)
    model = f"{Path(bench.model).name}, {len(mesh.faces):,} triangles"
    yield Row(
        HASH, model, "elements of a texture", f"{SIDE}^3 slots", "", None,
        f"{SIDE}^3 has {SIDE**3:,} slots", text=ELEMENTS, note=MISPRINT,
        statement="[Lefebvre 2006] packs this number of a texture of 512^3",
    )  # fmt: skip
    for level in LEVELS[:1] if quick else LEVELS:
        plan = partial(plan_adf, mesh, tolerance=TOLERANCE, max_level=level, measure=False)
        row = partial(Row, model=model, setting=f"level {level}")
        try:
            field = plan(device=bench.timed).run()
        except MemoryLimitError as error:
            yield row(HASH, what="keys", unit="", voxtool=None, ours=f"no field: {error}")
            break
        yield from _hash(row, field, bench)
        yield from _sizes(row, field)
        yield from _searches(row, mesh, field, level, bench)
        asked = replace(bench.request, repeat=RUNS, levels=(level,))
        points = {POINTS[kind]: places for kind, places in points_of(mesh, asked).items()}
        yield from field_rows(row, field, points, replace(bench, request=asked))


def _hash(row: partial[Row], field: DistanceField, bench: Bench) -> Iterator[Row]:
    """Yield rows of the perfect hash of the cells that are stored."""
    keys = key_of(*cell_of(field.blocks))
    n, row = len(keys), partial(row, HASH)
    words = f"cells with children of fields of tolerance {TOLERANCE:g}"
    yield row(what="keys", unit="", voxtool=n, ours=words)
    yield row(what="level of the deepest leaves", unit="", voxtool=field.depth, ours="")
    table = build_hash(keys, bench.timed)
    row_of_build = partial(row, what="build", unit="s", statement=BUILD)
    for way, with_w in (("with w", True), ("offsets alone", False)):
        build = partial(build_hash, keys, bench.timed, with_w=with_w)
        words = "w where it helps" if with_w else "w is m for each offset"
        try:
            spent = timing.times(build, bench.request.repeat)
        except MemoryLimitError as error:
            yield row_of_build(way=way, voxtool=None, ours=f"{words}; {error}")
            continue
        yield row_of_build(way=way, voxtool=statistics.median(spent), ours=words)
    yield row(what="numbers an offset", unit="", voxtool=table.offsets.shape[-1],
              ours="the fourth is w, where some offset needs it")  # fmt: skip
    sides = range(math.ceil((n / KEYS_AN_OFFSET) ** (1 / 3)), 2 * table.m + 1)
    lost = sum(_alike(keys, table.m, r) > 0 for r in sides)
    words = "of the sides of offsets up to twice that of slots; voxtool takes coprime ones"
    yield row(what="sides with equal keys", unit="%", voxtool=100 * lost / len(sides),
              ours=words, statement=ALIKE)  # fmt: skip
    words = "modulo the sides of both tables of voxtool"
    yield row(what="keys equal to another", unit="", voxtool=_alike(keys, table.m, table.r),
              ours=words)  # fmt: skip
    said = "the smallest cube of slots that holds the keys; no figure"
    yield row(what="load", unit="%", voxtool=100 * table.load(n), ours="slots used", statement=said)
    share = 100 * table.nbytes / field.cells.nbytes
    yield row(what="offsets", unit="% of the slots' bytes", voxtool=share, ours="",
              statement=SMALLER)  # fmt: skip
    yield row(what="offsets", unit="bits a key", voxtool=table.bits_a_key(n), ours="")
    yield row(what="identifier", unit="bytes a cell", voxtool=field.blocks.itemsize, text=4,
              ours="a Morton code after a leading one",
              statement="4 in place of the 12 of a key")  # fmt: skip


def _alike(keys: np.ndarray, m: int, r: int) -> int:
    """Return the number of keys that are equal to another modulo m and r, which no offset
    separates."""
    side = math.lcm(m, r)
    if side > keys.max():
        return 0
    codes = (keys % side) @ np.array([1, side, side * side])
    return len(keys) - len(np.unique(codes))


def _sizes(row: partial[Row], field: DistanceField) -> Iterator[Row]:
    """Yield rows of the bytes that shared samples and implicit leaves save."""
    n, sizes = len(field.voxels), field.sizes()
    texel = field.cells.shape[-1] * field.cells.itemsize
    every = {
        "3.1": ("shared samples", 57.0, "some 57 % smaller", sizes["voxels"],
                8 * 8 * n * field.voxels.itemsize, "with eight samples for each cell"),
        "3.2": ("implicit leaves", 87.0, "up to 87 % smaller", sizes["cells"],
                (8 * n + 1) * texel, "with a texel for each cell, and none free"),
    }  # fmt: skip
    for section, (what, text, said, ours, other, words) in every.items():
        share = 100 * (1 - ours / other)
        yield row(f"[ADF] section {section}", what=what, unit="% smaller", text=text,
                  statement=said, voxtool=share, ours=f"than {words}")  # fmt: skip
        yield row(f"[ADF] section {section}", what="texture", unit="bytes", voxtool=ours, ours="")


def _searches(
    row: partial[Row], mesh: Mesh, field: DistanceField, level: int, bench: Bench
) -> Iterator[Row]:
    """Yield rows of each search, in turns, at random points and at points along rays."""
    bench = replace(bench, request=replace(bench.request, repeat=RUNS, levels=(level,)))
    ask, searches = FieldQuery(field, bench.profiled), bench.request.searches
    for kind, places in points_of(mesh, bench.request).items():
        spent: dict[str, float] = {}
        profiles = bench.profile(*(partial(ask, places, search=search) for search in searches))
        for search, (stages, _) in zip(searches, profiles, strict=True):
            spent[search] = 1e9 * stages["query"] / len(places)
            yield row(SEARCH, what=POINTS[kind], unit="ns a point", way=search,
                      statement=SAID[kind], voxtool=spent[search],
                      ours="stage query")  # fmt: skip
        if kind == "rays":
            text = FASTER if level == FASTER_LEVEL else None
            faster = 100 * (spent["linear"] / spent["coherent"] - 1)
            yield row(SEARCH, what="coherent over linear", unit="% faster", text=text,
                      voxtool=faster, ours="at points along rays, half a leaf apart")  # fmt: skip
