"""Whole numbers to text of one width, a hundred million in a second."""

from __future__ import annotations

import numpy as np

FOUR = 10_000  # a group of four digits


def _groups() -> np.ndarray:
    """Return the text of each group of four digits as a uint32: behind others with zeros, then
    alone with blanks."""
    numbers = np.arange(FOUR)
    digits = np.stack([numbers // 10**k % 10 for k in (3, 2, 1, 0)], axis=1).astype(np.uint8)
    letters = digits + np.uint8(ord("0"))
    alone = letters.copy()
    for place, ten in enumerate((1000, 100, 10)):
        alone[numbers < ten, place] = ord(" ")
    return np.concatenate([letters, alone]).view("<u4").ravel()


GROUPS = _groups()


def width_of(most: int) -> int:
    """Return the letters of numbers up to `most`: a multiple of four."""
    return 4 * -(-len(str(most)) // 4)


def text_of(numbers: np.ndarray, width: int) -> np.ndarray:
    """Return whole numbers, from 0, as text of `width` letters, blanks first: (n,) of bytes.

    `width` is a multiple of four, and the numbers have no more digits.
    """
    rest = np.asarray(numbers).astype(np.uint32 if width <= 8 else np.uint64)
    found = np.full((len(rest), width // 4), np.frombuffer(b"    ", "<u4")[0])
    first = np.ones(len(rest), bool)  # whether the group, from the last on, has digits
    for place in range(width // 4 - 1, -1, -1):
        above = rest // FOUR
        group = (rest - above * FOUR).astype(np.uint32)
        text = GROUPS[group + np.uint32(FOUR) * (above == 0)]
        found[:, place] = text if first.all() else np.where(first, text, found[:, place])
        rest, first = above, above > 0
    return found.view(f"S{width}").ravel()
