"""The Hausdorff distance between meshes: two bounds that hold, by branch and bound.

The directed distance from a mesh to another is the largest distance from a point of the one to the
other. The distances at vertices, and at the centroids of pieces of faces, are lower bounds of it
[Guthe 2005]. The largest of them plus the tolerance is the reach. Most faces are within reach by
the distances of their corners and their size. Whatever of the others is within reach of
single triangles is cut off. The distance to a triangle is convex [Sacht 2024]: where corners of a
piece, and points on its edges, are within reach of it, so is their hull. Each round cuts by the
triangles nearest to the centroids of all pieces. A piece of which little would be cut off is
halved. In the end nothing is left, so no point is beyond the reach. Cuts follow the edges of the
other mesh. So where surfaces coincide the number of pieces grows as the logarithm of 1 / tolerance;
by halving alone it would grow as 1 / tolerance.

No result depends on the size of batches: pieces keep their order, and the reach is that of a round.

Rounding: in the local coordinates of the other mesh (bvh.Frame), of which none exceeds R >= 1, a
distance is off by less than 430 u R, u = 2^-53: the estimate of kernels/spatial/nearest_packets.cl,
for numbers below 9. A corner that a cut makes is off by less than 9 u R, as is a centroid, and by
as much more of the surface the pieces may miss after a round. ERROR R is more than all of it, and
both bounds are moved outward by that.

Kernels: kernels/spatial/hausdorff.cl.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.arrays import Data
from voxtool.errors import MeshError, VoxtoolError
from voxtool.memory import check_memory
from voxtool.mesh.lengths import in_units
from voxtool.opencl import default_device
from voxtool.spatial.bvh import tree_bytes
from voxtool.spatial.distance import (
    POINT_BYTES,
    POINTS_AT_ONCE,
    TriangleDistance,
    local_block,
    rounded_bytes,
)
from voxtool.vector import length

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

SOURCE = "spatial/hausdorff.cl"
TOLERANCE = 1e-5  # by default, of the diagonal of the box around both meshes
ROUNDS = 128
ERROR = 2.0**-42  # more than (430 + 9 (ROUNDS + 2)) 2^-53
NEARLY = 2.0**-6  # of a reach: what is nearer to it may be taken for beyond
PIECES = 1 << 21  # left after a round, at most; those nearest to the other mesh are given up
PIECES_AT_ONCE = 1 << 18  # cut on the device
PIECE_BYTES = 448  # bytes of a piece on the host, with what two parts of it take
PART_BYTES = 256  # bytes of a piece on the device


@dataclass(frozen=True, eq=False)
class DirectedHausdorff(Data):
    """The largest distance from a point of a mesh to another mesh lies between two bounds.

    Attributes
    ----------
    lower, upper : float
        World units; rounding is included.
    point, nearest : (3,) float64
        Where the distance is `lower`, up to rounding: a point of the mesh, and the nearest point of
        the other.
    pieces : int
        Pieces of faces whose distances were computed.
    """

    lower: float
    upper: float
    point: np.ndarray
    nearest: np.ndarray
    pieces: int

    def as_dict(self) -> dict[str, Any]:
        """Return the attributes by name, of JSON types."""
        ends = {"point": self.point.tolist(), "nearest": self.nearest.tolist()}
        return {"lower": self.lower, "upper": self.upper, **ends, "pieces": self.pieces}


@dataclass(frozen=True)
class Hausdorff:
    """The Hausdorff distance between two meshes lies between two bounds.

    Attributes
    ----------
    tolerance : float
        How far apart the bounds of each direction may be, world units.
    a_to_b, b_to_a : DirectedHausdorff
        From points of each mesh to the other.
    """

    tolerance: float
    a_to_b: DirectedHausdorff
    b_to_a: DirectedHausdorff

    @property
    def lower(self) -> float:
        """The larger of the two lower bounds, world units."""
        return max(self.a_to_b.lower, self.b_to_a.lower)

    @property
    def upper(self) -> float:
        """The larger of the two upper bounds, world units."""
        return max(self.a_to_b.upper, self.b_to_a.upper)

    def as_dict(self) -> dict[str, Any]:
        """Return the attributes by name, of JSON types."""
        ways = {"a_to_b": self.a_to_b.as_dict(), "b_to_a": self.b_to_a.as_dict()}
        return {"lower": self.lower, "upper": self.upper, "tolerance": self.tolerance, **ways}


def hausdorff(
    a: Mesh,
    b: Mesh,
    tolerance: float | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> Hausdorff:
    """Return bounds of the Hausdorff distance; see voxtool.hausdorff."""
    b = in_units(b, a.units)
    tolerance = tolerance_of(a, b, tolerance)
    ways = (
        directed_hausdorff(*pair, tolerance, device=device, max_memory=max_memory)
        for pair in ((a, b), (b, a))
    )
    return Hausdorff(tolerance, *ways)


def directed_hausdorff(
    mesh: Mesh,
    other: Mesh,
    tolerance: float | None = None,
    faces: np.ndarray | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> DirectedHausdorff:
    """Return bounds of the directed distance; see voxtool.directed_hausdorff."""
    other = in_units(other, mesh.units)
    tolerance = tolerance_of(mesh, other, tolerance)
    chosen = mesh.faces if faces is None else mesh.faces[_checked(faces, len(mesh.faces))]
    block = min(POINTS_AT_ONCE, len(chosen))
    tree = tree_bytes(len(other.faces)) + rounded_bytes(len(other.faces))
    fixed = tree + POINT_BYTES * block + PART_BYTES * min(PIECES_AT_ONCE, block)
    instead = "simplify the meshes"
    check_memory(fixed + PIECE_BYTES * len(chosen), "distances of meshes", instead, max_memory)
    most = PIECES if max_memory is None else min(PIECES, (max_memory - fixed) // PIECE_BYTES)
    to = TriangleDistance(other, device or default_device())
    with to.device.stage("bounds"):
        return bound(mesh, chosen, to, tolerance, most)


def tolerance_of(a: Mesh, b: Mesh, tolerance: float | None) -> float:
    """Return the tolerance in world units, by default TOLERANCE of the diagonal of the box around
    both meshes; raise VoxtoolError if it is not positive."""
    if tolerance is None:
        ends = np.concatenate([a.bounds, b.bounds])
        size = ends.max(axis=0) - ends.min(axis=0)
        return TOLERANCE * float(size.max() * length(size / size.max()))
    if not 0 < tolerance < math.inf:
        raise VoxtoolError(f"tolerance {tolerance:g}: give a length greater than 0")
    return float(tolerance)


def _checked(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the numbers of faces that are given by number or by a mask."""
    numbers = np.asarray(faces)
    if numbers.dtype == bool and numbers.shape == (count,):
        numbers = np.flatnonzero(numbers)
    if numbers.ndim != 1 or not np.issubdtype(numbers.dtype, np.integer):
        raise MeshError(
            f"faces of shape {numbers.shape} and type {numbers.dtype}: give numbers of faces, or a "
            f"mask of shape ({count},)"
        )
    if not len(numbers) or numbers.min() < 0 or numbers.max() >= count:
        raise MeshError(f"faces: give numbers from 0 to {count - 1}, at least one")
    return numbers


