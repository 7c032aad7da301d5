"""Triangle mesh to sparse voxel octree, exactly ([voCCeL], sections 3.2, 5.1 and 6.2, appendix A).

The stages, on the device:

1. Survey: the mesh is rounded to the grid's lattice and summed up for the plan (lattice.py).
2. Active nodes: the level-1 nodes (8 x 8 x 8 voxels) that a triangle touches (scan.py).
3. Octree: the levels above, bottom-up from shortened Morton codes (build.py).
4. Voxels. A surface is scan-converted into the bricks of the active nodes (scan.py). For a solid,
   flips mark where rows along x change between inside and outside, and the voxels between flips
   are filled (fill/rows.py); or everything that the outside cannot reach is filled
   (fill/flood.py). Near holes, the winding number decides each voxel (fill/winding.py).

[voCCeL] descends the octree to find the brick of a voxel, from the root or from the common ancestor
with the last; here, the rank of its level-1 node among the active nodes gives the brick directly.
[voCCeL] links x-neighbours and propagates flips level by level; here, rows walk the octree. A plan
can force the former (kernels/svo/voxelization/columns.h, fill/propagation.py).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import FILLS, MODES
from voxtool.errors import GridError, VoxtoolError, count_of
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.job import Job, one_call
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.once import once
from voxtool.mesh.topology import merged_faces, net_faces, volume
from voxtool.mesh.watertight import watertight
from voxtool.opencl import Array, Device, default_device
from voxtool.opencl.builder import Request
from voxtool.opencl.primitives import COMPACTION, RADIX_SORT
from voxtool.opencl.primitives import SCAN as PREFIX_SUMS
from voxtool.svo.octree.build import SOURCE as BUILD
from voxtool.svo.octree.build import build_octree
from voxtool.svo.octree.links import level_states
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.connected.about import about_connected, check_connected
from voxtool.svo.voxelization.fill.rows import (
    CROSSINGS,
    Filled,
    fill_rows,
    flip_changes,
    flip_crossings,
    list_crossings,
)
from voxtool.svo.voxelization.fill.rows import SOURCE as ROWS
from voxtool.svo.voxelization.lattice import place_mesh
from voxtool.svo.voxelization.plan import REQUEST, Survey, VoxelizePlan, plan_of
from voxtool.svo.voxelization.scan_conversion import SOURCE as SCAN
from voxtool.svo.voxelization.scan_conversion import ActiveNodes, Scan, add_nodes, find_active_nodes

if TYPE_CHECKING:
    from voxtool.mesh.topology import TopologyCheck
    from voxtool.spatial.fill_rule import Inside
    from voxtool.svo.voxelization.connected.thin_parts import Bricks

LARGE = 64  # columns of a face, on average, from which repeated faces cost more than their search
Window = tuple[Sequence[int], Sequence[int]]  # of a grid: its low corner and its shape


def plan_voxelize(
    mesh: Mesh,
    grid: Grid,
    mode: str = "solid",
    *,
    fill: str = "auto",
    gap: int = 0,
    with_surface: bool = False,
    connected: bool = False,
    window: Window | None = None,
    every_face: bool = False,
    closed: bool = False,
    bits: int = FIXED_POINT_BITS,
    device: Device | None = None,
    max_memory: int | None = None,
) -> VoxelizeJob:
    """Return the surveyed and planned job of `voxelize`; see `voxtool.voxelize`.

    With `every_face`, faces that repeat others are not left out: each may have its own colour. With
    `closed`, the mesh is a part of one without holes, and its own boundary does not count. The
    lattice is of 2**-bits voxel.
    """
    if mode not in MODES:
        raise VoxtoolError(f"mode {mode!r} is unknown: choose one of {', '.join(MODES)}")
    if fill not in FILLS:
        raise VoxtoolError(f"fill {fill!r} is unknown: choose one of {', '.join(FILLS)}")
    if with_surface and mode != "solid":
        raise VoxtoolError(f"mode {mode!r} is a surface already: drop with_surface")
    check_connected(connected, mode, with_surface, window)
    if gap and fill != "flood":
        raise VoxtoolError(f"gap {gap} goes with fill 'flood', not {fill!r}")
    if not 0 <= gap <= grid.dim:
        raise VoxtoolError(f"gap {gap} is out of range: choose from 0 to {grid.dim} voxels")
    if window is not None:
        low, shape = window
        if min(low) < 0 or any(a + n > m for a, n, m in zip(low, shape, grid.shape, strict=True)):
            raise GridError(f"window {low}, {shape} reaches beyond the grid's {grid.shape}")
    job = VoxelizeJob(mesh, grid, window, device or default_device(), max_memory)
    job.every_face, job.closed, job.connected = every_face, closed, connected
    job.bits = bits
    if fill == "auto" and mode == "solid":
        fill, gap = job.choose()
    job.place(mode + "+surface26" * with_surface, fill if mode == "solid" else "none", gap)
    return job


voxelize = one_call(plan_voxelize, "voxelize", Octree)


class VoxelizeJob(Job[Octree]):
    """The voxelization of a mesh, surveyed and planned.

    Attributes
    ----------
    mesh : Mesh
        The mesh that is voxelized; faces are reversed where the fill rule that was chosen needs it.
    grid : Grid
        The grid of the octree: the window, if there is one.
    lattice : LatticeMesh
        The mesh on the device.
    plan : VoxelizePlan
        The decisions.
    chosen : bool
        True if fill "auto" chose the fill rule.
    inside : Inside or None
        What is inside, if fill "auto" decided it. It is None for a closed mesh until its rows show
        winding numbers other than 0 and 1.
    differing : int
        Voxels that parity fills otherwise than the union of parts.
    """

    device: Device
    plan: VoxelizePlan
    chosen: bool = False
    inside: Inside | None = None
    differing: int = 0
    every_face: bool = False  # also those that repeat others
    closed: bool = False  # a part of a closed mesh
    connected: bool = False  # thin parts stay in one piece
    one_part: bool = False  # each connected part of the inside lies far from the others
    added: Bricks | None = None  # known once it has run: voxels that connect thin parts
    bits: int = FIXED_POINT_BITS  # of the lattice
    surface_found: Callable[[Scan, ActiveNodes, Array], None] | None = None  # receives a surface
    _crowded: bool = False  # known once it has run
    _certain: bool = True  # False once a check has found that parts may overlap

    def __init__(
        self, mesh: Mesh, grid: Grid, window: Window | None, device: Device, max_memory: int | None
    ) -> None:
        self.mesh, self.device, self.max_memory = mesh, device, max_memory
        self._given = mesh
        self._whole, self._window = grid, window
        self._forced: dict[str, Any] = {}

    @property
    def watertight(self) -> bool:
        """True if every edge has exactly two faces, which traverse it in opposite directions."""
        return once(watertight)(self._given, self.device)

    def choose(self) -> tuple[str, int]:
        """Return the fill rule of "auto" and its gap; the mesh becomes the one that it fills."""
        self.chosen = True
        if self.watertight:
            return "parity", 0
        from voxtool.svo.voxelization.inside import inside_of

        self.inside = inside_of(self.mesh, self.device)
        self.mesh = self.inside.mesh_of(self.mesh)
        return self.inside.fill, self.inside.gap_in(self._whole)

    def settle(self) -> None:
        """Decide whether parts of a closed mesh overlap, if that is left until it runs."""
        if not self.plan.checked:
            return
        self.plan = replace(self.plan, checked=False)
        from voxtool.spatial.fill_rule import UNION, inside_of_closed

        inside = inside_of_closed(self._given, self.device)
        assert inside  # the mesh is closed
        self.inside = inside
        if inside.fill != UNION:
            return
        from voxtool.svo.voxelization.fill.differing import count_differing

        low, shape = self._window or ((0, 0, 0), self._whole.shape)
        crossings, limit = self.plan.survey.areas[0], self.limit
        place = self._whole, tuple(low), tuple(shape), crossings, self.device, limit
        self.differing = count_differing(inside.mesh_of(self._given), *place, self.bits)
        if self.differing:
            self.mesh = inside.mesh_of(self._given)
            self.place(self.plan.mode, UNION, 0)

    def place(self, mode: str, fill: str, gap: int) -> None:
        """Upload the mesh, survey it and make the plan."""
        with self.device.stage("survey"):
            some = net_faces(self.mesh) if fill in ("nonzero", "winding") else None
            survey = self._place(some, fill)
            crowded = sum(survey.areas) > LARGE * survey.triangles and not self.every_face
            if some is None and crowded:
                some = merged_faces(self.mesh, parity=fill == "parity")
                survey = survey if some is None else self._place(some, fill)
            caps = self.lattice.caps
        self._faces = some
        self.grid = self._whole.window(*self._window) if self._window else self._whole
        holes, faces = (caps.holes, len(caps.faces)) if caps else (0, 0)
        request: dict[str, Any] = {"mode": mode, "fill": fill, "gap": gap}
        flooded = self._flooded[1] if fill == "flood" else None
        request |= {"holes": holes, "caps": faces, "flooded": flooded}
        inside = self.inside
        request["choice"] = inside.why if inside and inside.compared else ""
        request["checked"] = self.chosen and fill == "parity"
        if inside and self.differing:
            found = {"parts": inside.parts, "faces_turned": inside.turned, "why": inside.why}
            request["inside"] = *found.items(), ("voxels_parity_differs", self.differing)
        request["connected"] = self.connected
        request["bits"] = self.bits
        plan = plan_of(survey, self.grid.shape, **request)
        self.plan = plan.in_slabs(self.limit, self.device.info.max_allocation)

    @property
    def whole(self) -> Grid:
        """The grid without the window."""
        return self._whole

    @property
    def window(self) -> Window | None:
        """The part of the grid that is voxelized, or None for all of it."""
        return self._window

    @property
    def is_whole_surface(self) -> bool:
        """True if it scan-converts every face into a surface, and the octree is this surface."""
        return not self.plan.solid and self._faces is None

    @property
    def _flooded(self) -> Window:
        """The part of the grid that is flooded."""
        return (0, 0, 0), self._whole.shape

    @property
    def mesh_of_faces(self) -> Mesh:
        """The mesh of the faces that are voxelized."""
        mesh, some = self.mesh, self._faces
        faces = mesh.faces if some is None else mesh.faces[some]
        return Mesh(mesh.vertices, faces, mesh.source_sha256, mesh.name, mesh.units, mesh.transform)

    def _place(self, some: np.ndarray | None, fill: str) -> Survey:
        """Upload the mesh, or only `some` of its faces, and survey it: on the window, or on the
        whole grid to flood it."""
        counted = fill == "winding" and not self.closed
        boundary = None
        if counted:
            from voxtool.svo.voxelization.inside import net_boundary

            boundary = net_boundary(self.mesh)
        window = self._flooded if fill == "flood" else self._window
        place = self.mesh, self._whole, window, some, boundary, self.device
        self.lattice = place_mesh(*place, self.bits)
        return self.lattice.survey()

    def with_(self, **decisions: Any) -> VoxelizeJob:
        """Return a copy of the job with fields of its plan replaced, for ablation and tests;
        another `fill` makes a new plan. Raises TypeError if the plan has no such field."""
        forced = {**self._forced, **decisions}
        job = super().with_(**forced)
        job._forced = forced
        if job.plan.fill != self.plan.fill:
            job.place(self.plan.mode, job.plan.fill, job.plan.gap)
            job.plan = replace(job.plan, **forced)
        return job

    def within(self, window: Window) -> VoxelizeJob:
        """Return the job of another window, by the same rule."""
        plan = self.plan
        mode, _, added = plan.mode.partition("+")
        rule: Any = {"fill": plan.fill if plan.solid else "auto", "gap": plan.gap}
        place: Any = {"device": self.device, "max_memory": self.max_memory}
        rule |= {"with_surface": bool(added), "window": window}
        return plan_voxelize(self.mesh, self._whole, mode, **rule, **place)

    def capped(self) -> VoxelizeJob:
        """Return the job of the mesh that its caps close, in which they count as faces."""
        if not self.plan.caps:
            return self
        job = copy.copy(self)
        job.lattice = self.lattice.capped()
        job.plan = replace(self.plan, holes=0, caps=0)
        return job

    def solid_octree(self) -> Octree:
        """Return the octree of a job that another one is a part of, which checks the memory."""
        return self._run()

    @property
    def programs(self) -> list[Request]:
        """The programs that the stages use, in order."""
        plan, options = self.plan, Scan(self.lattice, self.plan).options
        code, wide = ({"CODE": name} for name in (options["CODE"], "ulong"))
        sort: Request = RADIX_SORT, {"KEY": "ulong"}
        programs: list[Request] = [(SCAN, options), (PREFIX_SUMS, {})]
        by_rows: list[Request] = [(CROSSINGS, options | ({"LISTED": 1} if plan.listed else {}))]
        by_rows += [sort] * plan.listed
        if plan.caps:
            from voxtool.svo.voxelization.fill.winding import programs as near_holes

            programs += [*by_rows, *near_holes(plan)]
        if plan.fill == "flood":
            from voxtool.svo.voxelization.fill.dilation import SOURCE as DILATION
            from voxtool.svo.voxelization.fill.flood_pieces import SOURCE as FLOOD

            programs += [(ROWS, {"CODE": "uint"}), (BUILD, wide), (COMPACTION, {"KEY": "ulong"})]
            return [*programs, (FLOOD, wide), *[(DILATION, wide), sort] * (plan.gap > 0)]
        programs += [(BUILD, code), (COMPACTION, {"KEY": options["CODE"]})]
        if plan.solid:
            filling = ROWS
            if plan.propagation == "levels":
                from voxtool.svo.voxelization.fill.propagation import SOURCE as filling
            programs += [*by_rows, (filling, code)]
        if self.chosen and not self.watertight:
            from voxtool.mesh.counts import PROGRAMS as COUNTING

            programs += COUNTING
        return programs

    def _run(self) -> Octree:
        octree = self._make()
        if not self._certain:
            self.settle()
            if self.differing or self.plan.connects:
                return self._make()
        return octree

    def _make(self) -> Octree:
        """Return the octree as the plan says; a check may find that it is not certain."""
        plan, scan = self.plan, Scan(self.lattice, self.plan)
        self.device.prepare(*self.programs)
        if plan.fill == "flood":
            return self._flood()
        holes = crossings = None
        with self.stage("active nodes"):
            active = find_active_nodes(scan)
        touched = active.nodes.get() if plan.caps else None
        if touched is not None:
            from voxtool.svo.voxelization.fill.winding import NearHoles

            with self.stage("holes"):
                crossings = list_crossings(scan)
                capped = add_nodes(scan, touched, self.lattice.closing).nodes.get()
                holes = NearHoles(self.lattice, plan, self.limit, crossings)
            with self.stage("near holes"):
                nodes = holes.decide(touched, capped)
                self._crowded = holes.crowded
                active = add_nodes(scan, np.append(capped, nodes))
        with self.stage("octree"):
            tree = build_octree(self.device, plan.side, active.nodes.codes, active.nodes.n)
        if plan.descends:
            active = replace(active, tree=tree)
        if not plan.solid:
            with self.stage(f"surface{plan.surface}"):
                bricks = scan.surface(active)
            if self.surface_found:
                self.surface_found(scan, active, bricks)
            return self._read(Filled(tree, bricks, None), None)
        with self.stage("crossings"):
            if plan.listed:
                crossings = crossings or list_crossings(scan)
                flips = flip_changes(scan, active, crossings)
            else:
                flips = flip_crossings(scan, active)
        filled = fill_rows(tree, flips, self.limit, plan.propagation == "levels")
        self._certain = filled.certain
        del tree, flips  # frees memory if the mesh is open: `filled` then has its own
        if holes:
            holes.fill(filled.tree, filled.bricks)
        if plan.surface:
            with self.stage(f"surface{plan.surface}"):
                filled.unite(scan.surface(active))
        octree = self._read(filled, touched)
        if plan.connects and self._certain:
            from voxtool.svo.voxelization.connected.connect import connect

            del filled
            with self.stage("connect"):
                return connect(self, octree, scan, active)
        return octree

    def _flood(self) -> Octree:
        """Return the octree of everything that the outside cannot reach through the surface."""
        from voxtool.svo.voxelization.fill.flood import flood, frame_of

        low = np.array(self._window[0] if self._window else (0, 0, 0))
        plan = self.plan
        frame = frame_of(self._whole.shape, low, np.array(plan.shape), plan.gap, plan.slabs)
        return self._pruned(*flood(self.device, self._walls, frame))

    def _walls(self, low: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, Array]:
        """Return the active level-1 nodes of a box of the grid, and the bricks with the surface."""
        lattice, plan, box = self.lattice, self.plan, tuple(shape.tolist())
        window = tuple(low.tolist()), box
        if window != self._flooded:
            lattice = place_mesh(self.mesh, self._whole, window, self._faces, None, self.device)
        if box != plan.shape:
            request = {name: getattr(plan, name) for name in REQUEST}
            plan = replace(plan_of(plan.survey, box, **request), **self._forced)
        scan = Scan(lattice, plan)
        with self.stage("active nodes"):
            active = find_active_nodes(scan)
        with self.stage(f"surface{plan.surface}"):
            return active.nodes.get(), scan.surface(active)

    def _read(self, filled: Filled, touched: np.ndarray | None) -> Octree:
        """Return the octree on the host; prune active nodes that the mesh does not touch."""
        with self.stage("read back"):
            tree = filled.tree
            codes = tree.refined[0].codes.get(0, tree.refined[0].n)
            offsets, nodes, masks = tree.offsets, tree.nodes.take(), filled.bricks.take()
        if touched is None:
            return self._octree(offsets, nodes, masks)
        return self._pruned(codes, level_states(offsets, nodes), masks, touched)

    def _pruned(self, *states: Any) -> Octree:
        from voxtool.svo.octree.prune import prune

        return self._octree(*prune(*states))

    def _octree(self, offsets: np.ndarray, nodes: np.ndarray, bricks: np.ndarray) -> Octree:
        mode, rule, scene = self.plan.mode, self.plan.rule, self.plan.scene()
        mesh, arrays = self.mesh, (offsets, nodes, bricks)
        origin = (mesh.source_sha256, mesh.units, mesh.transform)
        return Octree(self.grid, mode, rule, *arrays, scene, *origin)

    def notes(self, octree: Octree) -> list[str]:
        """Return lines about what was decided to be inside, and about the voxels that connect thin
        parts; they are not warnings."""
        return [*self._about_fill(octree), *about_connected(octree.plan)]

    def _about_fill(self, octree: Octree) -> list[str]:
        if doubts := self.doubts(octree):
            return doubts
        if self.watertight or not self.chosen or octree.fill != "winding":
            return []
        holes = f"{count_of(self.plan.holes, 'hole')}, " if self.plan.holes else ""
        filled = f"{holes}filled where its winding number is 1/2 or more"
        return [f"{self._name} is {self._summary}; {filled}"]

    def doubts(self, octree: Octree) -> list[str]:
        """Return a line if parts overlap, are turned, or rules were compared."""
        inside = self.inside
        if not inside or not inside.why or not octree.fill.startswith(inside.fill):
            return []
        if not self.watertight:
            return [f"{self._name} is {self._summary}; {inside.why}"]
        if not self.differing:
            return []
        share = 100 * self.differing / max(octree.count, 1)
        return [
            f"{self._name}: {inside.why}: their union is filled (parity would differ in "
            f"{self.differing:,} voxels, {share:.2g} %)"
        ]

    @property
    def _summary(self) -> str:
        return self._topology(self._given).summary()

    def _topology(self, mesh: Mesh) -> TopologyCheck:
        from voxtool.mesh.counts import check_topology

        return once(check_topology)(mesh, self.device)

    def findings(self, octree: Octree) -> Iterator[str]:
        """Yield warnings: the fill may leak, or the octree is empty."""
        leak = {
            "parity": "filled by parity, rows of voxels along x leak where they pass a gap",
            "nonzero": "filled where crossings do not cancel, rows of voxels along x leak where "
            "they pass a gap",
        }.get(octree.fill)
        if leak and not self.watertight:
            found = self._topology(self.mesh)
            if octree.fill == "nonzero" or not found.even:
                yield f"{self._name} is {found.summary()}; {leak}"
        if self._crowded:
            yield (
                f"{self._name} has more boundary loops near one voxel than winding numbers are "
                "computed for; caps close them there: see voxtool diagnose, or fill by flood"
            )
        if not octree.count:
            yield f"{self._name} sets no voxel: {self._why_empty()}"

    def _why_empty(self) -> str:
        if self.plan.survey.outside == self.plan.survey.triangles:
            return "it lies outside the grid: choose another grid, or none"
        if self.plan.fill == "winding" and volume(self.mesh) < 0:
            return (
                "it is inside out, so that its winding numbers are negative and nothing is inside: "
                "choose fill auto, which turns its faces outward, parity or nonzero"
            )
        if np.ptp(self.mesh.bounds, axis=0).min() == 0:
            return "it is flat and encloses nothing: choose fill flood, or mode surface26"
        if self.plan.solid:
            return (
                "no voxel's centre is inside it: choose smaller voxels, mode surface26, "
                "connected, or with_surface"
            )
        return "its faces reach no voxel of the grid"

    @property
    def _name(self) -> str:
        return self.mesh.name or "mesh"
