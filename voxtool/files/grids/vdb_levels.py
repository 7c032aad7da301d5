"""Level sets of OpenVDB, .vdb: the signed distances of a field near its surface, float32.

Index (i, j, k) is a sample: world = translation + scale * index. Samples nearer than the background
are active. The others hold the background, negative inside, and so do inactive tiles.
[OpenVDB: Museth 2013, doi 10.1145/2487228.2487235; files of version 224]
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from typing import BinaryIO
from uuid import UUID

import numpy as np

from voxtool.adf.surface.narrow_band import BLOCK_SIDE, LevelSet
from voxtool.files.grids import vdb
from voxtool.files.grids.vdb_encode import (
    ACTIVE_MASK,
    ALL_MINUS,
    ALL_PLUS,
    CELLS,
    KEY_SHIFTS,
    LEAF_SIDE,
    LOWER,
    LOWER_SIDE,
    MASK_BYTES,
    PLUS_OR_MINUS,
    UPPER,
    UPPER_SIDE,
    ZIP,
    Inside,
    Leaves,
    corners_of,
    keys_of,
    packed,
    parents_of,
    tiles_of,
)
from voxtool.version import __version__

assert BLOCK_SIDE == LEAF_SIDE
LEAF_BYTES = 3 * MASK_BYTES + 9 + 4 * CELLS  # masks, the way of the values, their size, the values


def size(image: LevelSet) -> int:
    """Return a bound of the bytes of the file."""
    lower, upper = parents_of(np.sort(keys_of(image.corners)), tiles_of([]))
    nodes = sum(
        len(keys) * (3 * 8**power // 8 + 64) for keys, power in ((lower, LOWER), (upper, UPPER))
    )
    return vdb.EXTRA + nodes + LEAF_BYTES * len(image.corners)


def write(image: LevelSet, file: BinaryIO) -> None:
    """Write one grid of float32."""
    leaves, inside = tree_of(image, leaf_values)
    low, high, count = extent_of(leaves)
    metadata = {
        "class": vdb.Meta.text("level set"),
        "creator": vdb.Meta.text(f"voxtool {__version__}"),
        "file_bbox_max": vdb.Meta.whole(*high.tolist()),
        "file_bbox_min": vdb.Meta.whole(*low.tolist()),
        "file_voxel_count": vdb.Meta.whole(count),
        "name": vdb.Meta.text(vdb.GRID_NAME),
        "voxtool_low": vdb.Meta.whole(0, 0, 0),
        "voxtool_origin": vdb.Meta.real(*image.origin),
        "voxtool_shape": vdb.Meta.whole(*image.shape),
        "voxtool_units": vdb.Meta.text(image.source.units),
    }
    background = float(np.float32(image.background))
    file.write(vdb.header_of(content_id(image)))
    vdb.write_grid(
        file, vdb.NAMES["float32"], ACTIVE_MASK | ZIP, metadata, image.middle, image.pitch, leaves,
        tiles_of(inside), Inside(-background, False), background,
    )  # fmt: skip


def content_id(image: LevelSet) -> UUID:
    """Return an identifier that follows from the content."""
    part = (image.source.digest(), image.pitch, image.background)
    return UUID(bytes=hashlib.sha256(repr(part).encode()).digest()[:16])


def tree_of(
    image: LevelSet, encoded: Callable[[np.ndarray, np.ndarray, np.ndarray], bytes]
) -> tuple[Leaves, list[tuple[np.ndarray, int]]]:
    """Return the leaves, and the cubes inside: low samples and sides. `encoded` makes the values
    of a leaf of its distances, and of which are active and which far inside, (512,) each."""
    keys, masks, values = [np.empty(0, np.int64)], [np.empty((0, MASK_BYTES), np.uint8)], []
    cubes = []
    for corners, distances in image.sampled():
        active = abs(distances) < np.float32(image.background)
        is_minus = ~active & (distances < 0)
        flat = is_minus.all(axis=1) | ~(active | is_minus).any(axis=1)
        cubes.append((corners[is_minus.all(axis=1)], LEAF_SIDE))
        kept = np.flatnonzero(~flat)
        keys.append(keys_of(corners[kept]))
        masks.append(np.packbits(active[kept], axis=1, bitorder="little"))
        values += [encoded(distances[i], active[i], is_minus[i]) for i in kept]
    leaves = Leaves.ordered(np.concatenate(keys), np.concatenate(masks), values)
    return leaves, [*cubes, *far_inside(image)]


def extent_of(leaves: Leaves) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the first and the last active sample, (3,) int, and their number."""
    held = leaves.masks.any(axis=1)  # a leaf where the sign jumps may have no active sample
    return vdb.extent_of(Leaves(leaves.keys[held], leaves.masks[held]), [])


def leaf_values(distances: np.ndarray, active: np.ndarray, is_minus: np.ndarray) -> bytes:
    """Return what follows the mask of a leaf: how its inactive values are stored, and the active
    ones."""
    if not is_minus.any():
        head = bytes([ALL_PLUS])
    elif (active | is_minus).all():
        head = bytes([ALL_MINUS])
    else:
        head = bytes([PLUS_OR_MINUS]) + np.packbits(~is_minus, bitorder="little").tobytes()
    return head + packed(distances[active].astype("<f4").tobytes())


def far_inside(image: LevelSet) -> Iterator[tuple[np.ndarray, int]]:
    """Yield the cubes inside that no block of the level set touches: low samples and sides.

    The surface is in none of them, so each is inside if its first sample is."""
    blocks = np.sort(keys_of(image.corners))
    lower, upper = parents_of(blocks, tiles_of([]))
    count = -(-max(image.shape) // UPPER_SIDE)
    every = keys_of(np.indices((count,) * 3).reshape(3, -1).T * UPPER_SIDE)
    yield _inside(image, np.setdiff1d(every >> KEY_SHIFTS["upper"][0], upper), "upper"), UPPER_SIDE
    for parents, power, taken, name, side in (
        (upper, UPPER, lower, "lower", LOWER_SIDE),
        (lower, LOWER, blocks, "leaf", LEAF_SIDE),
    ):
        for parent in parents.tolist():
            children = parent << 3 * power | np.arange(8**power)
            yield _inside(image, np.setdiff1d(children, taken), name), side


def _inside(image: LevelSet, keys: np.ndarray, name: str) -> np.ndarray:
    """Return the low samples of those nodes whose first sample is inside."""
    corners = corners_of(keys << KEY_SHIFTS[name][0]).astype(np.int64)
    corners = corners[(corners < image.shape).all(axis=1)]
    return corners[image.distances(corners) < 0]
