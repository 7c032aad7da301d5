"""Plans of voxelization, computed from the numbers of a survey before anything runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

from voxtool.errors import MemoryLimitError, count_of, human
from voxtool.grid import FIXED_POINT_BITS
from voxtool.job import Cost, Plan
from voxtool.svo.octree.layout import BRICK_BYTES, BRICK_SIDE, MAX_LINK, NODE_BYTES
from voxtool.svo.voxelization.connected.about import CONNECTED, RULE

LINK_BYTES = 10  # bytes of a node whose flips are propagated: its neighbours along x, and its flips
CELL = 2 * BRICK_SIDE  # voxels along a side of a level-1 node
NODE_BLOCK = 64  # voxels along a side of a block of level-1 nodes
NARROW_EXTENT = 4096  # voxels up to which a triangle's predicates fit 64 bits
CODE_32_SIDE = 8192  # voxels up to which level-1 Morton codes fit 32 bits
REGION = 8 * NODE_BLOCK  # voxels along a side of a region of blocks
DENSE_SIDE = 2048  # voxels up to which the level-1 volume is dense, and eight times as many up to
# which the set of its blocks is
CROWD = 1024  # leaves of caps near a voxel that winding numbers are summed over; at larger
# reaches more, by their squares
MOST_LEFT = 0.5  # share of nodes near holes without an answer up to which their bricks are expanded
FLOOD_BYTES = 176  # bytes of a brick in the graph of free space that a flood unites
FLOOD_BLOCK = 64  # voxels along a side of the blocks of which slabs consist, at least
COLUMN_TILE = 64  # columns along a side of a work-item's share of a triangle

# Fields that are given.
REQUEST = (
    "mode", "fill", "gap", "holes", "caps", "flooded", "choice", "inside", "checked", "connected",
    "bits",
)  # fmt: skip
COMPARISON = "comparison of fill rules"  # a stage


@dataclass(frozen=True)
class Survey:
    """The numbers of a mesh on a grid from which a plan is made."""

    triangles: int  # caps of holes included
    vertices: int
    outside: int  # triangles that neither touch the grid nor cross its rows
    extent: float  # longest side of the bounding box of any triangle, in voxels
    areas: tuple[float, float, float]  # sums of areas projected along x, y, z, in voxel^2
    before: bool  # True if a triangle reaches beyond the low-x side of the grid


@dataclass(frozen=True)
class VoxelizePlan(Plan):
    """The decisions on how a mesh is voxelized."""

    survey: Survey
    shape: tuple[int, int, int]
    side: int  # voxels along a side of the octree's cube
    mode: str
    fill: str  # rule that decides what is inside; "none" for a surface
    gap: int  # a flood closes openings of up to this many voxels
    surface: str  # separability of the surface that is voxelized: "26", "6", or "" for no surface
    holes: int  # counted for fill "winding" only
    caps: int  # triangles that close the holes
    wide: bool  # predicates use 128 bits
    code_bits: int  # of a Morton code
    blocked: bool  # the level-1 volume is stored in blocks
    regions: bool  # and only its active regions have blocks
    entry: bool  # rows have a state where they enter the grid
    tiled: bool  # a triangle's voxels are divided among work-items
    tiled_nodes: bool  # a triangle's level-1 nodes are divided among work-items
    active: tuple[int, ...]  # predicted refined nodes by level, from level 1 up
    flooded: tuple[int, int, int] | None = None  # shape of the grid that is flooded
    choice: str = ""  # why the rule was chosen, if rules were compared
    inside: tuple[tuple[str, Any], ...] = ()  # what was found of the parts, by name, to be stored
    checked: bool = False  # whether parts overlap is found out as it runs
    connected: bool = False  # thin parts stay in one piece
    slabs: int = 1  # in which it is flooded, one after the other
    bits: int = FIXED_POINT_BITS  # a voxel is 2**bits units of the lattice
    seeds: int = 0  # nodes that are refined at the faces of a window that is flooded
    column_tile: int = COLUMN_TILE  # columns along a side of a work-item's share of a triangle
    crowd: int = CROWD  # leaves of caps that may be near a voxel
    most_left: float = MOST_LEFT
    propagation: str = "rows"  # how flips spread: "rows" are walked, or by "levels"
    morton: str = "bits"  # how triangles' boxes are encoded: by "bits", or by "table"
    addressing: str = "ranks"  # how a voxel's node is found: by "ranks", "descent", or "jumps"
    overlap: str = "intervals"  # boxes tested: "base", all of a bounding box, or depth "intervals"
    plane_tiles: bool = False  # tiles of 4 x 4 columns are tested before their columns

    @property
    def solid(self) -> bool:
        return self.fill != "none"

    @property
    def rule(self) -> str:
        """The fill rule with its gap, as stored in the octree."""
        return f"{self.fill}+gap{self.gap}" if self.gap else self.fill

    @property
    def listed(self) -> bool:
        """True if crossings are listed with their directions."""
        return self.fill in ("nonzero", "winding")

    @property
    def by_rows(self) -> bool:
        """True if flips of rows along x decide what is inside."""
        return self.fill not in ("none", "flood")

    @property
    def connects(self) -> bool:
        """True if voxels may be added to connect thin parts; a flood has all that could be."""
        return self.connected and self.fill != "flood"

    @property
    def descends(self) -> bool:
        """True if a voxel's node is found in the octree, which a flood does not have yet."""
        return self.addressing != "ranks" and self.fill != "flood"

    @property
    def stages(self) -> list[str]:
        stages = {
            COMPARISON: self.choice != "",
            "survey": True,
            "active nodes": True,
            "holes": self.caps > 0,
            "near holes": self.caps > 0,
            "octree": self.fill != "flood",
            "crossings": self.by_rows,
            "levels": self.by_rows and self.propagation == "levels",
            "rows": self.by_rows and self.propagation == "rows",
            "fill": self.by_rows and self.propagation == "rows",
            f"surface{self.surface}": self.surface != "",
            "flood": self.fill == "flood",
            "read back": self.fill != "flood",
            "connect": self.connects,
        }
        return [stage for stage, runs in stages.items() if runs]

    @property
    def nodes(self) -> int:
        """Predicted number of nodes."""
        return 1 + 8 * sum(self.active)

    @property
    def bricks(self) -> int:
        """Predicted number of bricks."""
        return 8 * self.active[0]

    @property
    def cost(self) -> Cost:
        """The predicted bytes: at peak on the device, and of the octree on the host."""
        if self.flooded:
            return self._flood_cost(self.flooded)
        survey, finest = self.survey, self.active[0]
        nodes, bricks = NODE_BYTES * self.nodes, BRICK_BYTES * self.bricks
        mesh = 12 * (survey.vertices + survey.triangles)
        shares = 4 * survey.triangles * (self.tiled or self.tiled_nodes)
        lists = sum(self.active) * (self.code_bits // 8 + 4)
        rows = 8 * finest + 4 * (self.nodes - self.bricks) if self.solid else 0
        if self.propagation == "levels":
            rows += LINK_BYTES * self.nodes + bricks
        if self.entry:
            rows += 8 * -(-self.shape[1] // CELL) * -(-self.shape[2] // CELL)
        added = (bricks + 4 * finest) * (self.solid and (bool(self.surface) or self.connects))
        crossings = 0
        if self.listed:  # sorting copies them from one array to another
            crossings = 2 * 8 * round(survey.areas[0]) + 4 * survey.triangles
        levels = shares + self._volume_bytes + lists
        return Cost(
            device=mesh + levels + rows + crossings + added + nodes + bricks,
            host=nodes + bricks,
            largest=max(
                12 * survey.vertices, 12 * survey.triangles, nodes, bricks, self._volume_bytes // 2
            ),
        )

    def _flood_cost(self, grid: tuple[int, int, int]) -> Cost:
        """Return the predicted bytes of flooding a grid: of its largest slab, beside the mesh."""
        block, steps = flood_block(max(grid), self.gap), flood_steps(self.gap)
        slab = -(-grid[2] // (block * self.slabs)) * block + 2 * (block + steps)
        share = min(slab / grid[2], 1.0) if self.slabs > 1 else 1.0
        active = _predict_active(self.survey, grid, 1 << (max(grid) - 1).bit_length(), True)
        widened = 1 + 2 * steps / CELL  # a surface meets as many more nodes once it is dilated
        bricks = round(8 * active[0] * share * widened) + 8 * self.seeds
        mesh = 12 * (self.survey.vertices + self.survey.triangles)
        return Cost(
            device=mesh + self._volume_bytes + FLOOD_BYTES * bricks,
            host=NODE_BYTES * self.nodes + BRICK_BYTES * self.bricks,
            largest=max(mesh, self._volume_bytes // 2, 8 * BRICK_BYTES * bricks),
        )

    def in_slabs(self, max_memory: int, max_allocation: int) -> VoxelizePlan:
        """Return the plan with as few slabs as fit in memory, or with as many as there can be."""
        if not self.flooded:
            return self
        most = -(-self.flooded[2] // flood_block(max(self.flooded), self.gap))
        plan = self
        while not plan.fits(max_memory, max_allocation) and plan.slabs < most:
            plan = replace(plan, slabs=min(2 * plan.slabs, most))
        return plan

    @property
    def _volume_bytes(self) -> int:
        """Bytes of the level-1 volume: its words, and as many ranks."""
        if not self.blocked:
            return _dense_bytes(self.side, CELL)
        blocks, regions = (self.active[i] if len(self.active) > i else 1 for i in (3, 6))
        above = _dense_bytes(self.side, REGION if self.regions else NODE_BLOCK)
        return above + (blocks + regions * self.regions) * (16 * 4 * 2 + 8)

    @property
    def work(self) -> int:
        """Predicted number of voxels and crossings visited; it bounds the time."""
        ax, ay, az = self.survey.areas
        voxels = {"": 0.0, "6": max(ax, ay, az), "26": ax + ay + az}[self.surface]
        return round(voxels + (ax if self.solid else 0)) + self.survey.triangles

    @property
    def reasons(self) -> dict[str, str]:
        extent = f"the largest triangle spans {self.survey.extent:.1f} voxels"
        narrow = f"{extent}; 64 bits suffice up to {NARROW_EXTENT}"
        codes = f"the octree's side is {self.side}; 32 bits suffice up to {CODE_32_SIDE}"
        dense = f"a dense one takes {_dense_bytes(self.side, CELL):,} bytes"
        whole = "the outside is flooded" if self.solid else "the mode is a surface"
        before = "no triangle reaches beyond the low-x side"
        alone = "" if self.surface or self.connected else "the mode is solid, without its surface"
        thick = "a flood holds every voxel that touches the mesh"
        holes = "the rule counts crossings, also near holes"
        if self.fill == "winding":
            holes = "no edge bounds a hole: integers decide every voxel"
        return {
            "128-bit predicates": "" if self.wide else narrow,
            "64-bit Morton codes": codes if self.code_bits == 32 else "",
            "blocked level-1 volume": "" if self.blocked else dense,
            "sharing of triangles among work-items": "" if self.tiled else extent,
            "crossings, rows and fill": "" if self.by_rows else whole,
            "state of rows on entry": before if self.by_rows and not self.entry else "",
            "surface voxels": alone,
            "connecting of thin parts": thick if self.connected and not self.connects else "",
            "winding numbers near holes": holes if self.listed and not self.caps else "",
            "directions of crossings": "parity does not need them" if self.fill == "parity" else "",
        }

    def scene(self) -> dict[str, Any]:
        """The part of the plan that is stored in the octree, in JSON types."""
        return {
            "fill": self.rule,
            **({"choice": self.choice} if self.choice else {}),
            **({"inside": dict(self.inside)} if self.inside else {}),
            **({"holes": self.holes, "cap_triangles": self.caps} if self.fill == "winding" else {}),
            **({CONNECTED: True} if self.connects else {}),
            "triangles": self.survey.triangles - self.caps,
            "triangles_outside": self.survey.outside,
            "largest_extent_voxels": self.survey.extent,
            "stages": self.stages,
            "left_out": self.left_out,
            "predicted_nodes": self.nodes,
            "predicted_bricks": self.bricks,
        }

    def as_dict(self) -> dict[str, Any]:
        return {
            "shape": list(self.shape),
            **self.scene(),
            "predicted_octree_bytes": self.cost.host,
            "predicted_device_bytes": self.cost.device,
            "predicted_work": self.work,
        }

    def rows(self) -> list[tuple[str, str]]:
        spans = f"the largest spans {self.survey.extent:.1f} voxels"
        counts = f"{self.survey.triangles - self.caps:,} triangles, {self.survey.outside:,} outside"
        levels = (self.side // BRICK_SIDE).bit_length()
        rows = [
            ("grid", f"{' x '.join(map(str, self.shape))} voxels, octree of {levels} levels"),
            ("scene", f"{counts}; {spans}"),
        ]
        if self.fill == "winding":
            caps = count_of(self.caps, "cap triangle")
            rows.append(("fill", f"winding; {count_of(self.holes, 'hole')}, {caps}"))
        elif self.solid:
            slabs = f"; in {self.slabs} slabs, as memory allows" if self.slabs > 1 else ""
            rows.append(("fill", self.rule + slabs))
        if self.choice:
            rows.append(("chosen", self.choice))
        if self.connects:
            rows.append((CONNECTED, RULE))
        size = human(self.cost.host)
        rows.append(("octree", f"about {self.bricks:,} bricks, {self.nodes:,} nodes, {size}"))
        rows.append(("work", f"about {self.work:,} voxels and crossings visited"))
        return rows

    def fits(self, max_memory: int, max_allocation: int, cost: Cost | None = None) -> bool:
        """Return True if the work fits in memory and the nodes fit 30-bit links; `cost` may be that
        of more than the octree."""
        cost = cost or self.cost
        return not cost.shortage(max_memory, max_allocation) and self.nodes < MAX_LINK

    def refuse_beyond(
        self,
        max_memory: int,
        max_allocation: int,
        cost_of: Callable[[VoxelizePlan], Cost] = attrgetter("cost"),
    ) -> None:
        """Raise MemoryLimitError, which names the largest dim that fits, if the work needs more
        than max_memory bytes on the device, or max_allocation bytes in one buffer; `cost_of` is the
        cost of a plan with all that follows from it."""
        if self.fits(max_memory, max_allocation, cost_of(self)):
            return
        dim = max(self.shape)
        low, high = CELL - 1, dim  # low fits, or is below the least dim
        while high - low > 1:
            middle = (low + high) // 2
            plan = _rescale(self, middle / dim).in_slabs(max_memory, max_allocation)
            if plan.fits(max_memory, max_allocation, cost_of(plan)):
                low = middle
            else:
                high = middle
        hint = f"dim {low} is the largest that fits" if low >= CELL else "no dim fits"
        cost = cost_of(self)
        raise MemoryLimitError(
            f"dim {dim} would need {human(cost.device)} of memory ({human(cost.largest)} in one "
            f"buffer), of {human(max_memory)} ({human(max_allocation)}) allowed: {hint} (see "
            "--max-memory)"
        )


def plan_of(survey: Survey, shape: tuple[int, int, int], **request: Any) -> VoxelizePlan:
    """Return the plan for a surveyed mesh on a grid of the given shape, and its fields REQUEST."""
    mode, fill = request["mode"], request["fill"]
    solid = fill != "none"
    side = 1 << (max(shape) - 1).bit_length()
    return VoxelizePlan(
        survey=survey,
        shape=shape,
        side=side,
        **request,
        surface="6" if mode == "surface6" else "26" * ("26" in mode or fill == "flood"),
        wide=survey.extent > NARROW_EXTENT or request.get("bits", 0) > FIXED_POINT_BITS,
        code_bits=32 if side <= CODE_32_SIDE else 64,
        blocked=side > DENSE_SIDE,
        regions=side > DENSE_SIDE * NODE_BLOCK // CELL,
        entry=solid and survey.before,
        tiled=survey.extent > COLUMN_TILE - 3,
        tiled_nodes=survey.extent > (COLUMN_TILE - 3) * CELL,
        active=_predict_active(survey, shape, side, solid),
    )


def flood_steps(gap: int) -> int:
    """Return the steps that a flood stays away from the surface, to close openings of `gap`
    voxels."""
    return -(-gap // 2)


def flood_block(dim: int, gap: int) -> int:
    """Return the voxels along a side of the blocks of which slabs consist. They are wider than what
    a surface beyond a slab's neighbouring block can change, and not too many."""
    least = max(FLOOD_BLOCK, 2 * (flood_steps(gap) + 2 * CELL), dim // 64)
    return 1 << (least - 1).bit_length()


def _predict_active(
    survey: Survey, shape: tuple[int, int, int], side: int, solid: bool
) -> tuple[int, ...]:
    """Predict the refined nodes of each level: on a lattice of spacing c, a plane patch of area A
    and normal n meets A (|nx| w + |ny| h + |nz| d) / c^3 boxes of size w x h x d."""
    if survey.triangles == survey.outside:
        return (0,) * ((side // CELL).bit_length())
    ax, ay, az = survey.areas
    counts = []
    cell = CELL
    while cell <= side:
        widened = cell + 1 if solid else cell
        expected = (ax * widened + ay * cell + az * cell) / cell**3
        most = math.prod(-(-n // cell) for n in shape)
        counts.append(int(min(max(round(expected), 1), most)))
        cell *= 2
    return tuple(counts)


def _dense_bytes(side: int, cell: int) -> int:
    """Return the bytes of a set of the cells of a grid: its words, and as many ranks."""
    return 2 * 4 * max((side // cell) ** 3 // 32, 1)


def _rescale(plan: VoxelizePlan, factor: float) -> VoxelizePlan:
    """Return the plan of the same scene at another dim."""
    s = plan.survey
    ax, ay, az = (a * factor**2 for a in s.areas)
    survey = replace(s, extent=s.extent * factor, areas=(ax, ay, az))
    request = {name: getattr(plan, name) for name in REQUEST}
    if plan.flooded:
        nx, ny, nz = (max(round(n * factor), 1) for n in plan.flooded)
        request["flooded"] = nx, ny, nz
    nx, ny, nz = (max(round(n * factor), 1) for n in plan.shape)
    return plan_of(survey, (nx, ny, nz), **request)
