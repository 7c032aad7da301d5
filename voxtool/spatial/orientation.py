"""The faces of a mesh that are to be reversed so that all point outward.

The faces are joined to sheets across edges of two faces, which tell how neighbours are wound. Lines
through points of a sheet then tell which of its two sides is out [Takayama 2014]: the side that is
seen from outside, along lines that meet nothing there; or, where that says little, as inside of a
closed shell, the side with an even number of faces before the outside, if the other one's is odd.
Points and directions are quasi-random, and votes are counted. A sheet that neither decides keeps
the direction that most of its area has. Copies of a face count once, and get the same direction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.shells import Sheets, find_sheets
from voxtool.mesh.topology import topology_of, twins_of, ways_of
from voxtool.opencl import Device, default_device
from voxtool.spatial.bvh import Frame, build_tree
from voxtool.spatial.crossings import count_crossings
from voxtool.spatial.sampling import sample_cube, sample_triangles
from voxtool.vector import cross, dot, length

LINES = 1 << 15  # through all sheets
LEAST, MOST = 4, 1024  # through a sheet
DECISIVE = 16  # one vote in DECISIVE lines, more for one side than for the other, decides
GRAZING = 1 / 16  # lines at a smaller angle to their face, by its sine, do not count


@dataclass(frozen=True, eq=False)
class Orientation:
    """The directions of the faces of a mesh.

    mesh : Mesh, the oriented one: the given one if no face is reversed.
    reversed : (F,) bool.
    sheets, seen, counted, kept : int, the sheets with an area and two sides, and how many of them
        the view from outside decides, how many the parity, and how many neither.
    """

    mesh: Mesh
    reversed: np.ndarray
    sheets: int
    seen: int
    counted: int
    kept: int


def orient(mesh: Mesh, device: Device | None = None) -> Orientation:
    """Return a mesh with its faces pointing outward; raises as build_tree."""
    device = device or default_device()
    twins = twins_of(mesh)
    twins = np.arange(len(mesh.faces)) if twins is None else twins
    first, copy = np.unique(twins, return_index=True, return_inverse=True)[1:]
    once = replace(mesh, faces=mesh.faces[first])
    topology = topology_of(once)
    sheets = find_sheets(topology)
    proper = np.flatnonzero(topology.proper)
    triangles = Frame.of(mesh).local(mesh.vertices)[once.faces[proper]]
    areas = length(cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    lines, seen, parity = _votes(device, once, proper, triangles, areas, sheets)
    by_view = (DECISIVE * np.abs(seen) >= lines) & (lines > 0)
    by_parity = (DECISIVE * np.abs(parity) >= lines) & (lines > 0) & ~by_view
    surplus = np.bincount(sheets.of, np.where(sheets.alike, areas, -areas), len(proper))
    out = np.where(by_view, seen, np.where(by_parity, parity, surplus)) >= 0
    turned = np.zeros(len(first), bool)
    turned[proper] = (sheets.alike != out[sheets.of]) & ~sheets.one_sided
    _, way = ways_of(mesh.positions[mesh.faces])
    flipped = turned[copy] ^ (way != way[first][copy])
    count = int(np.count_nonzero(lines))
    of_view, of_parity = (int(np.count_nonzero(by)) for by in (by_view, by_parity))
    faces = np.where(flipped[:, None], mesh.faces[:, [0, 2, 1]], mesh.faces)
    oriented = replace(mesh, faces=faces) if flipped.any() else mesh
    return Orientation(oriented, flipped, count, of_view, of_parity, count - of_view - of_parity)


def _votes(
    device: Device,
    mesh: Mesh,
    proper: np.ndarray,
    triangles: np.ndarray,
    areas: np.ndarray,
    sheets: Sheets,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lines through each sheet, and the votes that the direction of its first face is
    out: those for it minus those against it, by the view from outside and by parity, (n,) int64
    each, at the sheet's first face; 0 elsewhere and for sheets with one side."""
    n = len(proper)
    none = np.zeros(n, np.int64)
    faces, number = _sampled_faces(sheets, areas)
    if not len(faces):
        return none, none, none
    a, b, c = triangles[faces].transpose(1, 0, 2)
    points = sample_triangles(a, b, c, number)
    along = _directions(MOST)[number]
    normal = cross(b - a, c - a) * np.where(sheets.alike[faces], 1.0, -1.0)[:, None]
    rise = dot(normal, along)
    along = np.where(rise[:, None] < 0, -along, along)
    kept = np.abs(rise) > GRAZING * length(normal) * length(along)
    ahead, behind = count_crossings(
        device, mesh, build_tree(device, mesh), points[kept], along[kept], proper[faces[kept]]
    )
    of = sheets.of[faces[kept]]
    seen = (ahead == 0) * 1.0 - (behind == 0)
    parity = behind % 2.0 - ahead % 2.0
    lines, seen, parity = (np.bincount(of, votes, n) for votes in (np.ones(len(of)), seen, parity))
    return lines.astype(np.int64), seen.astype(np.int64), parity.astype(np.int64)


def _sampled_faces(sheets: Sheets, areas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the faces through which lines pass, by area in each sheet, and the numbers of the
    lines in their sheets."""
    total = np.bincount(sheets.of, areas, len(areas))
    chosen = np.flatnonzero((total[sheets.of] > 0) & ~sheets.one_sided)
    if not len(chosen):
        return chosen, chosen
    order = chosen[np.argsort(sheets.of[chosen], kind="stable")]
    along = np.cumsum(areas[order] / total[sheets.of[order]])  # adds one by one, in order
    starts = np.flatnonzero(np.diff(sheets.of[order], prepend=-1))
    ends = np.append(starts[1:], len(order))
    per_sheet = min(max(LINES // len(starts), LEAST), MOST)
    before = np.append(0.0, along)[starts][:, None]
    number = np.arange(per_sheet)
    at = before + (number + 0.5) / per_sheet * (along[ends - 1][:, None] - before)
    places = np.searchsorted(along, at.ravel(), side="right").reshape(at.shape)
    places = np.minimum(places, ends[:, None] - 1)
    return order[places.ravel()], np.tile(number, len(starts))


def _directions(count: int) -> np.ndarray:
    """Return the points of R3 in a unit ball without its middle, (count, 3) float64: directions in
    all of space, nearly uniform."""
    ball = 2 * sample_cube(4 * count) - 1
    square = dot(ball, ball)
    return ball[(square <= 1) & (square > 1 / 16)][:count]
