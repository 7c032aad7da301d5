"""A tree of boxes over the triangles of a mesh.

A packed R-tree (Kamel and Faloutsos, "On packing R-trees", CIKM 1993): the triangles in the order
of a Hilbert curve through their middles, LEAF of them in a leaf, ARITY children in a node, every
level filled from the left. Beside Karras's binary tree along a Morton curve ("Maximizing
Parallelism in the Construction of BVHs, Octrees, and k-d Trees", HPG 2012) it has no links, no
cases for equal codes and no climb with atomics: a level is bounded after the one below it. A node
is tested against all of its children at once, in a vector. The Hilbert curve pays: with this tree
along a Morton curve, a query at the surface of the bunny or the dragon visits 1.5 to 2 times as
many leaves.

Kernels: kernels/spatial/bvh.cl.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import DeviceError, MeshError
from voxtool.opencl import Array, Device, program
from voxtool.opencl.primitives import radix_sort

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh

SOURCE = "spatial/bvh.cl"
ARITY = 8  # children of a node, and
LEAF = 4  # triangles of a leaf; the kernels' vector types are of these widths
FIELDS = 15  # numbers of a triangle, as in kernels/spatial/point_triangle.h
MAX_LEVELS = 10  # of nodes: ARITY**10 * LEAF is more than there are int32
FACE_BITS = 21  # of the curve along an axis, for triangles
POINT_BITS = 10  # and for points
MARGIN_BITS = 20  # a box in single precision is 2**-20 wider than what it holds
NAMELESS = 0xFFFFFFFF  # triangle of a leaf
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
    """The coordinates in which the device works: the mesh's box about 0, within [-1, 1].

    centre : (3,) float64, world units; exponent : world = centre + 2**exponent * local.
    """

    centre: np.ndarray
    exponent: int

    @classmethod
    def of(cls, mesh: Mesh) -> Frame:
        """The frame of a mesh.

        Raises
        ------
        MeshError : the mesh has no faces, or an extent whose square float64 cannot hold.
        """
        low, high = 0.5 * mesh.bounds
        half = float((high - low).max())
        exponent = math.frexp(half)[1]
        if not (math.isfinite(half) and abs(exponent) <= MAX_EXPONENT):
            raise MeshError(
                f"{mesh.name or 'mesh'}: its extent of {2 * half:g} is beyond the range of "
                f"2^±{MAX_EXPONENT}: scale the mesh"
            )
        return cls(low + high, exponent)

    def local(self, points: np.ndarray) -> np.ndarray:
        """World to local; infinite or NaN where the result, or a point, is not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            return (points - self.centre) * math.ldexp(1.0, -self.exponent)


@dataclass(frozen=True)
class TriangleTree:
    """Triangles and their boxes on the device, in local coordinates.

    Nodes are numbered from the root, 0, as if every level were full: the children of node i are
    ARITY * i + 1 and the following; from first_leaf on they are leaves.

    nodes : float32, of each node low x, y, z and high x, y, z, each of ARITY children in turn;
    leaves : float64, of each leaf FIELDS, each of LEAF triangles in turn (see frame_triangles);
    count : of triangles; the last leaf repeats the last one;
    names : uint32, of each triangle in a leaf (see name_triangles), or None if not asked for.
    """

    frame: Frame
    nodes: Array
    leaves: Array
    first_leaf: int
    count: int
    names: Array | None

    def parts(self) -> list[tuple[int, int]]:
        """Of each level of nodes, from the root down, the first node and how many there are."""
        count, counts = -(-self.count // LEAF), []
        while count > 1 or not counts:
            count = -(-count // ARITY)
            counts.append(count)
        firsts = [(ARITY**level - 1) // (ARITY - 1) for level in range(len(counts))]
        return list(zip(firsts, counts[::-1], strict=True))


def build_tree(device: Device, mesh: Mesh, flat: np.ndarray | None = None) -> TriangleTree:
    """The tree over all faces of a mesh, degenerate ones included.

    Parameters
    ----------
    flat : (F,) uint8, 1 for faces that get no name; None gives no names at all.

    Raises
    ------
    MeshError : as Frame.of.
    DeviceError : the device has no double precision.
    """
    if not device.info.fp64:
        raise DeviceError(
            f"{device.info.name} has no double precision (cl_khr_fp64), which exact distances "
            "need: choose another device (see voxtool devices)"
        )
    frame = Frame.of(mesh)
    vertices, faces = device.put(frame.local(mesh.vertices)), device.put(mesh.faces)
    n = len(mesh.faces)
    with device.stage("tree"):
        order = _sort_faces(device, vertices, faces, n)
        count = -(-n // LEAF)
        leaves = device.empty(count * LEAF * FIELDS, np.float64)
        device.kernel(SOURCE, "frame_triangles")(
            count * LEAF, vertices, faces, np.uint32(n), order, leaves
        )
        nodes, first_leaf = _bound(device, vertices, faces, n, order)
        names = None
        if flat is not None:
            names, nameless = device.empty(count * LEAF, np.uint32), device.put(flat)
            device.kernel(SOURCE, "name_triangles")(
                count * LEAF, vertices, faces, np.uint32(n), order, nameless, names
            )
            nameless.release()
    for array in (vertices, faces, order):
        array.release()
    return TriangleTree(frame, nodes, leaves, first_leaf, n, names)


def _sort_faces(device: Device, vertices: Array, faces: Array, n: int) -> Array:
    """(n,) uint32: the faces along the curve; equal codes stay in the mesh's order."""
    codes, order = device.empty(n, np.uint64), device.empty(n, np.uint32)
    device.kernel(SOURCE, "face_codes")(n, vertices, faces, np.uint32(n), codes, order)
    codes, order = radix_sort(codes, n, 3 * FACE_BITS, order)
    codes.release()
    return order


def _bound(
    device: Device, vertices: Array, faces: Array, n: int, order: Array
) -> tuple[Array, int]:
    """The nodes, level by level from the leaves up, and the number of the first leaf."""
    count = -(-n // LEAF)
    levels = 1
    while ARITY**levels < count:
        levels += 1
    first = [(ARITY**level - 1) // (ARITY - 1) for level in range(levels + 1)]
    parents = -(-count // ARITY)
    nodes = device.empty((first[levels - 1] + parents) * 6 * ARITY, np.float32)
    device.kernel(SOURCE, "bound_leaves")(
        parents * ARITY, vertices, faces, np.uint32(n), order, np.uint32(first[levels - 1]), nodes
    )
    bound_nodes = device.kernel(SOURCE, "bound_nodes")
    for level in range(levels - 1, 0, -1):
        count, parents = parents, -(-parents // ARITY)
        bound_nodes(
            parents * ARITY,
            np.uint32(first[level]),
            np.uint32(count),
            np.uint32(first[level - 1]),
            nodes,
        )
    return nodes, first[levels]
