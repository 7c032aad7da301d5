"""The sparse voxel octree: the data, as in figures 3.5 and 5.1 of the thesis.

Level 0 nodes are bricks of 4 x 4 x 4 voxels; a node of level L spans 4 * 2**L voxels a side, and
the root spans the grid's cube. A node has no child or eight. The nodes of a level are contiguous
and in Morton order (x in the lowest bit), so a child index is a multiple of 8; levels are stored
from the root down in one flat array, and links count from the start of their level.

A node is two 32-bit words, `parent` and `child`. The bits of a word are given once, here: the
device's header is generated from them.

    bit 31      INSIDE, in `child` only: a leaf above level 0 that lies wholly inside a solid
    bit 30      VALID: the word holds a link (the root has no parent, a coarse leaf no child)
    bits 0..29  LINK: index of the parent, of the first child, or at level 0 of the node's brick

A brick is a 64-bit mask of its voxels in Morton order: bit 0 is voxel (0, 0, 0), bit 1 (1, 0, 0),
bit 2 (0, 1, 0), bit 4 (0, 0, 1), bit 8 (2, 0, 0). Level 0 node i owns brick i.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from voxtool.errors import FileError
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.morton import morton_decode, spread_bits
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
    "svo/octree.h": "\n".join(
        [
            program.c_struct("svo_node", NODE),
            program.c_constants(INSIDE=INSIDE, VALID=VALID, LINK=LINK),
            f"#define FIXED_POINT_BITS {FIXED_POINT_BITS}",
        ]
    )
}

BRICK_VOXELS = morton_decode(np.arange(BRICK_SIDE**3))  # (64, 3): the voxel of each bit


@dataclass(frozen=True)
class Level:
    """The nodes of one level, in Morton order.

    number : the level; 0 holds the bricks.
    side : voxels along a side of a node.
    nodes : (N,) view of the octree's nodes, dtype NODE.
    codes : (N,) uint64 Morton codes of the nodes' cells.
    """

    number: int
    side: int
    nodes: np.ndarray
    codes: np.ndarray

    @property
    def refined(self) -> np.ndarray:
        """(N,) bool: nodes that have children (at level 0: a brick)."""
        return (self.nodes["child"] & VALID) != 0

    @property
    def inside(self) -> np.ndarray:
        """(N,) bool: leaves wholly inside the solid."""
        return (self.nodes["child"] & INSIDE) != 0

    @property
    def cells(self) -> np.ndarray:
        """(N, 3) int64: low corners of the nodes, in voxels."""
        return morton_decode(self.codes) * self.side


@dataclass(frozen=True, eq=False)
class Octree:
    """A set of voxels of a grid.

    grid : where the voxels lie.
    mode : "surface26", "surface6", "solid" or "solid+surface26".
    fill : rule that told inside from outside: "parity", or "none" for a surface.
    offsets : (depth + 1,) uint32: where each level begins, root first; the last is the node count.
    nodes : (N,) NODE.
    bricks : (M,) uint64, one a level 0 node.
    plan : what the plan said of the scene: JSON types only.
    source_sha256 : hex digest of the bytes that the mesh was read from, or "".
    units : name of the world unit if known, or "".
    """

    grid: Grid
    mode: str
    fill: str
    offsets: np.ndarray
    nodes: np.ndarray
    bricks: np.ndarray
    plan: dict[str, Any] = field(default_factory=dict)
    source_sha256: str = ""
    units: str = ""

    @property
    def depth(self) -> int:
        """Number of levels, the root's and the bricks' included."""
        return len(self.offsets) - 1

    def levels(self) -> list[Level]:
        """All levels, root first."""
        found: list[Level] = []
        codes = np.zeros(1, np.uint64)
        for d in range(self.depth):
            number = self.depth - 1 - d
            nodes = self.nodes[self.offsets[d] : self.offsets[d + 1]]
            level = Level(number, BRICK_SIDE << number, nodes, codes)
            found.append(level)
            if number:
                parents = codes[level.refined] << np.uint64(3)
                codes = (parents[:, None] | np.arange(8, dtype=np.uint64)).ravel()
        return found

    @property
    def count(self) -> int:
        """Number of set voxels."""
        return sum(self.count_by_level().values())

    def count_by_level(self) -> dict[int, int]:
        """Set voxels that each level holds: bricks at 0, whole inside leaves above."""
        counts = {0: int(np.bitwise_count(self.bricks).sum(dtype=np.int64))}
        for d in range(self.depth - 1):
            number = self.depth - 1 - d
            nodes = self.nodes[self.offsets[d] : self.offsets[d + 1]]
            leaves = int(np.count_nonzero(nodes["child"] & INSIDE))
            counts[number] = leaves * (BRICK_SIDE << number) ** 3
        return dict(sorted(counts.items()))

    @property
    def nbytes(self) -> int:
        """Bytes of nodes and bricks, without x-neighbour pointers."""
        return self.nodes.nbytes + self.bricks.nbytes

    def summary(self) -> dict[str, Any]:
        """What the octree holds, in JSON types; lengths in world units, volumes in their cubes.

        A level's `voxels` are those that its inside leaves or bricks hold; its `coverage` is the
        share of the volume of its nodes that is set.
        """
        counts = self.count_by_level()
        levels = []
        below = 0
        for level in reversed(self.levels()):
            below += counts[level.number]
            levels.append(
                {
                    "level": level.number,
                    "side": level.side,
                    "nodes": len(level.nodes),
                    "refined": int(np.count_nonzero(level.refined)) if level.number else 0,
                    "inside": int(np.count_nonzero(level.inside)),
                    "voxels": counts[level.number],
                    "coverage": below / max(len(level.nodes) * level.side**3, 1),
                }
            )
        nx, ny, nz = self.grid.shape
        voxels = sum(counts.values())
        return {
            "dim": self.grid.dim,
            "depth": self.depth,
            "mode": self.mode,
            "fill": self.fill,
            "shape": list(self.grid.shape),
            "origin": list(self.grid.origin),
            "pitch": list(self.grid.pitch),
            "units": self.units,
            "source_sha256": self.source_sha256,
            "voxels": voxels,
            "occupancy": voxels / (nx * ny * nz),
            "volume": voxels * self.grid.voxel_volume,
            "nodes": len(self.nodes),
            "bricks": len(self.bricks),
            "bytes": self.nbytes,
            "bytes_with_x_pointers": self.nbytes + self.nodes.nbytes,
            "compression": nx * ny * nz / 8 / self.nbytes,
            "levels": levels[::-1],
            "plan": self.plan,
        }

    def to_dense(self) -> np.ndarray:
        """The set voxels as a bool array indexed [x, y, z], of the grid's shape."""
        nx, ny, nz = self.grid.shape
        dense = np.zeros([-(-n // BRICK_SIDE) * BRICK_SIDE for n in self.grid.shape], bool)
        for level in self.levels():
            s = level.side
            a, b, c = whole = [n // s for n in dense.shape]  # nodes that lie in the array
            blocks = dense[: a * s, : b * s, : c * s].reshape(a, s, b, s, c, s)
            blocks = blocks.transpose(0, 2, 4, 1, 3, 5)
            cells = morton_decode(level.codes)
            if level.number:
                i, j, k = cells[level.inside].T
                blocks[i, j, k] = True
            else:
                held = (cells < whole).all(axis=1)
                i, j, k = cells[held].T
                blocks[i, j, k] = unpack_bricks(self.bricks[held])
        return dense[:nx, :ny, :nz]

    def occupied(self) -> np.ndarray:
        """The set voxels as an (N, 3) int64 array, in lexicographic order."""
        parts = []
        for level in self.levels():
            if level.number:
                if not level.inside.any():
                    continue
                corners = level.cells[level.inside]
                offsets = np.indices((level.side,) * 3).reshape(3, -1).T
                parts.append((corners[:, None] + offsets).reshape(-1, 3))
            else:
                brick, x, y, z = np.nonzero(unpack_bricks(self.bricks))
                parts.append(level.cells[brick] + np.stack([x, y, z], axis=1))
        voxels = np.concatenate(parts)
        return voxels[np.lexsort(voxels.T[::-1])]

    def digest(self) -> str:
        """SHA-256 of the canonical content: shape, mode, fill, origin, pitch, offsets, nodes and
        bricks, little-endian. Equal content has an equal digest on every device and platform."""
        head = {
            "shape": list(self.grid.shape),
            "mode": self.mode,
            "fill": self.fill,
            "origin": [v.hex() for v in self.grid.origin],
            "pitch": [v.hex() for v in self.grid.pitch],
        }
        sha = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
        for array, dtype in ((self.offsets, "<u4"), (self.nodes, NODE), (self.bricks, BRICK)):
            sha.update(np.ascontiguousarray(array, dtype).data)
        return sha.hexdigest()

    def validate(self) -> None:
        """Check every invariant of the structure.

        Raises
        ------
        FileError : names the first that fails, with its level and node.
        """
        self._check_offsets()
        for level in self.levels():
            self._check_level(level)
        self._check_border()

    def _check_offsets(self) -> None:
        check_offsets(self.grid, self.offsets)
        offsets = self.offsets.astype(np.int64)
        depth = self.depth
        if offsets[-1] != len(self.nodes):
            raise FileError(
                f"octree offsets: they end at {offsets[-1]} where there are {len(self.nodes)} nodes"
            )
        if len(self.bricks) != offsets[-1] - offsets[-2]:
            raise FileError(
                f"octree bricks: {len(self.bricks)} for {offsets[-1] - offsets[-2]} level 0 nodes"
            )
        for d in range(depth - 1):
            refined = np.count_nonzero(self.nodes["child"][offsets[d] : offsets[d + 1]] & VALID)
            if 8 * refined != offsets[d + 2] - offsets[d + 1]:
                raise FileError(
                    f"octree children: {refined} refined nodes on level {depth - 1 - d} do not "
                    f"have the {offsets[d + 2] - offsets[d + 1]} nodes of the level below"
                )

    def _check_level(self, level: Level) -> None:
        def refuse(what: str, bad: np.ndarray) -> None:
            if bad.any():
                raise FileError(
                    f"octree {what}: level {level.number}, node {int(np.argmax(bad))} is wrong"
                )

        parent, child = level.nodes["parent"], level.nodes["child"]
        refined = level.refined
        refuse(
            "inside flag of a refined node (both coarse-inside and refined)", refined & level.inside
        )
        if level.number == 0:
            refuse(
                "brick link (one brick a node, in order)",
                child != (VALID | np.arange(len(child), dtype=np.uint32)),
            )
        else:
            links = child[refined] & LINK
            refuse(
                "child link (Morton order: 8 nodes after the one before)",
                links != 8 * np.arange(len(links), dtype=np.uint32),
            )
            refuse(
                "leaf (link bits of a node without children are zero)",
                ~refined & ((child & LINK) != 0),
            )
            if "solid" not in self.mode:
                refuse("inside flag of a surface", level.inside)
        if level.number == self.depth - 1:
            refuse("parent link of the root (it has none)", parent != 0)
        else:
            d = self.depth - 1 - level.number
            above = self.nodes["child"][self.offsets[d - 1] : self.offsets[d]]
            owners = np.flatnonzero(above & VALID).astype(np.uint32)
            refuse(
                "parent link (the parent and its child agree)",
                parent != (VALID | np.repeat(owners, 8)),
            )

    def _check_border(self) -> None:
        """No voxel is set beyond the grid's shape: the padding to a cube is zero."""
        if self.grid.shape == (self.grid.side,) * 3:
            return
        for level in self.levels():
            beyond = _beyond(level, self.grid.shape)
            if level.number:
                bad = beyond & level.inside
            else:
                edge = np.flatnonzero(beyond)
                allowed = voxels_within(morton_decode(level.codes[edge]), self.grid.shape)
                bad = np.zeros(len(level.codes), bool)
                bad[edge] = (self.bricks[edge] & ~allowed) != 0
            if bad.any():
                raise FileError(
                    f"octree padding: level {level.number}, node {int(np.argmax(bad))} has voxels "
                    "set beyond the grid's shape"
                )


def check_offsets(grid: Grid, offsets: np.ndarray) -> None:
    """Check what offsets, (depth + 1,), can tell alone: before memory is taken for nodes.

    Raises
    ------
    FileError : levels that the grid does not have, or of impossible sizes.
    """
    offsets = offsets.astype(np.int64)
    depth = (grid.side // BRICK_SIDE).bit_length()
    if len(offsets) != depth + 1:
        raise FileError(
            f"octree offsets: {len(offsets) - 1} levels where a grid of dim {grid.dim} has {depth}"
        )
    sizes = np.diff(offsets)
    if offsets[0] != 0 or offsets[1] != 1 or (sizes < 0).any():
        raise FileError("octree offsets: they do not rise from 0 and 1 (the root)")
    if (sizes[1:] % 8).any():
        raise FileError("octree offsets: a level below the root is no multiple of 8 nodes")
    if (sizes[1:] > 8 * sizes[:-1]).any() or sizes.max() > int(LINK) + 1:
        raise FileError("octree offsets: a level has more nodes than the one above allows")


def _beyond(level: Level, shape: tuple[int, int, int]) -> np.ndarray:
    """(N,) bool: nodes that reach beyond the shape; codes of one axis compare as its cells do."""
    axis = spread_bits(np.array([(1 << 21) - 1]))[0]  # the bits of x in a code
    beyond = np.zeros(len(level.codes), bool)
    for a in range(3):
        first = spread_bits(np.array([shape[a] // level.side]))[0]  # first cell not wholly within
        beyond |= (level.codes & (axis << np.uint64(a))) >= (first << np.uint64(a))
    return beyond


def voxels_within(bricks: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """(N, 3) brick cells to (N,) masks of the voxels that lie within the shape."""
    bits = np.uint64(1) << np.arange(BRICK_SIDE**3, dtype=np.uint64)
    within = np.full(len(bricks), ~np.uint64(0))
    for a in range(3):
        masks = np.array(
            [bits[BRICK_VOXELS[:, a] < n].sum(dtype=np.uint64) for n in range(BRICK_SIDE + 1)],
            np.uint64,
        )
        within &= masks[np.clip(shape[a] - BRICK_SIDE * bricks[:, a], 0, BRICK_SIDE)]
    return within


def unpack_bricks(bricks: np.ndarray) -> np.ndarray:
    """(M,) uint64 masks to (M, 4, 4, 4) bool, indexed [brick, x, y, z]."""
    bits = np.unpackbits(
        np.ascontiguousarray(bricks, BRICK).view(np.uint8), bitorder="little"
    ).reshape(-1, 64)
    x, y, z = BRICK_VOXELS.T
    dense = np.empty((len(bricks), BRICK_SIDE, BRICK_SIDE, BRICK_SIDE), bool)
    dense[:, x, y, z] = bits
    return dense
