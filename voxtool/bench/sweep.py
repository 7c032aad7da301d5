"""The measuring engine: every bench of every model, point by point.

Every time is of work in this process whose kernels are compiled, after a warm-up. Other tools do
the same work in the same run, and their errors are measured in the same way.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

from voxtool.bench import (
    adf,
    attributes,
    combine,
    degenerate,
    distance,
    exchange,
    field_surfaces,
    fractions,
    growth,
    morph,
    pictures,
    plans,
    repair,
    scale,
    tets,
    view,
    voxels,
)
from voxtool.bench.request import benches_for, is_volume
from voxtool.bench.timing import Bench
from voxtool.errors import MeshWarning
from voxtool.files import read_unstructured
from voxtool.files.meshes.mesh import load_mesh
from voxtool.opencl import shared_device

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from voxtool.bench.points import Ablation, Point
    from voxtool.bench.request import Request

BENCHES = {
    "voxelize": voxels.measure_voxelize,
    "extract": voxels.measure_extract,
    "fractions": fractions.measure,
    "attributes": attributes.measure,
    "adf": adf.measure,
    "surfaces": field_surfaces.measure,
    "distance": distance.measure,
    "pictures": pictures.measure,
    "tets": tets.measure,
    "view": view.measure,
    "exchange": exchange.measure,
    "combine": combine.measure,
    "morph": morph.measure,
    "scale": scale.measure,
    "repair": repair.measure,
    "growth": growth.measure,
    "degenerate": degenerate.measure,
    "plans": plans.measure,
}
GENERATED = {"degenerate": degenerate, "plans": plans}  # whose models are names of their own


def sweep(
    models: Sequence[str],
    request: Request,
    benches: tuple[str, ...] | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> Iterator[Point | Ablation]:
    """Measure each model in the named benches, by default in every bench for its kind of file. The
    models of the benches in GENERATED are names of what they generate, by default all.

    Parameters
    ----------
    progress : called with the bench and the model as each begins.

    Raises
    ------
    VoxtoolError : a model cannot be read, or a result cannot be computed.
    """
    bench = Bench(
        request, shared_device(request.device), shared_device(request.device, profile=True)
    )
    generated = GENERATED.get(benches[0]) if benches else None
    if generated:
        models = models or generated.KINDS
    for model in models:  # read all before anything is measured
        if generated:
            generated.check_kind(model)
        elif is_volume(model):
            read_unstructured(model, request.scalar, request.component)
        else:
            load_mesh(model)
    for model in models:
        for name in benches or benches_for(model):
            progress(f"{name}, {model}")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", MeshWarning)  # every run would repeat it
                found = list(BENCHES[name](replace(bench, name=name, model=model)))
            yield from found
