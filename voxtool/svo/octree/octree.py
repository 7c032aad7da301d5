"""The sparse voxel octree: the data.

Level 0 nodes are bricks of 4 x 4 x 4 voxels; a node of level L spans 4 * 2**L voxels a side, and
the root spans the grid's cube. A node has no child or eight children. The nodes of a level are
contiguous and in Morton order (x in the lowest bit), so a child index is a multiple of 8. Levels
are stored from the root down in one flat array, and links count from the start of their level;
level 0 node i owns brick i. layout.py gives the bits of nodes and bricks.

The structure is that of [voCCeL], figures 3.5 and 5.1.
"""

from __future__ import annotations

import contextlib
import operator
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.arrays import Data
from voxtool.choices import OCTREE_MODES
from voxtool.errors import GridError, VoxtoolError, human
from voxtool.grid import Grid
from voxtool.memory import check_memory
from voxtool.morton import morton_decode
from voxtool.svo.octree.attributes import KINDS, Attribute
from voxtool.svo.octree.content import AttributedContent, OctreeContent, StoredOctree
from voxtool.svo.octree.layout import (
    BRICK,
    BRICK_SIDE,
    INSIDE,
    NODE,
    VALID,
    descend,
    pack_array,
    pack_voxels,
    unpack_bricks,
)
from voxtool.svo.octree.links import level_states, nodes_of, offsets_of
from voxtool.svo.octree.validate import check_sizes

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from voxtool.opencl import Device

ARRAYS = ("offsets", "nodes", "bricks")
ALLOW = "allow more (see --max-memory), or voxelize at a smaller dim"
VOXEL = -2  # the level of voxels: a node of level n has 2**(n + 2) voxels along a side


@dataclass(frozen=True)
class Level:
    """The nodes of one level, in Morton order."""

    number: int  # 0 for the bricks
    side: int  # voxels along a side of a node
    nodes: np.ndarray  # (N,) NODE, a view of the octree's nodes
    codes: np.ndarray  # (N,) uint64 Morton codes of the nodes' cells

    @property
    def refined(self) -> np.ndarray:
        """(N,) bool: True for nodes that have children (at level 0, a brick)."""
        return (self.nodes["child"] & VALID) != 0

    @property
    def inside(self) -> np.ndarray:
        """(N,) bool: True for leaves that lie completely inside the solid."""
        return (self.nodes["child"] & INSIDE) != 0

    @property
    def cells(self) -> np.ndarray:
        """(N, 3) int64: low corners of the nodes, in voxels."""
        return morton_decode(self.codes) * self.side


class PointQueries:
    """Queries at points, of octrees with all nodes and of merged ones."""

    def contains(self, points: Any, *, device: Device | None = None) -> np.ndarray:
        """Return whether points lie in set voxels; see voxtool.query_svo.

        Parameters
        ----------
        points : (N, 3) or (3,) array_like
            World units; (3,) is one point.
        device : Device, optional
            Where to search; the default device if None.

        Returns
        -------
        (N,) bool
            A point on a plane between voxels is in the upper one; outside the grid False.

        Raises
        ------
        VoxtoolError
            If the shape is wrong, or a coordinate is NaN.
        """
        from voxtool.svo.queries.query import OctreeQuery  # which imports this module

        return OctreeQuery(self, device=device)(points).contains  # pyright: ignore[reportArgumentType]


