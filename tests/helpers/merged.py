"""Octrees with equal, full, empty and mixed parts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from helpers.octree import octree_from_dense

from voxtool.svo.octree.octree import Octree


def random_octree(seed: int, mode: str = "solid") -> Octree:
    """An octree with repeated, full, empty and mixed parts, whose grid is no cube."""
    random = np.random.default_rng(seed)
    part = random.random((8, 8, 8)) < random.choice([0.05, 0.5])
    pattern = random.random((5, 6, 3)) < random.choice([0.1, 0.5, 0.9])
    dense = np.kron(pattern, part) if seed % 2 else np.kron(pattern, np.ones((8, 8, 8), bool))
    dense = dense[:-3]
    dense[random.random(dense.shape) < random.choice([0, 1e-3])] = True
    return octree_from_dense(dense, mode=mode, fill="none")


EXTREMES: dict[str, np.ndarray] = {
    "empty": np.zeros((9, 8, 8), bool),
    "full": np.ones((16, 16, 16), bool),
    "full, no cube": np.ones((17, 9, 12), bool),
    "one voxel": np.pad(np.ones((1, 1, 1), bool), ((33, 6), (2, 37), (39, 0))),
    "checkerboard": np.indices((32, 32, 32)).sum(axis=0) % 2 == 1,
}
OCTREES: dict[str, Callable[[], Octree]] = {
    **{f"random {seed}": lambda seed=seed: random_octree(seed) for seed in range(8)},
    **{f"surface {seed}": lambda seed=seed: random_octree(seed, "surface26") for seed in range(4)},
    **{name: lambda dense=dense: octree_from_dense(dense) for name, dense in EXTREMES.items()},
}
