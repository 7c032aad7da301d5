"""The components of free space that are outside, if several regions have parts of them.

A piece that two regions have is one, so its roots in either are united; so are all pieces beyond
the grid. Roots of the regions are numbered one region after the other.
"""

from __future__ import annotations

import numpy as np

from voxtool.mesh.topology import components
from voxtool.morton import distinct
from voxtool.svo.voxelization.fill.flood_pieces import Shared


class Outside:
    """The components of regions, which are added one by one."""

    def __init__(self) -> None:
        self._keys: list[np.ndarray] = []
        self._numbers: list[np.ndarray] = []  # of the roots of the keys
        self._links: list[np.ndarray] = []  # (2, n) numbers
        self._beyond: list[np.ndarray] = []
        self._starts = [0]

    def add(self, shared: Shared) -> int:
        """Add a region; return its number."""
        first = self._starts[-1]
        self._keys.append(shared.keys)
        self._numbers.append(first + shared.roots.astype(np.int64))
        self._beyond.append(first + shared.beyond.astype(np.int64))
        self._starts.append(first + shared.size)
        return len(self._starts) - 2

    def link(self, region: int, roots: np.ndarray, other: int) -> None:
        """Unite roots of a region with the first root of another."""
        numbers = self._starts[region] + roots.astype(np.int64)
        self._links.append(np.stack([numbers, np.full(len(numbers), self._starts[other])]))

    def roots(self) -> list[np.ndarray]:
        """Return the roots of each region that are outside."""
        keys, numbers = np.concatenate(self._keys), np.concatenate(self._numbers)
        order = np.argsort(keys, kind="stable")
        keys, numbers = keys[order], numbers[order]
        same = keys[1:] == keys[:-1]
        links = np.stack([numbers[:-1][same], numbers[1:][same]])
        u, v = np.concatenate([links, *self._links], axis=1)
        beyond = np.concatenate(self._beyond)
        known = distinct(np.concatenate([u, v, beyond]))
        u, v = np.searchsorted(known, u), np.searchsorted(known, v)
        least = components(u, v, len(known))
        outside = known[np.isin(least, least[np.searchsorted(known, beyond)])]
        parts = np.split(outside, np.searchsorted(outside, self._starts[1:-1]))
        return [part - first for part, first in zip(parts, self._starts, strict=False)]
