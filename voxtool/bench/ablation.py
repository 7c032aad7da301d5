"""What a plan leaves out, forced in: the same work by the same code, with the plan's choice
replaced, timed by turns with the work as planned.

Only what the code has a way to do is forced. What it cannot do otherwise is said, too.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.build import plan_adf
from voxtool.adf.query import FieldQuery
from voxtool.bench import timing
from voxtool.bench.points import Saving
from voxtool.svo.voxelize import plan_voxelize
from voxtool.tets import view as tets_view
from voxtool.tets.render import VolumeRenderer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.adf.field import DistanceField
    from voxtool.bench.timing import Runs
    from voxtool.camera import Rays
    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.svo.octree import Octree
    from voxtool.tets.transfer import TransferFunction
    from voxtool.tets.volume import TetVolume

VOXELIZE = {  # what a plan says that it leaves out, and the fields of the plan that take it in
    "128-bit predicates": {"wide": True},
    "64-bit Morton codes": {"code_bits": 64},
    "blocked level-1 volume": {"blocked": True},
    "sharing of triangles among work-items": {"tiled": True, "tiled_nodes": True},
    "state of rows on entry": {"entry": True},
    "directions of crossings": {"fill": "winding"},
}
FIELD = {
    "faces without a side": {"flat": 1},
    "search for jumps of the sign": {"closed": False, "sign": "pseudonormal"},
    "winding numbers": {"sign": "winding"},
}
WIDE = "64-bit identifiers"
W = "w of the hash's offsets"
TRANSPARENT = "tetrahedra that the transfer function leaves transparent"


@contextmanager
def _made_otherwise(module: Any, name: str, change: Callable[[Any], Any]) -> Iterator[None]:
    """What a function of a module returns is changed; it is called by its name there."""
    make = getattr(module, name)
    setattr(module, name, lambda *args, **more: change(make(*args, **more)))
    try:
        yield
    finally:
        setattr(module, name, make)


def of_voxelize(
    mesh: Mesh, grid: Grid, mode: str, device: Device, runs: Runs, about: dict[str, str]
) -> Iterator[Saving]:
    """What planning a voxelization saves, what is left out being in the plan's words."""

    def work(**decisions: Any) -> Octree:
        return plan_voxelize(mesh, grid, mode, device=device).with_(**decisions).run()

    octree = work()
    for what, why in octree.plan["left_out"].items():
        if what in VOXELIZE:
            forced = partial(work, **VOXELIZE[what])
            same = replace(forced(), fill=octree.fill).digest() == octree.digest()
            planned, more = runs.by_turns(partial(_time, work), partial(_time, forced))
            yield Saving(**about, what=what, why=why, runs=planned, forced=more, same=same)


def of_field(
    mesh: Mesh, device: Device, runs: Runs, about: dict[str, str], **request: Any
) -> Iterator[Saving]:
    """Likewise of a field's build, the measurement of its errors left out."""

    def build(**forced: Any) -> DistanceField:
        return plan_adf(mesh, device=device, measure=False, **request).with_(**forced).run()

    field = build()
    for what, why in field.plan["left_out"].items():
        if what in FIELD and field.sign != "none":
            forced = partial(build, **FIELD[what])
            same = replace(forced(), sign=field.sign).digest() == field.digest()
            planned, more = runs.by_turns(partial(_time, build), partial(_time, forced))
            yield Saving(**about, what=what, why=why, runs=planned, forced=more, same=same)


def of_queries(
    field: DistanceField,
    points: np.ndarray,
    device: Device,
    runs: Runs,
    about: dict[str, str],
) -> Iterator[Saving]:
    """Likewise of distances at points, by what the field's textures do not hold."""
    table, otherwise = field.hash, {}
    if field.cells.shape[-1] == 2:
        high = np.insert(field.cells, 1, 0, axis=-1)
        why = field.plan["left_out"].get(WIDE, f"leaves end at level {field.depth}")
        otherwise[WIDE] = replace(field, cells=high), why
    if not table.has_w:
        offsets = np.insert(table.offsets, 3, table.m, axis=-1)
        why = "keys that share an offset differ modulo m"
        otherwise[W] = replace(field, hash=replace(table, offsets=offsets)), why
    planned = FieldQuery(field, device)
    answer = planned(points).distance
    for what, (other, why) in otherwise.items():
        forced = FieldQuery(other, device)
        same = np.array_equal(forced(points).distance, answer)
        found, more = runs.by_turns(
            partial(_time, partial(planned, points)), partial(_time, partial(forced, points))
        )
        yield Saving(**about, what=what, why=why, same=same, runs=found, forced=more)


def of_picture(
    volume: TetVolume,
    rays: Rays,
    transfer: TransferFunction,
    method: str,
    device: Device,
    runs: Runs,
    about: dict[str, str],
) -> Iterator[Saving]:
    """Likewise of a picture, of which a later frame is timed."""

    planned, forced = VolumeRenderer(volume, device), VolumeRenderer(volume, device)
    picture = planned.render(rays, transfer, method)
    with _made_otherwise(tets_view, "kept_blocks", np.ones_like):  # it is kept for later frames
        same = np.array_equal(forced.render(rays, transfer, method), picture)
    kept = tets_view.kept_blocks(volume, transfer.local(volume))
    why = f"{np.count_nonzero(~kept)} of {kept.size} blocks of cells show nothing"
    found, more = runs.by_turns(
        partial(_time, partial(planned.render, rays, transfer, method)),
        partial(_time, partial(forced.render, rays, transfer, method)),
    )
    yield Saving(**about, what=TRANSPARENT, why=why, same=same, runs=found, forced=more)


def _time(work: Callable[[], object]) -> float:
    return timing.times(work, 1)[0]


def _under(
    forced: Callable[[], Any], time: Callable[..., float], *args: Any
) -> Callable[[], float]:
    """The same, with something forced in."""

    def run() -> float:
        with forced():
            return time(*args)

    return run
