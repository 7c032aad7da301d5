"""The work of the workers of a Dask cluster: they make windows from plain arrays and options.

A worker that sees the folder of windows of the process that spreads them writes its own there, and
returns what the journal says of it; others return the window.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from voxtool.files.windows import Key, Window, write_beside
from voxtool.grid import Grid
from voxtool.mesh.appearance import Appearance, Material
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import shared_device
from voxtool.svo.attribution.colours import SurfaceAttributesJob
from voxtool.svo.attribution.fraction import Volumes
from voxtool.svo.attribution.labels_window import PartsOfWindows
from voxtool.svo.fill.pieces import Shared
from voxtool.svo.flood_window import FloodWindowJob
from voxtool.svo.merge import merge
from voxtool.svo.plan import VoxelizePlan
from voxtool.svo.voxelize import plan_voxelize
from voxtool.tiles.attributed import flooded
from voxtool.tiles.flooding import filled
from voxtool.tiles.fractions import (
    Bar,
    face_cubes,
    fraction_cubes,
    fraction_job,
    part_fraction_cubes,
    part_fraction_job,
)
from voxtool.tiles.merging import merging_shortage, window_of
from voxtool.tiles.windows import Content, attributed, content_of, refuse_smallest, shape_of

Made = Window | dict[str, Any]  # a window, or what the journal says of it if it is on disk
Place = tuple[str, str]  # where windows wait, and the first line of the journal there
Described = dict[str, Any]  # what with_attributes takes


def make_window(
    mesh: Mesh,
    grid: Grid,
    key: Key,
    options: dict[str, Any],
    device_name: str | None,
    merged: bool,
    place: Place | None,
    described: Described | None,
) -> Made | None:
    """Return a window, with `merged` merged here and with `described` with these attributes; None
    if it does not fit in the memory that the worker may take."""
    options = {**options, "max_memory": allowed(options["max_memory"])}
    window = key[:3], shape_of(key, grid)
    job = plan_voxelize(mesh, grid, window=window, device=shared_device(device_name), **options)
    return _made(job, key, place, described, merged=merged)


def label_window(
    parts: PartsOfWindows,
    faces: np.ndarray,
    key: Key,
    max_memory: int | None,
    device_name: str | None,
    place: Place | None,
    described: Described | None,
) -> Made | None:
    """Return a window with labels, as `make_window` does, given the faces that can change it."""
    window = key[:3], shape_of(key, parts.grid)
    job = parts.job(faces, window, shared_device(device_name), allowed(max_memory))
    return _made(job, key, place, described)


def flood_window(
    mesh: Mesh,
    grid: Grid,
    whole: VoxelizePlan,
    key: Key,
    max_memory: int | None,
    device_name: str | None,
    outside: np.ndarray | None,
    described: Described | None,
    merged: bool,
    place: Place | None,
) -> Shared | Made:
    """Return the pieces of free space that a window shares with others or, given the roots of its
    pieces that are outside, the window as `make_window` does."""
    job = FloodWindowJob(mesh, grid, whole, key, shared_device(device_name), max_memory)
    if outside is None:
        return job.shared()
    content = filled(job, outside)
    if described:
        return stored(key, flooded(with_attributes(job, **described), content), place)
    return stored(key, _window(content, merged), place)


def fraction_bar(
    mesh: Mesh,
    grid: Grid,
    bar: Bar,
    volumes: Volumes,
    options: dict[str, Any],
    pairs: list[list[np.ndarray]],
    device_name: str | None,
    place: Place | None,
) -> list[Made]:
    """Return the cubes of a bar, with shares of faces of a bar along y or z, with fractions of one
    along x, given the shares of the faces of its cubes."""
    job = fraction_job(mesh, grid, bar.box(grid), volumes, shared_device(device_name), options)
    assert job is not None  # it was planned
    cubes = face_cubes(job, bar) if bar.axis else fraction_cubes(job, bar, pairs)
    keys = bar.cubes(grid.shape)
    return [stored(key, cube, place) for key, cube in zip(keys, cubes, strict=True)]


def part_fraction_bar(
    parts: PartsOfWindows,
    faces: np.ndarray,
    bar: Bar,
    volumes: dict[int, Volumes],
    max_memory: int | None,
    device_name: str | None,
    place: Place | None,
) -> list[Made]:
    """Return the cubes of a bar with labels and fractions."""
    given = bar.box(parts.grid), volumes, shared_device(device_name), max_memory
    job = part_fraction_job(parts, faces, *given)
    assert job is not None  # it was planned
    keys, cubes = bar.cubes(parts.grid.shape), part_fraction_cubes(job, bar)
    return [stored(key, cube, place) for key, cube in zip(keys, cubes, strict=True)]


def allowed(max_memory: int | None) -> int | None:
    """Return the bytes that a window may take: what is given, or half of what the worker has; None
    if it has no limit."""
    from distributed import get_worker

    if max_memory is not None:
        return max_memory
    limit = get_worker().memory_manager.memory_limit
    return limit and limit // 2  # half is for results


def with_attributes(
    job: Any,
    mesh: Mesh,
    look: Appearance | None,
    materials: tuple[Material, ...] | None,
    names: tuple[str, ...],
    colour: str,
) -> SurfaceAttributesJob:
    """Return the job of a window with attributes of its surface, given that of its octree.

    Parameters
    ----------
    mesh, look : the faces near the window, and what they look like but for the materials, which
        are sent once for all windows.
    """
    if look is not None and materials is not None:
        mesh = replace(mesh, appearance=replace(look, materials=materials))
    place = job.device, job.max_memory
    return SurfaceAttributesJob(job, mesh, names, colour, *place, alone=True)


def _made(
    job: Any,
    key: Key,
    place: Place | None,
    described: Described | None,
    *,
    merged: bool = False,
) -> Made | None:
    """Return the window of a job, or None if it does not fit in memory."""
    if described:
        job = with_attributes(job, **described)
    if shortage := merging_shortage(job) if merged else job.shortage:
        refuse_smallest(key, shortage)
        return None
    if merged:
        return stored(key, _window(content_of(job, key[3]), merged), place)
    return stored(key, attributed(job._run(), key[3]), place)


def _window(content: Content, merged: bool) -> Window:
    """Return the content of a window as what waits on disk, with `merged` its distinct subtrees."""
    levels, bricks, _ = content
    return window_of(merge(levels[::-1], bricks)) if merged else Window(*content)


def stored(key: Key, window: Window, place: Place | None) -> Made:
    """Return a window, or what a journal says of it if this worker sees the place."""
    return (place and write_beside(place, key, window)) or window
