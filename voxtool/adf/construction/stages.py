"""The stages of each level of a field under construction: sample, constrain, examine, refine.

The list of a cell contains the nearest triangle to every point of the cell. Children inherit the
part of the list that they need, so lists shrink with the cells, and no tree is searched. A triangle
is not needed where another point of the mesh is nearer to all corners of a cell (rivals.h). Sixteen
triangles are tested side by side in single precision, with a bound on the error; only those that it
leaves in doubt are tested in double precision. In a long list, a ball about sixteen triangles tells
whether they need a test (bundles.h).

Kernels: kernels/adf/construction/, a source for each stage.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from voxtool.adf.construction.plan import FieldPlan
from voxtool.adf.construction.survey import Survey
from voxtool.adf.field.cells import JUMP, bound_values
from voxtool.opencl import Array, program
from voxtool.opencl.builder import Request
from voxtool.opencl.primitives import exclusive_scan
from voxtool.spatial.bvh import TriangleTree

CROSSED = 64.0  # tolerances: the largest edge of a leaf where triangles pass, unless certain
BESIDE = 8  # edges from the mesh: nearer leaves along the medial axis are always refined
WALKERS = {"sample_blocks", "examine_children", "pass_lists_on"}  # kernels that walk whole lists
NARROWING = "adf/construction/narrow.cl"
NARROW = 16  # numbers of a triangle in single precision: a line of the cache
KEPT = 32  # triangles of a cell that are combined in pairs, at most
BUNDLE = 16  # triangles, the lanes of a vector of float32
FEW = 16  # triangles of a child, at most, whose list is not worth pruning
LONG = 128  # triangles of a block, from which on they are in bundles, and a few bound the errors
NO_TRIANGLE = OUT_OF_CUBE = 0xFFFFFFFF
COARSE = OUT_OF_CUBE - 1  # a neighbour that is a leaf, or lies within one
UNKNOWN, OUTSIDE, INSIDE = 0, 1, 2  # sides of the mesh
THIN_LEAF, LEFT_LEAF = 1, 2  # the mesh is thinner; the tolerance is out of reach, see _hopeless
OF_PARENTS = ["parent_values", "parent_states", "parent_neighbours"]

# ---- the points at which a cell is sampled

POINTS = 32  # in a row: 27, and the last one again
MIDDLE = 13  # of the vertices of a block
BLOCK = np.indices((3, 3, 3)).reshape(3, 27)[::-1]  # x, y, z of its vertices
OCTANTS = np.indices((2, 2, 2)).reshape(3, 8)[::-1]
# of a cell, in quarters: the middles of itself, its faces and its edges, and of its octants
_CENTRAL = (BLOCK == 1).sum(axis=0)  # 3 for the cell's, 2 for a face's, 1 for an edge's
SAMPLES = np.concatenate(
    [*(2 * BLOCK[:, central == _CENTRAL] for central in (3, 2, 1)), 2 * OCTANTS + 1], axis=1
)
# No point of a cell is further from a corner or sample than this, in edges: together they are a
# body-centred cubic lattice of half an edge.
SAMPLE_GAP = math.sqrt(5) / 8 * (1 + 2.0**-50)
HALF_DIAGONAL = math.sqrt(3) / 2 * (1 + 2.0**-50)


def _table(name: str, rows: np.ndarray, kind: str = "double", width: int = POINTS) -> str:
    """Return a constant table for kernels: they read vectors of eight, so rows are padded with
    their last number."""
    rows = np.pad(rows, ((0, 0), (0, width - rows.shape[1])), mode="edge")
    values = ", ".join(f"{value:g}" for value in rows.ravel().tolist())
    return f"__constant {kind} {name}[] = {{{values}}};"


def _weights() -> np.ndarray:
    """Return the weight of each corner at each sample in trilinear interpolation, (8, 27)."""
    near = np.where(OCTANTS.T[:, :, None] == 1, SAMPLES / 4, 1 - SAMPLES / 4)
    return near.prod(axis=1)


def _corners() -> np.ndarray:
    """Return the vertices of the block at the corners of each child, (8, 8)."""
    places = OCTANTS.T[:, None] + OCTANTS.T[None]
    return places[..., 0] + 3 * places[..., 1] + 9 * places[..., 2]


HEADERS = {
    "adf/construction/level.h": program.c_constants(
        BESIDE=BESIDE,
        FEW=FEW,
        LONG=LONG,
        JUMP=JUMP,
        KEPT=KEPT,
        NARROW=NARROW,
        NO_TRIANGLE=NO_TRIANGLE,
        OUT_OF_CUBE=OUT_OF_CUBE,
        COARSE=COARSE,
        UNKNOWN=UNKNOWN,
        OUTSIDE=OUTSIDE,
        INSIDE=INSIDE,
        THIN_LEAF=THIN_LEAF,
        LEFT_LEAF=LEFT_LEAF,
    ),
    "adf/construction/sample_points.h": "\n".join(
        [
            program.c_constants(POINTS=POINTS, MIDDLE=MIDDLE),
            f"#define HALF_DIAGONAL {HALF_DIAGONAL.hex()}",
            f"#define SAMPLE_GAP {SAMPLE_GAP.hex()}",
            _table("VERTICES", BLOCK),
            _table("MIDDLES", 2 * OCTANTS + 1),
            _table("CELL", OCTANTS),
            _table("SAMPLES", SAMPLES),
            _table("WEIGHTS", _weights()),
            _table("CORNERS", _corners(), "uint", width=8),
        ]
    ),
}


# ---- levels


@dataclass
class Level:
    """Refined cells of a level that follow one another along the Morton curve, on the device; the
    root has level 0.

    arrays : by the names of the kernels' parameters, as far as the stages have computed them:
        identifiers : uint64, rising.
        sources : uint32, which child of the cells whose arrays are OF_PARENTS each cell is.
        begins : uint32 for each cell, where its list begins in `items`.
        items : uint32, the triangles of all lists.
        masks : uint8 for each item, a bit for each child that needs it.
        needed : uint32 for each child, the number of items that it needs.
        values : float64, 27 for each cell, the distances of its block, in the frame.
        centres : float64, 8 for each cell, the distances at the centres of its children.
        places : uint32, 27 for each cell, the nearest triangles, as indices of `items`.
        sided : uint32, 27 for each cell, the nearest triangles that have an area, where some have
            none.
        states : uint8 for each cell, its side of the mesh.
        doubts : uint32 for each cell, the vertices of its block whose signs are unknown.
        asked : uint32 for each cell, the vertices whose winding numbers are computed.
        neighbours : uint32, 27 a cell, see find_neighbours.
        strays : float32, 27 a cell, the changes of its vertices by constraining.
        ranks : uint32, a child: whether it is refined, then the number of refined children before
            it.
        parent_ranks : the same of the whole level above; OF_PARENTS : arrays of those cells of it
            whose children these are.
    """

    number: int
    count: int
    arrays: dict[str, Array]

    def allocate(self, **arrays: tuple[int, type]) -> None:
        """Add arrays of undefined content, given the numbers a cell and their type."""
        device = self.arrays["items"].device
        for name, (width, dtype) in arrays.items():
            self.arrays[name] = device.empty(width * self.count, dtype)


def programs(plan: FieldPlan) -> list[Request]:
    """Return the programs that the stages of the levels use, in order."""
    options = _options(plan)
    stages = ["sample", *["signs"] * (plan.sign != "none")]
    stages += [*["constrain"] * (plan.continuous and plan.max_level > 1), "examine"]
    stages += ["refine"] * (plan.max_level > 1)
    return [(NARROWING, {}), *((f"adf/construction/{stage}.cl", options) for stage in stages)]


def _options(plan: FieldPlan) -> dict[str, int | str]:
    signed = plan.sign != "none"
    options = {
        "SIGNED": signed,
        "WINDING": plan.sign == "winding",
        "CLOSED": plan.certain,
        "JUMPS": signed and not plan.certain,
        "FLAT": signed and plan.flat > 0,
    }
    return {name: 1 for name, on in options.items() if on}


class Construction:
    """The data that the stages of all levels share.

    arguments : the kernels', by name; options : the kernels'; steepest : uint32, the bits of the
    steepest slope of a leaf; unbalanced : uint32, whether a leaf has a neighbour that is coarser by
    two levels; kept : uint32, the hanging vertices that keep their distances.
    """

    def __init__(self, survey: Survey, plan: FieldPlan) -> None:
        self.survey, self.plan, self.device = survey, plan, survey.device
        self.steepest = self.device.zeros(1, np.uint32)
        self.unbalanced = self.device.zeros(1, np.uint32)
        self.kept = self.device.zeros(1, np.uint32)
        side = 2 * survey.extent
        self.arguments: dict[str, Any] = {
            **survey.arguments,
            **(survey.sides.arguments if plan.sign == "winding" else {}),
            "tolerance": plan.tolerance * side,
            "misplaced": survey.misplaced * side,
            "band": plan.band * side,
            "thorough": plan.max_bytes is not None,
            "guarantee": plan.guarantee,
            "bounds": self.device.put(bound_values()),
            "narrow": narrow_triangles(survey.tree),
            "steepest": self.steepest,
            "unbalanced": self.unbalanced,
            "kept": self.kept,
        }
        self.options = _options(plan)

    def run(self, stage: str, kernel: str, level: Level, size: int = 0, **more: Any) -> None:
        """Run a kernel of kernels/adf/construction/ for each cell of a level, or with `size`
        work-items;
        `more` replaces arguments of the construction and the level."""
        launch = self.device.kernel(f"adf/construction/{stage}.cl", kernel, **self.options)
        arguments = {**self.arguments, **level.arrays, "level": level.number, **more}
        alone = kernel in WALKERS and self.device.lanes > 1  # a core for each of few long lists
        launch(size or level.count, **arguments, local=1 if alone else 64)

    def ask(
        self, stage: str, kernel: str, level: Level, changed: Sequence[str] = (), **more: Any
    ) -> None:
        """Run a kernel that asks for the winding number beside faces, until all that it asks for
        are known; `changed` are the arguments of which it changes what it reads."""
        arrays, kept = {**level.arrays, "steepest": self.steepest}, {}
        asks = self.plan.sign == "winding" and self.survey.sides.is_partial
        if asks:
            kept = {name: arrays[name].get() for name in changed}
        self.run(stage, kernel, level, **more)
        while asks and self.survey.sides.find_wanted():
            for name, values in kept.items():
                self.device.write(arrays[name], values)
            self.run(stage, kernel, level, **more)

    def root(self) -> Level:
        """Return the root, whose list contains every triangle of the tree: duplicates, which are
        equally near everywhere, are not in it."""
        triangles = np.arange(self.survey.tree.count, dtype=np.uint32)
        arrays = {
            "identifiers": np.ones(1, np.uint64),
            "sources": np.zeros(1, np.uint32),
            "begins": np.array([0, len(triangles)], np.uint32),
            "items": triangles,
            "neighbours": np.array([*[OUT_OF_CUBE] * 13, 0, *[OUT_OF_CUBE] * 13], np.uint32),
            "parent_states": np.array([UNKNOWN], np.uint8),
        }
        return Level(0, 1, {name: self.device.put(values) for name, values in arrays.items()})


def windows_of(level: Level, size: float) -> Iterator[Level]:
    """Yield cells in parts of up to `size`: stages need of the others only the level above."""
    if level.count <= size:
        yield level
        return
    size = int(size)
    device, arrays = level.arrays["items"].device, level.arrays
    begins = arrays["begins"].get()
    for first in range(0, level.count, size):
        last = min(first + size, level.count)
        items = arrays["items"].get(int(begins[first]), int(begins[last]))
        own = {name: arrays[name].get(first, last) for name in ("identifiers", "sources")}
        own |= {"begins": begins[first : last + 1] - begins[first], "items": items}
        put = {name: device.put(values) for name, values in own.items()}
        yield Level(level.number, last - first, {**arrays, **put})


def narrow_triangles(tree: TriangleTree) -> Array:
    """Return the triangles of a tree in single precision, NARROW float32 a slot: most comparisons
    of distances need nothing else."""
    slots, device = tree.face_of.size, tree.leaves.device
    narrow = device.empty(slots * NARROW, np.float32)
    device.kernel(NARROWING, "narrow_triangles")(slots, tree.leaves, narrow)
    return narrow


def sample(work: Construction, level: Level) -> None:
    """Compute the distances of a level's blocks, their signs, and the triangles of each child."""
    device, winding = work.device, "WINDING" in work.options
    level.allocate(values=(27, np.float64), places=(27, np.uint32))
    if "FLAT" in work.options:
        level.allocate(sided=(27, np.uint32))
    level.allocate(centres=(8, np.float64), needed=(8, np.uint32))
    level.arrays["masks"] = device.empty(level.arrays["items"].size, np.uint8)
    with device.stage("sample"):
        work.run("sample", "sample_blocks", level, **_balls(level))
        if "SIGNED" in work.options:
            level.allocate(states=(1, np.uint8), doubts=(1, np.uint32), asked=(1, np.uint32))
            work.ask("signs", "sign_blocks", level, ("values",))
        for _ in ("middles of blocks", "vertices") if winding else ():
            settle_signs(work, level)


