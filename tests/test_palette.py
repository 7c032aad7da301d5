"""Colours of labels: the same for a label in any number of them, and apart from each other."""

from __future__ import annotations

import numpy as np

from voxtool.palette import FIRST, palette


def lab(colours: np.ndarray) -> np.ndarray:
    """Colours of CIE 1976 (L*, a*, b*)."""
    x = colours / 255.0
    light = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    xyz = light @ to_xyz.T / [0.9505, 1.0, 1.089]
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.stack(
        [116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1
    )


def nearest(count: int) -> float:
    """The least distance of two of the first colours."""
    points = lab(palette(count))
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
    return float((gaps + 1e9 * np.eye(count)).min())


def test_a_label_has_one_colour() -> None:
    many = palette(5000)
    for count in (0, 1, 5, 24, 25, 100):
        assert np.array_equal(palette(count), many[:count])
    assert many.dtype == np.uint8
    assert len(np.unique(many, axis=0)) > 4900


def test_colours_are_apart() -> None:
    assert nearest(8) > 25  # 2.3 is a just noticeable difference
    assert nearest(len(FIRST)) > 15
    assert nearest(60) > 5
    assert nearest(100) > 2.3


def test_no_colour_is_that_of_paper_or_shadow() -> None:
    points = lab(palette(200))
    assert points[:, 0].min() > 10
    assert points[:, 0].max() < 97
