"""A mesh on the fixed-point lattice of a grid, on the device.

Vertices are rounded once to 1/256 voxel, or for fractions to a finer lattice; everything after that
is integer arithmetic. Kernel: kernels/svo/voxelization/lattice.cl.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import GridError
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Array, Device
from voxtool.svo.voxelization.plan import Survey

if TYPE_CHECKING:
    from voxtool.svo.voxelization.fill.caps import Boundary, Caps

SOURCE = "svo/voxelization/lattice.cl"
SURVEY_ITEMS = 256  # work-items; each sums its share of the triangles


@dataclass(frozen=True, eq=False)
class LatticeMesh:
    """A mesh on the fixed-point lattice of a grid, on the device."""

    device: Device
    grid: Grid
    bits: int  # a voxel is 2**bits units
    fixed: np.ndarray  # (V, 3) int32 vertices, in units
    vertices: Array  # the same on the device
    faces: Array  # of the mesh, then of the caps
    triangles: int  # faces of the mesh, without caps
    closed: Array  # faces of the mesh and the caps, without those that cancel
    closing: Array | None  # those of the caps
    caps: Caps | None  # None if the fill rule does not need them

    def capped(self) -> LatticeMesh:
        """Return the mesh whose faces are `closed`: its caps count as faces."""
        n = self.closed.size // 3
        return replace(self, faces=self.closed, triangles=n, closing=None, caps=None)

    @property
    def options(self) -> dict[str, int | str]:
        """The option of kernels that says what a unit is, where it is not 1/256 voxel."""
        return {} if self.bits == FIXED_POINT_BITS else {"FIXED_POINT_BITS": self.bits}

    def survey(self) -> Survey:
        """Return the numbers from which a plan is made."""
        n = self.faces.size // 3
        partial = self.device.empty(6 * SURVEY_ITEMS, np.uint64)
        survey = self.device.kernel(SOURCE, "survey", **self.options)
        survey(SURVEY_ITEMS, self.vertices, self.faces, n, self.grid.shape, partial)
        parts = partial.get().reshape(-1, 6)
        units = 1 << self.bits
        x, y, z = (int(v) / (2 * units) for v in parts[:, 1:4].sum(axis=0))
        return Survey(
            triangles=n,
            vertices=self.vertices.size // 3,
            outside=int(parts[:, 5].sum()),
            extent=int(parts[:, 0].max()) / units,
            areas=(x, y, z),
            before=bool(parts[:, 4].any()),
        )


def place_mesh(
    mesh: Mesh,
    grid: Grid,
    window: tuple[Sequence[int], Sequence[int]] | None,
    some: np.ndarray | None,
    boundary: Boundary | None,
    device: Device,
    bits: int = FIXED_POINT_BITS,
) -> LatticeMesh:
    """Return the mesh, or only `some` of its faces, on the lattice of a grid or of a window, of
    2**-bits voxel, with caps if their boundary is given; raise GridError if a vertex lies too far
    from the grid's corner."""
    fixed = fixed_of(mesh, grid, bits)
    if window is not None:
        low, shape = window
        grid = grid.window(low, shape)
        fixed -= np.asarray(low, np.int32) << bits
    own = mesh.faces if some is None else mesh.faces[some]
    caps = None
    if boundary is not None:
        from voxtool.svo.voxelization.fill.caps import find_caps

        caps = find_caps(fixed, boundary)
    faces = device.view(own if caps is None else np.concatenate([own, caps.faces]))
    closed, closing = faces, None
    if boundary is not None and caps is not None:
        kept = caps.faces[: len(caps.faces) - np.count_nonzero(boundary.alone)]
        closing = device.put(kept)
        if len(kept) < len(caps.faces):
            closed = device.put(np.concatenate([own[~boundary.alone], kept]))
    vertices = device.view(fixed)
    return LatticeMesh(device, grid, bits, fixed, vertices, faces, len(own), closed, closing, caps)


def fixed_of(mesh: Mesh, grid: Grid, bits: int = FIXED_POINT_BITS) -> np.ndarray:
    """Return the vertices of a mesh on the lattice of a grid, of 2**-bits voxel, (V, 3) int32;
    raise GridError if one lies too far from the grid's corner."""
    try:
        return grid.to_fixed(mesh.vertices, bits)
    except GridError:  # vertices that no face uses may lie anywhere
        return grid.to_fixed(_used_vertices(mesh), bits)


def _used_vertices(mesh: Mesh) -> np.ndarray:
    """Return the vertices, with those that no face uses moved to one that a face uses."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces] = True
    return np.where(used[:, None], mesh.vertices, mesh.vertices[mesh.faces[0, 0]])
