"""Requests to connect thin parts: which are refused, and what reports say."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from voxtool.errors import OnePieceError, VoxtoolError, count_of

CONNECTED = "connected"  # in plans
RULE = "parts thinner than two voxels stay in one piece"


def check_connected(connected: bool, mode: str, with_surface: bool, window: object) -> None:
    """Raise VoxtoolError if thin parts cannot be connected in a voxelization of this kind."""
    if connected and mode != "solid":
        raise VoxtoolError(f"connected goes with mode 'solid', not {mode!r}: drop it")
    if connected and with_surface:
        raise VoxtoolError("with_surface sets all voxels that connected chooses from: drop one")
    if connected and window is not None:
        raise VoxtoolError("connected takes the whole grid: drop the window")


def refuse_windows(plan: Any) -> None:
    """Raise OnePieceError if the plan of a voxelization connects thin parts."""
    if getattr(getattr(plan, "octree", plan), "connects", False):
        raise OnePieceError(
            "thin parts are connected in one piece, not in windows: allow more (see --max-memory), "
            "choose a smaller dim, or drop connected"
        )


def united(plans: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Return the sums of what connecting added to several octrees, given their plans; {} if none
    was connected."""
    found = [facts for plan in plans if isinstance(facts := plan.get(CONNECTED), dict)]
    return {name: sum(one[name] for one in found) for one in found[:1] for name in one}


def about_connected(plan: Mapping[str, Any]) -> list[str]:
    """Return a line about what connecting added to an octree, given its plan, if it was asked
    for."""
    facts = plan.get(CONNECTED)
    if not isinstance(facts, dict):
        return []
    added, pieces, became = (facts[name] for name in ("added", "pieces", "became"))
    if not added:
        return ["no voxel had to be added: no thin part is broken"]
    return [f"{count_of(added, 'voxel')} added: {count_of(pieces, 'piece')} became {became:,}"]
