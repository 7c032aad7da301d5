"""The choice of the job that makes an octree in windows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from voxtool.svo.attribution.colours import SurfaceAttributesJob
from voxtool.svo.attribution.fraction import FractionJob
from voxtool.svo.attribution.labels import PartLabelsJob
from voxtool.svo.attribution.part_fractions import PartFractionsJob
from voxtool.svo.voxelization.connected.about import refuse_windows
from voxtool.tiles.flooding import FloodWindowsJob
from voxtool.tiles.fractions import FractionWindowsJob, PartFractionWindowsJob
from voxtool.tiles.labelled import LabelWindowsJob
from voxtool.tiles.spread import Executor, Workers
from voxtool.tiles.windows import WindowsJob

if TYPE_CHECKING:
    from distributed import Client


def plan_windows(
    whole: Any, executor: Executor | None = None, *, merged: bool = False
) -> WindowsJob:
    """Return the job in windows of a voxelization, which may have attributes; with `merged` one
    that merges subtrees. Raises MemoryLimitError if the smallest windows do not fit, and
    OnePieceError if something is not made in windows.

    Parameters
    ----------
    executor : what makes the windows; by default this process.
    """
    refuse_windows(whole.plan)
    octree = whole.inner if isinstance(whole, SurfaceAttributesJob) else whole
    return _kind_of(octree)(whole, executor, merged=merged)


def plan_spread(
    whole: Any, client: Client, device_name: str | None = None, *, merged: bool = False
) -> WindowsJob:
    """Return the job of a voxelization, as `plan_windows` does, whose windows the workers of a
    cluster make.

    Parameters
    ----------
    device_name : the device of a worker, as --device takes it.
    """
    return plan_windows(whole, Workers(client, device_name, whole.max_memory), merged=merged)


def _kind_of(whole: Any) -> type[WindowsJob]:
    if isinstance(whole, FractionJob):
        return FractionWindowsJob
    if isinstance(whole, PartFractionsJob):
        return PartFractionWindowsJob
    if isinstance(whole, PartLabelsJob):
        return LabelWindowsJob
    return FloodWindowsJob if whole.plan.fill == "flood" else WindowsJob
