"""A bounding volume hierarchy over the triangles of a mesh.

A packed R-tree [Kamel 1993]: the triangles are sorted along a Hilbert curve through their centres,
LEAF of them make a leaf, ARITY children a node, and every level is filled from the left. Unlike the
binary tree of [Karras 2012] it has no links, needs no case for equal codes and no atomics: each
level is bounded after the one below it. A node is tested against all of its children at once, in a
vector. Along a Morton curve, queries near the surface of the bunny or the dragon visit 1.5 to 2
times as many leaves.

Kernels: kernels/spatial/bvh.cl.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MeshError
from voxtool.mesh.once import once
from voxtool.mesh.topology import merged_faces
from voxtool.opencl import Array, Device, program
from voxtool.opencl.primitives import radix_sort

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh

SOURCE = "spatial/bvh.cl"
ARITY = 8  # children of a node: the width of the kernels' vectors of boxes
LEAF = 4  # triangles of a leaf: the width of the kernels' vectors of triangles
FIELDS = 15  # numbers of a triangle, as in kernels/spatial/point_triangle.h
MAX_LEVELS = 10  # of nodes: ARITY**10 * LEAF exceeds int32
FACE_BITS = 21  # bits of the Hilbert curve along an axis, for triangles
POINT_BITS = 10  # and for points
MARGIN_BITS = 20  # a box in single precision is 2**-20 wider than its content
NAMELESS = 0xFFFFFFFF  # the name of a face without area
MAX_EXPONENT = 500  # squares of lengths up to 2**500 are in the range of float64

HEADERS = {
    "spatial/bvh.h": program.c_constants(
        ARITY=ARITY,
        LEAF=LEAF,
        FIELDS=FIELDS,
        MAX_LEVELS=MAX_LEVELS,
        FACE_BITS=FACE_BITS,
        POINT_BITS=POINT_BITS,
        MARGIN_BITS=MARGIN_BITS,
    ),
    "spatial/names.h": program.c_constants(NAMELESS=NAMELESS),
}


@dataclass(frozen=True)
class Frame:
    """Local coordinates, in which the device works: the mesh's box is centred at 0, in [-1, 1].

    centre : (3,) float64, world units; exponent : world = centre + 2**exponent * local.
    """

    centre: np.ndarray
    exponent: int

    @classmethod
    def of(cls, mesh: Mesh, most: int = MAX_EXPONENT) -> Frame:
        """Return the frame of a mesh; raise MeshError if it has no faces, or an extent beyond
        2**-most and 2**most."""
        low, high = 0.5 * mesh.bounds
        half = float((high - low).max())
        exponent = math.frexp(half)[1]
        if not (math.isfinite(half) and abs(exponent) <= most):
            raise MeshError(
                f"{mesh.name or 'mesh'}: its extent of {2 * half:g} is beyond the range of "
                f"2^±{most}: scale the mesh"
            )
        return cls(low + high, exponent)

    def local(self, points: np.ndarray) -> np.ndarray:
        """Return local coordinates of points, infinite or NaN where a point is, or on overflow."""
        with np.errstate(over="ignore", invalid="ignore"):
            return (points - self.centre) * math.ldexp(1.0, -self.exponent)


@dataclass(frozen=True)
class TriangleTree:
    """Triangles and their boxes on the device, in local coordinates.

    Nodes are numbered from the root, 0, as if every level were full: the children of node i are
    ARITY * i + 1 and the following; from first_leaf on they are leaves. A slot is the place of a
    triangle in the order of the leaves; the last leaf repeats the last triangle.

    nodes : float32, for each node low x, y, z and high x, y, z of its ARITY children;
    leaves : float64, for each leaf FIELDS of its LEAF triangles (see frame_triangles);
    face_of : uint32, the face of each slot;
    count : number of triangles;
    names : uint32, for each slot three times the face plus the corner that comes first there,
        NAMELESS for faces without area; None if not asked for.
    """

    frame: Frame
    nodes: Array
    leaves: Array
    face_of: Array
    first_leaf: int
    count: int
    names: Array | None

    def parts(self) -> list[tuple[int, int]]:
        """Return the first node of each level, from the root down, and how many nodes it has."""
        count, counts = -(-self.count // LEAF), []
        while count > 1 or not counts:
            count = -(-count // ARITY)
            counts.append(count)
        firsts = [first_node(level) for level in range(len(counts))]
        return list(zip(firsts, counts[::-1], strict=True))


def first_node(level: int) -> int:
    """Return the number of the first node of a level; the root's level is 0."""
    return (ARITY**level - 1) // (ARITY - 1)


