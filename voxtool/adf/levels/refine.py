"""Stage "refine": the refined children become the cells of the next level."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.levels.level import Level, Parents
from voxtool.opencl.primitives import exclusive_scan

if TYPE_CHECKING:
    from voxtool.adf.levels.level import Construction

SOURCE = "adf/levels/refine.cl"


def list_size(level: Level, refined: np.ndarray) -> int:
    """Return the total length of the lists of the refined children, those with (8 n,) not 0."""
    assert level.needed is not None
    return int(level.needed.get()[refined != 0].sum(dtype=np.int64))


def refine(work: Construction, level: Level, size: int) -> Level:
    """Return the next level, whose lists have `size` triangles; it has at least one cell."""
    device, n = work.device, level.count
    assert level.ranks is not None
    with device.stage("refine"):
        total = exclusive_scan(level.ranks, 8 * n)
        identifiers = device.empty(total, np.uint64)
        sources, begins = device.empty(total, np.uint32), device.empty(total + 1, np.uint32)
        work.kernel(SOURCE, "list_refined")(
            8 * n,
            ranks=level.ranks,
            above=level.identifiers,
            needed=level.needed,
            identifiers=identifiers,
            sources=sources,
            counts=begins,
        )
        exclusive_scan(begins, total)
        items = device.empty(size, np.uint32)
        work.kernel(SOURCE, "pass_lists_on")(
            total,
            sources=sources,
            above=level.begins,
            parent_items=level.items,
            masks=level.masks,
            begins=begins,
            items=items,
        )
    above = Parents(level.values, level.states, level.neighbours, level.ranks)
    return Level(level.number + 1, total, identifiers, sources, begins, items, above)