def _balls(level: Level) -> dict[str, Any]:
    """Return the kernel's arguments for the balls about bundles, see bundles.h."""
    items = level.arrays["items"]
    row = items.size // BUNDLE + level.count + BUNDLE  # bundles are loaded BUNDLE at a time
    return {"balls": items.device.empty(4 * row, np.float32), "row": row}


def settle_signs(work: Construction, level: Level) -> None:
    """Decide unknown signs by winding numbers, at the vertices in `asked`."""
    device = work.device
    begins = device.empty(level.count + 1, np.uint32)
    with device.stage("signs"):
        work.run("signs", "count_asked", level, counts=begins)
        total = exclusive_scan(begins, level.count)
        if total == 0:
            return
        points, vertices = device.empty(3 * total, np.float64), device.empty(total, np.uint64)
        work.run("signs", "list_asked", level, begins=begins, points=points, vertices=vertices)
        # blocks share most of their vertices: each is computed once
        _, first, again = np.unique(vertices.take(), return_index=True, return_inverse=True)
        numbers = device.zeros(total, np.float64)
        which = device.put(np.sort(first).astype(np.uint32))  # consecutive ones are near each other
        work.survey.winding.wind(len(first), points, which, numbers)
        numbers = device.put(numbers.take()[first][again])
        work.run("signs", "settle_signs", level, begins=begins, numbers=numbers)


