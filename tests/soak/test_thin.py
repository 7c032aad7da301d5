"""Long tests of fields of thin scenes: 50,000 points in each."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers.thin import prove

from voxtool.selftest import thin

pytestmark = pytest.mark.soak
POINTS = 22_500  # which become 50,000 with those near the worst


def test_no_point_of_thin_scenes_exceeds_its_bound(rounds) -> None:
    devices = [opened(index) for index, _ in usable_devices()]
    worst, counts, number = 0.0, np.zeros(2, int), 0
    for number, rng in enumerate(rounds, 1):
        random = np.random.default_rng(rng.randrange(1 << 32))
        scene, device = thin.scene(random), devices[number % len(devices)]
        field = thin.build(random, scene, device)
        over, ratio = thin.over_bound(random, field, scene, POINTS, device)
        assert over == 0, (scene.kind, field.tolerance, field.max_level, ratio)
        counts += prove(field, scene, random, 40)
        worst = max(worst, ratio)
    print(
        f"soak: {number:,} thin scenes, {50_000 * number:,} points: largest error {worst:.4f} of "
        f"its bound; proved {counts[0]:,} leaves, {counts[1]:,} undecided"
    )
