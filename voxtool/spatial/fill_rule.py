"""The decision about what is inside of a mesh: the fill rule, and the faces that are turned for it.

The inside of a closed mesh is the union of its parts. A part is a shell that encloses a volume; a
shell within another, turned against it, is a cavity. Each shell is turned outward by what encloses
it: if an outermost shell encloses a negative volume, it is reversed with all shells within it. A
point is inside where the winding number is 1 or more after that.

A mesh is simple if that number is 0 or 1 everywhere: nothing intersects, no shell contains another
that is turned alike, and none repeats another. Parity and pseudo-normals then give the same inside,
faster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import count_of
from voxtool.mesh.collinear import collinear
from voxtool.mesh.counts import check_topology
from voxtool.mesh.once import once
from voxtool.mesh.topology import Topology, topology_of, twins_of, volume, ways_of
from voxtool.mesh.watertight import watertight
from voxtool.spatial.bvh import build_tree
from voxtool.spatial.self_intersections import crossing_shells, find_self_intersections

if TYPE_CHECKING:
    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

UNION = "winding"  # the fill rule that unites parts, once they are turned outward


@dataclass(frozen=True, eq=False)
class Inside:
    """A decision about what is inside of a mesh.

    oriented : Mesh or None
        The mesh to fill, if faces of the given one are turned.
    fill : str
        The rule that fills it, one of voxtool.choices.FILLS, but not "auto".
    simple : bool
        Whether pseudo-normals are certain: the mesh is closed, nothing intersects, all faces have
        an area, and winding numbers are 0 and 1.
    meeting : (F,) uint8 or None
        As find_self_intersections returns it, with 1 for copies of faces; None if not needed.
    united : (F,) bool or None
        Faces of parts that overlap, contain one another alike, or repeat others; None if none do.
    parts, turned : int
        The number of parts that overlap, and of faces that were reversed.
    why : str
        What was found, a clause of a report; "" if there is nothing to say.
    compared : bool
        Whether rules were compared on a grid.
    gap, pitch : int, float
        A flood's gap, in voxels of this side, world units.
    """

    oriented: Mesh | None
    fill: str
    simple: bool = False
    meeting: np.ndarray | None = None
    united: np.ndarray | None = None
    parts: int = 0
    turned: int = 0
    why: str = ""
    compared: bool = False
    gap: int = 0
    pitch: float = 0.0

    @property
    def sign(self) -> str:
        """The way in which the sign of a distance is found: "pseudonormal" or "winding"."""
        return "pseudonormal" if self.simple else "winding"

    def mesh_of(self, mesh: Mesh) -> Mesh:
        """Return the mesh to fill, given the mesh that was decided about."""
        return self.oriented or mesh

    def note(self, mesh: Mesh) -> list[str]:
        """Return a line of a report on the decision about a mesh, if there is something to say."""
        if not self.why:
            return []
        if self.fill == "flood":
            done = "; a flood fills whole voxels, so winding numbers decide about points"
        else:
            done = ": their union is inside" * (self.parts > 0)
        return [f"{mesh.name or 'mesh'}: {self.why}{done}"]

    def gap_in(self, grid: Grid) -> int:
        """Return the voxels of a grid that are at least as long as the gap."""
        return min(math.ceil(self.gap * (self.pitch / min(grid.pitch))), grid.dim)


def turn(mesh: Mesh, faces: np.ndarray) -> Mesh:
    """Return a mesh with some faces reversed, given which, (F,) bool."""
    if not faces.any():
        return mesh
    return replace(mesh, faces=np.where(faces[:, None], mesh.faces[:, [0, 2, 1]], mesh.faces))


def inside_as_wound(mesh: Mesh, device: Device) -> Inside:
    """Return what is inside of a mesh; an open one is decided by winding numbers."""
    return inside_of_closed(mesh, device) or Inside(None, "winding")


@once
def inside_of_closed(mesh: Mesh, device: Device) -> Inside | None:
    """Return what is inside of a closed mesh; None if it is not closed.

    It is closed if each edge has two faces that run along it in opposite directions, by the
    positions of vertices or by their indices. Repeated faces count once.
    """
    plain = once(watertight)(mesh, device)
    meeting = meeting_faces(mesh, device) if plain else None
    if meeting is not None and not meeting.any() and check_topology(mesh, device).shells == 1:
        return _simple(mesh, np.full(len(mesh.faces), volume(mesh) < 0), meeting)
    twins = None if plain else twins_of(mesh)
    first = copy = np.arange(len(mesh.faces))
    if twins is not None:
        _, first, copy = np.unique(twins, return_index=True, return_inverse=True)
    distinct = mesh if twins is None else replace(mesh, faces=mesh.faces[first])
    topology = topology_of(distinct)
    if not _is_closed(topology):
        topology = topology_of(distinct, weld=False)
        if not _is_closed(topology):
            return None
    from voxtool.mesh.loops import find_loops
    from voxtool.mesh.shells import find_shells
    from voxtool.spatial.nesting import nest

    shells = find_shells(distinct, topology, find_loops(distinct, topology))
    meeting = meeting_faces(distinct, device)
    crossing, clear = crossing_shells(device, distinct, shells.of, meeting)
    nesting = nest(distinct, shells, crossing[clear], device)
    wrong = (shells.volumes < 0)[nesting.roots]
    inward = (shells.volumes < 0) ^ wrong
    inner = np.flatnonzero(nesting.parents >= 0)
    alike = inner[inward[inner] == inward[nesting.parents[inner]]]
    of, copies = shells.of[copy], np.bincount(copy)[copy]
    most = np.ones(len(wrong), np.int64)  # times that a face of each shell is there
    np.maximum.at(most, of[of >= 0], copies[of >= 0])
    overlap = most > 1
    one, other = crossing.T
    clear |= (nesting.parents[one] != other) & (nesting.parents[other] != one)  # not from within
    overlap[np.concatenate([crossing[clear].ravel(), alike, nesting.parents[alike]])] = True
    _, way = ways_of(mesh.positions[mesh.faces])
    turned = (of >= 0) & wrong[of] ^ (way != way[first][copy])  # copies follow the first
    meeting = np.where(copies > 1, np.uint8(1), meeting[copy])
    outermost = len(np.unique(nesting.roots[of[turned]]))
    if plain and not (meeting.any() or overlap.any()):
        return _simple(mesh, turned, meeting, outermost)
    parts = int(most[overlap].sum())
    repeat = " or repeat one another" * (twins is not None)
    why = f"{parts} parts overlap{repeat}" if parts else "it touches or intersects itself"
    why = "; ".join(filter(None, [why, _turned(turned, outermost)]))
    united = (of >= 0) & overlap[of] if parts else None
    count = int(np.count_nonzero(turned))
    return Inside(_turn(mesh, turned), UNION, False, meeting, united, parts, count, why)


def _simple(mesh: Mesh, turned: np.ndarray, meeting: np.ndarray, wrong: int = 1) -> Inside:
    """Return what is inside of a mesh whose winding numbers are 0 and 1, once faces are turned."""
    flat = collinear(mesh.vertices[mesh.faces]).any()
    count, why = int(np.count_nonzero(turned)), _turned(turned, wrong)
    return Inside(_turn(mesh, turned), "parity", not flat, meeting, turned=count, why=why)


def _turned(faces: np.ndarray, parts: int) -> str:
    """Return what a report says of faces that were turned, (F,) bool, of some parts."""
    if not faces.any():
        return ""
    what = "it is" if faces.all() else f"{count_of(parts, 'part')} {'is' if parts == 1 else 'are'}"
    return f"{what} inside out, and turned outward"


def _turn(mesh: Mesh, faces: np.ndarray) -> Mesh | None:
    """Return a mesh with some faces reversed, given which, (F,) bool; None if none are."""
    if not faces.any():
        return None
    return replace(mesh, faces=np.where(faces[:, None], mesh.faces[:, [0, 2, 1]], mesh.faces))


def _is_closed(topology: Topology) -> bool:
    """Return whether each edge has two faces, which run along it in opposite directions."""
    along = np.bincount(topology.edge, topology.forward)
    return len(along) > 0 and bool((topology.count == 2).all() and (along == 1).all())


@once
def meeting_faces(mesh: Mesh, device: Device) -> np.ndarray:
    """Return find_self_intersections of a mesh, (F,) uint8."""
    flat = collinear(mesh.vertices[mesh.faces]).astype(np.uint8)
    return find_self_intersections(device, mesh, build_tree(device, mesh, flat))
