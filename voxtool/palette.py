"""Colours of labels: a palette of any number of colours that eyes tell apart.

The first ones are chosen by hand; the others are spread evenly over hues, lightness and saturation.
All is in whole numbers, the same everywhere.
"""

from __future__ import annotations

import numpy as np

# The first six are those of [Okabe 2008], which eyes that do not tell red and green apart tell
# apart, without black and yellow: a shadow hides the one, white paper the other.
FIRST = (
    (0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0),
    (120, 94, 240), (154, 205, 50), (136, 34, 85), (102, 102, 102), (221, 204, 119), (170, 68, 153),
    (17, 119, 51), (250, 128, 114), (64, 224, 208), (139, 90, 43), (51, 34, 136), (240, 230, 70),
    (176, 196, 222), (128, 0, 0), (0, 206, 0), (255, 20, 147), (143, 188, 143), (40, 60, 90),
)  # fmt: skip
# Further colours: steps of the hue, of the largest and of the smallest part, in 2**-32 of
# their range: powers of 1 / 1.22074, whose multiples fill a cube evenly [Roberts 2018].
STEPS = (3518319155, 2882110345, 2360945575)
LARGEST, SMALLEST = (110, 250), (10, 60)  # of the largest part from 0 to 255; % of the largest


def palette(count: int) -> np.ndarray:
    """Return the colours of the labels 0 to count - 1, (count, 3) uint8, in sRGB."""
    found = np.zeros((count, 3), np.uint8)
    given = min(count, len(FIRST))
    found[:given] = np.array(FIRST)[:given]
    more = np.arange(count - given, dtype=np.uint64)
    if not len(more):
        return found
    hue, large, small = (
        (more * np.uint64(step) & np.uint64(0xFFFFFFFF)).astype(np.int64) >> 16 for step in STEPS
    )
    sector, within = hue * 6 >> 16, hue * 6 & 0xFFFF
    high = LARGEST[0] + ((LARGEST[1] - LARGEST[0]) * large >> 16)
    low = high * (SMALLEST[0] + ((SMALLEST[1] - SMALLEST[0]) * small >> 16)) // 100
    rising = low + ((high - low) * within >> 16)
    falling = high - ((high - low) * within >> 16)
    ways = np.array(
        [
            [high, rising, low], [falling, high, low], [low, high, rising],
            [low, falling, high], [rising, low, high], [high, low, falling],
        ]
    )  # fmt: skip
    found[given:] = ways[sector, :, np.arange(len(more))]
    return found