def bound(
    mesh: Mesh, faces: np.ndarray, to: TriangleDistance, tolerance: float, most: int = PIECES
) -> DirectedHausdorff:
    """Return bounds of the largest distance from a point of (n, 3) faces of a mesh to another mesh.

    They are at most `tolerance` apart, or 3 ERROR R if that is more; further apart if more than
    `most` pieces would be left after a round.
    """
    frame, local = to.tree.frame, to.tree.frame.local(mesh.vertices)
    at_vertices = _at_vertices(to, mesh.vertices, faces)
    lower, furthest = _furthest(at_vertices, local)
    error = ERROR * max(1.0, float(np.abs(local[at_vertices >= 0]).max()))
    gap = max(math.ldexp(tolerance, -frame.exponent) - 2 * error, error)
    uppers = _at_faces(to.device, local, at_vertices, faces)
    far = uppers > lower + gap
    covered, count = float(uppers[~far].max(initial=0)), 0
    pieces, uppers = local[faces[far]], uppers[far]
    for _ in range(ROUNDS):
        if not len(pieces):
            break
        count += len(pieces)
        centroids = (pieces[:, 0] + pieces[:, 1] + pieces[:, 2]) / 3
        distances, slots = _nearest(to, centroids)
        highest, point = _furthest(distances, centroids)
        if highest > lower:
            lower, furthest = highest, point
        reach = max(lower + gap, covered)
        pieces, counts, found, hull = _cut(to, pieces, slots, reach, gap / 4)
        uppers = np.repeat(np.minimum(uppers, found), counts)
        covered = max(covered, hull)
        if len(pieces) > most:
            covered = max(covered, float(np.partition(uppers, -most)[-most]))
            pieces, uppers = pieces[uppers > covered], uppers[uppers > covered]
    upper = max(lower, covered, float(uppers.max(initial=0)))
    nearest = to.at_block(local_block(to.device, furthest[None]), located=True).points
    assert nearest is not None
    return DirectedHausdorff(
        math.ldexp(max(lower - error, 0.0), frame.exponent),
        math.ldexp(upper + error, frame.exponent),
        np.ldexp(furthest, frame.exponent) + frame.centre,
        nearest[0],
        count,
    )


