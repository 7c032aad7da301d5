"""Sweeps over settings, each with its time and its error: what reports are made of.

Every time is of work whose kernels are compiled, in the same process, after a warm-up; peers do the
same work in the same run, and their errors are by the same measure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from voxtool.bench.sweep.fields import of_fields
from voxtool.bench.sweep.pictures import of_pictures
from voxtool.bench.sweep.request import QUICK, Sweep
from voxtool.bench.sweep.surfaces import of_extract, of_voxelize
from voxtool.files import VOLUME_FORMATS, read_unstructured
from voxtool.files.mesh import load_mesh
from voxtool.opencl import open_device

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from voxtool.bench.points import Point, Saving

__all__ = ["BENCHES", "QUICK", "Sweep", "bench_of", "is_volume", "sweep"]

BENCHES = {
    "voxelize": of_voxelize,
    "extract": of_extract,
    "adf": of_fields,
    "tets": of_pictures,
}


def bench_of(model: str) -> tuple[str, ...]:
    """The benches for a file, by its name."""
    return ("tets",) if is_volume(model) else ("voxelize", "extract", "adf")


def is_volume(model: str) -> bool:
    name = model.lower().removesuffix(".gz")
    return name.endswith(tuple(VOLUME_FORMATS))


def sweep(
    models: Sequence[str],
    asked: Sweep,
    benches: tuple[str, ...] | None = None,
    on_step: Callable[[str], None] = lambda step: None,
) -> Iterator[Point | Saving]:
    """Measure every model, in the benches for its kind or in those that are named; `on_step` is
    told which one begins.

    Raises
    ------
    VoxtoolError : a model cannot be read, or something of it cannot be computed.
    """
    timed = open_device(asked.device)
    profiled = open_device(asked.device, profile=True)
    for model in models:  # a wrong one is refused before anything is measured
        if is_volume(model):
            read_unstructured(model, asked.scalar, asked.component)
        else:
            load_mesh(model)
    for model in models:
        for bench in benches or bench_of(model):
            on_step(f"{bench}, {model}")
            yield from BENCHES[bench](model, asked, timed, profiled)
