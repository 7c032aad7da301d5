"""The distance from points to a triangle mesh, in float64.

The result is the least of the distances to all triangles, each computed in the same way wherever
the triangle is stored: the tree saves work and changes no bit. Points are in local coordinates
(bvh.Frame), rounded once. Over 200,000 distances to slivers, needles and other triangles, the error
against rational arithmetic was at most 6e-16 of the mesh's extent, or of the distance if that is
larger. Degenerate faces count as the segments and points that they are. If pseudo-normals are
given, distances are negative inside.

Many points go in packets: 16 neighbours share the traversal, for which nodes have oriented boxes
[Gottschalk 1996], and distances are computed in single precision, with a bound on the error, before
those that can be least. A triangle that is nearest in one packet is tested first in the next.

Kernels: distance.cl and nearest_packets.cl in kernels/spatial.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.opencl import Array, Device, default_device, program
from voxtool.opencl.device import VECTOR
from voxtool.opencl.primitives import radix_sort
from voxtool.spatial.bvh import (
    ARITY,
    FIELDS,
    LEAF,
    MAX_EXPONENT,
    POINT_BITS,
    TriangleTree,
    build_tree,
    distinct_faces,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.mesh.mesh import Mesh
    from voxtool.spatial.pseudonormals import Pseudonormals

SOURCE, PACKETS = "spatial/distance.cl", "spatial/nearest_packets.cl"
POINTS_AT_ONCE = 1 << 20  # on the device: the more there are, the nearer is the next
POINT_BYTES = 48  # bytes of a point on the device: position, order, codes, distance
SORTED_FROM = 1 << 9  # points: fewer are not sorted
NEAR = 8.0  # extents within which single precision bounds distances to boxes; see MARGIN_BITS
POINTS = VECTOR  # of a packet, which are near each other and share a traversal
PACKETS_FROM = 1 << 13  # points: fewer are too far apart

RUN = 8  # packets of a work-item
RUNS_TOGETHER = 8  # work-items of a group, which have much to do
ORIENTED = 15  # numbers of an oriented box: centre, three axes, half of the extents
ORIENTED_LEVELS = 4  # of the tree, leaves included: packets are small beside larger boxes

HEADERS = {
    "spatial/nearest_packets.h": program.c_constants(POINTS=POINTS, RUN=RUN, ORIENTED=ORIENTED)
}


def rounded_bytes(faces: int) -> int:
    """Return the bytes on the device of what packets need of a number of faces."""
    leaves = -(-faces // LEAF)
    return 4 * (FIELDS * LEAF * leaves + ORIENTED * (leaves * 8 // 7 + ARITY * ORIENTED_LEVELS))


class Nearest(NamedTuple):
    """The distances of points, and on request the nearest triangles.

    distances : (n,) float64, world units.
    faces : (n,) int64; of equally near faces the first in the mesh.
    points : (n, 3) float64: the nearest points of the mesh, world units.
    directions : (n, 3) float64 from these to the points, of length 1; on the surface the normal of
        the face, 0 where it has no area.
    """

    distances: np.ndarray
    faces: np.ndarray | None = None
    points: np.ndarray | None = None
    directions: np.ndarray | None = None


@dataclass(frozen=True)
class Rounded:
    """A tree in single precision, for packets.

    triangles : float32, FIELDS of each slot; boxes : float32, ORIENTED of each node from `first`
    on, of the lowest levels.
    """

    triangles: Array
    boxes: Array
    first: int


@dataclass(frozen=True)
class PointBlock:
    """Points on the device."""

    where: slice  # of these points among all
    n: int
    local: Array  # float64 local coordinates
    order: Array  # uint32, in which points near each other follow each other
    box: str  # "float" or "double": the precision in which distances to boxes can be bounded


class TriangleDistance:
    """The distance to a mesh. The tree is built once, for any number of calls."""

    def __init__(
        self,
        mesh: Mesh,
        device: Device | None = None,
        *,
        normals: Pseudonormals | None = None,
        block: int = POINTS_AT_ONCE,
        near: float = NEAR,
        packets_from: int | None = None,
    ) -> None:
        """Build the tree. With normals, distances are negative inside.

        No result depends on the others: the number of points that are on the device at once, the
        extents within which boxes are bounded in single precision, and the number of points from
        which they go in packets, by default what suits the device.
        """
        self.device = device or default_device()
        self.block, self.near = block, near
        suits = self.device.lanes == POINTS
        self._packets_from = packets_from or (PACKETS_FROM if suits else math.inf)
        self._rounded: Rounded | None = None
        if normals is not None and normals.flat.all():  # no face has a side
            normals = None
        flat = normals.flat if normals else None
        self.tree = build_tree(self.device, mesh, flat, distinct_faces(mesh))
        self._sides: tuple[Array, ...] = ()
        self._has_flat = False
        if normals:
            self._sides = tuple(map(self.device.put, (normals.features, normals.normals)))
            self._has_flat = bool(normals.flat.any())

    def __call__(self, points: Any) -> np.ndarray:
        """Return the distance from each of (N, 3) points to the nearest triangle, (N,) float64.

        Both are in world units. Far away (from about 2**40 extents) every triangle is tested.
        Raises VoxtoolError for a wrong shape, or a point that is not finite or 2^500 extents away.
        """
        world = checked_points(points)
        distances = np.empty(len(world))
        for block in self.blocks(world):
            distances[block.where] = self.at_block(block).distances
        return distances

    def nearest(self, points: np.ndarray) -> Nearest:
        """Return all of Nearest for (N, 3) points in world units; raises VoxtoolError as the
        call."""
        n = len(points)
        made = np.empty(n), np.empty(n, np.int64), np.empty((n, 3)), np.empty((n, 3))
        for block in self.blocks(points):
            found = self.at_block(block, located=True)
            for whole, part in zip(made, cast("tuple[np.ndarray, ...]", found), strict=True):
                whole[block.where] = part
        return Nearest(*made)

    def blocks(self, world: np.ndarray) -> Iterator[PointBlock]:
        """Return the points on the device, block by block; raises VoxtoolError as the call."""
        return point_blocks(self.device, self.tree, world, self.block, self.near)

    def at_block(self, block: PointBlock, located: bool = False) -> Nearest:
        """Return the distances of a block's points, and if `located` also the nearest triangles."""
        device, tree, scale = self.device, self.tree, self.tree.frame.exponent
        with device.stage("distance"):
            ranks = tree.names if self._sides else tree.face_of if located else None
            distances, slots = self.search(block, ranks)
            if self._sides:
                sign_distances = device.kernel(SOURCE, "sign_distances", BOX="float")
                sign_distances(
                    -(-block.n // LEAF), block.local, block.order, block.n, tree.leaves, slots,
                    tree.names, *self._sides, distances,
                )  # fmt: skip
            if not located:
                return Nearest(np.ldexp(distances.take(), scale))
            if self._has_flat:  # flat faces have no sides, but may be nearest
                _, slots = self.search(block, tree.face_of)
            faces = device.empty(block.n, np.uint32)
            nearest, directions = (device.empty(3 * block.n, np.float64) for _ in range(2))
            describe_nearest = device.kernel(SOURCE, "describe_nearest", BOX="float")
            describe_nearest(
                block.n, block.local, tree.leaves, slots, tree.face_of, faces, nearest, directions
            )
            return Nearest(
                np.ldexp(distances.take(), scale),
                faces.take().astype(np.int64),
                np.ldexp(nearest.take().reshape(-1, 3), scale) + tree.frame.centre,
                directions.take().reshape(-1, 3),
            )

    def nearest_faces(self, points: np.ndarray, grains: float) -> tuple[np.ndarray, np.ndarray]:
        """Return for (N, 3) points the nearest faces, (N,) int64, and the squares of their
        distances in grains, (N,) float64 whole numbers. The first of equally near faces counts.

        `grains` is the number of grains in a square of a unit of the world, a power of two.
        """
        squares, faces = np.empty(len(points)), np.empty(len(points), np.int64)
        face_of = self.tree.face_of.get()
        for block in self.blocks(points):
            found, slots = self.search(block, self.tree.face_of, grains)
            assert slots is not None
            squares[block.where], faces[block.where] = found.take(), face_of[slots.take()]
        return faces, squares

    def search(
        self, block: PointBlock, ranks: Array | None, grains: float = 0
    ) -> tuple[Array, Array | None]:
        """Return local distances of a block's points, (n,) float64, and with ranks (TriangleTree)
        the slots of the nearest triangles, (n,) uint32; with `grains`, as of `nearest_faces`, the
        squares of the distances in grains."""
        device, tree = self.device, self.tree
        options: dict[str, int] = {"RANKED": 1} if ranks else {}
        more = {}
        if grains:
            options["GRAINED"] = 1
            more["grain"] = math.ldexp(grains, 2 * tree.frame.exponent)
        distances = device.empty(block.n, np.float64)
        slots = device.empty(block.n, np.uint32) if ranks else None
        if block.box == "float" and block.n >= self._packets_from:
            rounded = self._rounded = self._rounded or _round(device, tree)
            nearest_in_packets = device.kernel(PACKETS, "nearest_in_packets", **options)
            nearest_in_packets(
                -(-block.n // (RUN * POINTS)), block.local, block.order, block.n, tree.nodes,
                tree.leaves, rounded.triangles, rounded.boxes, tree.count, tree.first_leaf,
                rounded.first, ranks=ranks, slots=slots, distances=distances, **more,
                local=RUNS_TOGETHER,
            )  # fmt: skip
            return distances, slots
        nearest_triangles = device.kernel(SOURCE, "nearest_triangles", BOX=block.box, **options)
        nearest_triangles(
            block.n, block.local, block.order, tree.nodes, tree.leaves, tree.first_leaf,
            ranks=ranks, slots=slots, distances=distances, **more,
        )  # fmt: skip
        return distances, slots


def _round(device: Device, tree: TriangleTree) -> Rounded:
    """Return what packets need of a tree."""
    slots = tree.face_of.size
    triangles = device.empty(slots * FIELDS, np.float32)
    device.kernel(PACKETS, "round_triangles")(slots, tree.leaves, triangles)
    levels = [*tree.parts(), (tree.first_leaf, slots // LEAF)][1:][-ORIENTED_LEVELS:]
    first = levels[0][0]
    boxes = device.empty((tree.first_leaf + slots // LEAF - first) * ORIENTED, np.float32)
    orient_boxes = device.kernel(PACKETS, "orient_boxes")
    for height, (node, count) in enumerate(levels[::-1]):
        span = LEAF * ARITY**height
        orient_boxes(count, tree.leaves, tree.count, span, boxes, node - first)
    return Rounded(triangles, boxes, first)


def others_within(
    device: Device, tree: TriangleTree, points: np.ndarray, reaches: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Return whether other faces than its own are within reach of each point, (n,) bool.

    points : (n, 3), in the mesh's box, reaches : (n,) float64, local coordinates; faces : (n,),
        those of the points.
    """
    n, found = len(points), device.empty(len(points), np.uint8)
    find = device.kernel(SOURCE, "others_within", BOX="float")
    own = tuple(map(device.put, (points, reaches, faces.astype(np.uint32))))
    find(n, *own, tree.nodes, tree.leaves, tree.face_of, tree.first_leaf, found)
    return found.take().astype(bool)


def checked_points(points: Any) -> np.ndarray:
    """Return points as (N, 3) float64; raise VoxtoolError if they are no such array."""
    try:
        world = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        raise VoxtoolError("points are not an array of numbers: give (N, 3)") from None
    if world.ndim != 2 or world.shape[1] != 3:
        raise VoxtoolError(f"points of shape {world.shape}: give (N, 3)")
    return world


def point_blocks(
    device: Device,
    tree: TriangleTree,
    world: np.ndarray,
    block: int = POINTS_AT_ONCE,
    near: float = NEAR,
) -> Iterator[PointBlock]:
    """Yield the points on the device, in local coordinates, `block` of them at a time; raise
    VoxtoolError if a point is not finite or 2^500 extents away."""
    for start in range(0, len(world), block):
        local = tree.frame.local(world[start : start + block])
        reach = np.abs(local).max(axis=1)
        fits = reach <= 2.0**MAX_EXPONENT
        if not fits.all():
            first = start + int(np.argmin(fits))
            place = ", ".join(map(str, world[first].tolist()))
            raise VoxtoolError(
                f"point {first}, ({place}), is not finite or too far from the mesh: remove it"
            )
        yield local_block(device, local, start, near)


def local_block(
    device: Device, local: np.ndarray, start: int = 0, near: float = NEAR
) -> PointBlock:
    """Return (n, 3) points in local coordinates on the device; `start` is the number of the first
    among all."""
    n, box = len(local), "float" if np.abs(local).max() <= near else "double"
    points = device.put(local)
    return PointBlock(slice(start, start + n), n, points, _order(device, points, n), box)


def _order(device: Device, points: Array, n: int) -> Array:
    """Return the points along a Hilbert curve, (n,) uint32; few points keep their order."""
    if n < SORTED_FROM:
        return device.put(np.arange(n, dtype=np.uint32))
    codes, order = device.empty(n, np.uint32), device.empty(n, np.uint32)
    device.kernel(SOURCE, "point_codes", BOX="float")(n, points, codes, order)
    return radix_sort(codes, n, 3 * POINT_BITS, order)[1]
