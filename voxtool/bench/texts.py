"""What the three texts say of their experiments, with our figures beside."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence

from voxtool.bench import text_voxels
from voxtool.bench.request import Request
from voxtool.bench.text_rows import Row
from voxtool.bench.timing import Bench
from voxtool.errors import MeshWarning
from voxtool.opencl import shared_device

REQUEST = Request(repeat=3, seconds=0.0)


def rows_of(models: Sequence[str], device: str | None, quick: bool) -> Iterator[Row]:
    """The rows of each model.

    Raises
    ------
    VoxtoolError : a model cannot be read, or a result cannot be computed.
    """
    timed, profiled = shared_device(device), shared_device(device, profile=True)
    for model in models:
        bench = Bench(REQUEST, timed, profiled, "texts", model)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MeshWarning)  # every run would repeat it
            found = list(text_voxels.rows_of(bench, quick))
        yield from found
