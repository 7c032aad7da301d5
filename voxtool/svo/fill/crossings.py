"""Where rows of voxel centres along x cross a mesh ([voCCeL], section 3.2, eq. 3.5).

A flip is a voxel at which a row changes between inside and outside. By parity every crossing flips
the first voxel at or beyond it. By direction, crossings are listed and sorted first, and a voxel
flips where the number of crossings before it, those that enter minus those that leave, comes to
lie in the rule's range or leaves it. Kernels: kernels/svo/fill/crossings.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl import Array, program
from voxtool.opencl.primitives import exclusive_scan, radix_sort
from voxtool.svo.layout import BRICK
from voxtool.svo.scan import CROSSED

if TYPE_CHECKING:
    from voxtool.svo.active import ActiveNodes
    from voxtool.svo.scan import Scan

SOURCE = "svo/fill/crossings.cl"
# Bit 0 of a key stays free: with it Oclgrind 21.10 meets a shift that it does not know.
ENTERS = 2
HEADERS = {"svo/fill/crossings.h": program.c_constants(ENTERS=ENTERS)}


@dataclass(frozen=True)
class Crossings:
    """The crossings of rows with a closed mesh, in order.

    Attributes
    ----------
    keys : (n,) uint64: the row, x_bits - 2 bits of the first voxel at or beyond the crossing,
        counted from -1, and ENTERS where the row enters.
    """

    keys: Array
    n: int
    x_bits: int


@dataclass(frozen=True)
class Flips:
    """The voxels at which rows change between inside and outside.

    Attributes
    ----------
    bricks : (8 n,) uint64 masks, of the n active nodes.
    shape : voxels of the grid.
    entry : (bundles,) uint64 states at x = 0 of bundles of 8 x 8 rows, one bit a row; None if
        every row begins outside.
    """

    bricks: Array
    shape: tuple[int, int, int]
    entry: Array | None

    @property
    def bundles(self) -> int:
        """Bundles of 8 x 8 rows."""
        return self.bundles_y * -(-self.shape[2] // 8)

    @property
    def bundles_y(self) -> int:
        """Bundles along y."""
        return -(-self.shape[1] // 8)


def no_flips(scan: Scan, active: ActiveNodes) -> Flips:
    """Flips to be set by a kernel."""
    flips = Flips(scan.device.zeros(8 * active.n, BRICK), scan.plan.shape, None)
    if not scan.plan.entry:
        return flips
    return Flips(flips.bricks, flips.shape, scan.device.zeros(flips.bundles, np.uint64))


def flip_crossings(scan: Scan, active: ActiveNodes) -> Flips:
    """The flips of the parity rule."""
    flips = no_flips(scan, active)
    shares = scan.shares(CROSSED)
    scan.kernel(SOURCE, "flip_crossings")(
        shares.n, **shares.arguments, shape=scan.shape(), **active.lookup, bricks=flips.bricks,
        entry=flips.entry,
    )  # fmt: skip
    return flips


def list_crossings(scan: Scan) -> Crossings:
    """The crossings with the mesh and its caps."""
    nx, ny, nz = scan.plan.shape
    x_bits = nx.bit_length() + 2
    shares = scan.shares(CROSSED, with_caps=True)
    firsts = scan.device.empty(shares.n + 1, np.uint32)
    scan.kernel(SOURCE, "count_crossings")(
        shares.n, **shares.arguments, shape=scan.shape(), counts=firsts
    )
    count = exclusive_scan(firsts, shares.n)
    keys = scan.device.empty(count, np.uint64)
    scan.kernel(SOURCE, "list_crossings")(
        shares.n, **shares.arguments, shape=scan.shape(), firsts=firsts, x_bits=x_bits,
        crossings=keys,
    )  # fmt: skip
    keys, _ = radix_sort(keys, count, (ny * nz - 1).bit_length() + x_bits)
    return Crossings(keys, count, x_bits)


def flip_changes(scan: Scan, active: ActiveNodes, crossings: Crossings) -> Flips:
    """The flips of the rules that count directions: nonzero, and winding away from holes."""
    flips = no_flips(scan, active)
    scan.kernel(SOURCE, "flip_changes")(
        crossings.n, crossings=crossings.keys, x_bits=crossings.x_bits,
        nonzero=scan.plan.fill == "nonzero", shape=scan.shape(), **active.lookup,
        bricks=flips.bricks, entry=flips.entry,
    )  # fmt: skip
    return flips
