"""How a window is planned and made, in this process or by a worker of a cluster, from plain arrays
and options."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from voxtool.files.octrees.windows import Key, Window
from voxtool.grid import Grid
from voxtool.mesh.appearance import Appearance, Material
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.attribution.colours import SurfaceAttributesJob
from voxtool.svo.attribution.labels import PartLabelsJob
from voxtool.svo.attribution.labels_window import PartsOfWindows
from voxtool.svo.dag.merge import merge
from voxtool.svo.voxelization.fill.flood_pieces import Shared
from voxtool.svo.voxelization.flood_window import FloodWindowJob
from voxtool.svo.voxelization.plan import VoxelizePlan
from voxtool.svo.voxelization.voxelize import VoxelizeJob, plan_voxelize
from voxtool.tiles.merging import merging_shortage, window_of
from voxtool.tiles.subtree import codes_of, refuse_smallest, shape_of, subtree_of, voxels_of

Plan = Callable[..., Any]  # returns the job of a window's octree
Described = tuple[Mesh, Appearance | None, tuple[str, ...], str]


def plan_plain(
    device: Device,
    max_memory: int | None,
    key: Key,
    mesh: Mesh,
    grid: Grid,
    options: dict[str, Any],
) -> VoxelizeJob:
    """Return the job of a window."""
    place: dict[str, Any] = {"window": (key[:3], shape_of(key, grid)), "device": device}
    return plan_voxelize(mesh, grid, **place, max_memory=max_memory, **options)


def plan_flood(
    device: Device, max_memory: int | None, key: Key, mesh: Mesh, grid: Grid, whole: VoxelizePlan
) -> FloodWindowJob:
    """Return the job of a window of a flood."""
    return FloodWindowJob(mesh, grid, whole, key, device, max_memory)


def plan_labels(
    device: Device, max_memory: int | None, key: Key, parts: PartsOfWindows, faces: np.ndarray
) -> PartLabelsJob:
    """Return the job of a window with labels, given the faces that can change it."""
    return parts.job(faces, (key[:3], shape_of(key, parts.grid)), device, max_memory)


def plan_window(
    device: Device,
    max_memory: int | None,
    plan: Plan,
    key: Key,
    described: Described | None,
    materials: tuple[Material, ...] | None,
    *given: Any,
) -> Any:
    """Return the job of a window.

    Parameters
    ----------
    plan, given : the function that plans its octree, and what this takes.
    described : of a window with attributes of its surface, the faces near it, what they look like
        but for the materials, the names of the attributes, and how colours are found.
    materials : of all windows.
    """
    job = plan(device, max_memory, key, *given)
    if described is None:
        return job
    mesh, look, names, colour = described
    if look is not None and materials is not None:
        mesh = replace(mesh, appearance=replace(look, materials=materials))
    return SurfaceAttributesJob(job, mesh, names, colour, device, job.max_memory, alone=True)


def make_window(
    device: Device,
    max_memory: int | None,
    merged: bool,
    outside: np.ndarray | None,
    plan: Plan,
    key: Key,
    *given: Any,
) -> list[tuple[Key, Window]] | None:
    """Return a window with its key; None if it does not fit in memory.

    Parameters
    ----------
    merged : whether its subtrees are merged.
    outside : of a flood, the roots of the window's pieces that are outside.
    plan, given : as `plan_window` takes them.
    """
    job = plan_window(device, max_memory, plan, key, *given)
    if outside is not None:
        window = flooded(job, outside)
    elif shortage := merging_shortage(job) if merged else job.shortage:
        refuse_smallest(key, shortage)
        return None
    else:
        octree = job._run()
        levels = subtree_of(octree, key[3]).levels
        window = Window(levels, octree.bricks, octree.count, octree.attributes)
    if merged:
        window = window_of(merge(window.levels[::-1], window.bricks))
    return [(key, window)]


def shared_pieces(device: Device, max_memory: int | None, plan: Plan, *given: Any) -> Shared:
    """Return the pieces of free space that a window of a flood shares with others."""
    return plan(device, max_memory, *given).shared()


def flooded(job: Any, outside: np.ndarray) -> Window:
    """Return a window of a flood, which may have attributes of the surface."""
    levels, bricks = getattr(job, "inner", job).fill(outside)
    found = ()
    if isinstance(job, SurfaceAttributesJob):
        found = job.surface_values().attributes(codes_of(levels), bricks)
    return Window(levels, bricks, voxels_of(levels, bricks), found)
