"""A report on a mesh: what is wrong with it, where, and which fill rule and sign suit it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from voxtool.choices import DEFAULT_DIM, FILLS
from voxtool.diagnosis.text import counted, lines
from voxtool.errors import MeshWarning
from voxtool.grid import Grid
from voxtool.mesh.collinear import collinear
from voxtool.mesh.loops import Loops, find_loops
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.shells import FLAT, find_patches, find_shells
from voxtool.mesh.topology import (
    SurfaceCheck,
    Topology,
    closed_chain,
    crowded_edges,
    repeated_faces,
    surface_counts,
    topology_of,
)
from voxtool.opencl import Device, default_device
from voxtool.spatial.bvh import Frame, build_tree
from voxtool.spatial.nesting import nest
from voxtool.spatial.self_intersections import UNDECIDED, crossing_shells, find_self_intersections
from voxtool.svo.sets.compare import count_differences, leaking_rows
from voxtool.svo.voxelization.kept_share import Share, outer_surface, share_of
from voxtool.svo.voxelization.voxelize import plan_voxelize, voxelize

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.svo.octree.octree import Octree

RULES = tuple(fill for fill in FILLS if fill != "auto")
STAGES = ("topology", "self-intersections", "nesting", *RULES, "auto", "outer surface")

MAX_EXPONENT = 250  # of an extent: squares of areas, and cubes of lengths, are in float64
LISTED = 1000  # faces, edges or rows in a list
REMOVE_INSIDE = "remove the faces inside, or fill by winding"
UNITE = "fill auto unites parts that overlap; voxtool repair leaves out the faces inside"
REVERSE_CAVITIES = "reverse the faces of cavities; fill auto unites shells that are wound alike"
JSON_NAMES = {"self_intersecting_faces": "crossed_faces", "hint": "mend"}  # since version 0.1


class Fault(NamedTuple):
    """Something that is wrong with a mesh, and what helps."""

    what: str
    hint: str


@dataclass(frozen=True)
class Report:
    """The faults of a mesh, their places, and what to do about them.

    Lengths and positions are in world units; faces are counted from 0; vertices at bit-equal
    positions are one. A list of faces, edges or rows ends after 1,000.

    Attributes
    ----------
    mesh, units, source_sha256 : str
        Name, units and digest of the mesh.
    diagnosis : SurfaceCheck
        The counts of edges, faces, vertices and shells.
    low, high : list of float
        Corners of the bounding box.
    dim, pitch : int, float
        Voxels along the longest side, and size of a voxel, of the grid on which the fill rules are
        compared.
    loops : list of dict
        Every boundary loop, the longest first: edges, length, centre, size of its box, closed.
    t_junctions : bool
        Whether every boundary edge is part of a T-junction, so that there are no holes.
    crowded_edges : list of dict
        Edges of more than two faces: the number of faces, and the two ends.
    duplicate_faces, degenerate_faces, self_intersecting_faces : dict
        Count, list of faces, and the centre of the first.
    undecided_faces : int
        Faces that may intersect others: too many are near them to test all.
    shells : list of dict
        Every shell, the one with most faces first: faces, closed, consistent, volume, loops, box,
        parent, depth, and its kind: "solid", "cavity", "open", "flat", "mixed", "inside out", or
        "nested alike" (wound like the shell around it).
    patches : dict
        Count, one_sided, and the flipped ones.
    leaking_rows : dict
        Rows of voxels along x that leak by parity.
    auto : str
        The fill rule that `fill="auto"` takes, with its gap.
    choice : str
        Why, if it compared rules, unites parts or turns faces; otherwise "".
    outer_surface : int
        Voxels of the outer surface: those that touch a face, beside what a flood reaches.
    fills : dict
        For each fill rule, and "auto" if it is none of them, its voxels, those missing and extra
        compared with the recommended one, and the share of the outer surface that it keeps.
    recommended : dict
        Fill rule, and why.
    faults : list of Fault
        What is wrong, and what helps.
    boundary : Loops
        The loops themselves; not in as_dict().
    """

    mesh: str
    units: str
    source_sha256: str
    diagnosis: SurfaceCheck
    low: list[float]
    high: list[float]
    dim: int
    pitch: float
    loops: list[dict[str, Any]]
    t_junctions: bool
    crowded_edges: list[dict[str, Any]]
    duplicate_faces: dict[str, Any]
    degenerate_faces: dict[str, Any]
    self_intersecting_faces: dict[str, Any]
    undecided_faces: int
    shells: list[dict[str, Any]]
    patches: dict[str, Any]
    leaking_rows: dict[str, Any]
    auto: str
    choice: str
    outer_surface: int
    fills: dict[str, dict[str, Any]]
    recommended: dict[str, str]
    faults: list[Fault]
    boundary: Loops

    def as_dict(self) -> dict[str, Any]:
        """Return the report in JSON types."""
        found = {JSON_NAMES.get(f.name, f.name): getattr(self, f.name) for f in fields(self)}
        del found["boundary"]
        found["diagnosis"] = self.diagnosis.as_dict()
        found["faults"] = [{"what": what, JSON_NAMES["hint"]: hint} for what, hint in self.faults]
        return found

    def text(self) -> str:
        """Return the report as one screen of text."""
        return "\n".join(lines(self))

    def __str__(self) -> str:
        return self.text()

    def __repr__(self) -> str:
        faults = "; ".join(fault.what for fault in self.faults) or "no faults"
        return f"<Report on {self.mesh or 'a mesh'}: {faults}>"


def diagnose(
    mesh: Mesh,
    grid: Grid | None = None,
    *,
    device: Device | None = None,
    progress: Callable[[str], None] | None = None,
) -> Report:
    """Report what is wrong with a mesh, where, and what to do about it; see voxtool.diagnose."""
    Frame.of(mesh, MAX_EXPONENT)
    grid = grid or Grid.fit(mesh, DEFAULT_DIM)
    device = device or default_device()
    enter = progress or (lambda _: None)
    enter("topology")
    topology = topology_of(mesh)
    counts = surface_counts(mesh, topology)
    loops = find_loops(mesh, topology)
    flat, repeated = collinear(mesh.vertices[mesh.faces]), repeated_faces(topology)
    edges, crowded = crowded_edges(mesh, topology)
    enter("self-intersections")
    intersecting = _self_intersecting(mesh, flat, repeated, device)
    low, high = mesh.bounds.tolist()
    found: dict[str, Any] = {
        "mesh": mesh.name,
        "units": mesh.units,
        "source_sha256": mesh.source_sha256,
        "diagnosis": counts,
        "low": low,
        "high": high,
        "dim": grid.dim,
        "pitch": grid.pitch[0],
        "loops": _loop_rows(loops),
        "t_junctions": len(loops.closed) > 0 and closed_chain(mesh),
        "crowded_edges": _rows(faces=crowded[:LISTED], ends=mesh.vertices[edges[:LISTED]]),
        "duplicate_faces": _listed_faces(mesh, repeated),
        "degenerate_faces": _listed_faces(mesh, flat),
        "self_intersecting_faces": _listed_faces(mesh, intersecting == 1),
        "undecided_faces": int(np.count_nonzero(intersecting == UNDECIDED)),
    }
    enter("nesting")
    found["shells"] = _shell_rows(mesh, topology, loops, intersecting, device)
    found["patches"] = _patch_rows(mesh, topology)
    octrees = {}
    with warnings.catch_warnings(action="ignore", category=MeshWarning):  # the report says more
        for rule in RULES:
            enter(rule)
            octrees[rule] = voxelize(mesh, grid, fill=rule, device=device)
        enter("auto")
        job = plan_voxelize(mesh, grid, device=device)
        job.settle()
        decided = job.inside.why if job.inside and job.plan.fill != "parity" else ""
        found |= {"auto": job.plan.rule, "choice": decided}
        if decided:
            octrees["auto"] = job.run()
        enter("outer surface")
        surface = voxelize(mesh, grid, "surface26", device=device)
        outer = outer_surface(surface, octrees["flood"], device)
    found["outer_surface"] = outer.count
    shares = {rule: share_of(outer, octree, device) for rule, octree in octrees.items()}
    found |= _compared(octrees, shares, found)
    return Report(**found, faults=list(_faults(found)), boundary=loops)


# ---- what is found


def _self_intersecting(
    mesh: Mesh, flat: np.ndarray, repeated: np.ndarray, device: Device
) -> np.ndarray:
    """Return find_self_intersections of a mesh, (F,) uint8; duplicate faces do not count."""
    some = np.flatnonzero(~repeated) if repeated.any() else None
    tree = build_tree(device, mesh, flat.astype(np.uint8), some)
    return find_self_intersections(device, mesh, tree)


def _rows(**columns: np.ndarray) -> list[dict[str, Any]]:
    """Return a dict for each row of columns of equal length, in JSON types."""
    values = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in values]


def _loop_rows(loops: Loops) -> list[dict[str, Any]]:
    size = loops.high - loops.low
    return _rows(
        edges=loops.sizes,
        length=loops.lengths,
        centre=loops.low + size / 2,
        size=size,
        closed=loops.closed,
    )


def _listed_faces(mesh: Mesh, chosen: np.ndarray) -> dict[str, Any]:
    """Return the number of chosen faces, a list of them, and the centre of the first."""
    faces = np.flatnonzero(chosen)
    first = mesh.vertices[mesh.faces[faces[:1]]].mean(axis=1).tolist()
    return {"count": len(faces), "centre": (first or [None])[0], "faces": faces[:LISTED].tolist()}


def _shell_rows(
    mesh: Mesh, topology: Topology, loops: Loops, intersecting: np.ndarray, device: Device
) -> list[dict[str, Any]]:
    shells = find_shells(mesh, topology, loops)
    crossing, clear = crossing_shells(device, mesh, shells.of, intersecting)
    nesting = nest(mesh, shells, crossing[clear], device)
    rows = _rows(
        faces=shells.faces,
        closed=shells.closed,
        consistent=shells.consistent,
        volume=shells.volumes,
        loops=shells.loops,
        low=shells.low,
        high=shells.high,
        parent=nesting.parents,
        depth=nesting.depths,
    )
    for row in rows:
        row["volume"] = row["volume"] if row["volume"] == row["volume"] else None  # NaN
        row["parent"] = row["parent"] if row["parent"] >= 0 else None
    for row in rows:
        row["is"] = _role(row, rows)
    return rows


def _role(shell: dict[str, Any], shells: list[dict[str, Any]]) -> str:
    """Return the role of a shell among the others."""
    volume = shell["volume"]
    if not shell["closed"]:
        return "open"
    if volume is None:
        return "mixed"
    side = max(b - a for a, b in zip(shell["low"], shell["high"], strict=True))
    if abs(volume) <= FLAT * side**3:
        return "flat"
    around = shells[shell["parent"]]["volume"] if shell["depth"] else None
    if around is None:
        return "solid" if volume > 0 else "inside out"
    if (volume > 0) == (around > 0):
        return "nested alike"
    return "solid" if volume > 0 else "cavity"


def _patch_rows(mesh: Mesh, topology: Topology) -> dict[str, Any]:
    patches = find_patches(mesh, topology)
    by_patch = np.argsort(patches.of, kind="stable")
    starts = np.searchsorted(patches.of[by_patch], np.arange(len(patches.areas) + 1))
    flipped = []
    for patch in np.flatnonzero(patches.flipped).tolist():
        faces = by_patch[starts[patch] : starts[patch + 1]]
        points = mesh.vertices[mesh.faces[faces]].reshape(-1, 3)
        low, high = points.min(axis=0), points.max(axis=0)
        flipped.append(
            {
                "faces": len(faces),
                "first": int(faces[0]),
                "area": float(patches.areas[patch]),
                "centre": (low + (high - low) / 2).tolist(),
                "size": (high - low).tolist(),
            }
        )
    one_sided = int(np.count_nonzero(patches.one_sided))
    return {"count": len(patches.areas), "one_sided": one_sided, "flipped": flipped}


# ---- fill rules, advice and faults


def _compared(
    octrees: dict[str, Octree], shares: dict[str, Share], found: dict[str, Any]
) -> dict[str, Any]:
    """Return the voxels of each fill rule, the recommended one, and the rows that leak."""
    fill, why = _recommended_fill(found, octrees)
    rules = {}
    for rule, octree in octrees.items():
        extra, missing = count_differences(octree, octrees[fill])
        rules[rule] = {"voxels": octree.count, "missing": missing, "extra": extra}
        rules[rule]["share"] = shares[rule].permille / 1000
    rows = leaking_rows(octrees["parity"])
    _, ny, nz = octrees["parity"].grid.shape
    return {
        "leaking_rows": {
            "count": len(rows),
            "of": ny * nz,
            "low": rows.min(axis=0).tolist() if len(rows) else None,
            "high": rows.max(axis=0).tolist() if len(rows) else None,
            "rows": rows[:LISTED].tolist(),
        },
        "fills": rules,
        "recommended": {"fill": fill, "why": why},
    }


def _roles(found: dict[str, Any]) -> list[str]:
    return [shell["is"] for shell in found["shells"]]


def _recommended_fill(found: dict[str, Any], octrees: dict[str, Octree]) -> tuple[str, str]:
    """Return the fill rule that suits a mesh, which is that of "auto", and why."""
    if "auto" in octrees:
        united = ": their union is filled" * ("parts overlap" in found["choice"])
        return "auto", found["choice"] + united
    if found["auto"] == "parity":
        return "parity", "the mesh is closed, and no row has a winding number other than 0 and 1"
    return found["auto"], "it suits meshes that are open, or doubled"


def _faults(found: dict[str, Any]) -> Iterator[Fault]:
    """Yield what is wrong, and what helps."""
    patches, roles = found["patches"], _roles(found)
    flipped = sum(patch["faces"] for patch in patches["flipped"])
    repeated, flat, intersecting = (
        found[f"{kind}_faces"]["count"] for kind in ("duplicate", "degenerate", "self_intersecting")
    )
    holes = "close the holes, or fill by winding"
    if found["t_junctions"]:
        holes = "no holes: edges end within others (T-junctions)"
    crowded = found["diagnosis"].nonmanifold_edges
    for count, noun, more, hint in (
        (len(found["loops"]), "boundary loop", "", holes),
        (crowded, "edge", " of more than two faces", REMOVE_INSIDE),
        (flipped, "face", " flipped", "reverse them, or fill by auto"),
        (patches["one_sided"], "patch", " with one side only", "voxelize it as a surface"),
        (repeated, "duplicate face", "", "remove them"),
        (flat, "degenerate face", "", "remove them, or keep them: voxels do not depend on them"),
        (intersecting, "self-intersecting face", "", UNITE),
        (roles.count("inside out"), "shell", " inside out", "reverse its faces"),
        (roles.count("nested alike"), "shell", " wound like the one around it", REVERSE_CAVITIES),
    ):
        if count:
            yield Fault(f"{counted(count, noun)}{more}", hint)
