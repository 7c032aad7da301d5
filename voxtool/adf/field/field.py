"""The adaptively sampled distance field as data [ADF, figure 3.2].

It is a full octree over the unit cube. The root has level 0, and its children level 1. (Octrees of
voxels count the other way, from their finest level.) A cell with children has a block of 3 x 3 x 3
distances at the vertices of its eight children, so that the eight of each child are 2 x 2 x 2 of
them. Leaves are implicit: they are the children without a block. A field has three textures:

    voxels   the blocks, in the order of their cells: by level, then along the Morton curve
    cells    the identifier of a cell and the number of its block, where the hash puts its key
    hash     offsets of a perfect spatial hash (hashing.py)

and optionally a fourth: a byte for each child of a block, which bounds its error. Here they are as
buffers suit; packing.py makes the 3-D textures of them that a file holds.

Distances are float32, in sides of the cube, and negative inside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from voxtool.adf.field.cells import (
    JUMP,
    NO_LEAF,
    cell_identifier,
    cell_of,
    identifier_type,
    identifiers_in,
    key_of,
)
from voxtool.adf.field.host_query import CORNERS, QueryResult, query_on_host
from voxtool.adf.field.packing import shapes
from voxtool.adf.field.spatial_hash import SpatialHash
from voxtool.arrays import Data, blocks_of, digest_of
from voxtool.choices import MAX_LEVEL
from voxtool.errors import FileError, VoxtoolError

EXACT = "side", "tolerance", "band", "lipschitz"  # attributes that the digest covers in full
AT_ONCE = 1 << 16  # blocks that are checked at once
FAR = 1024.0  # sides: far beyond any distance in a cube, and safe from overflow


@dataclass(frozen=True, eq=False, repr=False)
class DistanceField(Data):
    """Distances to a mesh, sampled more finely where they vary more.

    Attributes
    ----------
    voxels : (n, 3, 3, 3) float32
        [block, z, y, x], in sides of the cube.
    cells : (m, m, m, 2 or 3) uint32
        [z, y, x]: low word of the identifier, high word if there is one, block; all 0 in a free
        slot.
    hash : SpatialHash
        The slot in `cells` of the key of a cell.
    bounds : (n, 2, 2, 2) uint8, or None
        [block, z, y, x], codes of bound_values.
    origin, side : tuple of float, float
        Low corner and side of the cube, in world units: world = origin + side * point.
    sign : str
        Method of the sign, one of voxtool.choices.FIELD_SIGNS, or GIVEN.
    tolerance, max_level, band : float, int, float
        As requested: sides, level, and sides or infinity.
    continuous : bool
        Whether neighbours of different levels agree on their common faces.
    lipschitz : float
        The steepest slope in any leaf without a sign discontinuity.
    reached : dict
        JSON types: "leaves", their number; "missed", the number of leaves whose error exceeds the
        tolerance though smaller leaves would help, and if there are any, "worst": their largest
        error, its level, and its position (world units); "medial", if there are any, the
        "leaves" over the tolerance along the medial axis, how many of them were "left" before the
        last level, and the "worst" of them in the same way; "thin", if there are any, the
        "leaves" that are thicker than the mesh there and do not have its signs, and the mesh's
        "shells" and "volume" (cubic world units); "kept", the number of hanging vertices of blocks
        that keep their distances, where coarser leaves have the other sign; "unproved", with a
        guarantee, the number of leaves whose bounds exceed the tolerance; "jumps", the number of
        leaves in which the sign changes away from the surface; "balanced", whether every leaf's
        neighbours are at most one level coarser; "errors", as
        voxtool.adf.construction.accuracy.measure_errors, if they were measured.
    plan : dict
        The part of the plan that depends on the mesh: JSON types.
    source_sha256 : str
        Hex digest of the bytes that the mesh was read from, or "".
    units : str
        Name of the world unit if known, or "".
    transform : (4,) tuple of float
        Scale and offset x, y, z of the normalized mesh that the field is of: world coordinates are
        original * scale + offset; () of other meshes.
    """

    voxels: np.ndarray
    cells: np.ndarray
    hash: SpatialHash
    bounds: np.ndarray | None
    origin: tuple[float, float, float]
    side: float
    sign: str
    tolerance: float
    max_level: int
    band: float
    continuous: bool
    lipschitz: float
    reached: dict[str, Any] = field(default_factory=dict, compare=False)
    plan: dict[str, Any] = field(default_factory=dict, compare=False)
    source_sha256: str = field(default="", compare=False)
    units: str = ""
    transform: tuple[float, ...] = field(default=(), compare=False)

    def __repr__(self) -> str:
        return (
            f"DistanceField({len(self.voxels):,} blocks, levels to {self.depth}, tolerance "
            f"{self.tolerance:g}, sign {self.sign}, side {self.side:g})"
        )

    # ---- samples

    def corners(self, block: np.ndarray, octant: np.ndarray) -> np.ndarray:
        """Return the distances at the corners of children of blocks, (N, 2, 2, 2) float32."""
        first = octant[:, 0] + 3 * octant[:, 1] + 9 * octant[:, 2] + 27 * block
        return self.voxels.reshape(-1)[first[:, None] + CORNERS].reshape(-1, 2, 2, 2)

    def bound_codes(self, block: np.ndarray, octant: np.ndarray) -> np.ndarray:
        """Return the codes of the bounds of children of blocks, (N,) uint8; it has bounds."""
        assert self.bounds is not None
        x, y, z = octant.T
        return self.bounds[block, z, y, x]

    # ---- structure

    @cached_property
    def identifiers(self) -> np.ndarray:
        """(m, m, m) uint32 or uint64: the identifier of the cell in each slot, 0 in a free one."""
        return identifiers_in(self.cells)

    @cached_property
    def blocks(self) -> np.ndarray:
        """(n,) identifiers of the cells that have blocks, in the order of the blocks."""
        identifiers = self.identifiers.ravel()
        taken = identifiers != 0
        ordered = np.zeros(len(self.voxels), identifiers.dtype)
        ordered[self.cells[..., -1].ravel()[taken]] = identifiers[taken]
        return ordered

    @cached_property
    def depth(self) -> int:
        """The deepest level of a leaf; the root has level 0."""
        return (int(self.identifiers.max()).bit_length() - 1) // 3 + 1

    def cells_by_level(self) -> list[int]:
        """Return the number of cells with children of each level, from the root (level 0)."""
        first = np.uint64(8) ** np.arange(self.depth + 1, dtype=np.uint64)  # identifiers of levels
        return [*np.diff(np.searchsorted(self.blocks, first)).tolist(), 0]

    def leaves_by_level(self) -> list[int]:
        """Return the number of leaves of each level, from 1, the root's children."""
        refined = self.cells_by_level()
        return [8 * above - own for above, own in zip([0, *refined], refined, strict=False)][1:]

    def slots(self, level: int, ijk: np.ndarray) -> np.ndarray:
        """Return the (N,) blocks of (N, 3) cells of a level, -1 for cells without one."""
        slot = self.hash.slots(key_of(level, ijk))
        same = self.identifiers.ravel()[slot] == cell_identifier(level, ijk)
        return np.where(same, self.cells[..., -1].ravel()[slot].astype(np.int64), -1)

    # ---- queries

    def distance(self, points: Any) -> np.ndarray:
        """Return the distance at (N, 3) points, (N,) float64, world units; see query."""
        return self.query(points).distance

    def gradient(self, points: Any) -> np.ndarray:
        """Return the gradient at (N, 3) points, (N, 3) float32; see query."""
        gradient = self.query(points, gradient=True).gradient
        assert gradient is not None
        return gradient

    def query(
        self, points: Any, *, gradient: bool = False, bounds: bool = False, cell: bool = False
    ) -> QueryResult:
        """Return the values of the field at points, computed on the host.

        voxtool.query_adf returns the same values, and is faster for many points.

        Outside the cube the distance is sqrt(g^2 + max(|d| - e, 0)^2), where g is the distance to
        the cube, d the field's value at the nearest point of the cube, and e its bound, or without
        bounds (sqrt(3) / 2) of the leaf's edge. As the mesh is inside the cube, the exact distance
        is at least that. The gradient is that of this expression. At infinity the distance is
        infinite and the gradient its limit along a ray, where finite coordinates count as 0.

        Parameters
        ----------
        points : (N, 3) or (3,) array_like
            World units; (3,) is one point.
        gradient, bounds, cell : bool
            Whether these are returned as well.

        Returns
        -------
        QueryResult

        Raises
        ------
        VoxtoolError
            If the shape is wrong, or bounds are requested of a field without them.
        """
        return query_on_host(self, points, gradient=gradient, bounds=bounds, cell=cell)

    # ---- sizes, identity, soundness

    def sizes(self) -> dict[str, int]:
        """Return the bytes of each texture, as on a device: the blocks alone, without the places of
        a 3-D texture that no block fills."""
        sizes = {"voxels": self.voxels.nbytes, "cells": self.cells.nbytes, "hash": self.hash.nbytes}
        if self.bounds is not None:
            sizes["bounds"] = self.bounds.nbytes
        return sizes

    def digest(self) -> str:
        """Return the SHA-256 of the canonical content, without `reached`, `plan`, source and units.

        It covers the identifiers of the cells that have blocks, the blocks in their order, and the
        bounds, not where a hash or a texture puts them. It is the same on every device and
        platform."""
        head = {
            "origin": [v.hex() for v in self.origin],
            **{name: float(getattr(self, name)).hex() for name in EXACT},
            **{name: getattr(self, name) for name in ("sign", "max_level", "continuous")},
            "bounds": self.bounds is not None,
        }
        arrays = [self.blocks.astype(np.uint64), self.voxels]
        return digest_of(head, *arrays, *([] if self.bounds is None else [self.bounds]))

    def summary(self) -> dict[str, Any]:
        """Return the counts and sizes in JSON types; origin and side in world units, lengths in
        sides.

        `saved` has the two savings of [ADF]: of section 3.1, the blocks against eight float32 a
        leaf or, as it counts there, a cell; of section 3.2, the slots of cells that have blocks
        against slots for the leaves, too, whose identifiers are longer.
        """
        n, depth = len(self.voxels), self.depth
        cells, leaves = self.cells_by_level(), self.leaves_by_level()
        sizes, eight = self.sizes(), 8 * self.voxels.itemsize
        identifier = self.identifiers.itemsize
        with_leaves = identifier_type(depth).itemsize + self.cells.itemsize
        jumps = self.reached.get("jumps")
        if self.bounds is not None:
            jumps = int(np.count_nonzero(self.bounds == JUMP))
        return {
            "origin": list(self.origin),
            "side": self.side,
            "units": self.units,
            "transform": list(self.transform),
            "sign": self.sign,
            "tolerance": self.tolerance,
            "max_level": self.max_level,
            "band": self.band if math.isfinite(self.band) else None,
            "continuous": self.continuous,
            "lipschitz": self.lipschitz,
            "source_sha256": self.source_sha256,
            "depth": depth,
            "blocks": n,
            "leaves": sum(leaves),
            "levels": [
                {"level": level, "cells": own, "leaves": left}
                for level, own, left in zip(range(depth + 1), cells, [0, *leaves], strict=True)
            ],
            "memory_bytes": sum(sizes.values()),
            "bytes_a_leaf": sum(sizes.values()) / sum(leaves),
            "textures": sizes,
            "shapes": shapes(self),
            "saved": {
                "voxels_of_leaves": 1 - sizes["voxels"] / (eight * sum(leaves)),
                "voxels_of_cells": 1 - sizes["voxels"] / (eight * 8 * n),
                "cells": 1 - (identifier + self.cells.itemsize) * n / (with_leaves * (8 * n + 1)),
            },
            "hash": {
                "m": self.hash.m,
                "r": self.hash.r,
                "w": self.hash.has_w,
                "load": self.hash.load(n),
                "bits_a_key": self.hash.bits_a_key(n),
                "identifier_bits": 8 * identifier,
            },
            "jumps": jumps,
            "reached": self.reached,
            "plan": self.plan,
        }

    def validate(self) -> None:
        """Check every invariant of the structure.

        Raises
        ------
        FileError
            If one does not hold; the message names the first.
        """
        n, m = len(self.voxels), self.hash.m
        low, high = np.array(self.origin), np.array(self.origin) + self.side
        if not (
            np.isfinite(high).all() and 2.0**-900 < self.side < 2.0**900 and (low < high).all()
        ):
            raise FileError(
                f"field: a cube of side {self.side:g} at {self.origin} is beyond float64"
            )
        shaped = n > 0 and self.voxels.shape == (n, 3, 3, 3)
        parts = blocks_of(self.voxels, AT_ONCE) if shaped else ()
        if not shaped or not all((np.abs(some) <= FAR).all() for some in parts):
            raise FileError("field voxels: blocks of 3 x 3 x 3 finite distances are expected")
        if self.cells.shape not in ((m, m, m, 2), (m, m, m, 3)):
            raise FileError(f"field cells: {self.cells.shape} where the hash has m = {m}")
        if self.bounds is not None and self.bounds.shape != (n, 2, 2, 2):
            raise FileError(f"field bounds: {self.bounds.shape} for {n} blocks")
        identifiers = self.identifiers.ravel()
        taken = np.flatnonzero(identifiers)
        owners = self.cells[..., -1].ravel()
        if len(taken) != n or not np.array_equal(np.sort(owners[taken]), np.arange(n)):
            raise FileError(f"field cells: they do not have each of the {n} blocks once")
        if owners[identifiers == 0].any():
            raise FileError("field cells: a free slot names a block")
        self._check_tree()

    def _check_tree(self) -> None:
        order = self.blocks
        if (
            (order[1:] <= order[:-1]).any()
            or order[0] != 1
            or int(order[-1]) >> (3 * MAX_LEVEL - 2)
        ):
            raise FileError("field cells: blocks are not in the order of their cells, root first")
        levels, ijk = cell_of(order)
        if levels.max() >= MAX_LEVEL or (identifier_type(int(levels.max())) != order.dtype):
            raise FileError(
                f"field cells: identifiers of {order.dtype.itemsize} bytes for level {levels.max()}"
            )
        parents = order[1:] >> order.dtype.type(3)
        of = np.minimum(np.searchsorted(order, parents), len(order) - 1)
        if not np.array_equal(order[of], parents):
            raise FileError("field cells: a cell has no parent")
        keys = key_of(levels, ijk)
        try:
            self.hash.validate(keys)
        except VoxtoolError as error:
            raise FileError(f"field: {error}") from None
        if not np.array_equal(self.identifiers.ravel()[self.hash.slots(keys)], order):
            raise FileError("field cells: a cell is not where the hash puts it")
        if self.bounds is not None:
            refined = np.zeros((len(order), 8), bool)
            refined[of, (order[1:] & order.dtype.type(7)).astype(np.int64)] = True
            if not np.array_equal((self.bounds == NO_LEAF).reshape(-1, 8), refined):
                raise FileError("field bounds: they are not those of the leaves")


def assemble(
    identifiers: np.ndarray, keys: np.ndarray, voxels: np.ndarray, bounds: np.ndarray | None,
    hash: SpatialHash, **head: Any,
) -> DistanceField:  # fmt: skip
    """Return the field of cells with the (n,) ascending identifiers, of the type of
    identifier_type; the keys, blocks and the hash are theirs, `head` has the other attributes."""
    wide = identifiers.dtype == np.uint64
    cells = np.zeros((hash.m**3, 3 if wide else 2), np.uint32)
    slot = hash.slots(keys)
    cells[slot, 0] = identifiers & identifiers.dtype.type(0xFFFFFFFF)
    if wide:
        cells[slot, 1] = identifiers >> np.uint64(32)
    cells[slot, -1] = np.arange(len(identifiers))
    return DistanceField(voxels, cells.reshape(*[hash.m] * 3, -1), hash, bounds, **head)
