"""The angle of a vector, by + - * / alone: the same on every machine.

The kernels have it in kernels/spatial/angles.h, with the same coefficients.
"""

from __future__ import annotations

import numpy as np

# atan t = t + t^3 P(t^2) on [0, tan(pi/8)] to 2e-17: the first twelve terms of the Chebyshev series
# 2 sum (-1)^k q^(2k+1) / (2k+1) T_(2k+1)(t / tan(pi/8)), q = tan(pi/16)
COEFFICIENTS = (
    -0.3333333333333243,
    0.1999999999983741,
    -0.14285714272042474,
    0.11111110465849684,
    -0.09090890205164943,
    0.07691944938571023,
    -0.06661951161621596,
    0.058403740045694916,
    -0.05008550701328832,
    0.03734732216833096,
    -0.017180029701564188,
)
EIGHTH = 0.41421356237309503  # tan(pi/8)
PI = 3.141592653589793

HEADERS = {
    "spatial/arctangent.h": "\n".join(
        f"#define {name} {value.hex()}"
        for name, value in (
            *((f"ARCTANGENT_{i}", value) for i, value in enumerate(COEFFICIENTS)),
            ("TAN_EIGHTH", EIGHTH),
            ("PI", PI),
        )
    )
}


def angle_of(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The angle of each vector (x, y) from the x axis, in [-pi, pi], within 1e-15; 0 where y is
    0, whatever x."""
    across, along = np.abs(y), np.abs(x)
    small, big = np.minimum(across, along), np.maximum(across, along)
    turned = small > EIGHTH * big
    above = np.where(turned, small - big, small)
    below = np.where(turned, small + big, np.where(big > 0, big, 1.0))
    t = above / below
    z = t * t
    p = np.full_like(z, COEFFICIENTS[-1])
    for coefficient in COEFFICIENTS[-2::-1]:
        p = p * z + coefficient
    angle = t + t * z * p
    angle = np.where(turned, PI / 4 + angle, angle)
    angle = np.where(across > along, PI / 2 - angle, angle)
    angle = np.where(x < 0, PI - angle, angle)
    angle = np.where(y < 0, -angle, angle)
    return np.where(y == 0, 0.0, angle)
