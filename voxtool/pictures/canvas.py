"""Figures that matplotlib draws, as pixels, which depend on that library's version."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import FileError

if TYPE_CHECKING:
    from collections.abc import Callable

DPI = 100  # at which text has its size


def need_matplotlib(what: str) -> None:
    """Raise FileError if matplotlib is missing."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise FileError(f"{what} need matplotlib: pip install 'voxtool[pictures]'") from None


def drawn(
    width: float,
    height: float,
    paint: Callable[[Any], None],
    scale: float = 1.0,
    face: str = "none",
) -> np.ndarray:
    """Return the picture of a matplotlib figure, (height, width, 4) float32, not premultiplied.

    width, height : pixels; paint : draws into the figure.
    scale : that of text and lines; face : the colour of the figure.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    dpi = DPI * scale
    inches = ((width + 0.01) / dpi, (height + 0.01) / dpi)
    with matplotlib.rc_context(dict(matplotlib.rcParamsDefault)):  # whatever the user prefers
        figure = Figure(figsize=inches, dpi=dpi, facecolor=face)
        canvas = FigureCanvasAgg(figure)
        paint(figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba()).astype(np.float32) / 255
