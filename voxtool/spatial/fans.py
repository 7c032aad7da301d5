"""Fans: the thin faces about a crowded vertex, and books: the faces about a crowded edge. Their
winding numbers are sums of few terms.

Long faces about one vertex or edge are near every point around them, so that a tree of boxes sums
all of them. Here bundles of faces count at once: those between the apex a and places near c. Let
f(q) be the solid angle of the triangle (a, c, q). The faces of the tetrahedron (a, c, q, r) are
closed, so that the solid angle of the face (a, q, r) is f(r) - f(q) plus that of (c, q, r), as long
as the point is not in the tetrahedron. The triangles (c, q, r) of a bundle are small and count
through their moments; f is smooth where the ray from the point away from the apex does not pass
near c, so that its Taylor series to the third order needs the moments of q - c alone. A bundle
counts at once if that ray is farther from c than REACH times the bundle's radius; then the point is
in none of the tetrahedra, either. Otherwise its parts do, and in the end single faces, exactly.

In a book the faces (a, b, q) are those of (a, b, c) and of f about a less f about b, as long as the
point is not in the tetrahedron (a, b, c, q): a bundle counts at once if the point is outside of the
wedge about the line a b that contains the bundle, and both rays pass far from c.

The order of a sum depends on the point and the fan alone. Beside the sums over all faces, at 4,500
points in, around and near fans of 3,000 and 20,000 faces, the error was at most 8e-4 and 2.4e-4
RMS, as that of the tree; in a book of 20,000 faces, whose numbers reach 271, 0.011, of the tree
0.24. 4,096 points take 0.1 s of processor time in a fan and 1.6 s in a book of a million faces,
instead of 0.2 s for each thousand faces.

Kernels: kernels/spatial/fans.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.morton import morton_encode
from voxtool.opencl import Array, Device, program
from voxtool.spatial.bvh import ARITY, LEAF, Frame
from voxtool.vector import dot

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh

SOURCE = "spatial/fans.cl"
CROWDED = 512  # faces of a fan, at least
THIN = 16.0  # squared length of a face beside the apex, over that of its side at the rim, at least
REACH = 5.0  # radii of a bundle
BUNDLE = ARITY * LEAF  # faces of a smallest bundle
SUMS = 42  # numbers of a bundle
DEEP = 10  # levels of bundles: BUNDLE * ARITY**9 exceeds int32
HEADERS = {
    "spatial/fans.h": program.c_constants(SUMS=SUMS, BUNDLE=BUNDLE, DEEP=DEEP),
}


@dataclass(frozen=True, eq=False)
class Fan:
    """The faces about a vertex or an edge, on the device, in the local coordinates of a frame.

    apex : (3,) float64: the vertex. spine : (3,) float64: from there to the edge's other end; 0.
    rim : float64, in leaves of LEAF faces: x, y, z of the start of each side opposite to the apex,
        and of the way to its end; or of the corner opposite to the edge, and the sign of the face,
        0, 0. The last leaf has ways or signs of 0.
    count : number of faces.
    bundles : float64, SUMS of each bundle, level by level, from those of BUNDLE faces on.
    """

    apex: np.ndarray
    spine: np.ndarray
    rim: Array
    count: int
    bundles: Array

    def add_numbers(self, n: int, points: Array, order: Array, numbers: Array) -> None:
        """Add the winding numbers of the fan about n points on the device to `numbers`."""
        wind_fan = self.rim.device.kernel(SOURCE, "wind_fan", **_options(self.spine))
        ends = ((*end.tolist(), 0.0) for end in (self.apex, self.spine))
        wind_fan(n, points, order, *ends, self.rim, self.count, self.bundles, numbers)


def find_fans(mesh: Mesh, some: np.ndarray | None, device: Device) -> tuple[list[Fan], np.ndarray]:
    """Return the fans among the faces of a mesh, or among `some` of them, and whether each face is
    in one, (F,) bool. A face that could be in several is in that of its most crowded vertex or
    edge."""
    chosen = np.arange(len(mesh.faces)) if some is None else some
    in_fan = np.zeros(len(mesh.faces), bool)
    places = mesh.positions[mesh.faces[chosen]]
    crowds = np.bincount(places.ravel(), minlength=1)
    if crowds.max(initial=0) < CROWDED:
        return [], in_fan
    triangles = Frame.of(mesh).local(mesh.vertices)[mesh.faces[chosen]]
    crowd = crowds[places]
    corner, (a, q, r) = crowd.argmax(axis=1), _turned(triangles, crowd.argmax(axis=1))
    thin = THIN * dot(r - q, r - q) < np.minimum(dot(q - a, q - a), dot(r - a, r - a))
    groups = _crowded(places[np.arange(len(places)), corner], thin)
    zero = np.zeros(3)
    fans = [fan_of(a[g[0]], zero, q[g], r[g] - q[g], device) for g in groups]

    left = np.count_nonzero(crowd >= CROWDED, axis=1) >= 2
    left[np.concatenate([*groups, []]).astype(np.int64)] = False
    rows = np.flatnonzero(left)
    start, end = places[rows], np.roll(places[rows], -1, axis=1)
    edges, of_edge = np.unique(
        np.minimum(start, end) << 32 | np.maximum(start, end), return_inverse=True
    )
    pages = np.bincount(of_edge.ravel(), minlength=len(edges))[of_edge.reshape(-1, 3)]
    side = pages.argmax(axis=1)
    forward = (start < end)[np.arange(len(rows)), side]
    low, high, page = _turned(triangles[rows], side)
    low, high = np.where(forward[:, None], (low, high), (high, low))
    signs = np.insert(np.zeros((len(rows), 2)), 0, np.where(forward, 1, -1), axis=1)
    books = _crowded(of_edge.reshape(-1, 3)[np.arange(len(rows)), side], np.ones(len(rows), bool))
    fans += [fan_of(low[g[0]], high[g[0]] - low[g[0]], page[g], signs[g], device) for g in books]
    in_fan[chosen[np.concatenate([*groups, *(rows[g] for g in books), []]).astype(np.int64)]] = True
    return fans, in_fan


def _turned(triangles: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the corners of (n, 3, 3) triangles from their first ones on, (n, 3) each."""
    rows = np.arange(len(triangles))
    a, b, c = (triangles[rows, (first + i) % 3] for i in range(3))
    return a, b, c


