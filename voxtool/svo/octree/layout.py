"""The layout of an octree in memory: nodes, bricks and their bits, for host and device.

A node is two 32-bit words, `parent` and `child`. The device's header is generated from the
constants of this module.

    bit 31      INSIDE, in `child` only: a leaf above level 0 that lies completely inside a solid
    bit 30      VALID: the word holds a link (the root has no parent, a coarse leaf no child)
    bits 0..29  LINK: index of the parent, of the first child, or at level 0 of the node's brick

A brick is a 64-bit mask of 4 x 4 x 4 voxels in Morton order: bit 0 is voxel (0, 0, 0), bit 1
(1, 0, 0), bit 2 (0, 1, 0), bit 4 (0, 0, 1), bit 8 (2, 0, 0).
"""

from __future__ import annotations

import numpy as np

from voxtool.grid import FIXED_POINT_BITS
from voxtool.morton import morton_decode, morton_encode
from voxtool.opencl import program

NODE = np.dtype([("parent", "<u4"), ("child", "<u4")])
INSIDE = np.uint32(1 << 31)
VALID = np.uint32(1 << 30)
LINK = np.uint32(VALID - 1)
MAX_LINK = int(VALID)  # nodes, as a link has 30 bits

BRICK = np.dtype("<u8")
BRICK_SIDE = 4
NODE_BYTES, BRICK_BYTES = NODE.itemsize, BRICK.itemsize
HEADERS = {
    "svo/octree/octree.h": "\n".join(
        [
            program.c_struct("svo_node", NODE),
            program.c_constants(INSIDE=INSIDE, VALID=VALID, LINK=LINK),
            "#ifndef FIXED_POINT_BITS // an option, on a finer lattice",
            f"#define FIXED_POINT_BITS {FIXED_POINT_BITS}",
            "#endif",
        ]
    )
}

AT_ONCE = 1 << 16  # bricks whose bits are unpacked at once
BRICK_VOXELS = morton_decode(np.arange(BRICK_SIDE**3))  # (64, 3): the voxel of each bit


def descend(codes: np.ndarray, levels: int = 1) -> np.ndarray:
    """Return the Morton codes of all cells a number of levels below, (8**levels n,) uint64."""
    below = np.arange(8**levels if len(codes) else 0, dtype=np.uint64)
    return ((codes << np.uint64(3 * levels))[:, None] | below).ravel()


def unpack_bits(bricks: np.ndarray) -> np.ndarray:
    """Return the (M, 64) uint8 bits of (M,) masks."""
    octets = np.ascontiguousarray(bricks, BRICK).view(np.uint8).reshape(-1, BRICK.itemsize)
    return np.unpackbits(octets, axis=1, bitorder="little")


def held_in(masks: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return which voxels of (M,) masks, brick by brick in the order of the bits, are in the masks
    of `others`, too, (N,) bool."""
    some = np.flatnonzero(masks)
    parts = (some[i : i + AT_ONCE] for i in range(0, len(some), AT_ONCE))
    found = (unpack_bits(others[part])[unpack_bits(masks[part]) != 0] != 0 for part in parts)
    return np.concatenate([np.empty(0, bool), *found])


def unpack_bricks(bricks: np.ndarray) -> np.ndarray:
    """Return the (M, 4, 4, 4) bool voxels of (M,) masks, indexed [brick, x, y, z]."""
    bits = unpack_bits(bricks)
    x, y, z = BRICK_VOXELS.T
    dense = np.empty((len(bricks), BRICK_SIDE, BRICK_SIDE, BRICK_SIDE), bool)
    dense[:, x, y, z] = bits
    return dense


def pack_array(dense: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the occupied bricks of an (nx, ny, nz) bool array: (M,) uint64 Morton codes in
    ascending order, and (M,) uint64 masks."""
    padded = np.pad(dense, [(0, -n % BRICK_SIDE) for n in dense.shape])
    a, b, c = (n // BRICK_SIDE for n in padded.shape)
    blocks = padded.reshape(a, BRICK_SIDE, b, BRICK_SIDE, c, BRICK_SIDE)
    cells = np.argwhere(blocks.any(axis=(1, 3, 5)))
    codes = morton_encode(cells)
    order = np.argsort(codes)
    i, j, k = cells[order].T
    x, y, z = BRICK_VOXELS.T
    voxels = blocks.transpose(0, 2, 4, 1, 3, 5)[i, j, k][:, x, y, z]
    return codes[order], np.packbits(voxels, bitorder="little").view(BRICK)


def pack_voxels(voxels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the occupied bricks, as pack_array does, of (N, 3) voxels from 0 to 2**21 - 1, in any
    order, with repetitions."""
    codes = np.sort(morton_encode(voxels))
    bits = np.uint64(1) << (codes & np.uint64(63))
    codes >>= np.uint64(6)
    return unite_bricks(codes, bits)


def unite_bricks(codes: np.ndarray, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ascending codes without duplicates, and the united masks of each brick."""
    first = np.flatnonzero(np.diff(codes, prepend=~codes[:1]))
    return codes[first], np.bitwise_or.reduceat(masks, first) if len(first) else masks


def voxels_within(bricks: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Return (N,) uint64 masks of the voxels of (N, 3) brick cells that lie in a grid's shape."""
    bits = np.uint64(1) << np.arange(BRICK_SIDE**3, dtype=np.uint64)
    within = np.full(len(bricks), ~np.uint64(0))
    for a in range(3):
        masks = np.array(
            [bits[BRICK_VOXELS[:, a] < n].sum(dtype=np.uint64) for n in range(BRICK_SIDE + 1)],
            np.uint64,
        )
        within &= masks[np.clip(shape[a] - BRICK_SIDE * bricks[:, a], 0, BRICK_SIDE)]
    return within
