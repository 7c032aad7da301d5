"""Queries of octrees at points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from voxtool.api.octrees import Path, opened
from voxtool.files import read_drawn
from voxtool.files.formats import OCTREE
from voxtool.opencl import Device
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.octree import Octree
from voxtool.svo.queries import query
from voxtool.svo.queries.query import OctreeAnswers, QueryJob


def plan_query_svo(
    octree: Octree | MergedOctree | Path,
    *,
    level: int | str | None = None,
    nearest: bool = False,
    attributes: Sequence[str] = (),
    device: Device | None = None,
    max_memory: int | None = None,
) -> QueryJob:
    """Return the job of queries of an octree at points.

    Parameters
    ----------
    octree : Octree, MergedOctree or path
        The octree; a merged one is not expanded.
    level : int or "voxel", optional
        The level of the nodes whose coverage is returned, 0 for bricks; by default none is.
    nearest : bool
        Whether the nearest set voxels are returned.
    attributes : sequence of str
        Names of the attributes that are returned: "label", "colour", "normal", "area", "fraction",
        "faces".
    device, max_memory
        As in voxelize.

    Returns
    -------
    QueryJob
        Its `run` returns an OctreeQuery, which answers at any number of points.

    Raises
    ------
    VoxtoolError
        If there is no such level.
    GridError
        If nearest voxels are requested of voxels 2^20 times as long as wide.
    DeviceError
        If nearest voxels are requested and the device has no double precision.
    """
    found = opened(octree, lambda path: read_drawn(path, OCTREE))
    return query.plan_query(
        found, level=level, nearest=nearest, attributes=attributes, device=device,
        max_memory=max_memory,
    )  # fmt: skip


def query_svo(
    octree: Octree | MergedOctree | Path,
    points: Any,
    *,
    level: int | str | None = None,
    nearest: bool = False,
    attributes: Sequence[str] = (),
    device: Device | None = None,
    max_memory: int | None = None,
) -> OctreeAnswers:
    """Return the values of an octree at points; it stays on the device for the next call.

    Which voxel a point lies in is decided exactly, with planes at origin + i pitch. Voxels are
    half-open: a point on a plane is in the voxel above it, and one on the upper side of the grid is
    outside.

    The nearest voxel is that with the nearest centre; of equal distances, as rounded, that of the
    least x, then y, then z.

    Parameters
    ----------
    octree, level, nearest, attributes, device, max_memory
        As in plan_query_svo.
    points : (N, 3) or (3,) array_like
        World units; (3,) is one point.

    Returns
    -------
    OctreeAnswers
        With `contains`; if a level is given, `coverage`; if requested, `nearest` and `distance`,
        and the attributes by their names.

    Raises
    ------
    VoxtoolError
        If there is no such level, points have a wrong shape, or a coordinate is NaN; or a point
        whose nearest voxel is requested is 2^20 voxels away from the grid.
    GridError, DeviceError
        As in plan_query_svo.
    MemoryLimitError
        If the octree does not fit on the device.

    References
    ----------
    [voCCeL], algorithm 1

    Examples
    --------
    >>> voxtool.query_svo("bunny.svo.h5", [[0, 0, 0], [0.1, 0, 0]]).contains
    >>> voxtool.query_svo(octree, points, level=0).coverage
    """
    job = plan_query_svo(
        octree, level=level, nearest=nearest, attributes=attributes, device=device,
        max_memory=max_memory,
    )  # fmt: skip
    return job.run()(points)
