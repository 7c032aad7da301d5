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

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.choices import FILLS, MODES
from voxtool.errors import GridError, MemoryLimitError, VoxtoolError
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.topology import watertight
from voxtool.opencl import Array, Device, default_device, program
from voxtool.opencl.primitives import exclusive_scan, radix_sort
from voxtool.svo.build import DeviceOctree, build_octree, code_name
from voxtool.svo.fill import parity as inside
from voxtool.svo.fill.caps import find_caps
from voxtool.svo.fill.flood import flood
from voxtool.svo.fill.winding import Crossings, NearHoles
from voxtool.svo.octree import BRICK, Octree
from voxtool.svo.plan import BLOCK, CELL, TILE, Plan, Survey, plan_voxelization
from voxtool.svo.prune import contract, states_of

if TYPE_CHECKING:
    from collections.abc import Sequence

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
        TILE=TILE,
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
    device = device or default_device()
    scene = _Scene(mesh, grid, mode, fill, gap, with_surface, window, device)
    limit = device.max_memory if max_memory is None else max_memory
    scene.plan.refuse_beyond(limit, device.info.max_allocation)
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
) -> Plan:
    """What `voxelize` would do with the same arguments, without doing it."""
    device = device or default_device()
    return _Scene(mesh, grid, mode, fill, gap, with_surface, window, device).plan


def fill_for(closed: bool) -> str:
    """What suits a mesh: "parity" if it is closed and consistently wound, or else "winding"."""
    return "parity" if closed else "winding"


class _Scene:
    """The mesh on the grid's lattice, on the device, and the plan for it."""

    def __init__(
        self,
        mesh: Mesh,
        grid: Grid,
        mode: str,
        fill: str,
        gap: int,
        with_surface: bool,
        window: tuple[Sequence[int], Sequence[int]] | None,
        device: Device,
    ) -> None:
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
        if fill == "auto" and mode == "solid":
            fill = fill_for(watertight(mesh))
        self.device = device
        self.mode = mode + ("+surface26" if with_surface else "")
        fill = fill if mode == "solid" else "none"
        self.source_sha256, self.units = mesh.source_sha256, mesh.units
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
            grid = grid.window(low, shape)
            fixed -= np.asarray(low, np.int32) << FIXED_POINT_BITS
        self.grid = grid
        self.n = len(mesh.faces)
        caps = find_caps(fixed, mesh.faces) if fill == "winding" else None
        self._fixed, self._caps = fixed, caps
        closed = mesh.faces if caps is None else np.concatenate([mesh.faces, caps.faces])
        with device.stage("survey"):
            self.vertices = device.put(fixed)
            self.faces = device.put(closed.astype(np.int32, copy=False))  # the caps follow
            survey = self._survey(len(closed))
        self.plan = plan_voxelization(
            survey,
            grid.shape,
            fill=fill,
            gap=gap,
            surface="6" if mode == "surface6" else "26" * ("26" in self.mode or fill == "flood"),
            holes=caps.holes if caps else 0,
            caps=len(caps.faces) if caps else 0,
        )
        self.side = self.plan.side
        self.pad = HALF_VOXEL if self.plan.solid else 0  # of a level-1 node, along x (eq. 3.6)
        self.code = np.dtype(np.uint32 if self.plan.code_bits == 32 else np.uint64)
        self._options: dict[str, int | str] = {"CODE": code_name(self.code)}
        if self.plan.wide:
            self._options["WIDE"] = 1
        if self.plan.blocked:
            self._options["BLOCKED"] = 1
        if self.plan.surface:
            self._options["KIND"] = TOUCHED if self.plan.surface == "26" else SEPARATING

    def _survey(self, triangles: int) -> Survey:
        partial = self.device.empty(6 * SURVEY_ITEMS, np.uint64)
        survey = self.device.kernel(SOURCE, "survey", CODE="uint")
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
        if n * (max(self.grid.shape) // TILE + 1) ** 2 >= 1 << 32:  # they could be so many
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
        not all alike; all device memory of the scene is given back."""
        with self.device.stage("read back"):
            lists = [level.codes.get(0, level.n) for level in tree.refined]
            offsets, nodes, masks = tree.offsets, tree.nodes.take(), bricks.take()
            tree.release_refined()
        if touched is None:
            return self.result(offsets, nodes, masks)
        return self.result(*contract(lists, states_of(offsets, nodes), masks, touched))

    def result(self, offsets: np.ndarray, nodes: np.ndarray, bricks: np.ndarray) -> Octree:
        """The octree; all device memory of the scene is given back."""
        self.vertices.release()
        self.faces.release()
        return Octree(
            grid=self.grid,
            mode=self.mode,
            fill=self.plan.rule,
            offsets=offsets,
            nodes=nodes,
            bricks=bricks,
            plan=self.plan.scene(),
            source_sha256=self.source_sha256,
            units=self.units,
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


def _find_active_nodes(scene: _Scene, holes: NearHoles | None) -> _ActiveNodes:
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
    scene: _Scene,
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


def _collect(scene: _Scene, words: Array, blocks: _BitSet | None) -> _BitSet:
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


def _flood(scene: _Scene, tree: DeviceOctree, bricks: Array) -> Octree:
    """What the outside cannot reach through the surface that bricks hold."""
    with scene.device.stage("flood"):
        touched = tree.refined[0].codes.get(0, tree.refined[0].n)
        surface = bricks.take()
        tree.release()
        found = flood(touched, surface, scene.side, scene.grid.shape, scene.plan.gap)
    return scene.result(*contract(*found, touched))


def _voxelize_surface(scene: _Scene, active: _ActiveNodes) -> Array:
    """The bricks of the active nodes with the surface's voxels set."""
    kind = TOUCHED if scene.plan.surface == "26" else SEPARATING
    with scene.device.stage(f"surface{scene.plan.surface}"):
        bricks = scene.device.zeros(8 * active.n, BRICK)
        scene.scan_convert(
            "set_surface", kind, 0, scene.plan.tiled, scene.shape(0), *active.lookup, bricks
        )
    return bricks


def _flip_crossings(scene: _Scene, active: _ActiveNodes) -> tuple[Array, inside.Rows]:
    """The bricks of the active nodes with the first voxel beyond each crossing flipped."""
    flips, rows = _no_flips(scene, active)
    scene.scan_convert(
        "flip_crossings", CROSSED, 0, scene.plan.tiled, scene.shape(0), *active.lookup, flips,
        rows.entry or flips,
    )  # fmt: skip
    return flips, rows


def _no_flips(scene: _Scene, active: _ActiveNodes) -> tuple[Array, inside.Rows]:
    flips = scene.device.zeros(8 * active.n, BRICK)
    rows = inside.Rows(scene.grid.shape, None)
    if scene.plan.entry:
        rows = inside.Rows(scene.grid.shape, scene.device.zeros(rows.tiles, np.uint64))
    return flips, rows


def _list_crossings(scene: _Scene, active: _ActiveNodes) -> Crossings:
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
    scene: _Scene, active: _ActiveNodes, crossings: Crossings
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
