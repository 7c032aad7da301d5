"""`voxtool.tiles.voxelize`: voxelization in windows, in this process or on a cluster."""

from __future__ import annotations

import os
import tempfile
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from voxtool.choices import DEFAULT_MODE
from voxtool.errors import GridError
from voxtool.files import write_svo
from voxtool.files.mesh import as_mesh
from voxtool.files.windows import Windows
from voxtool.grid import Grid
from voxtool.opencl import Device
from voxtool.svo.octree import Octree
from voxtool.svo.voxelize import plan_voxelize
from voxtool.tiles.octree import BlockOctree
from voxtool.tiles.spread import SpreadJob
from voxtool.tiles.windows import WindowsJob

if TYPE_CHECKING:
    from distributed import Client


def voxelize(
    mesh: Any,
    grid: Grid | None = None,
    mode: str = DEFAULT_MODE,
    *,
    client: Client | None = None,
    file: str | os.PathLike[str] | None = None,
    resume: bool = False,
    dim: int | None = None,
    pitch: float | None = None,
    fill: str = "auto",
    with_surface: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> Octree | BlockOctree:
    """Voxelize a mesh in windows: the result is that of `voxtool.voxelize`, bit for bit.

    Parameters
    ----------
    mesh, grid, mode, dim, pitch, fill, with_surface
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
    VoxtoolError
        If the fill rule is a flood, which cannot be divided.
    FileError
        If the windows or the file cannot be written.

    Examples
    --------
    >>> with distributed.Client("tcp://host:8786") as client:
    ...     voxtool.tiles.voxelize("bunny.obj", dim=16384, client=client, file="bunny.svo.h5")
    """
    found = as_mesh(mesh, max_memory)
    if grid and (dim or pitch):
        raise GridError("a grid has its own dim and pitch: drop dim= and pitch=, or the grid")
    grid = grid or Grid.fit(found, dim, pitch=pitch)
    request = {"fill": fill, "with_surface": with_surface}
    whole = plan_voxelize(found, grid, mode, device=device, max_memory=max_memory, **request)
    job = SpreadJob(whole, client) if client else WindowsJob(whole)
    with tempfile.TemporaryDirectory(prefix="voxtool-") as folder:
        target = file or os.path.join(folder, "octree")
        with Windows(str(target), job.request, job.plan.disk, resume=resume) as job.store:
            made = job.run()
            if file is None:
                return in_memory(made)
            write_svo(cast("Octree", made), file)
            return made


def in_memory(octree: BlockOctree) -> Octree:
    """Return an octree that comes in blocks as one in memory."""
    blocks = octree.nodes, octree.bricks
    nodes, bricks = (np.concatenate([np.empty(0, x.dtype), *x.blocks]) for x in blocks)
    about = octree.plan, octree.source_sha256, octree.units, octree.transform
    return Octree(octree.grid, octree.mode, octree.fill, octree.offsets, nodes, bricks, *about)
