"""Random stiff scenes of voxels: slivers, needles, plates, wedges, faces without area, repeated and
nearly touching parts, deep sparse grids, far from 0, tiny and huge."""

from __future__ import annotations

from random import Random

import pytest
from helpers.stiff import CLOSED, KINDS, stiff_scene, volume_off, voxels_wrong

from voxtool.opencl import Device


def check(seed: int, device: Device) -> None:
    """Hold the scene of a seed, of each kind in turn, against integers and rational numbers."""
    kind = KINDS[seed % len(KINDS)]
    scene = stiff_scene(Random(seed), kind)
    assert voxels_wrong(scene, device) == 0, (kind, seed)
    if kind in CLOSED:
        assert volume_off(scene, device) <= 1, (kind, seed)


def test_stiff_scenes(device: Device) -> None:
    for seed in range(20):
        check(seed, device)


@pytest.mark.soak
@pytest.mark.long
def test_a_thousand_stiff_scenes(device: Device, seed: int) -> None:
    for number in range(1000):
        check(1000 * (seed + 1) + number, device)
