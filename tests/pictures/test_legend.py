"""Legends show a transfer function in its colours."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from voxtool.errors import VoxtoolError
from voxtool.pictures.legend import BOTTOM, LEAST_HEIGHT, TOP, draw_legend

STEP = SimpleNamespace(
    scalars=np.array([0.0, 1.0, 1.0, 2.0]),
    colours=np.array([(1, 0, 0), (1, 0, 0), (0, 0, 1), (0, 0, 1)], float),
    extinctions=np.array([0.0, 0.0, 4.0, 4.0]),
)


def test_a_legend_shows_colours_and_extinctions() -> None:
    legend = draw_legend(STEP, (0.0, 2.0), "density", 512, background=(1, 1, 1))
    assert legend.dtype == np.float32
    assert legend.shape[0] == 512
    assert (legend[..., :3] <= legend[..., 3:]).all()
    red = (legend == (1, 0, 0, 1)).all(axis=2)
    blue = (legend == (0, 0, 1, 1)).all(axis=2)
    rows = np.flatnonzero(red.any(axis=1)), np.flatnonzero(blue.any(axis=1))
    assert rows[1].max() < rows[0].min()  # the higher scalar is above
    assert abs(len(rows[0]) - len(rows[1])) <= 4
    # red is transparent: in the bar only; blue fills the curve, too
    assert blue.sum() > 4 * red.sum() > 0


def test_a_legend_has_its_text_in_contrast_with_the_paper() -> None:
    for background, dark in (((1, 1, 1), True), (None, True), ((0, 0, 0.1), False)):
        legend = draw_legend(STEP, (0.0, 2.0), "density", 256, background=background)
        text = legend[:16][legend[:16, :, 3] > 0.9]  # the title
        assert len(text)
        assert (text[:, :3].max() < 0.4) == dark


def test_a_constant_volume_and_a_transparent_function_have_legends() -> None:
    nothing = SimpleNamespace(
        scalars=np.array([3.0]), colours=np.array([(1.0, 0, 0)]), extinctions=np.array([0.0])
    )
    assert np.isfinite(draw_legend(nothing, (3.0, 3.0), "$x_{" * 50, 300)).all()


def test_a_histogram_is_behind_the_curve() -> None:
    scalars, volumes = np.array([0.24, 0.26, 0.4, 0.9]), np.array([2.0, 2.0, 1.0, 4.0])
    how = ((0.0, 2.0), "density", 512)
    plain, drawn = draw_legend(STEP, *how), draw_legend(STEP, *how, shares=(scalars, volumes))
    changed = (plain != drawn).any(axis=2)
    rows = np.flatnonzero(changed.any(axis=1))
    low, high = (512 * (1 - BOTTOM - (1 - BOTTOM - TOP) * share) for share in (0.22, 0.42))
    assert high - 2 <= rows.min() < rows.max() <= low + 2  # that at 0.9 is behind the blue area
    lengths = changed.sum(axis=1)
    assert lengths.max() > 1.2 * lengths[rows.min() + 2] > 0  # the square root of 2, about


def test_a_low_legend_is_refused() -> None:
    with pytest.raises(VoxtoolError, match=f"{LEAST_HEIGHT} or more, or leave out --legend"):
        draw_legend(STEP, (0.0, 2.0), "density", LEAST_HEIGHT - 1)
    assert draw_legend(STEP, (0.0, 2.0), "density", LEAST_HEIGHT).shape[0] == LEAST_HEIGHT


def test_a_legend_is_the_same_twice() -> None:
    first, second = (draw_legend(STEP, (0.0, 2.0), "density", 300) for _ in range(2))
    assert np.array_equal(first, second)