def _crowded(places: np.ndarray, fits: np.ndarray) -> list[np.ndarray]:
    """Return the rows that fit at each of the places that CROWDED or more have."""
    rows = np.flatnonzero(fits)
    rows = rows[np.argsort(places[rows], kind="stable")]
    starts = np.flatnonzero(np.diff(places[rows], prepend=-1))
    return [part for part in np.split(rows, starts[1:]) if len(part) >= CROWDED]


def fan_of(
    apex: np.ndarray, spine: np.ndarray, start: np.ndarray, way: np.ndarray, device: Device
) -> Fan:
    """Return the fan of faces about an apex or a spine, with the (n, 3) numbers of Fan.rim."""
    count = len(start)
    middles = start + way / 2 if not spine.any() else start
    order = np.argsort(morton_encode(((1 + middles) * 2.0**19).astype(np.int64)), kind="stable")
    sides = np.concatenate([start, way], axis=1)[order]
    sides = np.append(sides, np.repeat(sides[-1:], -count % LEAF, axis=0), axis=0)
    sides[count:, 3:] = 0
    rim = device.put(sides.reshape(-1, LEAF, 6).transpose(0, 2, 1).ravel())
    sizes = [BUNDLE]
    while sizes[-1] < count:
        sizes.append(sizes[-1] * ARITY)
    counts = [-(-count // size) for size in sizes]
    bundles, first = device.empty(sum(counts) * SUMS, np.float64), 0
    sum_bundles = device.kernel(SOURCE, "sum_bundles", **_options(spine))
    for size, n in zip(sizes, counts, strict=True):
        sum_bundles(n, rim, count, size, first, REACH, bundles)
        first += n
    return Fan(apex, spine, rim, count, bundles)


def _options(spine: np.ndarray) -> dict[str, int | str]:
    return {"BOOK": 1} if spine.any() else {}
