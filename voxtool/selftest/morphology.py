"""Morphology of voxels that are few and far apart, by radii whose squares decide."""

from __future__ import annotations

from itertools import product
from math import nextafter
from typing import TYPE_CHECKING

from voxtool.choices import MAX_DIM
from voxtool.grid import Grid
from voxtool.selftest.case import case
from voxtool.selftest.exchange import differing
from voxtool.svo.morphology import plan_morph
from voxtool.svo.octree import Octree

if TYPE_CHECKING:
    from voxtool.opencl import Device

FAR = MAX_DIM - 64


@case("morphology", "2 voxels at dim 65536, radii at and below 5, 2^0.5 and 33: lattice points",
      "voxels wrong", 0)  # fmt: skip
def balls_far_apart(device: Device, full: bool) -> int:
    """Dilated, each voxel is a ball of as many lattice points as there are within the radius;
    closed and opened, the set is as it was."""
    two = Octree.from_voxels(
        [(64, 64, 64), (FAR, FAR, FAR - 1)], Grid((MAX_DIM, MAX_DIM, MAX_DIM), (0, 0, 0), (1, 1, 1))
    )
    wrong = 0
    for radius in (5.0, 2**0.5, *([33.0] if full else [])):
        for given in (radius, nextafter(radius, 0)):
            balls = plan_morph(two, "dilate", given, device=device).run()
            wrong += abs(balls.count - 2 * lattice_points(given))
            wrong += differing(plan_morph(two, "close", given, device=device).run(), two)
            wrong += abs(plan_morph(balls, "open", given, device=device).run().count - balls.count)
    return wrong


def lattice_points(radius: float) -> int:
    """The lattice points within a radius of the origin."""
    n, d = radius.as_integer_ratio()
    steps = range(-int(radius), int(radius) + 1)
    return sum((x * x + y * y + z * z) * d * d <= n * n for x, y, z in product(steps, repeat=3))


CASES = (balls_far_apart,)
