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
from voxtool.files.mesh import load_mesh
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MeshWarning)  # every run would repeat it
        every = list(dict.fromkeys(models))
        meshes = {model: len(load_mesh(model).faces) for model in every if not is_volume(model)}
        beside = text_voxels.beside(meshes) if meshes else {}
        for model in every:
            bench = Bench(request, timed, profiled, "texts", model)
            if model in meshes:
                found += text_voxels.rows_of(bench, quick, beside[model])
                found += text_methods.rows_of(bench, quick)
                found += text_fields.rows_of(bench, quick)
            else:
                found += text_volumes.rows_of(bench, quick)
    return found
