"""Normals of the cells of an image, from the cells around them.

The gradient of the coverage is that of a Sobel operator of 5 x 5 x 5 cells: a binomial mean along
two axes, its difference along the third. Its sums are exact, so their order does not matter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from voxtool.svo.images.image import VoxelImage

REACH = 2  # cells to each side
MEAN = (1, 4, 6, 4, 1)
DIFFERENCE = (1, 2, 0, -2, -1)  # low minus high: outside is where less is set


class Normals:
    """Finds the normals of an image's cells, four layers at a time.

    Parameters
    ----------
    image : VoxelImage
        The cells. Those around its part count, too, and those outside the grid are empty.
    """

    def __init__(self, image: VoxelImage) -> None:
        self.image = image
        low = [max(n - REACH, 0) for n in image.low]
        ends = [n + m + REACH for n, m in zip(image.low, image.shape, strict=True)]
        high = [min(end, n) for end, n in zip(ends, image.all_cells, strict=True)]
        before = [low[axis] - image.low[axis] + REACH for axis in range(3)]
        after = [ends[axis] - high[axis] for axis in range(3)]
        self._around = [(before[axis], after[axis]) for axis in (1, 2)]
        wide = replace(
            image, low=tuple(low), shape=tuple(h - n for n, h in zip(low, high, strict=True)),
            dtype=np.dtype(np.float64 if image.level else np.uint8), progress=lambda share: None,
        )  # fmt: skip
        self._slabs = wide.slabs()
        self._layers: list[np.ndarray] = []
        self._first = -REACH  # of the held layers, counted from the part's low cell
        self._append(np.zeros((before[0], *wide.shape[1:]), wide.dtype))
        self._empty = np.zeros((REACH, *wide.shape[1:]), wide.dtype)

    def of(self, cells: np.ndarray) -> np.ndarray:
        """Return the unit normals of cells in world space, pointing to where less is set.

        Parameters
        ----------
        cells : (N, 3) int
            Cells counted from the low cell of the part, in lexicographic order. Later calls have
            cells of higher x.

        Returns
        -------
        (N, 3) float32
            Zero where all directions are equal, as deep inside.
        """
        if not len(cells):
            return np.empty((0, 3), np.float32)
        window = self._window(int(cells[0, 0]), int(cells[-1, 0]) + 1)
        places = cells - (cells[0, 0], 0, 0)
        _, rows, columns = window.shape
        first = (places[:, 0].astype(np.int64) * rows + places[:, 1]) * columns + places[:, 2]
        values, sums = window.ravel(), np.zeros((3, len(cells)))
        for i in range(len(MEAN)):
            for j in range(len(MEAN)):
                row = [values[first + (i * rows + j) * columns + k] for k in range(len(MEAN))]
                mean = sum(w * v.astype(np.float64) for w, v in zip(MEAN, row, strict=True))
                slope = sum(w * v.astype(np.float64) for w, v in zip(DIFFERENCE, row, strict=True))
                sums[0] += DIFFERENCE[i] * MEAN[j] * mean
                sums[1] += MEAN[i] * DIFFERENCE[j] * mean
                sums[2] += MEAN[i] * MEAN[j] * slope
        return _unit(sums, self.image.pitch)

    def _window(self, start: int, stop: int) -> np.ndarray:
        """Return the layers from `start` to `stop` and those around them, dense; forget earlier
        ones."""
        first, last = start - REACH, stop + REACH
        while self._first + len(self._layers) < last:
            self._append(next(self._slabs, self._empty))
            self._forget(first)
        self._forget(first)
        return np.stack(self._layers[: last - first])

    def _forget(self, first: int) -> None:
        """Drop the layers before this one."""
        dropped = min(max(first - self._first, 0), len(self._layers))
        del self._layers[:dropped]
        self._first += dropped

    def _append(self, slab: np.ndarray) -> None:
        self._layers += [np.pad(layer, self._around) for layer in slab]


def _unit(sums: np.ndarray, pitch: tuple[float, float, float]) -> np.ndarray:
    """Return gradients by cell as unit vectors of world space, zero where they vanish."""
    x, y, z = (s * (min(pitch) / p) for s, p in zip(sums, pitch, strict=True))
    length = np.sqrt(x * x + y * y + z * z)
    length[length == 0] = 1
    return np.stack([x / length, y / length, z / length], axis=1).astype(np.float32)
