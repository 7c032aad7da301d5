"""The peers that the texts name: the same distances and cells as voxtool's own, and their sizes."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from adf.queries.test_query import spike, with_w
from helpers.field import plain_field, sphere

from voxtool.adf.field.cells import cell_identifier
from voxtool.bench import text_peers
from voxtool.bench.request import Request
from voxtool.bench.text_peers import EIGHT, PERFECT, PROBED, VERTICES, Peers, Probing
from voxtool.bench.text_report import figures_of
from voxtool.bench.text_rows import Row
from voxtool.bench.timing import Bench
from voxtool.morton import morton_decode
from voxtool.opencl import open_device

WAYS = (EIGHT, VERTICES, PERFECT, PROBED)


def ball(max_level: int):
    return plain_field(sphere, 1e-2, max_level, origin=(-1.0, 2.0, 0.5), side=3.0)


@pytest.mark.parametrize("kind", ["shallow", "deep", "with w", "moved"])
def test_all_answer_alike(device, kind: str) -> None:
    deep = plain_field(lambda p: spike(p) / 32, 0.2 / 32, 13)
    fields = {"shallow": plain_field(sphere, 0.5, 2), "deep": deep, "with w": with_w(deep, 40),
              "moved": ball(5)}  # fmt: skip
    field = fields[kind]
    random = np.random.default_rng(3)
    points = np.array(field.origin) + field.side * random.uniform(0.001, 0.999, (3000, 3))
    points[0] = np.array(field.origin)
    expected = field.query(points).distance
    ways = Peers(field, device).ways(points)
    assert tuple(ways) == WAYS
    for name, run in ways.items():
        distances, probes = run()
        assert np.array_equal(distances, expected), name
        assert (probes.min() > 0) == (name != EIGHT)


def test_probes_are_those_of_a_table_filled_one_by_one() -> None:
    random = np.random.default_rng(4)
    keys = np.unique(random.integers(1, 1 << 60, 700, np.uint64))
    table = Probing.of(keys)
    assert len(keys) <= 0.7 * len(table.keys) < 1.4 * len(keys) + 2
    assert np.array_equal(table.keys[table.slots], keys)
    assert np.count_nonzero(table.keys) == len(keys)
    for key in keys.tolist():  # no free slot lies between its first slot and its own
        slot = (key * int(text_peers.GOLDEN) & (1 << 64) - 1) >> (64 - table.bits)
        while table.keys[slot] != key:
            assert table.keys[slot]
            slot = (slot + 1) % len(table.keys)


def test_cousins_share_what_is_equal() -> None:
    """Each level of an octree that is full down to its last is one lattice."""
    count = 3
    blocks = np.concatenate(
        [cell_identifier(level, np.indices([1 << level] * 3).reshape(3, -1).T).astype(np.uint64)
         for level in range(count)]
    )  # fmt: skip
    samples = np.zeros((len(blocks), 3, 3, 3), np.float32)

    full: Any = SimpleNamespace(voxels=samples, blocks=blocks)
    lattices = [(2 << level) + 1 for level in range(count)]
    assert text_peers.shared_by_cousins(full) == sum(n**3 for n in lattices)
    samples[9, 0, 0, 2] = 1  # of a block of the deepest level: its eight share nothing
    expected = sum(n**3 for n in lattices[:-1]) + 7 * 5**3 + 8 * 3**3
    assert text_peers.shared_by_cousins(full) == expected


def test_codes_are_decoded_by_table(device) -> None:
    codes = np.random.default_rng(5).integers(0, 1 << 63, 1000, np.uint64)
    for by_table in (False, True):
        assert np.array_equal(text_peers.decode(codes, device, by_table), morton_decode(codes))
    assert text_peers.decoding_table().nbytes == 3 * 512


def test_rows(device) -> None:
    field = ball(4)
    request = Request(repeat=2, seconds=0.0, levels=(4,))
    points = np.array(field.origin) + field.side * np.random.default_rng(6).random((300, 3))
    row = partial(Row, model="a", setting="level 4")
    profiled = open_device(str(device.info.index), profile=True)
    bench = Bench(request, profiled, profiled)
    rows = list(text_peers.field_rows(row, field, {"points": points}, bench))
    timed = [r for r in rows if r.unit == "ns a point"]
    assert {r.way for r in timed} == {text_peers.OURS, *WAYS}
    peers = [r for r in timed if r.way != text_peers.OURS]
    assert all(r.ours.endswith(": the same distances") for r in peers)
    samples = {r.way: r.voxtool for r in rows if r.what == "samples"}
    assert sorted(samples.values(), reverse=True) == list(samples.values())  # pyright: ignore[reportArgumentType]
    read = {r.way: r.voxtool or 0 for r in rows if r.what == "slots read a point, points"}
    assert 1 <= read[PERFECT] <= read[PROBED]


def test_figures_are_drawn() -> None:
    row = partial(Row, "[voCCeL] figure 7.1", "a.obj", "level 0", unit="ms", ours="")
    rows = [row(setting=f"dim {dim}", voxtool=dim / 8, way=way, spread=0.2)
            for dim in (64, 128) for way in ("one", "other")]  # fmt: skip
    (chart,) = figures_of([*rows, Row("[ADF] section 3.1", "b", "x", "", "ms", 1.0, "")])[
        "[voCCeL] figure 7.1"
    ]
    assert "level 0: one" in chart.svg
    assert "128" in chart.svg
    assert chart.png.startswith(b"\x89PNG")
