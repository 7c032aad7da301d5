"""Exports and imports of the octree of a mesh by every format: the time to write and to read a
file, its size beside that of the octree's own, and the voxels that come back otherwise."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from voxtool.bench.timing import by_turns
from voxtool.bench.view import bytes_of_file
from voxtool.errors import VoxtoolError, VoxtoolWarning
from voxtool.files.exchange import plan_export
from voxtool.files.formats import EXCHANGE, EXPORTS, ending
from voxtool.files.imports import read_voxels
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.compare import count_differences
from voxtool.svo.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.svo.octree import Octree

FORMATS = tuple(name for name in EXPORTS if EXCHANGE[name].parts)  # the others hold one slice
MOST_BYTES = 256_000_000  # of a file that is measured: a list of points may be very long
WITHOUT = {"returned": "voxtool does not read it"}


def measure(bench: Bench) -> Iterator[Point]:
    """The points of a model."""
    mesh = load_mesh(bench.model)
    for dim in bench.request.dims:
        octree = voxelize(mesh, Grid.fit(mesh, dim), device=bench.timed)
        size = bytes_of_file(octree)
        for name in FORMATS:
            yield from _both_ways(octree, name, size, bench)


def _both_ways(octree: Octree, name: str, own: int, bench: Bench) -> Iterator[Point]:
    """The points of a format: writing a file, and reading it where voxtool can; none, and a
    warning, where it cannot be written. `own` is the size of the octree's own file."""
    import tempfile  # slow to import, and the help of bench imports this module

    grid, format = octree.grid, EXCHANGE[name]
    with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
        path = Path(folder, "layers" if "%" in name else "", f"a{ending(name)}")
        works: dict[str, Callable[[], Any]] = {
            "octree to file": lambda: plan_export(octree, path, max_bytes=MOST_BYTES).run()
        }
        try:
            size = works["octree to file"]()  # the warm-up
        except VoxtoolError as error:
            what = f"{ending(name)} at dim {grid.dim} is left out: {error}"
            warnings.warn(what, VoxtoolWarning, stacklevel=2)
            return
        fields: dict[str, Any] = {"absent": WITHOUT}
        if format.reads:  # .npy and .binvox do not say where the voxels lie
            place = {"origin": grid.origin, "pitch": grid.pitch}
            works["file to octree"] = read = partial(read_voxels, path, **place)
            differing = sum(count_differences(octree, read()))
            fields = {"errors": {"returned": differing / max(octree.count, 1)}}
        runs = by_turns(bench.request, *works.values())
        for work, seconds in zip(works, runs, strict=True):
            yield bench.point(
                work, ending(name), f"dim {grid.dim}", runs=seconds, asked={"dims": grid.dim},
                size=octree.count, size_of="voxels", bytes=size,
                figures={"over the file": size / own}, **fields,
            )  # fmt: skip
