"""Values of voxels that the surface does not meet: those of the surface's nearest point.

The nearest face to the centre of a voxel is that of all faces whose corners, on the lattice of the
grid, span an area; if none does, of all. Squared distances are in units of the lattice, 1/256 of a
voxel, and are compared in whole 1/GRAINS of them; of faces that are equally near the first counts.
So it depends neither on the device nor on which other faces are searched: those near the voxels are
searched first, and farther ones only for voxels that they do not decide.

Kernel: kernels/svo/attribution/exposed.cl.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.subset import mesh_of
from voxtool.morton import distinct
from voxtool.opencl import Device
from voxtool.opencl.builder import Request
from voxtool.spatial.bvh import tree_bytes
from voxtool.spatial.distance import (
    PACKETS,
    PACKETS_FROM,
    POINT_BYTES,
    POINTS,
    TriangleDistance,
    rounded_bytes,
)
from voxtool.spatial.distance import SOURCE as DISTANCE
from voxtool.svo.attribution.materials import NO_LOOK, look_arguments
from voxtool.svo.attribution.surface_pass import VALUES, scale_of
from voxtool.svo.voxelization.lattice import fixed_of
from voxtool.svo.voxelization.plan import COLUMN_TILE

SOURCE = "svo/attribution/exposed.cl"
OPTIONS: dict[str, int | str] = {"CODE": "uint", "COLUMN_TILE": COLUMN_TILE}
GRAINS = 256.0  # in a squared unit of the lattice
REACH = 8  # voxels around the voxels of which faces are searched first; then 8 times as many
LEAST_AT_ONCE = 1 << 12  # faces
FACE_BYTES = 60  # bytes of a face's corners and box on the host
AREAS_AT_ONCE = 1 << 20  # faces whose areas are computed at once


def placed_bytes(faces: int) -> int:
    """Return the bytes on the host of the corners and the boxes of faces."""
    return FACE_BYTES * faces


def search_bytes(faces: int, points: int) -> int:
    """Return the bytes on the device of a search of faces for the nearest to points."""
    return tree_bytes(faces) + rounded_bytes(faces) + 36 * faces + POINT_BYTES * points


def programs(device: Device, voxels: int) -> list[Request]:
    """Return the programs by which a number of voxels find their values, in order."""
    ranked = {"RANKED": 1, "GRAINED": 1}
    packed = device.lanes == POINTS and voxels >= PACKETS_FROM
    search: Request = (PACKETS, ranked) if packed else (DISTANCE, {"BOX": "float", **ranked})
    return [search, (SOURCE, OPTIONS)]


class NearestSurface:
    """The surface of a mesh, of whose nearest points voxels take their values.

    Parameters
    ----------
    mesh : Mesh
        With an appearance, for colours.
    grid : Grid
        The whole grid, on whose lattice distances are.
    sampled : bool
        Colours are those of texels and corners, as they are.
    """

    def __init__(
        self, mesh: Mesh, grid: Grid, sampled: bool, device: Device, max_memory: int | None
    ) -> None:
        self.mesh, self.grid, self.sampled, self.device = mesh, grid, sampled, device
        self.fixed = fixed_of(mesh, grid)
        wide = np.concatenate([np.empty(0, bool), *self._span_areas()])
        self.faces = np.flatnonzero(wide) if wide.any() else np.arange(len(wide))
        corners = [self.fixed[mesh.faces[self.faces, k]] for k in range(3)]
        self._low = np.minimum(np.minimum(*corners[:2]), corners[2])
        self._high = np.maximum(np.maximum(*corners[:2]), corners[2])
        limit = device.max_memory if max_memory is None else max_memory
        self._at_once = max(limit // 2 // search_bytes(1, 0), LEAST_AT_ONCE)

    def _span_areas(self) -> Iterator[np.ndarray]:
        """Yield of blocks of faces which ones span an area."""
        for first in range(0, len(self.mesh.faces), AREAS_AT_ONCE):
            faces = self.mesh.faces[first : first + AREAS_AT_ONCE]
            a, b, c = (self.fixed[faces[:, k]].astype(np.int64) for k in range(3))
            across: np.ndarray = np.cross(b - a, c - a)
            yield (across != 0).any(axis=1)

    def values(self, names: Sequence[str], voxels: np.ndarray) -> dict[str, np.ndarray]:
        """Return the values of attributes of (n, 3) voxels, (n, channels) each."""
        found = {name: np.empty((len(voxels), *VALUES[name][0]), VALUES[name][1]) for name in names}
        if not len(voxels):
            return found
        centres = (voxels << FIXED_POINT_BITS) + (1 << (FIXED_POINT_BITS - 1))
        nearest = self.nearest(voxels, centres)
        chosen = distinct(nearest)
        faces_of = np.searchsorted(chosen, nearest)
        seen = mesh_of(self.mesh, chosen)
        fixed, faces = self._subset(chosen)
        device = self.device
        look: dict[str, Any] = look_arguments(seen, device) if "colour" in names else NO_LOOK
        arrays = {name: device.zeros(one.size, one.dtype) for name, one in found.items()}
        device.kernel(SOURCE, "values_at_nearest", **OPTIONS)(
            len(voxels), device.put(centres.astype(np.int32).ravel()),
            device.put(faces_of.astype(np.uint32)), device.put(fixed.ravel()),
            device.put(faces.ravel()), **look, scale=scale_of(self.grid), nearest=int(self.sampled),
            colour_values=arrays.get("colour"), normal_values=arrays.get("normal"),
        )  # fmt: skip
        return {name: array.take().reshape(found[name].shape) for name, array in arrays.items()}

    def nearest(self, voxels: np.ndarray, centres: np.ndarray) -> np.ndarray:
        """Return the face nearest to the centre of each of (n, 3) voxels, (n,) int64."""
        low, high = voxels.min(axis=0), voxels.max(axis=0) + 1
        found, left, reach = np.zeros(len(voxels), np.int64), np.arange(len(voxels)), REACH
        while len(left):
            near = self._reached(low - reach, high + reach)
            squares = np.full(len(left), np.inf)
            for first in range(0, len(near), self._at_once):
                self._search(
                    near[first : first + self._at_once], centres[left], found, left, squares
                )
            sure = squares < GRAINS * float(reach << FIXED_POINT_BITS) ** 2
            left = left[~sure] if len(near) < len(self.faces) else left[:0]
            reach *= 8
        return found

    def _reached(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the faces whose boxes reach a box of voxels, ascending."""
        first, last = (end.astype(np.int64) << FIXED_POINT_BITS for end in (low, high))
        return self.faces[((self._high >= first) & (self._low <= last)).all(axis=1)]

    def _search(
        self, faces: np.ndarray, centres: np.ndarray, found: np.ndarray, left: np.ndarray,
        squares: np.ndarray,
    ) -> None:  # fmt: skip
        """Update the faces that were found for the voxels that are left, and their distances, with
        faces that come after those."""
        fixed, own = self._subset(faces)
        search = TriangleDistance(Mesh(fixed.astype(np.float64), own), self.device)
        chosen, near = search.nearest_faces(centres.astype(np.float64), GRAINS)
        nearer = near < squares
        found[left[nearer]], squares[nearer] = faces[chosen[nearer]], near[nearer]

    def _subset(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the vertices on the lattice that some faces use, and these faces."""
        if len(faces) == len(self.mesh.faces):
            return self.fixed, self.mesh.faces
        used = np.zeros(len(self.fixed), bool)
        used[self.mesh.faces[faces]] = True
        index = np.cumsum(used, dtype=np.int32) - 1
        return self.fixed[used], index[self.mesh.faces[faces]]
