"""Crossings of a mesh and rows of voxel centres along x ([voCCeL], section 3.2, eq. 3.5).

A flip is a voxel at which a row changes between inside and outside. With the parity rule, every
crossing flips the first voxel at or beyond it. The other rules first list and sort the crossings
and count them along the row: +1 where it enters, -1 where it leaves. A voxel flips where the rule's
answer for this count changes. Kernels: kernels/svo/fill/crossings.cl.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.opencl import Array, program
from voxtool.opencl.primitives import exclusive_scan, radix_sort
from voxtool.svo.layout import BRICK
from voxtool.svo.scan import CROSSED, ActiveNodes, Scan

SOURCE = "svo/fill/crossings.cl"
# Bit 0 of a key is unused: Oclgrind 21.10 does not support the shift that it would need.
ENTERS = 2
HEADERS = {"svo/fill/crossings.h": program.c_constants(ENTERS=ENTERS)}


@dataclass(frozen=True)
class Crossings:
    """The sorted crossings of rows with a closed mesh.

    A key holds the row, then in x_bits - 2 bits the first voxel at or beyond the crossing, counted
    from -1, and ENTERS if the row enters the mesh there.
    """

    keys: Array  # (n,) uint64
    n: int
    x_bits: int


@dataclass(frozen=True)
class Flips:
    """The voxels at which rows change between inside and outside."""

    bricks: Array  # (8 n,) uint64 masks of the n active nodes
    shape: tuple[int, int, int]  # voxels of the grid
    entry: Array | None  # (bundles,) uint64 states at x = 0, one bit a row; None if all are outside

    @property
    def bundles(self) -> int:
        """Bundles of 8 x 8 rows."""
        return self.bundles_y * -(-self.shape[2] // 8)

    @property
    def bundles_y(self) -> int:
        """Bundles along y."""
        return -(-self.shape[1] // 8)


def no_flips(scan: Scan, active: ActiveNodes) -> Flips:
    """Return flips of which none is set."""
    bricks, shape = scan.device.zeros(8 * active.nodes.n, BRICK), scan.plan.shape
    bundles = Flips(bricks, shape, None).bundles
    return Flips(bricks, shape, scan.device.zeros(bundles, np.uint64) if scan.plan.entry else None)


def flip_crossings(scan: Scan, active: ActiveNodes) -> Flips:
    """Return the flips of the parity rule."""
    flips = no_flips(scan, active)
    n, triangles = scan.shares(CROSSED)
    flip = scan.kernel(SOURCE, "flip_crossings")
    flip(n, flips.bricks, flips.entry, **triangles, **active.lookup)
    return flips


def list_crossings(scan: Scan) -> Crossings:
    """Return the crossings with the mesh and its caps."""
    nx, ny, nz = scan.plan.shape
    x_bits = nx.bit_length() + 2
    n, triangles = scan.shares(CROSSED, with_caps=True)
    firsts = scan.device.empty(n + 1, np.uint32)
    list_crossings = scan.kernel(SOURCE, "list_crossings")
    list_crossings(n, firsts, x_bits, None, **triangles)
    count = exclusive_scan(firsts, n)
    keys = scan.device.empty(count, np.uint64)
    list_crossings(n, firsts, x_bits, keys, **triangles)
    keys, _ = radix_sort(keys, count, (ny * nz - 1).bit_length() + x_bits)
    return Crossings(keys, count, x_bits)


def flip_changes(scan: Scan, active: ActiveNodes, crossings: Crossings) -> Flips:
    """Return the flips of the rules that count directions: nonzero, and winding far from holes."""
    flips = no_flips(scan, active)
    keys, n, x_bits = crossings.keys, crossings.n, crossings.x_bits
    nonzero, shape = scan.plan.fill == "nonzero", scan.plan.shape
    flip = scan.kernel(SOURCE, "flip_changes")
    flip(n, keys, x_bits, nonzero, shape, flips.bricks, flips.entry, **active.lookup)
    return flips
