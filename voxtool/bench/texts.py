"""Rows of the experiments of [voCCeL], [ADF] and [TetVol], with figures of voxtool beside."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

from voxtool.bench import text_fields, text_methods, text_volumes, text_voxels
from voxtool.bench.request import Request, is_volume
from voxtool.bench.text_rows import Row
from voxtool.bench.timing import Bench
from voxtool.errors import MeshWarning
from voxtool.opencl import shared_device

REQUEST = Request(repeat=3, seconds=0.0, levels=(6,))


def rows_of(
    models: Sequence[str], device: str | None, quick: bool, scalar: str | None = None
) -> list[Row]:
    """The rows of each model; scalar : the array of volumes, as of `voxtool tet-build`.

    Raises
    ------
    VoxtoolError : a model cannot be read, or a result cannot be computed.
    """
    timed, profiled = shared_device(device), shared_device(device, profile=True)
    request = replace(REQUEST, scalar=scalar)
    found: list[Row] = []
    for model in models:
        bench = Bench(request, timed, profiled, "texts", model)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MeshWarning)  # every run would repeat it
            texts = (
                (text_volumes,) if is_volume(model) else (text_voxels, text_methods, text_fields)
            )
            for text in texts:
                found += text.rows_of(bench, quick)
    return found
