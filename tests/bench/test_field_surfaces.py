"""Benchmarks of surfaces of fields: sharp ones are nearer to a model with edges."""

from __future__ import annotations

from pathlib import Path

from conftest import opened, usable_devices
from helpers import meshes
from helpers.cli import write_obj

from voxtool.bench import field_surfaces
from voxtool.bench.request import Request
from voxtool.bench.timing import Bench


def test_sharp_surfaces_are_nearer_than_those_of_peers(tmp_path: Path) -> None:
    write_obj(tmp_path / "box.obj", *meshes.box((0.1, 0.2, 0.3), (4.2, 3.1, 2.7)))
    device = opened(usable_devices()[0][0])
    request = Request(levels=(5,), tolerances=(1e-3,), samples=500, repeat=1, seconds=0, peers=True)
    bench = Bench(request, device, device, "surfaces", str(tmp_path / "box.obj"))
    smooth, sharp, *others = field_surfaces.measure(bench)
    assert (smooth.method, sharp.method) == ("dual contouring", "sharp")
    assert len(others) == 2  # VTK and scikit-image
    assert sharp.errors["rms"] < 0.2 * smooth.errors["rms"]
    assert all(sharp.errors["rms"] < 0.2 * p.errors["rms"] for p in others if p.peer)
    largest = [p.figures["max in voxels"] or 0 for p in (smooth, sharp)]
    assert largest[0] > 0.5 > largest[1]
    assert "edges and corners" in smooth.left_out
