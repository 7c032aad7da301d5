"""Fields of any function, built in the plainest way, for tests of queries and files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.field.cells import bound_values, cell_of, identifier_type, key_of
from voxtool.adf.field.field import DistanceField, assemble
from voxtool.adf.field.hashing import build_hash
from voxtool.morton import morton_decode, morton_encode

if TYPE_CHECKING:
    from collections.abc import Callable

HALVES = np.indices((3, 3, 3)).reshape(3, 27).T[:, ::-1]  # (27, 3): x, y, z of a block's vertices
OCTANTS = np.indices((2, 2, 2)).reshape(3, 8).T[:, ::-1]
CORNERS = np.flatnonzero((HALVES % 2 == 0).all(axis=1))


def sphere(points: np.ndarray) -> np.ndarray:
    """Return the distance to a sphere of radius 0.3 in the middle of the cube."""
    return np.sqrt(((points - 0.5) ** 2).sum(axis=1)) - 0.3


def point(points: np.ndarray) -> np.ndarray:
    """Return the distance to a point that is no vertex of a cell; few cells need refinement."""
    return np.sqrt(((points - (0.3, 0.6, 0.7)) ** 2).sum(axis=1))


def plain_field(
    function: Callable[[np.ndarray], np.ndarray] = sphere,
    tolerance: float = 1e-2,
    max_level: int = 5,
    *,
    bounds: bool = True,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    side: float = 1.0,
    **head: Any,
) -> DistanceField:
    """Return a field with cracks, refined at the root and where a vertex of a block is further from
    the interpolation than the tolerance.

    function : of (N, 3) points of the unit cube.
    """
    weights = np.stack(
        [np.where(corner, HALVES / 2, 1 - HALVES / 2).prod(axis=1) for corner in OCTANTS], axis=1
    )
    codes, voxels, errors = [], [], []
    cells = np.zeros((1, 3), np.int64)
    for level in range(max_level):
        points = (2 * cells[:, None] + HALVES) / 2.0 ** (level + 1)
        values = function(points.reshape(-1, 3)).reshape(-1, 27)
        error = np.abs(values - values[:, CORNERS] @ weights.T).max(axis=1)
        refined = (error > tolerance) | (level == 0)
        cells, values = cells[refined], values[refined]
        order = np.argsort(morton_encode(cells))
        cells = cells[order]
        codes.append(morton_encode(cells) | np.uint64(1 << 3 * level))
        voxels.append(values[order])
        errors.append(error[refined][order])
        cells = (2 * cells[:, None] + OCTANTS).reshape(-1, 3)
    identifiers = np.concatenate(codes)
    levels, ijk = cell_of(identifiers)
    keys = key_of(levels, ijk)
    kind = identifier_type(int(levels.max()))
    children = identifiers[:, None] << np.uint64(3) | morton_encode(OCTANTS)
    # not real bounds: any number serves
    codes_of_bounds = np.searchsorted(bound_values(), np.exp2(-2.0 - levels)).astype(np.uint8)
    found = np.repeat(codes_of_bounds, 8).reshape(-1, 8)
    found[np.isin(children, identifiers)] = 0
    standard = {
        "sign": "pseudonormal", "tolerance": tolerance, "max_level": max_level,
        "band": float("inf"), "continuous": False, "lipschitz": 1.5,
    }  # fmt: skip
    return assemble(
        identifiers.astype(kind),
        keys,
        np.concatenate(voxels).astype(np.float32).reshape(-1, 3, 3, 3),
        found.reshape(-1, 2, 2, 2) if bounds else None,
        build_hash(keys),
        origin=origin,
        side=side,
        **{**standard, **head},
    )


def cells_of(field: DistanceField) -> tuple[np.ndarray, np.ndarray]:
    """Return the (n,) levels and (n, 3) cells that have blocks, in their order."""
    codes = field.blocks.astype(np.uint64)
    levels = cell_of(codes)[0]
    leading = np.uint64(1) << (3 * levels).astype(np.uint64)
    return levels, morton_decode(codes ^ leading)


def level_sets() -> dict[str, tuple[DistanceField, dict[str, Any], tuple[int, int, int]]]:
    """Return fields, the options of their level sets, and the shape of the samples to compare."""
    place: dict[str, Any] = {"origin": (-3.7, 0.1, 12.0), "side": 2.3}
    sphere_field = plain_field(**place, units="mm")
    half = plain_field(lambda points: points[:, 0] - 0.9, **place)  # few leaves, and large tiles
    return {
        "default": (sphere_field, {}, (32, 32, 32)),
        "fine": (sphere_field, {"spacing": 2.3 / 75.3, "band": 1.5}, (75, 75, 75)),
        "half": (half, {"spacing": 2.3 / 280, "band": 4}, (280, 20, 20)),  # a part of it
    }