def constrain(work: Construction, level: Level) -> None:
    """Set the values of vertices on a coarser leaf's faces and edges to its interpolation, so that
    the field has no cracks; those whose sign this would change stay."""
    if level.number == 0:
        return
    level.allocate(neighbours=(27, np.uint32), strays=(27, np.float32))
    edge = math.ldexp(2 * work.survey.extent, -level.number)
    with work.device.stage("constrain"):
        work.run("constrain", "find_neighbours", level)
        work.run("constrain", "constrain_blocks", level, edge=edge)


@dataclass
class Examined:
    """The children of a level's cells, on the host.

    voxels : (27 n,) float32, the blocks, in sides; refined : (8 n,) uint32, 1 or 0; errors : (8 n,)
    float32, in sides, -1 at a sign discontinuity; codes : (8 n,) uint8, of the bounds of leaves;
    kinds : (8 n,) uint8, THIN_LEAF or LEFT_LEAF in such leaves.
    """

    voxels: np.ndarray
    refined: np.ndarray
    errors: np.ndarray
    codes: np.ndarray
    kinds: np.ndarray


def examine(work: Construction, level: Level) -> Examined:
    """Return the errors of the children of a level's cells, and which of them are refined."""
    device, plan, n = work.device, work.plan, level.count
    voxels = device.empty(27 * n, np.float32)
    ranks = level.arrays["ranks"] = device.empty(8 * n + 1, np.uint32)
    errors = device.empty(8 * n, np.float32)
    codes, kinds = device.empty(8 * n, np.uint8), device.empty(8 * n, np.uint8)
    level.arrays.setdefault("strays", device.zeros(27 * n, np.float32))
    with device.stage("examine"):
        work.run("examine", "store_voxels", level, 27 * n, voxels=voxels)
        work.ask(
            "examine",
            "examine_children",
            level,
            ("masks", "needed", "steepest"),
            voxels=voxels,
            can_refine=level.number + 1 < plan.max_level,
            refine_coarse=0.5 ** (level.number + 1) > CROSSED * plan.tolerance,
            hopeless=2 * work.survey.extent * _hopeless(plan, level.number + 1),
            flags=ranks,
            errors=errors,
            codes=codes,
            kinds=kinds,
        )
    flags = ranks.get(0, 8 * n)
    return Examined(voxels.take(), flags, errors.take(), codes.take(), kinds.take())


