"""Rows of the hash, the searches and the sizes of [ADF], with figures of voxtool beside.

The chapter has no tables: its rows are statements, with the figures that they have.
"""

from __future__ import annotations

import statistics
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.build import plan_adf
from voxtool.adf.cells import cell_of, key_of
from voxtool.adf.hashing import build_hash
from voxtool.adf.query import FieldQuery
from voxtool.bench import timing
from voxtool.bench.adf import points_of
from voxtool.bench.text_rows import MISPRINT, Row
from voxtool.errors import MemoryLimitError
from voxtool.files.mesh import load_mesh

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.adf.field import DistanceField
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh

LEVELS = range(6, 13)
TOLERANCE = 1e-3
RUNS = 9  # of a search, which takes a millisecond
HASH, SEARCH = "[ADF] section 3.4", "[ADF] section 3.5"
STUCK = "heights over 8: mostly hours without a result"
ELEMENTS, SIDE = 562_912, 45  # as printed
SAID = {  # by kind of points and search
    ("random", "binary"): "level 8: as fast as linear on a CPU, slower on a GPU; no figures",
    ("rays", "coherent"): "level 9: some 30 % faster than linear",
}
FASTER, FASTER_LEVEL = 30.0, 9


def rows_of(bench: Bench, quick: bool) -> Iterator[Row]:
    """The rows of a mesh: fields down to levels 6 to 12, or 6 alone."""
    mesh = load_mesh(bench.model)
    model = f"{Path(bench.model).name} ({len(mesh.faces):,} triangles)"
    words = f"{SIDE}^3 has {SIDE**3:,} slots"
    yield Row(
        HASH, model, "elements of a texture", f"{SIDE}^3 slots", "", ELEMENTS,
        "as printed, of [Lefebvre 2006]", None, words, MISPRINT,
    )  # fmt: skip
    for level in LEVELS[:1] if quick else LEVELS:
        limit = f"levels to {level}"
        plan = partial(plan_adf, mesh, tolerance=TOLERANCE, max_level=level, measure=False)
        try:
            field = plan(device=bench.timed).run()
        except MemoryLimitError as error:
            why = f"not measured: {error}"
            yield Row(HASH, model, "hash", limit, "", None, STUCK, None, "no field", why)
            break
        row = partial(Row, model=model, setting=f"{limit}, reached {field.depth}")
        yield from _hash(row, field, bench)
        yield from _sizes(row, field)
        yield from _searches(row, mesh, field, level, bench)


def _hash(row: partial[Row], field: DistanceField, bench: Bench) -> Iterator[Row]:
    """Rows of the perfect hash of the cells that are stored."""
    keys = key_of(*cell_of(field.blocks))
    n, build = len(keys), partial(build_hash, keys, bench.timed)
    table = build()
    spent = statistics.median(timing.times(build, bench.request.repeat))
    row = partial(row, HASH, text=None)
    used = "with w" if table.has_w else "w is not needed"
    alike = n - len(np.unique(np.concatenate([keys % table.m, keys % table.r], axis=1), axis=0))
    said, used = "under a minute, on average", "without w"
    if table.has_w:
        used = "with w" if alike else "with w, though no two keys need it"
    yield row(
        what="hash, w where it helps",
        unit="s",
        statement=said,
        voxtool=spent,
        ours=f"{n:,} keys, {used}",
    )
    words = f"keys equal to another modulo {table.m} and {table.r}, which no offset separates"
    yield row(what="hash without w", unit="keys", statement=STUCK, voxtool=alike, ours=words)
    said = "the smallest cube of slots; no figure"
    yield row(what="load", unit="%", statement=said, voxtool=100 * table.load(n), ours="slots used")
    said = "the offsets are nearly always smaller than the slots; no figure"
    words = "bits of offsets a key"
    yield row(
        what="bits a key", unit="bits", statement=said, voxtool=table.bits_a_key(n), ours=words
    )


def _sizes(row: partial[Row], field: DistanceField) -> Iterator[Row]:
    """Rows of the bytes that shared samples and implicit leaves save."""
    n, sizes = len(field.voxels), field.sizes()
    texel = field.cells.shape[-1] * field.cells.itemsize
    every = {
        "3.1": ("shared samples", 57.0, "some 57 % smaller", sizes["voxels"],
                8 * 8 * n * field.voxels.itemsize, "with eight samples for each child"),
        "3.2": ("implicit leaves", 87.0, "up to 87 % smaller", sizes["cells"],
                (8 * n + 1) * texel, "with a texel for each cell, and none free"),
    }  # fmt: skip
    for section, (what, text, said, ours, other, words) in every.items():
        words = f"{ours:,} bytes; {other:,} {words}"
        share = 100 * (1 - ours / other)
        yield row(f"[ADF] section {section}", what=what, unit="%", text=text, statement=said,
                  voxtool=share, ours=words)  # fmt: skip


def _searches(
    row: partial[Row], mesh: Mesh, field: DistanceField, level: int, bench: Bench
) -> Iterator[Row]:
    """Rows of each search, in turns, at random points and at points along rays."""
    bench = replace(bench, request=replace(bench.request, repeat=RUNS))
    ask, searches = FieldQuery(field, bench.profiled), bench.request.searches
    for kind, places in points_of(mesh, bench.request).items():
        spent: dict[str, float] = {}
        profiles = bench.profile(*(partial(ask, places, search=search) for search in searches))
        for search, (stages, _) in zip(searches, profiles, strict=True):
            spent[search] = 1e9 * stages["query"] / len(places)
            yield row(SEARCH, what=f"{search} search, {kind}", unit="ns a point", text=None,
                      statement=SAID.get((kind, search), "no figure"), voxtool=spent[search],
                      ours=f"stage query, {len(places):,} points")  # fmt: skip
        if kind == "rays":
            text = FASTER if level == FASTER_LEVEL else None
            faster = 100 * (spent["linear"] / spent["coherent"] - 1)
            yield row(SEARCH, what="coherent over linear, rays", unit="% faster", text=text,
                      statement=SAID["rays", "coherent"], voxtool=faster,
                      ours="ratio of the two")  # fmt: skip
