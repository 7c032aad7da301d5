"""Thinning of a set of voxels whose topology, ends and sheets stay [Bertrand 1994, Bertrand 2015].

Voxels go one after the other, those of the least weight first. One may go if it is simple; if it
has never separated unset voxels, as those of a sheet do; and if each covered voxel about it stays,
or shares a face or an edge with one that stays. Voxels of one of 27 subfields, whose coordinates
are equal modulo 3, have no common neighbour, so all of them that may go are removed at once: that
is as good as one after the other. On the host, in whole numbers.
"""

from __future__ import annotations

import numpy as np

from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.voxelization.connected.neighbourhoods import (
    BIT_OF,
    CENTRE,
    NEAR,
    STEPS,
    is_simple,
    separates,
)

SUBFIELDS = 27
COVERING = NEAR | BIT_OF[CENTRE]  # a covered voxel shares a face or an edge with one that stays
ROWS = np.flatnonzero(BIT_OF & COVERING)
HOST_BYTES = 800  # bytes of a voxel, at peak


def neighbours_among(codes: np.ndarray) -> np.ndarray:
    """Return where the 27 neighbours of voxels are among them, (27, n) int32, in the order of
    STEPS, given their ascending Morton codes; n for those that are not."""
    n, cells = len(codes), morton_decode(codes)
    found = np.full((len(STEPS), n), n, np.int32)
    found[CENTRE] = np.arange(n)
    for number in range(CENTRE):  # each step and its opposite
        near = morton_encode(cells + STEPS[number])
        place = np.searchsorted(codes, near)
        own = np.flatnonzero(np.append(codes, ~np.uint64(0))[place] == near)
        found[number, own] = place[own]
        found[2 * CENTRE - number, place[own]] = own
    return found


class Thinning:
    """A set of voxels while some of them go.

    Attributes
    ----------
    present : (n + 1,) bool
        The voxels that are set; the last one is not.
    row_of : (n + 1,) int64
        The row in the following of each voxel that may go; m for other voxels.
    beside : (27, m) int32
        The neighbours of each row.
    masks : (m + 1,) uint32
        Their neighbourhoods.
    covering : (n + 1,) int64
        How many voxels are set of each covered voxel and those that share a face or an edge with
        it; a large number for other voxels.
    stays : (m,) bool
        Those that have separated.
    """

    def __init__(
        self, may_go: np.ndarray, covered: np.ndarray, sheets: np.ndarray, beside: np.ndarray
    ) -> None:
        """Take n voxels.

        Parameters
        ----------
        may_go, covered, sheets : (n,) bool
            The voxels that may go, the covered ones, and those that may lie in sheets.
        beside : (27, m) int32
            Where the neighbours of those that may go are among the n, as from neighbours_among.
        """
        n, self.rows, self.beside = len(may_go), np.flatnonzero(may_go), beside
        m = len(self.rows)
        self.present = np.append(np.ones(n, bool), False)
        self.row_of = np.full(n + 1, m)
        self.row_of[self.rows] = np.arange(m)
        self.masks = np.zeros(m + 1, np.uint32)
        for bit, near in zip(BIT_OF, self.beside, strict=True):
            self.masks[:-1] |= np.where(self.present[near], bit, np.uint32(0))
        self.covering = np.full(n + 1, len(STEPS) * (n + 1))
        own = np.flatnonzero(covered[self.rows])
        self.covering[self.rows[own]] = np.bitwise_count(self.masks[own] & COVERING)
        self.stays = np.zeros(m, bool)
        self._sheets = sheets[self.rows]
        self._changed = np.ones(m + 1, bool)

    def run(self, weights: np.ndarray, subfields: np.ndarray) -> np.ndarray:
        """Return which voxels stay, (n,) bool, given the weights and the subfields of those that
        may go, (m,) int64 from 0 on. No two of one subfield have a common neighbour that may
        go."""
        going = np.ones(len(self.rows), bool)
        key = SUBFIELDS * weights + subfields
        order = np.argsort(key, kind="stable")
        batches = np.split(order, np.flatnonzero(np.diff(key[order])) + 1)
        firsts = np.diff([weights[batch[0]] for batch in batches], prepend=-1) > 0
        while True:
            before = np.count_nonzero(going)
            for first, batch in zip(firsts, batches, strict=True):
                if first:
                    self._mark(going)
                batch = batch[going[batch] & ~self.stays[batch]]
                going[self._remove(batch)] = False
            if np.count_nonzero(going) == before:
                return self.present[:-1]

    def _mark(self, going: np.ndarray) -> None:
        """Let the voxels that separate stay."""
        rows = np.flatnonzero(self._changed[:-1] & going & self._sheets & ~self.stays)
        self.stays[rows[separates(self.masks[rows])]] = True
        self._changed[:] = False

    def _remove(self, rows: np.ndarray) -> np.ndarray:
        """Remove those of some rows of one subfield that may go, and return them."""
        rows = rows[is_simple(self.masks[rows])]
        rows = rows[(self.covering[self.beside[np.ix_(ROWS, rows)]] > 1).all(axis=0)]
        self.present[self.rows[rows]] = False
        for number, near in enumerate(self.beside[:, rows]):
            touched = self.row_of[near]
            self.masks[touched] &= ~BIT_OF[2 * CENTRE - number]
            self._changed[touched] = True
        for near in self.beside[np.ix_(ROWS, rows)]:
            self.covering[near] -= 1
        return rows
