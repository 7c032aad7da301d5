"""The choice of the job that makes an octree in windows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from voxtool.svo.attribution.colours import SurfaceAttributesJob
from voxtool.svo.attribution.fraction import FractionJob
from voxtool.svo.attribution.labels import PartLabelsJob
from voxtool.svo.attribution.part_fractions import PartFractionsJob
from voxtool.svo.connected.about import refuse_windows
from voxtool.tiles.attributed import (
    AttributeWindowsJob,
    FloodAttributeWindowsJob,
    LabelAttributeWindowsJob,
)
from voxtool.tiles.flooding import FloodMergingJob, FloodWindowsJob
from voxtool.tiles.fractions import FractionWindowsJob, PartFractionWindowsJob
from voxtool.tiles.labelled import LabelWindowsJob
from voxtool.tiles.merging import MergingJob
from voxtool.tiles.spread import (
    SpreadAttributeJob,
    SpreadFloodAttributeJob,
    SpreadFloodJob,
    SpreadFloodMergingJob,
    SpreadJob,
    SpreadLabelAttributeJob,
    SpreadLabelJob,
    SpreadMergingJob,
)
from voxtool.tiles.spread_bars import SpreadBarsJob, SpreadFractionJob, SpreadPartFractionJob
from voxtool.tiles.windows import WindowsJob

if TYPE_CHECKING:
    from distributed import Client


def plan_windows(whole: Any, *, merged: bool = False) -> WindowsJob:
    """Return the job in windows of a voxelization, which may have attributes; with `merged` one
    that merges subtrees. Raises MemoryLimitError if the smallest windows do not fit, and
    OnePieceError if something is not made in windows."""
    refuse_windows(whole.plan)
    if isinstance(whole, SurfaceAttributesJob):
        if isinstance(whole.inner, PartLabelsJob):
            return LabelAttributeWindowsJob(whole)
        flooded = whole.inner.plan.fill == "flood"
        return FloodAttributeWindowsJob(whole) if flooded else AttributeWindowsJob(whole)
    if isinstance(whole, FractionJob):
        return FractionWindowsJob(whole)
    if isinstance(whole, PartFractionsJob):
        return PartFractionWindowsJob(whole)
    if isinstance(whole, PartLabelsJob):
        return LabelWindowsJob(whole)
    if whole.plan.fill == "flood":
        return FloodMergingJob(whole) if merged else FloodWindowsJob(whole)
    return MergingJob(whole) if merged else WindowsJob(whole)


def plan_spread(
    whole: Any, client: Client, device_name: str | None = None, *, merged: bool = False
) -> SpreadJob | SpreadBarsJob:
    """Return the job of a voxelization, which may have attributes, whose windows the workers of a
    cluster make; with `merged` one that merges subtrees.

    Parameters
    ----------
    device_name : the device of a worker, as --device takes it.

    Raises
    ------
    OnePieceError
        If something is not made in windows.
    """
    refuse_windows(whole.plan)
    return _kind_of_spread(whole, merged)(whole, client, device_name)


def _kind_of_spread(whole: Any, merged: bool) -> type[SpreadJob | SpreadBarsJob]:
    if isinstance(whole, SurfaceAttributesJob):
        if isinstance(whole.inner, PartLabelsJob):
            return SpreadLabelAttributeJob
        return SpreadFloodAttributeJob if whole.inner.plan.fill == "flood" else SpreadAttributeJob
    if isinstance(whole, FractionJob):
        return SpreadFractionJob
    if isinstance(whole, PartFractionsJob):
        return SpreadPartFractionJob
    if isinstance(whole, PartLabelsJob):
        return SpreadLabelJob
    if whole.plan.fill == "flood":
        return SpreadFloodMergingJob if merged else SpreadFloodJob
    return SpreadMergingJob if merged else SpreadJob
