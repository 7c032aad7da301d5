"""Points on the inside by the winding number, from the winding numbers of few of them.

A ball about a point that reaches to the nearest face holds no face, so that the winding number
changes in it with the boundary's shape alone (boundary.py). Points in the ball are therefore on the
side of its centre where the number there is far enough from 1/2. Points along a Hilbert curve are
taken in groups, large ones first: for each group the number is computed at the point that is
farthest from the mesh, and decides others; the last groups have one point. Provided that numbers
are off by less than 2^-7, the sides are those of the numbers of all points. About the bunny, 46,000
of a million random points need a number.

Kernels: kernels/spatial/insides.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl import Array, program
from voxtool.opencl.primitives import compact

if TYPE_CHECKING:
    from voxtool.spatial.distance import PointBlock
    from voxtool.spatial.winding_number import WindingNumber

SOURCE = "spatial/insides.cl"
GROUPS = 512, 64, 8, 1  # points, in turns
UNKNOWN, OUTSIDE, INSIDE = range(3)
BYTES = 57  # of a point on the device: place, two distances, number, side, two numbers of a group

HEADERS = {
    "spatial/insides.h": program.c_constants(UNKNOWN=UNKNOWN, OUTSIDE=OUTSIDE, INSIDE=INSIDE)
}


def insides(
    winding: WindingNumber, spheres: Array, block: PointBlock, distances: np.ndarray
) -> np.ndarray:
    """Return which points of a block have a winding number above 1/2, (n,) bool; False on the mesh.

    spheres : from boundary_spheres; distances : (n,) float64, to the mesh, in local coordinates.
    """
    device, n = winding.device, block.n
    places, gaps = device.empty(3 * n, np.float64), device.empty(n, np.float64)
    put_in_order, choose, pass_on = (
        device.kernel(SOURCE, name) for name in ("put_in_order", "choose", "pass_on")
    )
    with device.stage("winding number"):
        put_in_order(n, block.local, device.put(distances), block.order, places, gaps)
        numbers, sides = device.zeros(n, np.float64), device.zeros(n, np.uint8)
        for size in GROUPS:
            groups = -(-n // size)
            candidates = device.empty(groups, np.uint32)
            wanted = device.empty(groups + 1, np.uint32)
            choose(groups, n, size, gaps, sides, candidates, wanted)
            chosen, count = compact(candidates, wanted, groups)
            winding.wind(count, places, chosen, numbers)
            about = (spheres, spheres.size // 5)
            pass_on(count, n, size, chosen, places, gaps, *about, numbers, sides)
    inside = np.empty(n, bool)
    inside[block.order.get(0, n)] = sides.take() == INSIDE
    return inside
