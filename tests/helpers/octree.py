"""Octrees from dense arrays, in plain numpy: what the files are tested with."""

from __future__ import annotations

import numpy as np

from voxtool.grid import Grid
from voxtool.morton import morton_decode
from voxtool.svo.octree.layout import BRICK, BRICK_VOXELS, INSIDE, NODE, VALID
from voxtool.svo.octree.octree import Octree

WORLD = {"origin": (-1.5, 0.1, 1e-3), "pitch": (0.1, 0.1, 0.1)}


def pack_bricks(dense: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The masks of the 4 x 4 x 4 blocks of a padded cube at (N, 3) brick cells."""
    voxels = cells[:, None] * 4 + BRICK_VOXELS
    set_bits = dense[voxels[..., 0], voxels[..., 1], voxels[..., 2]]
    return np.packbits(set_bits, axis=1, bitorder="little").reshape(-1, 8).view(BRICK).ravel()


def octree_from_dense(
    dense: np.ndarray, mode: str = "solid", fill: str = "parity", **more
) -> Octree:
    """An octree that holds dense, (nx, ny, nz) bool: a node is refined iff it is not uniform,
    and where mode is a surface also iff it is full."""
    grid = Grid(tuple(dense.shape), **WORLD)  # pyright: ignore[reportArgumentType]
    cube = np.zeros((grid.side,) * 3, bool)
    cube[tuple(map(slice, dense.shape))] = dense
    depth = (grid.side // 4).bit_length()
    codes, parents = np.zeros(1, np.uint64), np.zeros(1, np.uint32)
    levels: list[np.ndarray] = []
    for number in range(depth - 1, -1, -1):
        nodes = np.zeros(len(codes), NODE)
        nodes["parent"] = parents
        levels.append(nodes)
        if number == 0:
            nodes["child"] = VALID | np.arange(len(nodes), dtype=np.uint32)
            break
        side = 4 << number
        n = grid.side // side
        blocks = cube.reshape(n, side, n, side, n, side)
        i, j, k = morton_decode(codes).T
        full = blocks.all(axis=(1, 3, 5))[i, j, k]
        refined = blocks.any(axis=(1, 3, 5))[i, j, k] & ~(full & ("solid" in mode))
        links = np.arange(np.count_nonzero(refined), dtype=np.uint32) * np.uint32(8)
        nodes["child"][refined] = VALID | links
        nodes["child"][full & ~refined] = INSIDE
        parents = VALID | np.repeat(np.flatnonzero(refined).astype(np.uint32), 8)
        codes = (codes[refined] << np.uint64(3))[:, None] | np.arange(8, dtype=np.uint64)
        codes = codes.ravel()
    offsets = np.cumsum([0, *map(len, levels)]).astype(np.uint32)
    bricks = pack_bricks(cube, morton_decode(codes))
    return Octree(grid, mode, fill, offsets, np.concatenate(levels), bricks, **more)


def ball(shape: tuple[int, int, int], radius: float = 0.42) -> np.ndarray:
    """A ball in the middle of a dense array; the radius is a share of its longest side."""
    grids = np.ogrid[tuple(map(slice, shape))]
    parts = [(g + 0.5 - n / 2) ** 2 for g, n in zip(grids, shape, strict=True)]
    return sum(parts) < (radius * max(shape)) ** 2


def golden_octree() -> Octree:
    """Return the octree that tests/data/v1.0.svo.h5 and v1.0.svo.xml hold; version 1.0 of
    write_svo wrote them."""
    return octree_from_dense(
        ball((19, 16, 11)),
        plan={"triangles": 12, "stages": ["level 1", "level 0"], "ratio": 0.1},
        source_sha256="5e" * 32,
        units="mm",
    )
