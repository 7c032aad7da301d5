"""The pieces of triangles in voxels: pairs of a voxel and a triangle, and their areas.

Corners of pieces are rounded to nearest, to 2**-20 voxel along each axis, and everything else is in
whole numbers: so areas are equal on every device. Six planes cut a triangle, so a corner is rounded
six times at most; a side that moves by that changes the area by its length times as much. Nine
sides of up to the diagonal of a voxel change it by less than 1e-4 of a face.

Kernels: kernels/svo/voxelization/part_pieces.cl.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.opencl import Array, program
from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.voxelization.scan_conversion import ActiveNodes, Scan

SOURCE = "svo/voxelization/part_pieces.cl"
FINER = 1 << 12  # units of corners in a unit of the mesh's lattice
MOST_CORNERS = 9  # of a triangle that six planes cut
DROPPED_BITS = 11  # bits of twice an area, so that its square fits 64 bits
UNITS_OF_AREA = 2 * (1 << 20) ** 2 >> DROPPED_BITS  # of a face of a voxel

HEADERS = {
    "svo/voxelization/part_pieces.h": program.c_constants(
        FINER=FINER, MOST_CORNERS=MOST_CORNERS, DROPPED_BITS=DROPPED_BITS
    )
}


@dataclass(frozen=True)
class Pieces:
    """Pairs of a voxel and a triangle, on the device, in no order that has a meaning.

    n : int
    voxels : uint32, the rank of each pair's voxel among those of the masks
    faces : uint32, the triangle
    """

    n: int
    voxels: Array
    faces: Array


def list_pieces(scan: Scan, active: ActiveNodes, masks: Array, starts: Array, kind: int) -> Pieces:
    """Return the triangles of each voxel of some masks.

    Parameters
    ----------
    masks : uint64, eight bricks for each active node; the voxels that are asked for.
    starts : uint32, the voxels of the masks before each brick.
    kind : TOUCHED or SEPARATING, which voxels a triangle has.
    """
    n, triangles = scan.shares(kind)
    kernel = scan.kernel(SOURCE, "list_pieces")
    firsts = scan.device.empty(n + 1, np.uint32)
    arguments = {**active.lookup, **triangles, "masks": masks, "starts": starts, "firsts": firsts}
    kernel(n, kind, voxels=None, of_faces=None, **arguments)
    total = exclusive_scan(firsts, n)
    voxels, faces = (scan.device.empty(max(total, 1), np.uint32) for _ in range(2))
    if total:
        kernel(n, kind, voxels=voxels, of_faces=faces, **arguments)
    return Pieces(total, voxels, faces)


def areas_of(scan: Scan, pieces: Pieces, corners: np.ndarray) -> np.ndarray:
    """Return the area of each piece, (n,) uint32, of which UNITS_OF_AREA are a face of a voxel.

    Parameters
    ----------
    corners : (N, 3) int
        The low corner of each voxel, in voxels, by its rank.
    """
    if not pieces.n:
        return np.empty(0, np.uint32)
    areas = scan.device.empty(pieces.n, np.uint32)
    scan.kernel(SOURCE, "measure_pieces")(
        pieces.n, pieces.voxels, pieces.faces, scan.device.put(corners.astype(np.int32).ravel()),
        scan.mesh.vertices, scan.mesh.faces, areas,
    )  # fmt: skip
    return areas.take()
