"""Dilations and components of dense arrays, by other algorithms: those of scipy."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from scipy import ndimage

RNG = np.random.default_rng(3)


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


def sizes_of(dense: np.ndarray, neighbours: int) -> np.ndarray:
    """The voxels of each component by scipy, the largest first."""
    reach = {6: 1, 18: 2, 26: 3}[neighbours]
    labels = np.asarray(ndimage.label(dense, ndimage.generate_binary_structure(3, reach))[0])  # pyright: ignore
    return np.sort(np.bincount(labels.ravel())[1:])[::-1]


def scenes() -> dict[str, np.ndarray]:
    """Sets whose components are many, few, coarse or none."""
    blobs = ndimage.gaussian_filter(RNG.random((24, 20, 17)), 1.5) > 0.5
    leaves = np.zeros((70, 40, 40), bool)  # FULL leaves of two levels that share a corner
    leaves[:32, :32, :32] = leaves[32:48, 32:40, 32:40] = leaves[60, 5, 5] = True
    return {
        "sparse": RNG.random((9, 20, 33)) < 0.1,
        "dense": RNG.random((20, 18, 9)) < 0.31,
        "checkerboard": np.indices((8, 12, 9)).sum(axis=0) % 2 == 0,
        "blobs": blobs,
        "coarse": np.repeat(blobs[:8, :8, :8], 8, axis=0).repeat(8, axis=1).repeat(8, axis=2),
        "leaves": leaves,
        "shells": ~leaves,
        "none": np.zeros((8, 8, 8), bool),
        "all": np.ones((16, 16, 16), bool),
    }
