"""Triangle mesh to sparse voxel octree (the thesis, sections 3.2, 5.1 and 6.2, appendix A).

The stages, on the device (kernels/svo/voxelize.cl and inside.cl):

1. active nodes: the level-1 nodes (8 x 8 x 8 voxels) that a triangle touches, as a set of bits in
   Morton order; in large grids in blocks, found first.
2. octree: the levels above, bottom-up from shortened Morton codes.
3. voxels: a surface sets the voxels of its bricks; a solid flips the first voxel at or beyond each
   crossing of a row along x, and the rows' parity fills bricks and coarse leaves (inside.py).

That is parity. By nonzero and winding numbers only those crossings flip at which a row enters or
leaves the inside, and near holes voxels are decided one by one (winding.py); flood.py fills from
outside.

Where the thesis descends the octree to find a voxel's brick, the rank of its level-1 node among
the active ones gives it at once; where it links x-neighbours, rows walk the octree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from voxtool.choices import FILLS, MODES
from voxtool.errors import GridError, MemoryLimitError, VoxtoolError, count_of
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.job import Job
from voxtool.mesh.topology import check_topology, volume, watertight
from voxtool.opencl import Array, Device, default_device, program
from voxtool.opencl.primitives import exclusive_scan, radix_sort
from voxtool.svo.build import DeviceOctree, build_octree, code_name
from voxtool.svo.fill import parity as inside
from voxtool.svo.fill.caps import find_caps
from voxtool.svo.fill.flood import flood
from voxtool.svo.fill.winding import Crossings, NearHoles
from voxtool.svo.layout import BRICK
from voxtool.svo.octree import Octree
from voxtool.svo.plan import BLOCK, CELL, TILE, Survey, VoxelizePlan, plan_of
from voxtool.svo.prune import prune, states_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from voxtool.mesh.mesh import Mesh

SOURCE = "svo/voxelize.cl"
TOUCHED, SEPARATING, CROSSED = range(3)  # what a triangle is scan-converted into
NODE_LEVEL, BLOCK_LEVEL = CELL.bit_length() - 1, BLOCK.bit_length() - 1
BLOCK_WORDS = (BLOCK // CELL) ** 3 // 32
HALF_VOXEL = 1 << (FIXED_POINT_BITS - 1)
SURVEY_ITEMS = 256  # each sums its share of the triangles
HEADERS = {
    "svo/voxelize.h": program.c_constants(
        TOUCHED=TOUCHED,
        SEPARATING=SEPARATING,
        CROSSED=CROSSED,
        NODE_LEVEL=NODE_LEVEL,
        BLOCK=BLOCK,
    )
}


def voxelize(
    mesh: Mesh,
    grid: Grid,
    mode: str = "solid",
    *,
    fill: str = "auto",
    gap: int = 0,
    with_surface: bool = False,
    window: tuple[Sequence[int], Sequence[int]] | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> Octree:
    """The voxels of a triangle mesh, exactly, as a sparse voxel octree.

    Vertices are rounded once to 1/256 voxel; all that follows is integer arithmetic. Ties are
    decided as if voxel centres moved by (ex, ey, ez) with ex >> ey >> ez > 0, infinitely small.

    Parameters
    ----------
    mode : "surface26" (voxels whose closed cube touches a triangle), "surface6" (the thinner,
        6-separating set of section 3.2) or "solid" (voxels whose centre lies inside).
    fill : rule that tells inside from outside, for "solid". "parity": an odd number of crossings
        along x. "nonzero": as many that enter as leave do not cancel. "winding": the generalized
        winding number is 1/2 or more. "flood": the outside does not reach it through the voxels of
        "surface26"; these are inside. "auto": what suits the mesh (fill_for).
    gap : for "flood": openings of up to so many voxels are closed.
    with_surface : for "solid": set the voxels of "surface26", too.
    window : (low, shape) in voxels: voxelize this part of the grid only. The octree's grid is the
        window; the voxels are those of the whole.
    device : where to compute; the preferred device by default.
    max_memory : bytes that the device may use; what device and machine have by default.

    Returns
    -------
    Octree, the same bit for bit on every device.

    Raises
    ------
    GridError : a vertex lies more than 2**22 voxels from the grid's corner.
    MemoryLimitError : the octree would not fit; the message says which dim does.
    DeviceError : no usable device.
    """
    return plan_voxelize(
        mesh,
        grid,
        mode,
        fill=fill,
        gap=gap,
        with_surface=with_surface,
        window=window,
        device=device,
        max_memory=max_memory,
    ).run()


def plan_voxelize(
    mesh: Mesh,
    grid: Grid,
    mode: str = "solid",
    *,
    fill: str = "auto",
    gap: int = 0,
    with_surface: bool = False,
    window: tuple[Sequence[int], Sequence[int]] | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> VoxelizeJob:
    """The job that `voxelize` runs with the same arguments: the mesh is on the device, surveyed,
    and the fill rule is chosen."""
    job = VoxelizeJob(mesh, grid, device or default_device())
    job.max_memory = max_memory
    job.prepare(mode, fill, gap, with_surface, window)
    return job


def fill_for(closed: bool) -> str:
    """What suits a mesh: "parity" if it is closed and consistently wound, or else "winding"."""
    return "parity" if closed else "winding"


_watertight: WeakKeyDictionary[Mesh, bool] = WeakKeyDictionary()


def _voxelize(scene: VoxelizeJob) -> Octree:
    device = scene.device
    limit = device.max_memory if scene.max_memory is None else scene.max_memory
    holes = None
    if scene.plan.caps:
        with device.stage("holes"):
            holes = scene.near_holes(limit)
    with device.stage("active nodes"):
        active = _find_active_nodes(scene, holes)
    with device.stage("octree"):
        tree = build_octree(device, scene.side, active.codes, active.n)
    if scene.plan.fill == "none":
        bricks = _voxelize_surface(scene, active)
    elif scene.plan.fill == "flood":
        bricks = _voxelize_surface(scene, active)
        active.release()
        return _flood(scene, tree, bricks)
    else:
        with device.stage("crossings"):
            crossings = _list_crossings(scene, active) if scene.plan.listed else None
            if crossings:
                flips, rows = _flip_changes(scene, active, crossings)
            else:
                flips, rows = _flip_crossings(scene, active)
        tree, bricks, positions = inside.fill_parity(device, tree, flips, rows, limit)
        if holes and crossings:
            with device.stage("near holes"):
                holes.fill(tree, bricks, crossings)
        if scene.plan.surface:
            inside.unite(device, bricks, _voxelize_surface(scene, active), positions)
        if crossings:
            crossings.keys.release()
    active.release()
    return scene.octree(tree, bricks, active.touched)


class VoxelizeJob(Job[Octree]):
    """A mesh on a grid's lattice, on the device, and the plan for its voxels.

    Attributes
    ----------
    mesh : as it was given.
    grid : of the result: the window, if one was asked for.
    watertight : whether every edge of the mesh has two faces that agree.
    """

    device: Device
    plan: VoxelizePlan

    def __init__(self, mesh: Mesh, grid: Grid, device: Device) -> None:
        self.mesh, self.grid, self.device = mesh, grid, device
        self._forced: dict[str, Any] = {}

    @property
    def watertight(self) -> bool:
        """Every edge has exactly two faces, which run along it in opposite directions."""
        if self.mesh not in _watertight:
            _watertight[self.mesh] = watertight(self.mesh)
        return _watertight[self.mesh]

    def prepare(
        self,
        mode: str,
        fill: str,
        gap: int,
        with_surface: bool,
        window: tuple[Sequence[int], Sequence[int]] | None,
    ) -> None:
        """Upload and survey the mesh, and plan."""
        mesh, grid = self.mesh, self.grid
        if mode not in MODES:
            raise VoxtoolError(f"mode {mode!r} is unknown: choose one of {', '.join(MODES)}")
        if fill not in FILLS:
            raise VoxtoolError(f"fill {fill!r} is unknown: choose one of {', '.join(FILLS)}")
        if with_surface and mode != "solid":
            raise VoxtoolError(f"mode {mode!r} is a surface already: drop with_surface")
        if gap and fill != "flood":
            raise VoxtoolError(f"gap {gap} goes with fill 'flood', not {fill!r}")
        if not 0 <= gap <= grid.dim:
            raise VoxtoolError(f"gap {gap} is out of range: choose from 0 to {grid.dim} voxels")
        if fill == "flood" and window is not None:
            raise VoxtoolError("fill 'flood' needs the whole grid: drop window, or choose another")
        self._chosen = fill == "auto" and mode == "solid"
        if self._chosen:
            fill = fill_for(self.watertight)
        fill = fill if mode == "solid" else "none"
        try:
            fixed = grid.to_fixed(mesh.vertices)
        except GridError:  # but for vertices that no face uses?
            fixed = grid.to_fixed(_used_vertices(mesh))
        if window is not None:
            low, shape = window
            if min(low) < 0 or any(
                a + n > m for a, n, m in zip(low, shape, grid.shape, strict=True)
            ):
                raise GridError(f"window {low}, {shape} reaches beyond the grid's {grid.shape}")
            self.grid = grid.window(low, shape)
            fixed -= np.asarray(low, np.int32) << FIXED_POINT_BITS
        self.n = len(mesh.faces)
        self._fixed = fixed
        self._plan(mode + ("+surface26" if with_surface else ""), fill, gap)

    def _plan(self, mode: str, fill: str, gap: int) -> None:
        faces = self.mesh.faces
        self._caps = caps = find_caps(self._fixed, faces) if fill == "winding" else None
        closed = faces if caps is None else np.concatenate([faces, caps.faces])
        with self.device.stage("survey"):
            self.vertices = self.device.put(self._fixed)
            self.faces = self.device.put(closed.astype(np.int32, copy=False))  # the caps follow
            survey = self._survey(len(closed))
        self.plan = plan_of(
            survey,
            self.grid.shape,
            mode=mode,
            fill=fill,
            gap=gap,
            holes=caps.holes if caps else 0,
            caps=len(caps.faces) if caps else 0,
        )

    def with_(self, **decisions: Any) -> VoxelizeJob:
        """The same job with decisions of its plan forced, for ablation and tests; another `fill`
        is planned anew.

        Parameters
        ----------
        decisions : fields of the plan, and their values.

        Raises
        ------
        TypeError : the plan has no such field.
        """
        forced = {**self._forced, **decisions}
        job = super().with_(**forced)
        job._forced = forced
        if job.plan.fill != self.plan.fill:
            job._plan(self.plan.mode, job.plan.fill, job.plan.gap)
            job.plan = replace(job.plan, **forced)
        return job

    def _run(self) -> Octree:
        return _voxelize(self)

    def notes(self, octree: Octree) -> list[str]:
        """What a user may like to know of the rule that was chosen; no cause for a warning."""
        if not (self._chosen and octree.fill == "winding") or self.watertight:
            return []
        holes = f"{count_of(self.plan.holes, 'hole')}, " if self.plan.holes else ""
        rule = "filled where its winding number is 1/2 or more"
        return [f"{self._name} is {check_topology(self.mesh).summary()}; {holes}{rule}"]

    def findings(self, octree: Octree) -> Iterator[str]:
        """Why the octree is empty, or where its mesh leaks."""
        leak = {
            "parity": "filled by parity, rows of voxels along x leak where they pass a gap",
            "nonzero": "filled where crossings do not cancel, rows of voxels along x leak where "
            "they pass a gap",
        }.get(octree.fill)
        if leak and not self.watertight:
            found = check_topology(self.mesh)
            if octree.fill == "nonzero" or not found.even:
                yield f"{self._name} is {found.summary()}; {leak}"
        if not octree.bricks.any() and not octree.count:
            yield f"{self._name} sets no voxel: {self._why_empty()}"

    def _why_empty(self) -> str:
        if self.plan.survey.outside == self.n + self.plan.caps:
            return "it lies outside the grid: choose another grid, or none"
        if self.plan.fill == "winding" and volume(self.mesh) < 0:
            return (
                "it is inside out, so that its winding numbers are negative and nothing is inside: "
                "turn its faces, or choose fill parity or nonzero"
            )
        if np.ptp(self.mesh.bounds, axis=0).min() == 0:
            return "it is flat and encloses nothing: choose mode surface26"
        if self.plan.solid:
            return (
                "no voxel's centre is inside it: choose smaller voxels, mode surface26, or "
                "with_surface"
            )
        return "its faces reach no voxel of the grid"

    @property
    def _name(self) -> str:
        return self.mesh.name or "mesh"

    @property
    def side(self) -> int:
        """Voxels along a side of the octree."""
        return self.plan.side

    @property
    def pad(self) -> int:
        """By how much level-1 nodes are widened along x (eq. 3.6)."""
        return HALF_VOXEL if self.plan.solid else 0

    @property
    def code(self) -> np.dtype:
        """Of Morton codes."""
        return np.dtype(np.uint32 if self.plan.code_bits == 32 else np.uint64)

    @property
    def _options(self) -> dict[str, int | str]:
        options: dict[str, int | str] = {"CODE": code_name(self.code), "TILE": self.plan.tile}
        if self.plan.wide:
            options["WIDE"] = 1
        if self.plan.blocked:
            options["BLOCKED"] = 1
        if self.plan.surface:
            options["KIND"] = TOUCHED if self.plan.surface == "26" else SEPARATING
        return options

    def _survey(self, triangles: int) -> Survey:
        partial = self.device.empty(6 * SURVEY_ITEMS, np.uint64)
        survey = self.device.kernel(SOURCE, "survey", CODE="uint", TILE=TILE)
        n = np.uint32(triangles)
        survey(SURVEY_ITEMS, self.vertices, self.faces, n, self.shape(0), partial)
        parts = partial.get().reshape(-1, 6)
        partial.release()
        units = 1 << FIXED_POINT_BITS
        sums = [int(v) / (2 * units) for v in parts[:, 1:4].sum(axis=0)]
        return Survey(
            triangles=triangles,
            vertices=self.vertices.size // 3,
            outside=int(parts[:, 5].sum()),
            extent=int(parts[:, 0].max()) / units,
            areas=(sums[0], sums[1], sums[2]),
            before=bool(parts[:, 4].any()),
        )

    def kernel(self, name: str):
        """A kernel of kernels/svo/voxelize.cl with the plan's options."""
        return self.device.kernel(SOURCE, name, **self._options)

    def shape(self, level: int) -> np.ndarray:
        """The grid in boxes of 2**level voxels, as an int4."""
        return np.array([*(-(-n >> level) for n in self.grid.shape), 0], np.int32)

    def shares(
        self, kind: int, level: int, tiled: bool, n: int
    ) -> tuple[Array, np.uint32, np.uint32]:
        """How the first n triangles are shared among work-items: tile offsets, whether they are
        used, and the number of items. A large triangle is many tiles of columns."""
        if not tiled:
            return self.faces, np.uint32(0), np.uint32(n)
        tiles = self.device.empty(n + 1, np.uint32)
        count_tiles = self.kernel("count_tiles")
        count_tiles(
            n, self.vertices, self.faces, np.uint32(n), np.int32(kind), np.int32(level),
            self.shape(level), np.int32(self.pad if level else 0), tiles,
        )  # fmt: skip
        if (
            n * (max(self.grid.shape) // self.plan.tile + 1) ** 2 >= 1 << 32
        ):  # they could be so many
            total = int(tiles.get(0, n).sum(dtype=np.uint64))
            if total >= 1 << 32:
                raise MemoryLimitError(
                    f"{total:,} shares of large triangles exceed 32-bit indices: choose a smaller "
                    "dim, or voxelize windows of the grid"
                )
        return tiles, np.uint32(1), np.uint32(exclusive_scan(tiles, n))

    def scan_convert(
        self, name: str, kind: int, level: int, tiled: bool, *args, with_caps: bool = False
    ) -> None:
        """Launch a kernel over the shares of the mesh's triangles, and of its caps."""
        n = self.n + (self.plan.caps if with_caps else 0)
        offsets, shared, items = self.shares(kind, level, tiled, n)
        kernel = self.kernel(name)
        kernel(int(items), self.vertices, self.faces, np.uint32(n), offsets, shared, items, *args)
        if shared:
            offsets.release()

    def near_holes(self, max_memory: int) -> NearHoles:
        """Where the mesh's caps count."""
        assert self._caps is not None
        return NearHoles(
            self.device, self._caps, self._fixed, self.grid.shape, self.side,
            (self.vertices, self.faces), self.n, self.plan.wide, max_memory,
        )  # fmt: skip

    def octree(self, tree: DeviceOctree, bricks: Array, touched: np.ndarray | None) -> Octree:
        """The octree on the host, of the nodes that the mesh touches, if given, and those that are
        not all alike."""
        with self.device.stage("read back"):
            lists = [level.codes.get(0, level.n) for level in tree.refined]
            offsets, nodes, masks = tree.offsets, tree.nodes.take(), bricks.take()
            tree.release_refined()
        if touched is None:
            return self.result(offsets, nodes, masks)
        return self.result(*prune(lists, states_of(offsets, nodes), masks, touched))

    def result(self, offsets: np.ndarray, nodes: np.ndarray, bricks: np.ndarray) -> Octree:
        """The octree."""
        return Octree(
            grid=self.grid,
            mode=self.plan.mode,
            fill=self.plan.rule,
            offsets=offsets,
            nodes=nodes,
            bricks=bricks,
            plan=self.plan.scene(),
            source_sha256=self.mesh.source_sha256,
            units=self.mesh.units,
        )


def _used_vertices(mesh: Mesh) -> np.ndarray:
    """The vertices, where those that no face uses are moved onto one that is."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces] = True
    return np.where(used[:, None], mesh.vertices, mesh.vertices[mesh.faces[0, 0]])


# ---- active nodes (section 3.2, listing A.4)


@dataclass(frozen=True)
class _BitSet:
    """A set of Morton-ordered cells: words of 32 bits, the set bits before each, and the codes."""

    words: Array
    ranks: Array
    codes: Array
    n: int


@dataclass(frozen=True)
class _ActiveNodes:
    """The active level-1 nodes; `lookup` is what kernels find a node's place by; `touched` are the
    codes of those that the mesh touches, where there are others, or None."""

    nodes: _BitSet
    lookup: tuple[Array, ...]
    touched: np.ndarray | None

    @property
    def codes(self) -> Array:
        return self.nodes.codes

    @property
    def n(self) -> int:
        return self.nodes.n

    def release(self) -> None:
        """Give back the memory of the lookup; the octree has taken the codes."""
        for array in self.lookup:
            array.release()


def _find_active_nodes(scene: VoxelizeJob, holes: NearHoles | None) -> _ActiveNodes:
    """The level-1 nodes that triangles touch; for a solid, widened by half a voxel along x, so that
    the first voxel beyond every crossing lies in one (eq. 3.6). And those that caps touch, and near
    holes."""
    if not scene.plan.blocked:
        words = scene.device.zeros(max((scene.side // CELL) ** 3 // 32, 1), np.uint32)
        nodes, touched = _activate(scene, NODE_LEVEL, (words, words), words, None, holes)
        return _ActiveNodes(nodes, (nodes.words, nodes.ranks), touched)
    words = scene.device.zeros(max((scene.side // BLOCK) ** 3 // 32, 1), np.uint32)
    blocks, _ = _activate(scene, BLOCK_LEVEL, (words,) * 4, words, None, holes)
    words = scene.device.zeros(BLOCK_WORDS * blocks.n, np.uint32)
    lookup = (blocks.words, blocks.ranks, words, words)
    nodes, touched = _activate(scene, NODE_LEVEL, lookup, words, blocks, holes)
    lookup = (blocks.words, blocks.ranks, nodes.words, nodes.ranks)
    return _ActiveNodes(nodes, lookup, touched)


def _activate(
    scene: VoxelizeJob,
    level: int,
    lookup: tuple[Array, ...],
    words: Array,
    blocks: _BitSet | None,
    holes: NearHoles | None,
) -> tuple[_BitSet, np.ndarray | None]:
    """The set of the boxes of 2**level voxels that triangles touch, and of those near holes; and
    the codes of those that the mesh itself touches, where there are holes."""

    def activate(with_caps: bool) -> None:
        scene.scan_convert(
            "activate", TOUCHED, level, scene.plan.tiled_nodes, np.int32(level),
            scene.shape(level), np.int32(scene.pad), *lookup, words, with_caps=with_caps,
        )  # fmt: skip

    activate(with_caps=False)
    if holes is None:
        return _collect(scene, words, blocks), None
    mesh = _collect(scene, words, blocks)
    touched = mesh.codes.get(0, mesh.n)
    activate(with_caps=True)
    near = scene.device.put(holes.nodes.astype(scene.code))
    scene.kernel("activate_nodes")(
        near.size, near, np.uint32(near.size), np.int32(level), *lookup, words
    )
    return _collect(scene, words, blocks), touched


def _collect(scene: VoxelizeJob, words: Array, blocks: _BitSet | None) -> _BitSet:
    """Rank the words and list the codes of their set bits (listing A.5)."""
    device, n = scene.device, words.size
    ranks = device.empty(n + 1, np.uint32)
    scene.kernel("count_bits")(n, words, np.uint32(n), ranks)
    count = exclusive_scan(ranks, n)
    codes = device.empty(count, scene.code)
    scene.kernel("write_mortons")(
        n, words, np.uint32(n), ranks, blocks.codes if blocks else words,
        np.uint32(blocks is not None), codes,
    )  # fmt: skip
    return _BitSet(words, ranks, codes, count)


# ---- voxels


def _flood(scene: VoxelizeJob, tree: DeviceOctree, bricks: Array) -> Octree:
    """What the outside cannot reach through the surface that bricks hold."""
    with scene.device.stage("flood"):
        touched = tree.refined[0].codes.get(0, tree.refined[0].n)
        surface = bricks.take()
        tree.release()
        found = flood(touched, surface, scene.side, scene.grid.shape, scene.plan.gap)
    return scene.result(*prune(*found, touched))


def _voxelize_surface(scene: VoxelizeJob, active: _ActiveNodes) -> Array:
    """The bricks of the active nodes with the surface's voxels set."""
    kind = TOUCHED if scene.plan.surface == "26" else SEPARATING
    with scene.device.stage(f"surface{scene.plan.surface}"):
        bricks = scene.device.zeros(8 * active.n, BRICK)
        scene.scan_convert(
            "set_surface", kind, 0, scene.plan.tiled, scene.shape(0), *active.lookup, bricks
        )
    return bricks


def _flip_crossings(scene: VoxelizeJob, active: _ActiveNodes) -> tuple[Array, inside.Rows]:
    """The bricks of the active nodes with the first voxel beyond each crossing flipped."""
    flips, rows = _no_flips(scene, active)
    scene.scan_convert(
        "flip_crossings", CROSSED, 0, scene.plan.tiled, scene.shape(0), *active.lookup, flips,
        rows.entry or flips,
    )  # fmt: skip
    return flips, rows


def _no_flips(scene: VoxelizeJob, active: _ActiveNodes) -> tuple[Array, inside.Rows]:
    flips = scene.device.zeros(8 * active.n, BRICK)
    rows = inside.Rows(scene.grid.shape, None)
    if scene.plan.entry:
        rows = inside.Rows(scene.grid.shape, scene.device.zeros(rows.tiles, np.uint64))
    return flips, rows


def _list_crossings(scene: VoxelizeJob, active: _ActiveNodes) -> Crossings:
    """The crossings of rows with the mesh and its caps, with their directions, in order."""
    device, (nx, ny, nz) = scene.device, scene.grid.shape
    n = scene.n + scene.plan.caps
    offsets, shared, items = scene.shares(CROSSED, 0, scene.plan.tiled, n)
    shares = scene.vertices, scene.faces, np.uint32(n), offsets, shared, items
    shape, x_bits = scene.shape(0), nx.bit_length() + 2
    firsts = device.empty(int(items) + 1, np.uint32)
    scene.kernel("count_crossings")(int(items), *shares, shape, *active.lookup, firsts)
    count = exclusive_scan(firsts, int(items))
    keys = device.empty(count, np.uint64)
    scene.kernel("list_crossings")(
        int(items), *shares, shape, *active.lookup, firsts, np.uint32(x_bits), keys
    )
    firsts.release()
    if shared:
        offsets.release()
    keys, _ = radix_sort(keys, count, (ny * nz - 1).bit_length() + x_bits)
    return Crossings(keys, count, x_bits)


def _flip_changes(
    scene: VoxelizeJob, active: _ActiveNodes, crossings: Crossings
) -> tuple[Array, inside.Rows]:
    """The bricks of the active nodes with the first voxel beyond each crossing flipped at which a
    row enters or leaves the inside."""
    flips, rows = _no_flips(scene, active)
    scene.kernel("flip_changes")(
        crossings.n, crossings.keys, np.uint32(crossings.n), np.uint32(crossings.x_bits),
        np.uint32(scene.plan.fill == "nonzero"), scene.shape(0), *active.lookup, flips,
        rows.entry or flips,
    )  # fmt: skip
    return flips, rows