@dataclass(frozen=True, eq=False, repr=False)
class Octree(PointQueries, AttributedContent, Data):
    """A set of voxels of a grid, which may have attributes.

    Two octrees are equal if they have one grid and set the same voxels, whatever their mode, fill
    and refinement: their set digests are equal. With attributes they are equal if nodes, bricks and
    attributes are. Octrees are hashed by identity, so that the device
    can keep data for one of them. `a | b`, `a & b`, `a - b` and `a ^ b` are octrees of the combined
    sets; see `voxtool.combine`.

    Parameters
    ----------
    grid : Grid
        The grid of the voxels.
    mode : {"surface26", "surface6", "solid", "solid+surface26", "solid+fraction"}
        The kind of voxel set.
    fill : str
        Rule that decided what is inside: "parity", "nonzero", "winding", "flood" or "flood+gapN";
        "none" for surfaces, for octrees made from arrays and for combinations.
    offsets : (depth + 1,) uint32
        Index of the first node of each level, root first, and the number of nodes.
    nodes : (N,) NODE
        Links and flags of the nodes.
    bricks : (M,) uint64
        Voxels of the level 0 nodes, as bit masks.
    plan : dict, optional
        The plan of the voxelization, in JSON types.
    source_sha256 : str, optional
        Hex digest of the bytes that the mesh was read from.
    units : str, optional
        Name of the world unit.
    transform : (4,) tuple of float, optional
        Scale and offset x, y, z of the normalized mesh it was made from: world coordinates are
        original * scale + offset.
    attributes : tuple of Attribute, optional
        What the set voxels are made of.

    Raises
    ------
    VoxtoolError
        If the mode is unknown or an array has the wrong type.
    FileError
        If the sizes of the arrays do not fit the grid or each other.
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
    transform: tuple[float, ...] = field(default=(), compare=False)
    attributes: tuple[Attribute, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        if self.mode not in OCTREE_MODES:
            raise VoxtoolError(
                f"octree mode {self.mode!r} is unknown: choose one of {', '.join(OCTREE_MODES)}"
            )
        for name, dtype in zip(ARRAYS, (np.dtype("<u4"), NODE, BRICK), strict=True):
            array = getattr(self, name)
            if not isinstance(array, np.ndarray) or array.dtype != dtype or array.ndim != 1:
                raise VoxtoolError(f"octree {name}: give a one-dimensional array of {dtype}")
        super().__post_init__()
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
        """Return the octree of a dense array, with fill "none".

        Parameters
        ----------
        array : (nx, ny, nz) array_like
            Voxels, indexed [x, y, z]; the nonzero ones are set.
        origin : (3,) sequence of float
            World coordinates of the low corner of voxel (0, 0, 0).
        pitch : float or (3,) sequence of float
            World size of a voxel.
        mode : str
            "solid" makes leaves of nodes whose voxels are all set; "surface26" and "surface6"
            refine every node that holds a voxel.
        units : str
            Name of the world unit.

        Returns
        -------
        Octree

        Raises
        ------
        GridError
            If the array does not have three axes, or a number is out of a grid's range.
        """
        dense = np.asarray(array)
        if dense.ndim != 3:
            raise GridError(f"array of shape {dense.shape}: give one with three axes, x, y and z")
        grid = Grid(dense.shape, origin, pitch)  # pyright: ignore[reportArgumentType]
        from voxtool.svo.octree.prune import octree_of_bricks

        arrays = octree_of_bricks(grid.side, *pack_array(dense != 0), collapse="solid" in mode)
        return cls(grid, mode, "none", *arrays, units=units)

    @classmethod
    def from_voxels(
        cls, indices: Any, grid: Grid, *, mode: str = "solid", units: str = ""
    ) -> Octree:
        """Return the octree of a list of voxels, with fill "none"; needs no dense array.

        Parameters
        ----------
        indices : (N, 3) array_like of int
            Voxels x, y, z in any order; repeated ones count once.
        grid : Grid
            The grid of the voxels.
        mode, units : str
            As in `from_dense`.

        Returns
        -------
        Octree

        Raises
        ------
        GridError
            If an index is not an integer or not in the grid.
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
        from voxtool.svo.octree.prune import octree_of_bricks

        arrays = octree_of_bricks(grid.side, *pack_voxels(voxels), collapse="solid" in mode)
        return cls(grid, mode, "none", *arrays, units=units)

    @classmethod
    def of_states(
        cls, grid: Grid, mode: str, fill: str, levels: Sequence[np.ndarray], bricks: np.ndarray
    ) -> Octree:
        """Return the octree of nodes with these states, by level from the root down to level 1."""
        offsets = offsets_of(levels, len(bricks)).astype(np.uint32)
        return cls(grid, mode, fill, offsets, np.concatenate(list(nodes_of(levels))), bricks)

    @classmethod
    def of_stored(
        cls,
        octree: StoredOctree,
        max_memory: int | None = None,
        names: Collection[str] = tuple(KINDS),
    ) -> Octree:
        """Return an octree of a file in memory, with the attributes in `names`; the values of
        others stay in the file. MemoryLimitError if memory is too small, or if with attributes the
        octree takes more than `max_memory` bytes."""
        check_memory(octree.nbytes, "the octree's arrays", "choose a smaller file")
        if taken := [one for one in octree.attributes if one.name in names]:
            needed = octree.nbytes + sum(one.nbytes for one in taken)
            listed = ", ".join(one.name for one in taken)
            what = f"the octree's arrays with its attribute{'s' * (len(taken) > 1)} {listed}"
            check_memory(needed, what, ALLOW, max_memory)
        values: dict[str, Any] = {item.name: getattr(octree, item.name) for item in fields(octree)}
        values |= {name: values[name][:] for name in ("nodes", "bricks")}
        attributes = (one.loaded() if one.name in names else one for one in octree.attributes)
        values["attributes"] = tuple(attributes)
        return cls(**values)

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.grid.shape))
        rule = "" if self.fill == "none" else f" by {self.fill}"
        return f"<Octree {shape}, {self.mode}{rule}, {self.count:,} voxels, {human(self.nbytes)}>"

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("an octree cannot become an array without a copy: drop copy=False")
        return self.to_dense().astype(dtype or bool, copy=False)

    def child_words(self, d: int) -> np.ndarray:
        """Return the `child` words of the nodes of a level, d levels below the root."""
        return self.nodes["child"][self.offsets[d] : self.offsets[d + 1]]

    def levels(self, finest: int = 0) -> list[Level]:
        """Return the levels down to number `finest`, root first."""
        found: list[Level] = []
        codes = np.zeros(1, np.uint64)
        for d in range(self.depth - finest):
            number = self.depth - 1 - d
            nodes = self.nodes[self.offsets[d] : self.offsets[d + 1]]
            found.append(level := Level(number, BRICK_SIDE << number, nodes, codes))
            if number > finest:
                codes = descend(codes[level.refined])
        return found

    def to_dense(self) -> np.ndarray:
        """Return the voxels as a dense array, as `np.asarray(octree)` does.

        Returns
        -------
        (nx, ny, nz) bool
            Voxels, indexed [x, y, z].

        Raises
        ------
        MemoryLimitError
            If the array does not fit in memory.
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
        """Return the set voxels as an (N, 3) int64 array, in lexicographic order."""
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

    def pruned(self) -> Octree:
        """Return the pruned octree of the same voxels, with mode "solid" and fill "none": it has a
        leaf wherever all voxels of a node are set, or none. A set has one pruned octree."""
        none = np.empty(0, np.uint64)  # no node stays refined by its code
        from voxtool.svo.octree.prune import prune

        arrays = prune(none, level_states(self.offsets, self.nodes), self.bricks, none)
        return Octree(self.grid, "solid", "none", *arrays, units=self.units)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Octree) or self.grid != other.grid:
            return False
        if self.attributes or other.attributes:
            return self._same_arrays(other) and self.attributes == other.attributes
        return self._same_arrays(other) or self.pruned()._same_arrays(other.pruned())

    __hash__ = Data.__hash__

    def _same_arrays(self, other: Octree) -> bool:
        pairs = ((getattr(self, name), getattr(other, name)) for name in ARRAYS)
        return all(np.array_equal(a, b) for a, b in pairs)

    def _combined(self, other: object, operation: str) -> Octree:
        from voxtool.svo.sets.booleans import combine  # which imports this module

        return combine([self, other], operation) if isinstance(other, Octree) else NotImplemented

    def __or__(self, other: object) -> Octree:
        return self._combined(other, "union")

    def __and__(self, other: object) -> Octree:
        return self._combined(other, "intersection")

    def __sub__(self, other: object) -> Octree:
        return self._combined(other, "difference")

    def __xor__(self, other: object) -> Octree:
        return self._combined(other, "xor")


def level_number(octree: OctreeContent, level: int | str, coarsest: int) -> int:
    """Return the number of a level up to the coarsest one, VOXEL for "voxel"; raise VoxtoolError if
    there is no such level."""
    if level == "voxel":
        return VOXEL
    with contextlib.suppress(TypeError):  # a numpy integer, too
        number = int(operator.index(level))  # pyright: ignore[reportArgumentType]
        if 0 <= number <= coarsest:
            return number
    raise VoxtoolError(
        f"level {level!r}: choose 'voxel' or a level from 0 to {coarsest}, those that an octree of "
        f"dim {octree.grid.dim} has"
    )


def in_memory(
    octree: Any, max_memory: int | None = None, names: Collection[str] = tuple(KINDS)
) -> Octree:
    """Return an octree of a file, or a merged one, with all its nodes in memory, and the attributes
    in `names`; the values of others stay in the file.

    Raises
    ------
    MemoryLimitError
        If it does not fit, or with attributes in `max_memory` bytes, or its nodes exceed links of
        30 bits.
    """
    if isinstance(octree, Octree):
        return octree
    if isinstance(octree, StoredOctree):
        return Octree.of_stored(octree, max_memory, names)
    return octree.expanded()
