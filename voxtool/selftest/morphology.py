"""Morphology and resampling of voxels that are few and far apart, where the last bit decides."""

from __future__ import annotations

from itertools import product
from math import nextafter
from typing import TYPE_CHECKING

import numpy as np

from voxtool.choices import MAX_DIM
from voxtool.grid import Grid
from voxtool.selftest.case import case
from voxtool.selftest.exchange import differing
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.labels import plan_components
from voxtool.svo.sets.morphology import plan_morph
from voxtool.svo.sets.resample import plan_resample
from voxtool.svo.sets.thin import plan_thin

if TYPE_CHECKING:
    from voxtool.opencl import Device

FAR = MAX_DIM - 64


@case("morphology", "2 voxels at dim 65536, radii at and below 5, 2^0.5 and 33: lattice points",
      "voxels wrong", 0)  # fmt: skip
def balls_far_apart(device: Device, full: bool) -> int:
    """Dilate voxels: each is a ball of as many lattice points as there are within the radius.
    Closed and opened, the set is as it was."""
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
    """Return the lattice points within a radius of the origin."""
    n, d = radius.as_integer_ratio()
    steps = range(-int(radius), int(radius) + 1)
    return sum((x * x + y * y + z * z) * d * d <= n * n for x, y, z in product(steps, repeat=3))


@case("resampling", "8 voxels at dim 65536 to twice their size, at and above a share of 1/8",
      "voxels wrong", 0)  # fmt: skip
def shares_of_an_eighth(device: Device, full: bool) -> int:
    """Resample voxels to twice their size: each covers an eighth of the new one, so all are kept
    at a share of 1/8, as components, and none at the next larger number."""
    low = (64, FAR) if full else (64, 4096)
    cells = [(x, y, z) for x in low for y in low for z in low]
    grid = Grid((MAX_DIM, MAX_DIM, MAX_DIM), (0, 0, 0), (1, 1, 1))
    half = Grid((MAX_DIM // 2, MAX_DIM // 2, MAX_DIM // 2), (0, 0, 0), (2, 2, 2))
    apart = Octree.from_voxels(cells, grid)
    found = plan_resample(apart, half, threshold=1 / 8, device=device).run()
    expected = Octree.from_voxels([(x // 2, y // 2, z // 2) for x, y, z in cells], half)
    none = plan_resample(apart, half, threshold=nextafter(1 / 8, 1), device=device).run()
    parts = len(plan_components(found).run().sizes)
    return differing(found, expected) + none.count + abs(parts - len(cells))


@case("thin", "walls of boxes at dim 65536, 3 and 1 thick", "voxels wrong", 0)
def walls_in_a_corner(device: Device, full: bool) -> int:
    """Thin walls: the middle layer of 3 stays of a wall that 26-separates; a layer that
    6-separates loses its edges."""
    side = 40 if full else 10
    grid = Grid((MAX_DIM, MAX_DIM, MAX_DIM), (0, 0, 0), (1, 1, 1))
    depths = {c: [min(n, side - 1 - n) for n in c] for c in product(range(side), repeat=3)}
    wrong = 0
    for mode, thickness, layer, most in (("surface26", 3, 1, 3), ("surface6", 1, 0, 1)):
        walls = [cell for cell, depth in depths.items() if min(depth) < thickness]
        left = [c for c in walls if min(depths[c]) == layer and depths[c].count(layer) <= most]
        given, expected = (
            Octree.from_voxels(np.array(cells) + MAX_DIM - side, grid, mode=mode)
            for cells in (walls, left)
        )
        wrong += differing(plan_thin(given).run(), expected)
    return wrong


CASES = (balls_far_apart, shares_of_an_eighth, walls_in_a_corner)
