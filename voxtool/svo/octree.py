"""The sparse voxel octree: the data.

Level 0 nodes are bricks of 4 x 4 x 4 voxels; a node of level L spans 4 * 2**L voxels a side, and
the root spans the grid's cube. A node has no child or eight. The nodes of a level are contiguous
and in Morton order (x in the lowest bit), so a child index is a multiple of 8. Levels are stored
from the root down in one flat array, and links count from the start of their level; level 0 node i
owns brick i. layout.py gives the bits of nodes and bricks.

The structure is that of [voCCeL], figures 3.5 and 5.1.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.arrays import equal, read_only
from voxtool.choices import MODES
from voxtool.errors import GridError, VoxtoolError, human
from voxtool.grid import Grid
from voxtool.memory import check_memory
from voxtool.morton import morton_decode
from voxtool.svo.layout import (
    BRICK,
    BRICK_SIDE,
    INSIDE,
    NODE,
    VALID,
    pack_array,
    pack_voxels,
    unpack_bricks,
)
from voxtool.svo.prune import octree_of_bricks
from voxtool.svo.validate import check_sizes, check_structure

if TYPE_CHECKING:
    from collections.abc import Sequence

OCTREE_MODES = (*MODES, "solid+surface26")


@dataclass(frozen=True)
class Level:
    """The nodes of one level, in Morton order.

    Attributes
    ----------
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


@dataclass(frozen=True, eq=False, repr=False)
class Octree:
    """A set of voxels of a grid.

    Octrees are equal where their digests are: same grid, mode, fill and nodes, whatever their plan
    and source. They are hashed by identity, so that the device can keep data for one of them.

    Parameters
    ----------
    grid : where the voxels lie.
    mode : "surface26", "surface6", "solid" or "solid+surface26".
    fill : rule that decided what is inside: "parity", "nonzero", "winding", "flood", "flood+gapN";
        "none" for surfaces and for voxels that were given.
    offsets : (depth + 1,) uint32: where each level begins, root first; the last is the node count.
    nodes : (N,) NODE.
    bricks : (M,) uint64, one for each level 0 node.
    plan : what the plan said of the scene: JSON types only.
    source_sha256 : hex digest of the bytes that the mesh was read from, or "".
    units : name of the world unit if known, or "".

    Raises
    ------
    VoxtoolError : the mode is unknown, or an array is of another type.
    FileError : the sizes of the arrays do not fit the grid or each other.
    """

    grid: Grid
    mode: str
    fill: str
    offsets: np.ndarray
    nodes: np.ndarray
    bricks: np.ndarray
    plan: dict[str, Any] = field(default_factory=dict, compare=False)
    source_sha256: str = field(default="", compare=False)
    units: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if self.mode not in OCTREE_MODES:
            raise VoxtoolError(
                f"octree mode {self.mode!r} is unknown: choose one of {', '.join(OCTREE_MODES)}"
            )
        for name, dtype in (("offsets", np.dtype("<u4")), ("nodes", NODE), ("bricks", BRICK)):
            array = getattr(self, name)
            if not isinstance(array, np.ndarray) or array.dtype != dtype or array.ndim != 1:
                raise VoxtoolError(f"octree {name}: give a one-dimensional array of {dtype}")
            object.__setattr__(self, name, read_only(array))
        check_sizes(self)

    @classmethod
    def from_dense(
        cls,
        array: Any,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        pitch: Sequence[float] | float = 1.0,
        *,
        mode: str = "solid",
        units: str = "",
    ) -> Octree:
        """The octree of a dense array, with fill "none".

        Parameters
        ----------
        array : (nx, ny, nz), indexed [x, y, z]; voxels that are not zero are set.
        origin : world coordinates of the low corner of voxel (0, 0, 0).
        pitch : world size of a voxel, or one for each axis.
        mode : "solid": nodes whose voxels are all alike are leaves. "surface26" or "surface6":
            all nodes that hold a voxel are refined, as for a surface.
        units : name of the world unit.

        Raises
        ------
        GridError : the array has not three axes, or a number is out of a grid's range.
        """
        dense = np.asarray(array)
        if dense.ndim != 3:
            raise GridError(f"array of shape {dense.shape}: give one with three axes, x, y and z")
        grid = Grid(dense.shape, origin, pitch)  # pyright: ignore[reportArgumentType]
        arrays = octree_of_bricks(grid.side, *pack_array(dense != 0), collapse="solid" in mode)
        return cls(grid, mode, "none", *arrays, units=units)

    @classmethod
    def from_voxels(
        cls, indices: Any, grid: Grid, *, mode: str = "solid", units: str = ""
    ) -> Octree:
        """The octree of a list of voxels, with fill "none"; no dense array is made.

        Parameters
        ----------
        indices : (N, 3) whole numbers x, y, z, in any order; repeated ones count once.
        mode, units : as in from_dense.

        Raises
        ------
        GridError : an index is not in the grid, or no whole number.
        """
        voxels = np.asarray(indices)
        if voxels.size == 0:
            voxels = np.empty((0, 3), np.int64)
        if voxels.ndim != 2 or voxels.shape[1] != 3 or voxels.dtype.kind not in "iu":
            raise GridError(
                f"voxels of shape {voxels.shape} and type {voxels.dtype}: give (N, 3) whole numbers"
            )
        beyond = ((voxels < 0) | (voxels >= grid.shape)).any(axis=1)
        if beyond.any():
            raise GridError(
                f"voxel {tuple(voxels[np.argmax(beyond)].tolist())} is not in the grid of "
                f"{' x '.join(map(str, grid.shape))}"
            )
        arrays = octree_of_bricks(grid.side, *pack_voxels(voxels), collapse="solid" in mode)
        return cls(grid, mode, "none", *arrays, units=units)

    def __eq__(self, other: object) -> bool:
        return equal(self, other)

    __hash__ = object.__hash__

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.grid.shape))
        rule = "" if self.fill == "none" else f" by {self.fill}"
        return f"<Octree {shape}, {self.mode}{rule}, {self.count:,} voxels, {human(self.nbytes)}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return Octree, tuple(getattr(self, f.name) for f in fields(self))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("an octree is no array: a dense copy is needed")
        return self.to_dense().astype(dtype or bool, copy=False)

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
        """Counts and sizes in JSON types; lengths in world units, volumes in their cubes.

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
        """The voxels as a dense array; `np.asarray(octree)` is the same.

        Returns
        -------
        (nx, ny, nz) bool, indexed [x, y, z].

        Raises
        ------
        MemoryLimitError : the array does not fit in memory.
        """
        nx, ny, nz = self.grid.shape
        check_memory(nx * ny * nz, f"the {nx} x {ny} x {nz} bytes of a dense array")
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
        FileError : names the first invariant that does not hold, with its level and node.
        """
        check_structure(self)
