"""Stage "examine": the error of each child, whether it is refined, and the bound of a leaf."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from voxtool.adf.levels.level import Construction, Level

SOURCE = "adf/levels/examine.cl"
CROSSED = 64.0  # tolerances: the largest edge of a leaf where triangles pass, unless certain


@dataclass
class Examined:
    """The children of a level's cells, on the host.

    voxels : (27 n,) float32, the blocks, in sides; refined : (8 n,) uint32, 1 or 0; errors : (8 n,)
    float32, in sides, -1 at a sign discontinuity; codes : (8 n,) uint8, of the bounds of leaves.
    """

    voxels: np.ndarray
    refined: np.ndarray
    errors: np.ndarray
    codes: np.ndarray


def examine(work: Construction, level: Level) -> Examined:
    """Return the errors of the children of a level's cells, and which of them are refined."""
    device, plan, n, side = work.device, work.plan, level.count, work.side
    voxels = device.empty(27 * n, np.float32)
    level.ranks = device.empty(8 * n + 1, np.uint32)
    errors, codes = device.empty(8 * n, np.float32), device.empty(8 * n, np.uint8)
    with device.stage("examine"):
        work.kernel(SOURCE, "store_voxels")(
            27 * n, values=level.values, extent=work.survey.extent, voxels=voxels
        )
        work.kernel(SOURCE, "examine_children")(
            n,
            **work.arguments,
            **level.arguments,
            doubts=level.doubts,
            voxels=voxels,
            tolerance=plan.tolerance * side,
            misplaced=work.survey.misplaced * side,
            band=plan.band * side,
            can_refine=level.number + 1 < plan.max_level,
            refine_coarse=0.5 ** (level.number + 1) > CROSSED * plan.tolerance,
            thorough=plan.max_bytes is not None,
            bounds=work.bound_values,
            masks=level.masks,
            flags=level.ranks,
            errors=errors,
            codes=codes,
            steepest=work.steepest,
        )
    return Examined(voxels.take(), level.ranks.get(0, 8 * n), errors.take(), codes.take())
