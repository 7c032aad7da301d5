"""Parts of a mesh laid out side by side, so that one voxelization serves all of them.

Each part keeps its place within the smallest octree cell that holds its voxels. These cells, moved
to free places of a larger grid in Morton order, largest first, do not touch each other's voxels; a
move is by whole cells, so nodes of the large octree are nodes of the grid's with another prefix of
their codes. Parts that reach beyond the grid are not moved, as the grid cuts them off: each of them
has a voxelization of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from voxtool.choices import MAX_DIM, MIN_DIM
from voxtool.errors import MemoryLimitError
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import Mesh
from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.octree.layout import BRICK_SIDE
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.priority_union import Nodes
from voxtool.svo.voxelization.mesh_parts import PartMesh
from voxtool.svo.voxelization.voxelize import VoxelizeJob, plan_voxelize

CELL_BITS = 3  # bits of the least cell: a level-1 node


@dataclass(frozen=True)
class Atlas:
    """Cells of parts in a larger grid, in Morton order.

    side : voxels along a side of the grid
    parts : (n,) the part in each cell
    bits : (n,) a cell has 2**bits voxels a side
    starts, homes : (n,) uint64 codes of the level-1 nodes at which a cell begins, in the larger
        grid and in the parts' own
    """

    side: int
    parts: np.ndarray
    bits: np.ndarray
    starts: np.ndarray
    homes: np.ndarray

    @classmethod
    def of(cls, parts: np.ndarray, low: np.ndarray, high: np.ndarray) -> Atlas:
        """Return the atlas of parts whose voxels are from low to high, both (n, 3).

        Raises
        ------
        MemoryLimitError
            If a grid of MAX_DIM cannot hold them.
        """
        spans = np.frexp((low ^ high).max(axis=1).astype(np.float64))[1]  # bits of the difference
        bits = np.maximum(spans, CELL_BITS)
        order = np.argsort(-bits, kind="stable")
        bits, low = bits[order], low[order]
        sizes = np.uint64(1) << (3 * (bits - CELL_BITS)).astype(np.uint64)
        ends = np.cumsum(sizes)
        top = CELL_BITS + -(-(int(ends[-1]) - 1).bit_length() // 3) if len(ends) else CELL_BITS
        if 1 << top > MAX_DIM:
            raise MemoryLimitError(
                f"{len(parts):,} parts side by side need {1 << top} voxels a side, of {MAX_DIM}: "
                "choose a smaller dim, or label fewer parts"
            )
        homes = morton_encode((low >> bits[:, None]) << (bits - CELL_BITS)[:, None])
        return cls(max(1 << top, MIN_DIM), parts[order], bits, ends - sizes, homes)

    @property
    def grid(self) -> Grid:
        """The larger grid, whose unit is a voxel."""
        return Grid((self.side, self.side, self.side), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

    def mesh(self, fixed: np.ndarray, faces: np.ndarray, of: np.ndarray) -> Mesh:
        """Return the mesh of the parts at their places.

        Parameters
        ----------
        fixed : (V, 3) int32
            Vertices on the lattice of the parts' grid.
        faces : (F, 3) int32
            Faces, each with vertices of its part alone.
        of : (F,) int
            The part of each face; those of other parts are left out.
        """
        places = morton_decode(self.starts) - morton_decode(self.homes)
        moves = np.zeros((int(of.max(initial=-1)) + 1, 3), np.int64)
        held = np.zeros(len(moves), bool)
        moves[self.parts] = places << (CELL_BITS + FIXED_POINT_BITS)
        held[self.parts] = True
        kept = held[of]
        faces, of = faces[kept], of[kept]
        points = fixed.astype(np.int64)
        moved = np.zeros((len(points), 3), np.int64)
        moved[faces] = moves[of][:, None]
        return Mesh((points + moved) / (1 << FIXED_POINT_BITS), faces)

    def home_of(self, bricks: np.ndarray) -> np.ndarray:
        """Return the Morton codes of bricks of the larger grid, (n,) uint64, in the parts' own."""
        firsts, homes = (codes << np.uint64(CELL_BITS) for codes in (self.starts, self.homes))
        which = np.searchsorted(firsts, bricks, "right") - 1
        return bricks - firsts[which] + homes[which]

    def add_to(self, nodes: Nodes, octree: Octree, rank_of: np.ndarray) -> None:
        """Add the nodes of the parts' octree to nodes of the parts' own lattice, with the rank of
        each part."""
        for level in octree.levels():
            bits = level.number + BRICK_SIDE.bit_length() - 1
            up = 3 * (bits - CELL_BITS)  # from codes of level-1 nodes to those of this level
            firsts, homes = (_shifted(codes, up) for codes in (self.starts, self.homes))
            which = np.searchsorted(firsts, level.codes, "right") - 1
            inside = bits <= self.bits[which]
            if level.number:
                inside &= level.refined | level.inside
            if not inside.any():
                continue
            which = which[inside]
            codes = level.codes[inside] - firsts[which] + homes[which]
            ranks = rank_of[self.parts[which]].astype(np.uint32)
            order = np.argsort(codes, kind="stable")
            codes, ranks = codes[order], ranks[order]
            if level.number:
                states = (level.refined[inside][order], level.inside[inside][order])
                nodes.add(level.number, codes, ranks, *states)
            else:
                nodes.add_bricks(codes, ranks, octree.bricks[inside][order])


