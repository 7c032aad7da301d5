"""Proofs by interval arithmetic that leaves of fields of thin scenes keep their bounds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.construction.stages import OCTANTS
from voxtool.adf.field.cells import bound_values
from voxtool.adf.pictures.raycast import refined_children
from voxtool.adf.surface.narrow_band import _halved, leaves_of
from voxtool.selftest.thin import EXACT

if TYPE_CHECKING:
    from voxtool.adf.field.field import DistanceField
    from voxtool.selftest.thin import Thin

CLOSE = 1.02  # bounds: what is proved; no point at the middle of a box exceeds the bound itself
LEAST = 1 / 16  # edges: bounds below take too many boxes
MOST_BOXES = 1 << 13  # a round


def prove(field: DistanceField, thin: Thin, random: np.random.Generator, most: int) -> tuple:
    """Prove for `most` leaves near the surface that the field is nowhere in them farther from the
    distance than CLOSE times their bound; return for how many, and how many take too many boxes.

    In a box, the interpolation lies between its least and greatest corner. The distance differs
    from that at the middle by at most half of the diagonal. So the error lies in the difference of
    these two intervals. A box that this does not decide is halved along each axis.
    """
    refined, boxes = refined_children(field), leaves_of(field)
    assert field.bounds is not None
    codes = [
        field.bounds[refined >> bit & 1 == 0, z, y, x] for bit, (x, y, z) in enumerate(OCTANTS.T)
    ]
    bound = bound_values()[np.concatenate(codes)]
    near = np.abs(boxes.values).min(axis=(1, 2, 3)) < 2 * boxes.edge
    some = np.flatnonzero(near & (bound > LEAST * boxes.edge) & np.isfinite(bound))
    some = np.sort(random.choice(some, min(most, len(some)), replace=False))
    boxes, bound, of = boxes.chosen(some), bound[some], np.arange(len(some))
    while 0 < len(bound) < MOST_BOXES:
        middles = boxes.low + boxes.edge[:, None] / 2
        distance = thin.distance(np.array(field.origin) + field.side * middles) / field.side
        reach = math.sqrt(3) / 2 * boxes.edge + EXACT
        low, high = (f(boxes.values, axis=(1, 2, 3)) for f in (np.min, np.max))
        assert (np.abs(boxes.values.mean(axis=(1, 2, 3)) - distance) <= bound + EXACT).all()
        left = np.maximum(high - (distance - reach), distance + reach - low) > CLOSE * bound
        boxes, bound, of = (
            _halved(boxes.chosen(left)), np.tile(bound[left], 8), np.tile(of[left], 8),
        )  # fmt: skip
    undecided = len(np.unique(of))
    return len(some) - undecided, undecided