def _hopeless(plan: FieldPlan, level: int) -> float:
    """Return the error, in sides, beyond which leaves of a level along the medial axis are left: it
    halves with the edge there, so those of the last level have about twice the tolerance. Leaves
    are refined in any case while the square of their edge is over the tolerance: where the distance
    is smooth, errors fall with the square of the edge, and such leaves reach the tolerance."""
    if plan.everywhere or 0.25**level > plan.tolerance:
        return math.inf
    return 2 * math.ldexp(plan.tolerance, plan.max_level - level)


def refine(work: Construction, level: Level, size: int) -> Level:
    """Return the refined children of a level's cells, at least one; their lists have `size`
    triangles."""
    device, n = work.device, level.count
    parents = {f"parent_{name}": array for name, array in level.arrays.items()}
    with device.stage("refine"):
        count = exclusive_scan(level.arrays["ranks"], 8 * n)
        finer = Level(level.number + 1, count, {**parents, "items": device.empty(size, np.uint32)})
        finer.allocate(identifiers=(1, np.uint64), sources=(1, np.uint32))
        finer.arrays["begins"] = device.empty(count + 1, np.uint32)
        work.run("refine", "list_refined", finer, 8 * n, counts=finer.arrays["begins"])
        exclusive_scan(finer.arrays["begins"], count)
        work.run("refine", "pass_lists_on", finer)
    for name in parents.keys() - OF_PARENTS:
        del finer.arrays[name]
    return finer


def ranks_of(flags: Sequence[np.ndarray]) -> np.ndarray:
    """Return the number of refined children before each child of a level, and of all, uint32, from
    the flags of its windows."""
    ranks = np.zeros(sum(map(len, flags)) + 1, np.uint32)
    np.cumsum(np.concatenate(flags), out=ranks[1:])
    return ranks
