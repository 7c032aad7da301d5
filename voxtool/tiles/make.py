"""Octrees made in windows: `voxtool.tiles.voxelize`, also on a cluster, `combine` and `morph`."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from voxtool.choices import COLOURS, DEFAULT_MODE, ELEMENTS, OPERATIONS, PRIORITIES
from voxtool.files import write_svo
from voxtool.files.lattices import placed
from voxtool.files.meshes.mesh import as_mesh
from voxtool.files.octrees.windows import Windows
from voxtool.grid import Grid
from voxtool.mesh.appearance import Parts
from voxtool.opencl import Device, default_device
from voxtool.svo.attribution.request import kept_for, plan_octree
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.booleans import plan_combine
from voxtool.tiles.combining import CombineWindowsJob
from voxtool.tiles.morphing import MorphWindowsJob, plan_unread
from voxtool.tiles.octree import BlockOctree
from voxtool.tiles.operations import OperationJob
from voxtool.tiles.plan import plan_spread, plan_windows
from voxtool.tiles.windows import WindowsJob

if TYPE_CHECKING:
    from distributed import Client


def voxelize(
    mesh: Any,
    grid: Grid | str | os.PathLike[str] | None = None,
    mode: str = DEFAULT_MODE,
    *,
    client: Client | None = None,
    file: str | os.PathLike[str] | None = None,
    resume: bool = False,
    lattice: Grid | str | os.PathLike[str] | None = None,
    dim: int | None = None,
    pitch: float | None = None,
    fill: str = "auto",
    gap: int = 0,
    with_surface: bool = False,
    fraction_type: str | None = None,
    face_fractions: bool = False,
    labels: str | Parts | None = None,
    priority: str | Sequence[str] = PRIORITIES[0],
    attributes: Sequence[str] = (),
    colour: str = COLOURS[0],
    device: Device | None = None,
    max_memory: int | None = None,
) -> Octree | BlockOctree:
    """Voxelize a mesh in windows: the result is that of `voxtool.voxelize`, bit for bit.

    Parameters
    ----------
    mesh, grid, mode, lattice, dim, pitch, fill, gap, with_surface, fraction_type, face_fractions,
    labels,
    priority, attributes, colour
        As for `voxtool.voxelize`.
    client
        A `distributed.Client`, whose workers make the windows; this process makes them by default.
    file
        A .svo.h5 to write. Then the octree need not fit in memory.
    resume
        Go on with the windows that a killed run with this file left beside it.
    device
        Where this process computes; workers choose their own.
    max_memory
        Bytes that a device may take.

    Returns
    -------
    Octree, or with `file` the BlockOctree that was written, which has its counts and digest.

    Raises
    ------
    MeshError, GridError, DeviceError
        As `voxtool.voxelize`; DeviceError also if the cluster is lost.
    MemoryLimitError
        If a window of the least size does not fit.
    FileError
        If the windows or the file cannot be written.

    Examples
    --------
    >>> with distributed.Client("tcp://host:8786") as client:
    ...     voxtool.tiles.voxelize("bunny.obj", dim=16384, client=client, file="bunny.svo.h5")
    """
    given = as_mesh(mesh, max_memory, kept_for(labels, attributes))
    found, grid, *_ = placed(given, grid, lattice, dim=dim, pitch=pitch)
    whole = plan_octree(
        found, grid, mode, fill=fill, gap=gap,
        with_surface=with_surface, fraction_type=fraction_type, face_fractions=face_fractions,
        labels=labels, priority=priority, attributes=attributes, colour=colour, device=device,
        max_memory=max_memory,
    )  # fmt: skip
    job = plan_windows(whole) if client is None else plan_spread(whole, client)
    if file is not None:
        return _written(job, file, resume)
    with tempfile.TemporaryDirectory(prefix="voxtool-") as folder:
        target = os.path.join(folder, "octree")
        with Windows(target, job.request, job.plan.disk) as job.store:
            return in_memory(job.run())


def combine(
    octrees: Sequence[OctreeContent],
    operation: str = OPERATIONS[0],
    *,
    file: str | os.PathLike[str],
    resume: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> BlockOctree:
    """Combine octrees in windows, and write the result: that of `voxtool.combine`, bit for bit.

    Parameters
    ----------
    octrees
        Octrees in memory, or of `voxtool.files.open_svo`, whose nodes stay in their files.
    operation
        As for `voxtool.combine`.
    file, resume, device, max_memory
        As for `voxelize`.

    Returns
    -------
    The BlockOctree that was written, which has its counts and digest.

    Raises
    ------
    GridError, MemoryLimitError, FileError
        As `voxtool.combine` and `voxelize`.
    """
    whole = plan_combine(octrees, operation, device=device, max_memory=max_memory)
    return _written(CombineWindowsJob(whole, octrees), file, resume)


def morph(
    octree: OctreeContent,
    operation: str,
    radius: float,
    *,
    world: bool = False,
    shape: str = ELEMENTS[0],
    file: str | os.PathLike[str],
    resume: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> BlockOctree:
    """Dilate, erode, open, close or hollow an octree in windows, and write the result: that of
    `voxtool.morph`, bit for bit.

    Parameters
    ----------
    octree
        In memory, or of `voxtool.files.open_svo`, whose nodes stay in its file.
    operation, radius, world, shape
        As for `voxtool.morph`.
    file, resume, device, max_memory
        As for `voxelize`.

    Returns
    -------
    The BlockOctree that was written, which has its counts and digest.

    Raises
    ------
    VoxtoolError, MemoryLimitError, FileError
        As `voxtool.morph` and `voxelize`.
    """
    whole = plan_unread(octree, operation, radius, world, shape, max_memory)
    job = MorphWindowsJob(whole, octree, device or default_device(), max_memory)
    return _written(job, file, resume)


def _written(
    job: WindowsJob | OperationJob, file: str | os.PathLike[str], resume: bool
) -> BlockOctree:
    """Run a job in windows, and write the octree that they make together."""
    with Windows(str(file), job.request, job.plan.disk, resume=resume) as job.store:
        made = job.run()
        write_svo(cast("Octree", made), file)
    return made


def in_memory(octree: BlockOctree) -> Octree:
    """Return an octree that comes in blocks as one in memory."""
    blocks = octree.nodes, octree.bricks
    nodes, bricks = (np.concatenate([np.empty(0, x.dtype), *x.blocks]) for x in blocks)
    about = octree.plan, octree.source_sha256, octree.units, octree.transform
    attributes = tuple(one.in_memory() for one in octree.attributes)
    arrays = octree.offsets, nodes, bricks
    return Octree(octree.grid, octree.mode, octree.fill, *arrays, *about, attributes)
