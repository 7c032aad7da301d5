"""Benchmarks of exports and imports: a row for each format, and what is counted as an error."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.cli import write_obj

from voxtool.bench import exchange
from voxtool.bench.request import Request
from voxtool.bench.timing import Bench
from voxtool.errors import VoxtoolWarning
from voxtool.files import formats
from voxtool.svo.octree.octree import Octree

REQUEST = Request(dims=(16,), repeat=1, seconds=0)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    write_obj(tmp_path / "ball.obj", *meshes.icosphere(1))
    device = opened(usable_devices()[0][0])
    return Bench(REQUEST, device, device, "exchange", str(tmp_path / "ball.obj"))


def test_every_format_comes_back(bench: Bench) -> None:
    points = list(exchange.measure(bench))
    written = {p.method: p for p in points if p.work == "octree to file"}
    read = {p.method: p for p in points if p.work == "file to octree"}
    own = [f".{name}" for name in exchange.OWN]
    assert list(written) == own + [formats.ending(name) for name in exchange.FORMATS]
    assert list(read) == own + [f".{name}" for name in formats.IMPORTS]
    assert written[".svo.h5"].figures["over the file"] == 1
    assert (written[".merged.svo.h5"].figures["over the file"] or 0) < 1
    for method, point in written.items():
        assert point.errors == ({"returned": 0} if method in read else {})
        assert point.bytes
        assert point.figures["over the file"]
    assert written[".npy"].bytes == 128 + 16**3
    samples = {p.method: p for p in points if p.work == "field to file"}
    assert list(samples) == [formats.ending(name) for name in exchange.FIELD_FORMATS]
    assert samples[".npy"].bytes == 128 + 4 * 16**3
    links = [p for p in points if p.work == "octree to links"]
    assert [p.method for p in links] == ["D3Q19", "D3Q27"]
    assert all(p.errors == {"uncrossed": 0} and p.size for p in links)
    images = [p for p in points if p.work == "file to field"]
    assert [p.method for p in images] == [f".{name}" for name in formats.IMAGES]
    assert all(p.errors == {"returned": 0} for p in images)


def test_voxels_that_come_back_otherwise_are_counted(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def one_less(path: Path, **place) -> Octree:
        found = read(path, **place)
        return Octree.from_voxels(found.occupied()[1:], found.grid)

    read = exchange.read_voxels
    monkeypatch.setattr(exchange, "read_voxels", one_less)
    monkeypatch.setattr(exchange, "OWN", {})
    monkeypatch.setattr(exchange, "LATTICES", ())
    monkeypatch.setattr(exchange, "FORMATS", ("npy",))
    monkeypatch.setattr(exchange, "FIELD_FORMATS", ())
    for point in exchange.measure(bench):
        assert point.size
        assert point.errors == {"returned": 1 / point.size}


def test_formats_that_cannot_be_written_are_left_out(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = formats.EXCHANGE["nii"]._replace(needs="no_such_package")
    monkeypatch.setitem(formats.EXCHANGE, "nii", line)
    monkeypatch.setattr(exchange, "OWN", {})
    monkeypatch.setattr(exchange, "LATTICES", ())
    monkeypatch.setattr(exchange, "FORMATS", ("nii", "npy"))
    monkeypatch.setattr(exchange, "FIELD_FORMATS", ())
    monkeypatch.setattr(exchange, "MOST_BYTES", 5000)
    with pytest.warns(VoxtoolWarning, match=r"\.nii at dim 16 is left out: .*no_such_package"):
        assert {point.method for point in exchange.measure(bench)} == {".npy"}
    monkeypatch.setattr(exchange, "MOST_BYTES", 4000)
    with (
        pytest.warns(VoxtoolWarning, match=r"\.nii at dim 16 is left out: .*no_such_package"),
        pytest.warns(VoxtoolWarning, match=r"\.npy at dim 16 is left out: .* of 4 kB allowed"),
    ):
        assert list(exchange.measure(bench)) == []
