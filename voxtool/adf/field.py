"""The adaptively sampled distance field: the data, as in figure 3.2 of the text.

A full octree over the unit cube, whose first vertex is the origin; the root has level 0. A cell
with children has a block of 3 x 3 x 3 distances, those at the vertices of its eight children, so
each child has its own eight in 2 x 2 x 2 of them. Leaves are implicit: they are the children that
have no block. Three textures:

    voxels   the blocks, in the order of their cells: level by level, along the Morton curve
    cells    the identifier of a cell and the number of its block, where the hash puts its key
    hash     offsets of a perfect spatial hash (hashing.py)

and, unless left out, a fourth: a byte for each of a block's children, what its error is at most.

Distances are in sides of the cube, in float32, negative inside. A point is three 32-bit numbers in
units of 2**-32 sides: its bits are the cell of every level and the fraction within, exactly.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from voxtool.adf.hashing import SpatialHash, cell_identifier, cell_of, identifier_type, key_of
from voxtool.errors import FileError, VoxtoolError
from voxtool.opencl import program

POINT_BITS = 32  # of a coordinate in the cube
MAX_LEVEL = 21  # of a leaf, whose parent has a key of 21 bits and an identifier of 61
FAR = 1024.0  # sides: no distance in a cube is near it, and none overflows
WEIGHT_BITS = 24  # of the fraction within a cell that a weight in float32 takes

# A bound is a code: no leaf, none (a jump, or over a side), or 2**((code - 254) / 8) sides.
NO_LEAF, JUMP = 0, 255
BOUND_STEPS = 8  # of a code for a factor of two: rounding up adds at most 9.1 %

HEADERS = {"adf/field.h": program.c_constants(POINT_BITS=POINT_BITS, WEIGHT_BITS=WEIGHT_BITS)}


def bound_values() -> np.ndarray:
    """(256,) float64: what each code bounds the error to, in sides: 0 for NO_LEAF, infinite for
    JUMP, and else 2**((code - 254) / 8), by square roots alone."""
    eighth = math.sqrt(math.sqrt(math.sqrt(2.0)))
    steps = [1.0]
    for _ in range(BOUND_STEPS - 1):
        steps.append(steps[-1] * eighth)
    values = np.zeros(256)
    for code in range(1, JUMP):
        exponent, step = divmod(code - (JUMP - 1), BOUND_STEPS)
        values[code] = math.ldexp(steps[step], exponent)
    values[JUMP] = np.inf
    return values


def bound_codes(bounds: np.ndarray) -> np.ndarray:
    """The codes of bounds in sides: the least that is not below each; JUMP for what is over 1."""
    return np.clip(np.searchsorted(bound_values()[:JUMP], bounds), 1, JUMP).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Answer:
    """What a field says at N points.

    distance : (N,) float64, world units; NaN where the point is. Outside of the cube a lower bound
        on the distance (see DistanceField.query).
    gradient : (N, 3) float32, or None if not asked for.
    bound : (N,) float64, world units: how far at most the distance is from the exact one; infinite
        outside of the cube, and where a cell holds a jump; or None.
    level, cell : (N,) uint8 and (N, 3) uint32: the leaf, cell (i, j, k) of its level, or None.
    outside : (N,) bool: not in the cube.
    """

    distance: np.ndarray
    gradient: np.ndarray | None
    bound: np.ndarray | None
    level: np.ndarray | None
    cell: np.ndarray | None
    outside: np.ndarray


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Distances to a mesh, sampled as finely as each place needs.

    voxels : (n, 3, 3, 3) float32, [block, z, y, x], in sides of the cube.
    cells : (m, m, m, 2 or 3) uint32, [z, y, x]: low word of the identifier, high word if there is
        one, block; all 0 where the slot is free.
    hash : where the key of a cell is in `cells`.
    bounds : (n, 2, 2, 2) uint8, [block, z, y, x], codes of bound_values; or None.
    origin, side : of the cube: world = origin + side * point.
    sign : how the sign was found, one of voxtool.spatial.signed_distance.SIGNS.
    tolerance, max_level, band : as asked of the build; in sides, level, and sides or infinite.
    continuous : whether neighbours of different level agree on what they share.
    lipschitz : the steepest that the field is, but in leaves that hold a jump.
    reached : what the build reached: errors, counts; JSON types only.
    plan : what the plan said of the scene: JSON types only.
    source_sha256 : hex digest of the bytes that the mesh was read from, or "".
    units : name of the world unit if known, or "".
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
    reached: dict[str, Any] = field(default_factory=dict)
    plan: dict[str, Any] = field(default_factory=dict)
    source_sha256: str = ""
    units: str = ""

    # ---- structure

    @property
    def identifiers(self) -> np.ndarray:
        """(m, m, m) uint32 or uint64: of the cell in each slot; 0 where it is free."""
        if self.cells.shape[-1] == 2:
            return self.cells[..., 0]
        low, high = self.cells[..., 0].astype(np.uint64), self.cells[..., 1].astype(np.uint64)
        return high << np.uint64(32) | low

    @cached_property
    def blocks(self) -> np.ndarray:
        """(n,) identifiers of the cells that have blocks, in the order of the blocks."""
        identifiers = self.identifiers.ravel()
        taken = identifiers != 0
        ordered = np.zeros(len(self.voxels), identifiers.dtype)
        ordered[self.cells[..., -1].ravel()[taken]] = identifiers[taken]
        return ordered

    @property
    def depth(self) -> int:
        """The deepest level of a leaf."""
        return (int(self.identifiers.max()).bit_length() - 1) // 3 + 1

    def cells_by_level(self) -> list[int]:
        """How many cells with children each level has, from 0, the root's, to the leaves' last."""
        return np.bincount(cell_of(self.blocks)[0], minlength=self.depth + 1).tolist()

    def leaves_by_level(self) -> list[int]:
        """How many leaves each level has, from 1, the root's children, to the deepest."""
        refined = self.cells_by_level()
        return [8 * above - own for above, own in zip([0, *refined], refined, strict=False)][1:]

    def slots(self, level: int, ijk: np.ndarray) -> np.ndarray:
        """(N, 3) cells of a level to the (N,) numbers of their blocks, -1 where there is none."""
        slot = self.hash.slots(key_of(level, ijk))
        words = self.cells.reshape(-1, self.cells.shape[-1])[slot]
        found = self.identifiers.ravel()[slot]
        return np.where(found == cell_identifier(level, ijk), words[:, -1].astype(np.int64), -1)

    # ---- queries: the oracle of query.py

    def fixed(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) world points as (N, 3) uint32 in units of 2**-32 sides, and (N,) bool: outside.

        Points outside of the cube, and NaN, become the nearest in it, and 0.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            u = (points - np.array(self.origin)) / self.side
            outside = np.logical_not(((u >= 0) & (u <= 1)).all(axis=1))
            u = np.where(u > 0, u, 0.0) * 2.0**POINT_BITS
        return np.where(u < 2.0**POINT_BITS, u, 2.0**POINT_BITS - 1).astype(np.uint32), outside

    def distance(self, points: Any) -> np.ndarray:
        """(N,) float64: the distance at each of (N, 3) points, world units; as query."""
        return self.query(points).distance

    def gradient(self, points: Any) -> np.ndarray:
        """(N, 3) float32: the gradient at each of (N, 3) points; as query."""
        gradient = self.query(points, gradient=True).gradient
        assert gradient is not None
        return gradient

    def query(
        self, points: Any, *, gradient: bool = False, bounds: bool = False, cell: bool = False
    ) -> Answer:
        """What the field says at points, in numpy: the oracle of voxtool.query_adf.

        Outside of the cube the distance is sqrt(g^2 + max(|d| - e, 0)^2), where g is the distance
        to the cube, d the field's at the nearest point of the cube and e its bound, or without
        bounds (sqrt(3) / 2) of the leaf's edge. As the mesh is inside the cube, the exact distance
        is no less. Its gradient is that of this expression.

        Parameters
        ----------
        points : (N, 3) numbers, world units.
        gradient, bounds, cell : whether they are asked for.

        Raises
        ------
        VoxtoolError : a wrong shape, or bounds of a field without them.
        """
        points = checked_points(points)
        if bounds and self.bounds is None:
            raise no_bounds()
        fixed, outside = self.fixed(points)
        level, block = self._search(fixed)
        child = fixed.astype(np.uint64) >> (POINT_BITS - 1 - level)[:, None].astype(np.uint64)
        octant = (child & np.uint64(1)).astype(np.int64)
        values = self._corners(block, octant)
        fraction = (fixed << (level + 1)[:, None].astype(np.uint32)) >> np.uint32(
            POINT_BITS - WEIGHT_BITS
        )
        t = fraction.astype(np.float32) * np.float32(2.0**-WEIGHT_BITS)
        distance = trilinear(values, t)
        slope = None
        if gradient or outside.any():
            slope = trilinear_gradient(values, t) * np.ldexp(np.float32(1), level + 1)[:, None]
        bound = None
        if self.bounds is not None and (bounds or outside.any()):
            code = self.bounds[block, octant[:, 2], octant[:, 1], octant[:, 0]]
            bound = bound_values()[code]
        elif outside.any():
            bound = half_diagonals(level + 1)
        world = distance.astype(np.float64) * self.side
        if outside.any():
            assert slope is not None
            assert bound is not None
            self.extend(points, outside, distance, world, slope, bound)
        lost = np.isnan(points).any(axis=1)
        world[lost] = np.nan
        if slope is not None:
            slope[lost] = np.nan
        if bounds:
            assert bound is not None
            bound = np.where(outside, np.inf, bound * self.side)
        return Answer(
            world,
            slope if gradient else None,
            bound if bounds else None,
            (level + 1).astype(np.uint8) if cell else None,
            child.astype(np.uint32) if cell else None,
            outside & ~lost,
        )

    def _search(self, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of each point the deepest cell that has a block: (N,) int64 levels and blocks, by the
        linear search of section 3.5."""
        level, block = np.zeros(len(fixed), np.int64), np.zeros(len(fixed), np.int64)
        pending = np.arange(len(fixed))
        for deeper in range(self.depth):
            found = self.slots(deeper, fixed[pending].astype(np.int64) >> (POINT_BITS - deeper))
            pending, found = pending[found >= 0], found[found >= 0]
            level[pending], block[pending] = deeper, found
        return level, block

    def _corners(self, block: np.ndarray, octant: np.ndarray) -> np.ndarray:
        """(N, 2, 2, 2) float32, [z, y, x]: the distances at the vertices of children of blocks."""
        x, y, z = octant.T[:, :, None, None, None]
        dz, dy, dx = np.ogrid[:2, :2, :2]
        return self.voxels[block[:, None, None, None], z + dz, y + dy, x + dx]

    def extend(
        self,
        points: np.ndarray,
        outside: np.ndarray,
        distance: np.ndarray,
        world: np.ndarray,
        slope: np.ndarray,
        bound: np.ndarray,
    ) -> None:
        """Give points outside of the cube their lower bound, in `world`, and its gradient."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            u = (points[outside] - np.array(self.origin)) / self.side
            beyond = np.where(u < 0, u, np.where(u > 1, u - 1, 0.0))
            near = np.abs(distance[outside].astype(np.float64)) - bound[outside]
            near = np.where(near > 0, near, 0.0)
            exponent = np.frexp(np.abs(beyond).max(axis=1))[1]  # squares of large ones overflow
            x, y, z = np.ldexp(beyond.T, -exponent)
            part = np.ldexp(near, -exponent)
            total = np.ldexp(np.sqrt(x * x + y * y + z * z + part * part), exponent)
            inward = np.where(distance[outside] < 0, -near, near)[:, None]
            steep = np.where(beyond != 0, beyond, inward * slope[outside]) / total[:, None]
        world[outside] = total * self.side
        slope[outside] = steep.astype(np.float32)

    # ---- sizes, identity, soundness

    def sizes(self) -> dict[str, int]:
        """Bytes of each texture."""
        sizes = {
            "voxels": self.voxels.nbytes,
            "cells": self.cells.nbytes,
            "hash": self.hash.nbytes,
        }
        if self.bounds is not None:
            sizes["bounds"] = self.bounds.nbytes
        return sizes

    def digest(self) -> str:
        """SHA-256 of the canonical content: all but the reached, the plan and the source. Equal
        content has an equal digest on every device and platform."""
        head = {
            "origin": [v.hex() for v in self.origin],
            "side": self.side.hex(),
            "sign": self.sign,
            "tolerance": self.tolerance.hex(),
            "max_level": self.max_level,
            "band": self.band.hex(),
            "continuous": self.continuous,
            "lipschitz": self.lipschitz.hex(),
            "hash": [self.hash.m, self.hash.r, self.hash.offsets.shape[-1]],
            "bounds": self.bounds is not None,
        }
        sha = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
        arrays = [self.voxels, self.cells, self.hash.offsets]
        for array in arrays if self.bounds is None else [*arrays, self.bounds]:
            sha.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
        return sha.hexdigest()

    def validate(self) -> None:
        """Check every invariant of the structure.

        Raises
        ------
        FileError : names the first that fails.
        """
        n, m = len(self.voxels), self.hash.m
        low, high = np.array(self.origin), np.array(self.origin) + self.side
        if not (
            np.isfinite(high).all() and 2.0**-900 < self.side < 2.0**900 and (low < high).all()
        ):
            raise FileError(
                f"field: a cube of side {self.side:g} at {self.origin}: none float64 holds"
            )
        if n == 0 or self.voxels.shape != (n, 3, 3, 3) or not (np.abs(self.voxels) <= FAR).all():
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


def half_diagonals(levels: np.ndarray) -> np.ndarray:
    """(N,) float64: of cells of these levels, in sides; no distance in one is further off."""
    return np.ldexp(math.sqrt(3) / 2, -levels)


def trilinear(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(N,) float32: (N, 2, 2, 2) values, [z, y, x], interpolated at (N, 3) float32 in [0, 1]; along
    x first, a + t (b - a) each."""
    for axis in range(3):
        a, b = values[..., 0], values[..., 1]
        weight = t[:, axis].reshape(-1, *[1] * (a.ndim - 1))
        values = a + weight * (b - a)
    return values


def trilinear_gradient(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(N, 3) float32: the gradient of trilinear, by an edge's length: along each axis the
    differences, interpolated along the other two in the order of x, y, z."""
    slopes = []
    for axis in range(3):
        last = 3 - axis  # of the axes [point, z, y, x]
        v = np.diff(values, axis=last).squeeze(last)
        for other in (a for a in range(3) if a != axis):
            weight = t[:, other].reshape(-1, *[1] * (v.ndim - 2))
            v = v[..., 0] + weight * (v[..., 1] - v[..., 0])
        slopes.append(v)
    return np.stack(slopes, axis=1)


def checked_points(points: Any) -> np.ndarray:
    """(N, 3) float64 of anything.

    Raises
    ------
    VoxtoolError : it is no such array.
    """
    try:
        world = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        raise VoxtoolError("points are not an array of numbers: give (N, 3)") from None
    if world.ndim != 2 or world.shape[1] != 3:
        raise VoxtoolError(f"points of shape {world.shape}: give (N, 3)")
    return world


def no_bounds() -> VoxtoolError:
    """The error where bounds are asked of a field without them."""
    return VoxtoolError("the field has no bounds: build it without --no-bounds")


def assemble(
    identifiers: np.ndarray, voxels: np.ndarray, bounds: np.ndarray | None, hash: SpatialHash,
    **head: Any,
) -> DistanceField:  # fmt: skip
    """A field of blocks and the cells that have them.

    Parameters
    ----------
    identifiers : (n,) of the cells in rising order, of the type of identifier_type.
    voxels, bounds : their blocks, as in DistanceField.
    hash : of their keys.
    head : the other fields of DistanceField.
    """
    levels, ijk = cell_of(identifiers)
    wide = identifiers.dtype == np.uint64
    cells = np.zeros((hash.m**3, 3 if wide else 2), np.uint32)
    slot = hash.slots(key_of(levels, ijk))
    cells[slot, 0] = identifiers & identifiers.dtype.type(0xFFFFFFFF)
    if wide:
        cells[slot, 1] = identifiers >> np.uint64(32)
    cells[slot, -1] = np.arange(len(identifiers))
    return DistanceField(voxels, cells.reshape(*[hash.m] * 3, -1), hash, bounds, **head)
