"""Stage "sample": the exact distances at the vertices of a level's blocks, and the triangles that
each child needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.opencl.primitives import exclusive_scan

if TYPE_CHECKING:
    from voxtool.adf.levels.level import Construction, Level
    from voxtool.opencl import Array

SOURCE = "adf/levels/sample.cl"


def sample(work: Construction, level: Level) -> None:
    """Compute the distances of a level's blocks, their signs, and the triangles of each child."""
    device, n = work.device, level.count
    level.values = device.empty(27 * n, np.float64)
    level.masks = device.empty(level.items.size, np.uint8)
    level.needed = device.empty(8 * n, np.uint32)
    signed = "SIGNED" in work.options
    named: dict[str, Any] = {
        **work.arguments,
        **level.arguments,
        "values": level.values,
        "places": device.empty(27 * n, np.uint32) if signed else None,
    }
    with device.stage("sample"):
        work.kernel(SOURCE, "sample_blocks")(n, **named, masks=level.masks, counts=level.needed)
        if signed:
            sign(work, level, named)


def sign(work: Construction, level: Level, named: dict[str, Any]) -> None:
    """Give the distances of a level's blocks their signs."""
    device, n = work.device, level.count
    level.states = device.empty(n, np.uint8)
    above = level.above.states if level.above else device.zeros(1, np.uint8)
    asked = None
    if "WINDING" in work.options:
        level.doubts, asked = device.empty(n, np.uint32), device.empty(n, np.uint32)
    work.kernel(SOURCE, "sign_blocks")(
        n, **named, above=above, states=level.states, doubts=level.doubts, asked=asked
    )
    if asked is not None:
        for _ in ("middles of blocks", "vertices"):
            settle_signs(work, level, asked)


def settle_signs(work: Construction, level: Level, asked: Array) -> None:
    """Decide unknown signs by winding numbers, at the vertices in `asked`."""
    device, n = work.device, level.count
    begins = device.empty(n + 1, np.uint32)
    with device.stage("signs"):
        work.kernel(SOURCE, "count_asked")(n, asked=asked, counts=begins)
        total = exclusive_scan(begins, n)
        if total == 0:
            return
        points = device.empty(3 * total, np.float64)
        named = {**work.arguments, **level.arguments, "asked": asked, "begins": begins}
        work.kernel(SOURCE, "list_asked")(n, **named, points=points)
        numbers = work.survey.winding.at_local(points, total)
        work.kernel(SOURCE, "settle_signs")(
            n,
            **named,
            numbers=numbers,
            doubts=level.doubts,
            states=level.states,
            values=level.values,
        )
