"""Rows of the experiments of [voCCeL], [ADF] and [TetVol], with figures of voxtool beside."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from voxtool.bench import text_fields, text_methods, text_volumes, text_voxels
from voxtool.bench.request import Request, is_volume
from voxtool.bench.text_rows import Row
from voxtool.bench.timing import Bench
from voxtool.errors import MeshWarning
from voxtool.files import read_unstructured
from voxtool.files.meshes.mesh import load_mesh
from voxtool.opencl import shared_device

REQUEST = Request(repeat=3, seconds=0.0, levels=(6,))
MESH_STEPS, VOLUME_STEPS = ("tables", "methods", "fields"), ("volume",)


def steps_of(models: Sequence[str]) -> list[str]:
    """Return the steps that `rows_of` reports, in order; a model that is named twice counts
    once."""
    steps = {model: VOLUME_STEPS if is_volume(model) else MESH_STEPS for model in models}
    return [f"{step}, {model}" for model, names in steps.items() for step in names]


def rows_of(
    models: Sequence[str],
    device: str | None,
    quick: bool,
    scalar: str | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> list[Row]:
    """Return the rows of each model.

    Parameters
    ----------
    scalar : the array of volumes, as of `voxtool tet-build`.
    progress : called with each step as it begins.

    Raises
    ------
    VoxtoolError : a model cannot be read, or a result cannot be computed.
    """
    bench = Bench(
        replace(REQUEST, scalar=scalar), shared_device(device), shared_device(device, profile=True)
    )
    triangles: dict[str, int] = {}
    for model in models:  # read all before anything is measured
        if is_volume(model):
            read_unstructured(model, scalar)
        else:
            triangles[model] = len(load_mesh(model).faces)
    beside = text_voxels.beside(triangles) if triangles else {}
    found: list[Row] = []
    for model in dict.fromkeys(models):
        works = {
            "tables": partial(text_voxels.rows_of, models=beside.get(model, [])),
            "methods": text_methods.rows_of,
            "fields": text_fields.rows_of,
            "volume": text_volumes.rows_of,
        }
        for step in VOLUME_STEPS if is_volume(model) else MESH_STEPS:
            progress(f"{step}, {model}")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", MeshWarning)  # every run would repeat it
                found += works[step](replace(bench, name="texts", model=model), quick)
    return found
