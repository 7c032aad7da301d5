"""Sums along rows of voxels, of the parts of triangles in them: the shares of voxels and of their
faces that lie inside.

The share of the face between two voxels is the sum of the areas, across the axis, of the parts
before it in the row. One number is that of both voxels, so neighbours agree.

Kernels: kernels/svo/attribution/fraction_rows.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from voxtool.morton import distinct, morton_decode
from voxtool.opencl import Array, Device, program
from voxtool.svo.octree.layout import BRICK
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.stored_volume import WHOLE
from voxtool.svo.voxelization.plan import CELL

SOURCE = "svo/attribution/fraction_rows.cl"
UNIT_BITS = 40  # areas and volumes are whole numbers of 2**-40 of a face and of a voxel
CLOSED = 1 << 16  # units by which areas of a closed mesh, which are rounded, may miss whole faces
UNTOUCHED = 0xFFFFFFFF  # in place of the number of a touched voxel
PARITY, NONZERO, WINDING = range(3)
RULES = {"parity": PARITY, "nonzero": NONZERO, "winding": WINDING}
HEADERS = {
    "svo/attribution/fraction.h": program.c_constants(
        UNIT_BITS=UNIT_BITS, WHOLE=WHOLE, CLOSED=CLOSED, PARITY=PARITY, NONZERO=NONZERO,
        UNTOUCHED=UNTOUCHED,
    )
}  # fmt: skip
FACES = 6  # of a voxel: at low and high x, y, z


@dataclass(frozen=True)
class Parts:
    """Sums of the parts of triangles in the voxels that they touch.

    touched : (M,) uint64 masks of those voxels, brick by brick
    firsts : (2 M + 1,) uint32, the number of voxels before each half of a brick
    count : number of voxels
    sums : (2 count,) int64, the area across x and the volume of each voxel
    across : (2 count,) int64, the areas across y and z of each voxel; None without faces
    entries : int64, the areas before the grid in the rows along each axis; None without any
    """

    touched: Array
    firsts: Array
    count: int
    sums: Array
    across: Array | None
    entries: tuple[Array | None, Array | None, Array | None]


@dataclass(frozen=True)
class Shares:
    """Shares that lie inside, in units of 1 / WHOLE.

    touched : (M,) uint64, the voxels that triangles touch
    bricks : (M,) uint64, the voxels that have a share
    partial : (M,) uint64, those whose share is neither 0 nor WHOLE
    voxels : (count,) uint32 shares of touched voxels
    faces : (count, 6) uint32 shares of their faces, or None
    cut : (M,) uint64, the voxels that have a share, and a face that is not wholly inside, or None
    disagreements : places along rows where the sums and the fill rule differ
    """

    touched: np.ndarray
    bricks: np.ndarray
    partial: np.ndarray
    voxels: np.ndarray
    faces: np.ndarray | None
    cut: np.ndarray | None
    disagreements: int


def sum_rows(
    device: Device,
    solid: Octree,
    shape: tuple[int, int, int],
    parts: Parts,
    options: dict[str, int | str],
    axis_alone: int | None = None,
) -> Shares:
    """Return the shares of touched voxels and, if there are sums across y and z, of their faces;
    `solid` has the other voxels, in the part of the grid of this shape. With `axis_alone` only rows
    along it are summed: the other faces have no share yet, and voxels have one by rows along x."""
    bricks, partial = device.put(solid.bricks), device.empty(len(solid.bricks), BRICK)
    voxels, wrong = device.empty(parts.count, np.uint32), device.zeros(1, np.uint32)
    faces = device.empty(FACES * parts.count, np.uint32) if parts.across else None
    octree: dict[str, Any] = {
        "nodes": device.view(solid.nodes), "offsets": device.put(solid.offsets),
        "top": solid.depth - 1, "shape": shape, "rule": RULES[solid.fill], "bricks": bricks,
        "touched": parts.touched, "firsts": parts.firsts, "faces": faces, "wrong": wrong,
    }  # fmt: skip
    rows = device.kernel(SOURCE, "sum_rows", **options)
    sums = [(parts.sums, 0, {"partial": partial, "shares": voxels})]
    if parts.across:
        sums += [(parts.across, start, {"partial": None, "shares": None}) for start in (0, 1)]
    for axis, (areas, start, found) in enumerate(sums):
        if axis_alone not in (None, axis):
            continue
        entry = parts.entries[axis]
        chosen, n = _bundles(solid, shape, axis, entry is not None)
        rows(
            n, axis=axis, chosen=None if chosen is None else device.put(chosen), entry=entry,
            areas=areas, start=start, **found, **octree,
        )  # fmt: skip
    cut = None
    if faces and axis_alone is None:
        cut = device.empty(len(solid.bricks), BRICK)
        device.kernel(SOURCE, "mask_faces", **options)(
            cut.size, parts.touched, parts.firsts, voxels, faces, cut
        )
    return Shares(
        parts.touched.get(), bricks.take(), partial.take(), voxels.take(),
        faces.take().reshape(-1, FACES) if faces else None, cut and cut.take(),
        int(wrong.take()[0]),
    )  # fmt: skip


def _bundles(
    solid: Octree, shape: tuple[int, int, int], axis: int, entered: bool
) -> tuple[np.ndarray | None, int]:
    """Return the bundles of 8 x 8 rows along an axis that need to be traversed, (n,) uint32, and
    their number; None: all. If no row begins inside, only those that pass through refined level-1
    nodes change, which are listed if that is less work."""
    p, q = (axis + 1) % 3, (axis + 2) % 3
    along = -(-shape[p] // CELL)
    count = along * -(-shape[q] // CELL)
    if entered or len(solid.bricks) // 8 >= count:
        return None, count
    level1 = solid.levels(1)[-1]
    cells = morton_decode(level1.codes[level1.refined])
    chosen = distinct(cells[:, p] + along * cells[:, q]).astype(np.uint32)
    return chosen, len(chosen)
