"""Self-intersections: faces of a mesh through which others pass.

Two triangles are apart if the corners of one are on the same side of the other's plane. If not,
they meet where an edge of one passes through the other, touching included [Guigue 2003]; if they
are coplanar, where no edge of either separates them. Corners and edges that they share do not
count: if they share one corner, the edges opposite to it decide; if they share two, they meet if
they fold back onto each other. All of that are signs of determinants, which are exact
(kernels/spatial/exact_sides.h): of coordinates down to 2^-188 of half the mesh's extent.

Where many faces lie near each other, as about the apex of a large fan, the pairs are too many to be
tested. The work for each face is bounded, and faces that would need more are reported as undecided.

Kernels: kernels/spatial/self_intersections.cl.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl import program
from voxtool.spatial.bvh import build_tree

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.spatial.bvh import TriangleTree

SOURCE = "spatial/self_intersections.cl"
UNDECIDED = 2
LEFT_OUT = 3  # of faces that are not examined, while kernels run
NEAR = 128  # faces that are tested against each face
TESTS = 1 << 23  # shared by the faces that NEAR leaves undecided; more in large meshes
STEPS = (4, 2, 1)  # of the rounds for a home: the share of the way to go, as its divisor
MORE = 12  # rounds at most in which vertices move to their last home, after these
CROSSED = 8  # shells that are listed for a face that crosses them
CLEAR = 1 << 30  # of a listed shell: it is crossed clear of edges
HEADERS = {
    "spatial/self_intersections.h": program.c_constants(
        UNDECIDED=UNDECIDED, CROSSED=CROSSED, CLEAR=CLEAR
    )
}


def find_self_intersections(
    device: Device,
    mesh: Mesh,
    tree: TriangleTree,
    tests: int = TESTS,
    some: np.ndarray | None = None,
) -> np.ndarray:
    """Return whether another face meets each face outside their common corners and edges, (F,)
    uint8: 0, 1, or UNDECIDED where too many faces are near to test them all.

    Faces without area, and those that are not in the tree, do not count. The tree has names.
    `some` are the faces that are tested against all, (F,) bool, with 0 for the others; None for
    all.
    """
    scale = math.ldexp(1.0, -tree.frame.exponent)
    vertices, faces = device.put(mesh.vertices * scale), device.put(mesh.faces)
    centre = device.put(tree.frame.centre * scale)
    corners = device.put(mesh.positions[mesh.faces].astype(np.int32))
    found = device.zeros(len(mesh.faces), np.uint8)
    if some is not None:
        found = device.put(np.where(some, 0, LEFT_OUT).astype(np.uint8))
    with device.stage("self-intersections"):
        find = device.kernel(SOURCE, "find_self_intersections")
        shared = (tree.names, vertices, faces, corners, centre, tree.nodes, tree.first_leaf)
        find(tree.count, *shared, NEAR, 0, found)
        undecided = np.count_nonzero(found.get() == UNDECIDED)
        most = max(tests, NEAR * tree.count) // max(undecided, 1)
        if undecided and most > 2 * NEAR:
            find(tree.count, *shared, min(most, 1 << 31), UNDECIDED, found)
        result = found.take()
    result[result == LEFT_OUT] = 0
    return result


def crossing_shells(
    device: Device, mesh: Mesh, of: np.ndarray, meeting: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of shells of which an edge of one passes through a face of the other, (n, 2)
    int64, in rising order, and whether it does so clear of the face's edges, (n,) bool.

    Shells that touch, with an end of an edge on a face, do not cross; nor do those whose edges and
    faces are as near as rounding. If a face crosses more than CROSSED shells, others are found from
    their side.

    of : (F,) int64, the shell of each face; meeting : of find_self_intersections.
    """
    some = np.flatnonzero((meeting != 0) & (of >= 0))
    if len(np.unique(of[some])) < 2:
        return np.empty((0, 2), np.int64), np.empty(0, bool)
    tree = build_tree(device, mesh, np.zeros(len(of), np.uint8), some)
    names, frame = tree.names, tree.frame
    assert names  # the tree has names
    vertices, faces = device.put(frame.local(mesh.vertices)), device.put(mesh.faces)
    found = device.zeros(CROSSED * tree.count, np.int32)
    with device.stage("crossing parts"):
        device.kernel(SOURCE, "list_crossing_shells")(
            tree.count, names, vertices, faces, device.put(of.astype(np.int32)), tree.nodes,
            tree.first_leaf, found,
        )  # fmt: skip
    own = of[names.get()[: tree.count] // 3]
    listed = found.take().reshape(-1, CROSSED)
    face, slot = np.nonzero(listed)
    clear, other = listed[face, slot] >= CLEAR, (listed[face, slot] & ~CLEAR) - 1
    pairs = np.sort(np.stack([own[face], other], axis=1), axis=1)
    pairs, which = np.unique(pairs, axis=0, return_inverse=True)
    return pairs, np.bincount(which.reshape(-1), clear, len(pairs)) > 0


def rounds(
    homes: Sequence[np.ndarray], first: Sequence[int] = ()
) -> Iterator[tuple[np.ndarray, int]]:
    """Yield the homes that vertices of faces that meet others move to, round by round, each with
    the divisor of the way to go; `first` are those of rounds for the first home, before STEPS."""
    yield from ((homes[0], divisor) for divisor in first)
    yield from itertools.product(homes, STEPS)
    yield from [(homes[-1], STEPS[-1])] * MORE
