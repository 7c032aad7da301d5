"""Which job makes an octree in windows."""

from __future__ import annotations

from typing import Any

from voxtool.svo.attribution.colours import SurfaceAttributesJob
from voxtool.svo.attribution.fraction import FractionJob
from voxtool.svo.attribution.labels import PartLabelsJob
from voxtool.svo.attribution.part_fractions import PartFractionsJob
from voxtool.tiles.attributed import (
    AttributeWindowsJob,
    FloodAttributeWindowsJob,
    LabelAttributeWindowsJob,
)
from voxtool.tiles.flooding import FloodMergingJob, FloodWindowsJob
from voxtool.tiles.fractions import FractionWindowsJob, PartFractionWindowsJob
from voxtool.tiles.labelled import LabelWindowsJob
from voxtool.tiles.merging import MergingJob
from voxtool.tiles.windows import WindowsJob


def plan_windows(whole: Any, *, merged: bool = False) -> WindowsJob:
    """Return the job in windows of a voxelization, which may have attributes; with `merged` one
    that merges subtrees. Raises MemoryLimitError if the smallest windows do not fit."""
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
