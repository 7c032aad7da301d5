"""The pairs of a triangle and a voxel of a surface, and the values that they give the voxels.

Kernels: kernels/svo/attribution/colours.cl.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from voxtool.grid import Grid
from voxtool.opencl import Array, program
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.layout import BRICK, held_in
from voxtool.svo.voxelization.scan_conversion import ActiveNodes, Scan

SOURCE = "svo/attribution/colours.cl"
OPPOSED = 1 << 16  # a sum of normals shorter than this share of the area is 0
UNIT = 1 << 32  # of an area: that of a voxel's largest face
HEADERS = {"svo/attribution/colours.h": program.c_constants(OPPOSED=OPPOSED, UNIT=UNIT)}
NO_FACE = np.uint32(0xFFFFFFFF)
INSIDE_COLOUR = (
    128,
    128,
    128,
    255,
)  # of set voxels that are neither exposed nor met by the surface
DEFAULTS = {"colour": INSIDE_COLOUR, "normal": (0, 0, 0), "area": 0}
VALUES = {"colour": ((4,), np.uint8), "normal": ((3,), np.float32), "area": ((), np.float32)}
TARGETS = ("areas", "colour_sums", "normal_sums", "greatest", "faces_of")  # of a pass


@dataclass
class Pass:
    """A pass over the pairs of a surface."""

    scan: Scan
    active: ActiveNodes
    bricks: Array
    starts: Array
    n: int  # voxels
    look: dict[str, Any]
    inner_low: Sequence[int]  # the first side of voxels across each axis that two of them share
    inner_high: Sequence[int]  # and the last

    def values(self, names: Sequence[str], nearest: bool) -> dict[str, np.ndarray]:
        """Return the values of attributes, (n,) or (n, channels)."""
        device, n = self.scan.mesh.device, self.n
        nearest = nearest and "colour" in names
        sums: dict[str, Array] = {}
        if not nearest or len(names) > 1:
            sums["areas"] = device.zeros(n, np.uint64)
        if "colour" in names and not nearest:
            sums["colour_sums"] = device.zeros(4 * n, np.uint64)
        if "normal" in names:
            sums["normal_sums"] = device.zeros(3 * n, np.uint64)
        faces_of = device.put(np.full(n, NO_FACE))
        if nearest:
            greatest = device.zeros(n, np.uint32)
            self.add(**sums, greatest=greatest)
            self.add(greatest=greatest, faces_of=faces_of)
        else:
            self.add(**sums, faces_of=faces_of)
        values = {
            name: device.zeros(row[0] * n, dtype)
            for name, (row, dtype) in VALUES.items()
            if name in names and row
        }
        if values:
            self.finish(int(nearest), faces_of, sums, values)
        found = {name: array.take().reshape(n, -1) for name, array in values.items()}
        if "area" in names:
            unit = max(_face_areas(self.scan.mesh.grid)) / UNIT
            found["area"] = (sums["areas"].get() * unit).astype(np.float32)
        return found

    def add(self, **targets: Array) -> None:
        """Visit the pairs of triangles and voxels."""
        shares, triangles = self.scan.shares(0)
        self.scan.kernel(SOURCE, "add_parts")(
            shares, **triangles, **self.active.lookup, **self.look, masks=self.bricks,
            starts=self.starts, scale=scale_of(self.scan.mesh.grid), inner_low=self.inner_low,
            inner_high=self.inner_high, **{**dict.fromkeys(TARGETS), **targets},
        )  # fmt: skip

    def finish(
        self, nearest: int, faces_of: Array, sums: dict[str, Array], values: dict[str, Array]
    ) -> None:
        """Turn sums into values."""
        mesh = self.scan.mesh
        self.scan.kernel(SOURCE, "finish_values")(
            16 * self.active.nodes.n, self.active.nodes.codes, self.bricks, self.starts,
            mesh.vertices, mesh.faces, **self.look, scale=scale_of(mesh.grid),
            nearest=nearest, areas=sums.get("areas"), colour_sums=sums.get("colour_sums"),
            normal_sums=sums.get("normal_sums"), faces_of=faces_of,
            colour_values=values.get("colour"), normal_values=values.get("normal"),
        )  # fmt: skip


def without_values(name: str) -> Attribute:
    """Return an attribute of surfaces that has no values yet."""
    row, dtype = VALUES[name]
    none = np.empty((0, *row), dtype)
    return Attribute(name, none, none, default=DEFAULTS[name])


def _face_areas(grid: Grid) -> tuple[float, float, float]:
    """Return the areas of a voxel's faces across x, y and z, in world units."""
    x, y, z = grid.pitch
    return y * z, z * x, x * y


def scale_of(grid: Grid) -> tuple[float, float, float]:
    """Return what components of a cross product on the lattice are multiplied by, for a normal in
    world units: equal ones where voxels are cubes."""
    areas = _face_areas(grid)
    return tuple(one / max(areas) for one in areas)  # pyright: ignore[reportReturnType]


@dataclass(frozen=True)
class SurfaceValues:
    """The values of a surface's voxels, by the level-1 nodes that it touches."""

    codes: np.ndarray  # (N,) uint64 Morton codes of the nodes
    masks: np.ndarray  # (8 N,) uint64: voxels of their bricks
    values: dict[str, np.ndarray]

    def attributes(self, codes: np.ndarray, bricks: np.ndarray) -> list[Attribute]:
        """Return the attributes of the set voxels that the surface meets, of an octree with these
        bricks, which have these codes."""
        own = (self.codes[:, None] * 8 + np.arange(8, dtype=np.uint64)).ravel()
        if np.array_equal(codes, own) and np.array_equal(bricks, self.masks):
            held, chosen = None, slice(None)
        else:
            held, chosen = self._common(codes, bricks, own)
        return [
            Attribute(name, values[chosen], values[:0], held, DEFAULTS[name])
            for name, values in self.values.items()
        ]

    def _common(
        self, codes: np.ndarray, bricks: np.ndarray, own: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the voxels of some bricks that are the surface's, too, and which of its values
        these have."""
        held, kept = np.zeros(len(codes), BRICK), np.zeros(len(own), BRICK)
        if len(own):
            place = np.minimum(np.searchsorted(own, codes), len(own) - 1)
            both = own[place] == codes
            held[both] = bricks[both] & self.masks[place[both]]
            kept[place[both]] = held[both]
        return held, held_in(self.masks, kept)
