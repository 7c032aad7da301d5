"""Dilations of dense arrays, by another algorithm: exact distances and filters of scipy."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from scipy import ndimage


def near(dense: np.ndarray, radius: float, shape: str) -> np.ndarray:
    """The voxels of an array within a radius of a set one."""
    side = 2 * int(radius) + 1
    if shape == "cube":
        return ndimage.maximum_filter(dense, side, mode="constant")
    if shape == "cross":
        lines = np.where(np.eye(3, dtype=bool), side, 1)
        return np.any([ndimage.maximum_filter(dense, s, mode="constant") for s in lines], axis=0)
    if not dense.any():
        return dense
    distance = np.asarray(ndimage.distance_transform_edt(~dense))
    return np.rint(distance * distance) <= int(Fraction(radius) ** 2)


def morphed(dense: np.ndarray, operation: str, radius: float, shape: str) -> np.ndarray:
    """A dense array after an operation, of its own shape; all beyond it is unset."""
    margin = 2 * int(radius) + 1
    padded = np.pad(dense, margin)

    def dilated(array: np.ndarray) -> np.ndarray:
        return near(array, radius, shape)

    def eroded(array: np.ndarray) -> np.ndarray:
        return ~dilated(~array)

    result = {
        "dilate": lambda: dilated(padded),
        "erode": lambda: eroded(padded),
        "open": lambda: dilated(eroded(padded)),
        "close": lambda: eroded(dilated(padded)),
        "shell": lambda: padded & ~eroded(padded),
    }[operation]()
    return result[(slice(margin, -margin),) * 3]
