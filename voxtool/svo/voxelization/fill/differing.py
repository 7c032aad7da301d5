"""The voxels that parity fills otherwise than the union of a mesh's parts.

Along a row the winding number changes by 1 at each crossing. Parity fills where it is odd, the
union where it is 1 or more.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.voxelization.fill.rows import ENTERS, list_crossings
from voxtool.svo.voxelization.lattice import place_mesh
from voxtool.svo.voxelization.plan import plan_of
from voxtool.svo.voxelization.scan_conversion import Scan

CROSSING_BYTES = 64  # at most, on the device and on the host


def count_differing(
    mesh: Mesh, grid: Grid, low: tuple[int, ...], shape: tuple[int, ...], crossings: float,
    device: Device, max_memory: int, bits: int,
) -> int:  # fmt: skip
    """Return the number of voxels of a window of a grid that parity and the union fill otherwise.

    mesh : closed, its shells turned outward; bits : the lattice's; crossings : about how many
    there are, by which the window is divided in slabs that fit in max_memory bytes.
    """
    nz = shape[2]
    slabs = min(max(int(CROSSING_BYTES * crossings // max_memory) + 1, 1), nz)
    ends = [nz * i // slabs for i in range(slabs + 1)]
    found = 0
    with device.stage("union of parts"):
        for begin, end in pairwise(ends):
            slab = shape[0], shape[1], end - begin
            window = (low[0], low[1], low[2] + begin), slab
            lattice = place_mesh(mesh, grid, window, None, None, device, bits)
            request = {"mode": "solid", "fill": "winding", "gap": 0, "holes": 0, "caps": 0}
            request["bits"] = bits
            plan = plan_of(lattice.survey(), slab, **request)
            found += _differing(Scan(lattice, plan), shape[0])
    return found


def _differing(scan: Scan, nx: int) -> int:
    """Return the number of voxels of all rows."""
    crossings = list_crossings(scan)
    keys = crossings.keys.get(0, crossings.n)
    if not len(keys):
        return 0
    row = keys >> np.uint64(crossings.x_bits)
    first = np.flatnonzero(np.diff(row, prepend=~row[:1]))
    number = np.cumsum(np.where(keys & np.uint64(ENTERS), 1, -1))
    before = np.append(0, number)[first]
    number -= np.repeat(before, np.diff(first, append=len(row)))
    place = keys >> np.uint64(2)  # row and voxel, from which on the number holds
    x = np.maximum((place & np.uint64((1 << crossings.x_bits - 2) - 1)).astype(np.int64) - 1, 0)
    follows = np.append(row[1:] == row[:-1], False)
    end = np.where(follows, np.append(x[1:], 0), nx)
    differs = (number & 1 != 0) != (number >= 1)
    return int((end - x)[differs].sum())
