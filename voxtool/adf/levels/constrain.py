"""Stage "constrain": blocks take the interpolation of adjacent coarser leaves on shared faces and
edges, so that the field has no cracks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from voxtool.adf.levels.level import Construction, Level

SOURCE = "adf/levels/constrain.cl"


def constrain(work: Construction, level: Level) -> None:
    """Set the values of vertices on a coarser leaf to its interpolation."""
    above = level.above
    if above is None:
        return
    device, n = work.device, level.count
    level.neighbours = device.empty(27 * n, np.uint32)
    with device.stage("constrain"):
        work.kernel(SOURCE, "find_neighbours")(
            n,
            sources=level.sources,
            ranks=above.ranks,
            above=above.neighbours,
            neighbours=level.neighbours,
            unbalanced=work.unbalanced,
        )
        work.kernel(SOURCE, "constrain_blocks")(
            n,
            sources=level.sources,
            neighbours=level.neighbours,
            above=above.values,
            values=level.values,
        )