def tree_bytes(faces: int) -> int:
    """Return the bytes on the device of the tree over a number of faces, names included."""
    leaves = -(-faces // LEAF)
    return leaves * LEAF * (8 * FIELDS + 8) + (leaves * 8 // 7 + 8 * ARITY) * 24


@once
def distinct_faces(mesh: Mesh) -> np.ndarray | None:
    """Return the faces of which no earlier one has the same three corners in local coordinates,
    (n,) int64, rising; None for all. Distances to the others are the same."""
    return merged_faces(replace(mesh, vertices=Frame.of(mesh).local(mesh.vertices)))


def build_tree(
    device: Device, mesh: Mesh, flat: np.ndarray | None = None, some: np.ndarray | None = None
) -> TriangleTree:
    """Return the tree over the faces of a mesh, degenerate ones included, or over `some` of them.

    `flat` is (F,) uint8, 1 for faces without area; None gives no names. Raises MeshError as
    Frame.of, and DeviceError if the device has no double precision.
    """
    device.require_float64("exact distances and winding numbers")
    frame, n = Frame.of(mesh), len(mesh.faces)
    vertices, faces = device.put(frame.local(mesh.vertices)), device.put(mesh.faces)
    with device.stage("tree"):
        order = _sort_faces(device, vertices, faces, n)
        if some is not None:
            chosen, n = order.get(), len(some)
            order = device.put(chosen[np.isin(chosen, some)])
        slots = -(-n // LEAF) * LEAF
        leaves, face_of = device.empty(slots * FIELDS, np.float64), device.empty(slots, np.uint32)
        frame_triangles = device.kernel(SOURCE, "frame_triangles")
        frame_triangles(slots, vertices, faces, n, order, leaves, face_of)
        nodes, first_leaf = _bound(device, vertices, faces, n, order)
        names = None
        if flat is not None:
            names = device.empty(slots, np.uint32)
            name_triangles = device.kernel(SOURCE, "name_triangles")
            name_triangles(slots, vertices, faces, face_of, device.put(flat), names)
    return TriangleTree(frame, nodes, leaves, face_of, first_leaf, n, names)


def _sort_faces(device: Device, vertices: Array, faces: Array, n: int) -> Array:
    """Return the (n,) uint32 faces along the Hilbert curve; equal codes keep the mesh's order."""
    codes, order = device.empty(n, np.uint64), device.empty(n, np.uint32)
    device.kernel(SOURCE, "face_codes")(n, vertices, faces, codes, order)
    return radix_sort(codes, n, 3 * FACE_BITS, order)[1]


def _bound(
    device: Device, vertices: Array, faces: Array, n: int, order: Array
) -> tuple[Array, int]:
    """Return the nodes, bounded level by level from the leaves up, and the first leaf's number."""
    count = -(-n // LEAF)
    levels = 1
    while ARITY**levels < count:
        levels += 1
    parents = -(-count // ARITY)
    first = first_node(levels - 1)
    nodes = device.empty((first + parents) * 6 * ARITY, np.float32)
    bound_leaves = device.kernel(SOURCE, "bound_leaves")
    bound_leaves(parents * ARITY, vertices, faces, n, order, first, nodes)
    bound_nodes = device.kernel(SOURCE, "bound_nodes")
    for level in range(levels - 1, 0, -1):
        count, parents = parents, -(-parents // ARITY)
        bound_nodes(parents * ARITY, first_node(level), count, first_node(level - 1), nodes)
    return nodes, first_node(levels)