def faces_beyond(
    mesh: Mesh, faces: np.ndarray, to: TriangleDistance, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return which of (n, 3) faces of a mesh may have a point further than `reach` from another
    mesh, (n,) bool, and the largest distance that was found of each, (n,) float64; world units.

    Every point of the other faces is within reach. Faces whose largest distance is less than the
    reach by more than NEARLY of it are never named.
    """
    frame, local = to.tree.frame, to.tree.frame.local(mesh.vertices)
    beyond, largest = np.zeros(len(faces), bool), np.zeros(len(faces))
    for start in range(0, len(faces), PIECES_AT_ONCE):
        part = slice(start, start + PIECES_AT_ONCE)
        beyond[part], largest[part] = _beyond(local, mesh, faces[part], to, reach)
    return beyond, np.ldexp(largest, frame.exponent)


def _beyond(
    local: np.ndarray, mesh: Mesh, faces: np.ndarray, to: TriangleDistance, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return as faces_beyond, distances in local coordinates."""
    at_vertices = _at_vertices(to, mesh.vertices, faces)
    error = ERROR * max(1.0, float(np.abs(local[at_vertices >= 0]).max()))
    limit = math.ldexp(reach, -to.tree.frame.exponent) - 2 * error
    largest = at_vertices[faces].max(axis=1)
    beyond = largest > limit
    near = _at_faces(to.device, local, at_vertices, faces) <= limit
    owners = np.flatnonzero(~(near | beyond))
    pieces = local[faces[owners]]
    for _ in range(ROUNDS):
        if not len(pieces):
            break
        distances, slots = _nearest(to, (pieces[:, 0] + pieces[:, 1] + pieces[:, 2]) / 3)
        np.maximum.at(largest, owners, distances)
        beyond[owners[distances > limit]] = True
        kept = ~beyond[owners]
        if kept.any():
            pieces, counts, _, _ = _cut(to, pieces[kept], slots[kept], limit, NEARLY * limit)
            owners = np.repeat(owners[kept], counts)
        else:
            owners, pieces = owners[:0], pieces[:0]
    beyond[owners] = True
    return beyond, largest


def _at_vertices(to: TriangleDistance, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the local distances of the vertices that faces use, -1 for others, (V,) float64."""
    used, distances = np.zeros(len(vertices), bool), np.full(len(vertices), -1.0)
    used[faces] = True
    found = [to.search(block, None)[0].take() for block in to.blocks(vertices[used])]
    distances[used] = np.concatenate(found)
    return distances


def _at_faces(
    device: Device, vertices: np.ndarray, distances: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Return upper bounds of the distances of faces whose vertices have these distances."""
    uppers = device.empty(len(faces), np.float64)
    own = map(device.put, (vertices, distances, faces))
    device.kernel(SOURCE, "bound_faces")(len(faces), *own, uppers)
    return uppers.take()


def _furthest(distances: np.ndarray, points: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the largest distance, and the first point that has it."""
    first = int(np.argmax(distances))
    return float(distances[first]), points[first]


def _nearest(to: TriangleDistance, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of (n, 3) local points, and the slots of the nearest triangles."""
    distances, slots = np.empty(len(points)), np.empty(len(points), np.uint32)
    for start in range(0, len(points), to.block):
        block = local_block(to.device, points[start : start + to.block], start)
        found, nearest = to.search(block, to.tree.face_of)
        assert nearest is not None
        distances[block.where], slots[block.where] = found.take(), nearest.take()
    return distances, slots


def _cut(
    to: TriangleDistance, pieces: np.ndarray, slots: np.ndarray, reach: float, slack: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return what is left of (n, 3, 3) pieces when the parts within reach are cut away, the number
    of triangles left of each piece, upper bounds of the distances of each piece, and an upper bound
    of the distances of all that was cut away."""
    device, covered = to.device, 0.0
    left: list[np.ndarray] = []
    numbers: list[np.ndarray] = []
    bounds: list[np.ndarray] = []
    cut_pieces = device.kernel(SOURCE, "cut_pieces")
    for start in range(0, len(pieces), PIECES_AT_ONCE):
        batch = slice(start, start + PIECES_AT_ONCE)
        own = device.put(pieces[batch]), device.put(slots[batch])
        n = own[1].size
        parts, counts = device.empty(18 * n, np.float64), device.empty(n, np.uint8)
        found, hulls = (device.empty(n, np.float64) for _ in range(2))
        cut_pieces(n, *own, to.tree.leaves, reach, slack, parts, counts, found, hulls)
        numbers.append(counts.take())
        some = numbers[-1][:, None] > np.arange(2)
        left.append(parts.take().reshape(-1, 3, 3)[some.ravel()])
        bounds.append(found.take())
        covered = max(covered, float(hulls.take().max()))
    return np.concatenate(left), np.concatenate(numbers), np.concatenate(bounds), covered
