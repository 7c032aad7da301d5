"""The names of labels beside their colours, as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from voxtool.choices import WHITE
from voxtool.palette import palette
from voxtool.pictures.canvas import drawn, need_matplotlib
from voxtool.pictures.legend import HEIGHT, check_height, ink_on

WIDTH, ROW, MARGIN = 176, 18, 14  # pixels of a legend of HEIGHT; others in proportion
LETTERS = 24  # of a name that fit


def draw_label_legend(
    rows: Sequence[tuple[int, str]],
    height: int,
    *,
    background: Sequence[float] | None = WHITE,
) -> np.ndarray:
    """Return the names of labels with their colours, to stand at the right of a picture, (height,
    W, 4) float32, premultiplied. The last line counts the names that do not fit.

    Parameters
    ----------
    rows : the number and the name of each label.
    background : the colour behind the legend, which decides that of its text; None is white.

    Raises
    ------
    VoxtoolError : the legend would be too low to be read.
    FileError : matplotlib is missing.
    """
    check_height(height)
    need_matplotlib("legends")
    fit = (HEIGHT - 2 * MARGIN) // ROW
    shown = rows if len(rows) <= fit else rows[: fit - 1]
    colours = palette(max((number for number, _ in rows), default=0) + 1) / 255
    ink = ink_on(background)

    def paint(figure: Any) -> None:
        axes = figure.add_axes((0, 0, 1, 1), facecolor="none")
        axes.set_axis_off()
        axes.set_xlim(0, WIDTH)
        axes.set_ylim(HEIGHT, 0)
        words: dict[str, Any] = {
            "color": ink, "parse_math": False, "fontsize": 8, "va": "center",
        }  # fmt: skip
        for place, (number, name) in enumerate(shown):
            middle = MARGIN + ROW * (place + 0.5)
            box = (8, middle - 5), 12, 10
            axes.add_patch(_rectangle(*box, colours[number]))
            text = name if len(name) <= LETTERS else f"{name[: LETTERS - 1]}…"
            axes.text(26, middle, text, **words)
        if len(shown) < len(rows):
            left = len(rows) - len(shown)
            axes.text(26, MARGIN + ROW * (len(shown) + 0.5), f"and {left:,} more", **words)

    scale = height / HEIGHT
    legend = drawn(round(WIDTH * scale), height, paint, scale=scale, face="none")
    legend[..., :3] *= legend[..., 3:]
    return legend


def _rectangle(corner: tuple[float, float], width: float, height: float, colour: Any) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle(corner, width, height, facecolor=colour, edgecolor="none")
