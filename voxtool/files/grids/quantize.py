"""Few colours for many: a palette by median cut [Heckbert 1982], the same everywhere."""

from __future__ import annotations

import numpy as np

from voxtool.mesh.srgb import linear_table, to_levels

MOST = 255  # colours of a palette; number 0 is no colour
SHIFTS = np.array([24, 16, 8, 0], np.uint32)


def packed(colours: np.ndarray) -> np.ndarray:
    """Return colours, (..., 4) uint8, as one number each, (...) uint32."""
    return (colours.astype(np.uint32) << SHIFTS).sum(axis=-1, dtype=np.uint32)


def unpacked(numbers: np.ndarray) -> np.ndarray:
    """Return the colours of numbers, (..., 4) uint8."""
    return ((numbers[..., None] >> SHIFTS) & np.uint32(255)).astype(np.uint8)


def palette_of(colours: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a palette, (P, 4) uint8 of at most MOST colours, and the place in it of each colour.

    Up to MOST colours are the palette themselves. If there are more, the box of colours with the
    greatest product of count and squared range is divided at the median along its widest channel,
    until there are MOST; each takes its mean, in linear light.

    Parameters
    ----------
    colours : (N, 4) uint8
        Different ones, in the order of `packed`.
    counts : (N,) int64
        How often each is there.
    """
    if len(colours) <= MOST:
        return colours, np.arange(len(colours))
    boxes = [np.arange(len(colours))]
    weights = [_weight(colours, counts, boxes[0])]
    while len(boxes) < MOST:
        chosen = int(np.argmax(weights))  # of equal ones the first
        box = boxes[chosen]
        channel = int(np.argmax(np.ptp(colours[box].astype(int), axis=0)))
        box = box[np.argsort(colours[box, channel], kind="stable")]
        upto = np.cumsum(counts[box])
        split = int(np.searchsorted(2 * upto, upto[-1]))
        split = min(max(split, 1), len(box) - 1)
        boxes[chosen], more = np.sort(box[:split]), np.sort(box[split:])
        weights[chosen] = _weight(colours, counts, boxes[chosen])
        boxes.append(more)
        weights.append(_weight(colours, counts, more))
    palette = np.array([_mean(colours[box], counts[box]) for box in boxes], np.uint8)
    place = np.empty(len(colours), np.int64)
    for number, box in enumerate(boxes):
        place[box] = number
    return palette, place


def _weight(colours: np.ndarray, counts: np.ndarray, box: np.ndarray) -> int:
    side = int(np.ptp(colours[box].astype(int), axis=0).max())
    return side * side * int(counts[box].sum())


def _mean(colours: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the mean of colours in linear light, and of their opacities."""
    total = int(counts.sum())
    light = (linear_table()[colours[:, :3]] * counts[:, None]).sum(axis=0) // total
    alpha = (2 * (colours[:, 3] * counts).sum() + total) // (2 * total)
    return np.append(to_levels(light), np.uint8(alpha))