def _shifted(codes: np.ndarray, up: int) -> np.ndarray:
    return codes >> np.uint64(up) if up >= 0 else codes << np.uint64(-up)


def plan_parts(
    mesh: Mesh,
    own: PartMesh,
    grid: Grid,
    mode: str,
    fill: str,
    closed_fill: str,
    gap: int = 0,
    **request: Any,
) -> tuple[dict[int, str], Atlas | None, list[VoxelizeJob]]:
    """Return the parts of a mesh that are voxelized alone, with the reasons; where the others lie,
    which are closed; and the jobs, that of the others first if there are any. `request` as for
    plan_voxelize."""
    fixed = grid.to_fixed(own.points)
    alone = _alone(own, fixed, grid, fill if mode == "solid" else "none", gap)
    request["gap"] = gap
    jobs = []
    atlas = atlas_of(own, fixed, ~np.isin(own.parts, list(alone)), gap)
    if atlas:
        together = atlas.mesh(fixed, own.faces, own.of)
        jobs.append(plan_voxelize(together, atlas.grid, mode, fill=closed_fill, **request))
    jobs += [plan_voxelize(own.alone(part, mesh), grid, mode, fill=fill, **request)
             for part in alone]  # fmt: skip
    return alone, atlas, jobs


def atlas_of(own: PartMesh, fixed: np.ndarray, together: np.ndarray, gap: int) -> Atlas | None:
    """Return the atlas of some parts, given which of all; None of none."""
    if not together.any():
        return None
    low, high = (corner[together] for corner in voxels_of(own, fixed, gap))
    return Atlas.of(own.parts[together], low, high)


def voxels_of(own: PartMesh, fixed: np.ndarray, gap: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and last voxels, (n, 3) int64 each, that parts may set or make active: those
    that a box touches, and one more on each side; two and twice the gap more of a flood."""
    low, high = own.boxes(fixed)
    more = 1 + 2 * gap
    low = (low.astype(np.int64) - 1 >> FIXED_POINT_BITS) - more
    return low, (high.astype(np.int64) >> FIXED_POINT_BITS) + more


def _alone(own: PartMesh, fixed: np.ndarray, grid: Grid, fill: str, gap: int) -> dict[int, str]:
    """Return the parts that are voxelized alone, and why."""
    low, high = voxels_of(own, fixed, gap)
    beyond = ((low < 0) | (high >= grid.shape)).any(axis=1)
    alone = dict.fromkeys(own.parts[beyond].tolist(), "reaches to the side of the grid")
    if fill not in ("none", "flood"):  # rows that leak would run into other cells
        for part in own.parts[~own.closed()].tolist():
            alone.setdefault(part, "not closed: its holes take part in the fill")
    return dict(sorted(alone.items()))
