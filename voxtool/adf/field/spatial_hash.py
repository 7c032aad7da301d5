"""The perfect spatial hash as data: a function from keys to slots [Lefebvre 2006].

hashing.py builds it, and explains it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.adf.field.cells import shown
from voxtool.arrays import Data
from voxtool.errors import VoxtoolError

AT_ONCE = 1 << 16  # keys whose slots are found at once, in memory that fits caches


@dataclass(frozen=True, eq=False, repr=False)
class SpatialHash(Data):
    """A function from keys to slots without collisions among the keys that it was built for.

    m, r: sides of the tables of slots and of offsets; offsets: (r, r, r, 3 or 4) uint8 if m < 256,
    otherwise uint16; indexed [z, y, x]: x, y, z and, if some bucket needs it, w from 1 to m.
    """

    m: int
    r: int
    offsets: np.ndarray

    def __repr__(self) -> str:
        return f"SpatialHash(m={self.m}, r={self.r}{', with w' if self.has_w else ''})"

    @property
    def has_w(self) -> bool:
        """True if w is stored; otherwise it is m."""
        return self.offsets.shape[-1] == 4

    @property
    def nbytes(self) -> int:
        """The bytes of the offsets."""
        return self.offsets.nbytes

    def bits_a_key(self, n: int) -> float:
        """Return the bits of the offsets for each of n keys."""
        return 8 * self.nbytes / max(n, 1)

    def load(self, n: int) -> float:
        """Return the share of the slots that n keys take."""
        return n / self.m**3

    def slots(self, keys: np.ndarray) -> np.ndarray:
        """Return the slots x + m (y + m z) of (n, 3) keys >= 0, (n,) int64."""
        keys, m = np.asarray(keys, np.int64), self.m
        slots = np.empty(len(keys), np.int64)
        for begin in range(0, len(keys), AT_ONCE):
            some = keys[begin : begin + AT_ONCE]
            x, y, z = (some % self.r).T
            offset = self.offsets[z, y, x].astype(np.int64)
            w = offset[:, 3:] if self.has_w else m
            x, y, z = ((some % w + offset[:, :3]) % m).T
            slots[begin : begin + AT_ONCE] = x + m * (y + m * z)
        return slots

    def validate(self, keys: np.ndarray) -> None:
        """Raise VoxtoolError if the table is not valid, or two of the keys have the same slot."""
        self._check_table()
        slots = self.slots(keys)
        shared = np.flatnonzero(np.bincount(slots, minlength=self.m**3) > 1)
        if len(shared):
            first, second = (shown(keys[i]) for i in np.flatnonzero(slots == shared[0])[:2])
            raise VoxtoolError(f"spatial hash: keys {first} and {second} have the same slot")

    def _check_table(self) -> None:
        m, r, offsets = self.m, self.r, self.offsets
        if m < 1 or r < 1 or offsets.shape not in ((r, r, r, 3), (r, r, r, 4)):
            raise VoxtoolError(f"spatial hash: r = {r}, but offsets of shape {offsets.shape}")
        if offsets.dtype != offset_type(m):
            raise VoxtoolError(f"spatial hash: m = {m}, but offsets of type {offsets.dtype}")
        w = offsets[..., 3:]
        if (offsets[..., :3] >= m).any() or (w < 1).any() or (w > m).any():
            raise VoxtoolError(f"spatial hash: m = {m}, but an offset is out of range")


def offset_type(m: int) -> np.dtype:
    """Return the type of offsets in a table of m x m x m slots."""
    return np.dtype(np.uint8 if m < 256 else np.uint16)
