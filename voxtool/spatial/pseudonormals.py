"""Angle-weighted pseudo-normals of the faces, edges and vertices of a mesh.

Outside of a closed mesh, the way from the nearest point to the query has a positive product with
the pseudo-normal of the feature that the nearest point lies on [Baerentzen 2005]. Edges and
vertices are identified by position, as in mesh.topology, so seams have no effect. Faces on the same
three positions share their normal, so that two back to back bound nothing. The host computes them
with + - * / and square roots; cross products have twice the precision, for the normals of slivers.

Limits, in extents: a point d away beside a blade of less than about 1e-8 / sqrt(d) radians may be
taken for one on the other side, because float64 cannot decide which side is nearer. Where faces
without area close gaps between others (T-junctions), edges have only their own faces; the winding
number is right there, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.mesh.collinear import collinear
from voxtool.mesh.topology import edges_of, twins_of
from voxtool.spatial.bvh import Frame
from voxtool.vector import cross_component, difference, dot, length

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh

# atan t = t + t^3 P(t^2) on [0, tan(pi/8)] to 2e-17: the first twelve terms of the Chebyshev series
# 2 sum (-1)^k q^(2k+1) / (2k+1) T_(2k+1)(t / tan(pi/8)), q = tan(pi/16)
COEFFICIENTS = (
    -0.3333333333333243,
    0.1999999999983741,
    -0.14285714272042474,
    0.11111110465849684,
    -0.09090890205164943,
    0.07691944938571023,
    -0.06661951161621596,
    0.058403740045694916,
    -0.05008550701328832,
    0.03734732216833096,
    -0.017180029701564188,
)
EIGHTH = 0.41421356237309503  # tan(pi/8)
PI = 3.141592653589793
AT_ONCE = 1 << 13  # faces whose normals are computed at once, in memory that fits caches

HEADERS = {
    "spatial/arctangent.h": "\n".join(
        f"#define {name} {value.hex()}"
        for name, value in (
            *((f"ARCTANGENT_{i}", value) for i, value in enumerate(COEFFICIENTS)),
            ("TAN_EIGHTH", EIGHTH),
            ("PI", PI),
        )
    )
}


@dataclass(frozen=True, eq=False)
class Pseudonormals:
    """The pseudo-normals of a mesh.

    flat : (F,) uint8: 1 where a face has no area, exactly, and so no side. It adds to no normal.
    features : (F, 7) uint32: rows of `normals` for the face, its sides ab, bc, ca and its corners.
    normals : (K, 3) float64, not of unit length; 0 where sides cancel.
    """

    flat: np.ndarray
    features: np.ndarray
    normals: np.ndarray


def normal_bytes(faces: int) -> int:
    """Return the bytes of the pseudo-normals of a closed mesh of this many faces on the device."""
    return faces * (7 * 4 + 3 * 24)


@dataclass(frozen=True, eq=False)
class FaceNormals:
    """The normals and angles of the faces of a mesh, which pseudo-normals are summed from.

    flat : (F,) uint8, as of Pseudonormals.
    normals : (F, 3) float64, unit vectors; 0 where a face is flat.
    angles : (F, 3) float64 at the corners, radians.
    """

    flat: np.ndarray
    normals: np.ndarray
    angles: np.ndarray


def face_normals(mesh: Mesh) -> FaceNormals:
    """Return the normals and angles of the faces of a mesh; raises as Frame.of."""
    vertices, n = np.ldexp(mesh.vertices, -Frame.of(mesh).exponent), len(mesh.faces)
    flat, normals, angles = np.empty(n, bool), np.empty((n, 3)), np.empty((n, 3))
    for begin in range(0, n, AT_ONCE):
        some = slice(begin, begin + AT_ONCE)
        triangles = vertices[mesh.faces[some]]
        flat[some] = collinear(triangles)
        normals[some], angles[some] = _normals_and_angles(triangles)
    flat |= (normals == 0).all(axis=1)
    normals[flat] = 0
    return FaceNormals(flat.astype(np.uint8), normals, angles)


def pseudonormals(mesh: Mesh, faces: FaceNormals | None = None) -> Pseudonormals:
    """Return the pseudo-normals of a mesh, from its face_normals if they are known; raises as
    Frame.of."""
    faces = faces or face_normals(mesh)
    n = len(mesh.faces)
    corners = mesh.positions[mesh.faces]
    sides = edges_of(corners)[0].reshape(-1, 3)
    twins = twins_of(mesh)
    planes = (np.arange(n) if twins is None else twins).reshape(-1, 1)
    parts, rows, first = [], [], 0
    for feature, weights in (
        (planes, np.ones((n, 1))),
        (sides, np.ones((n, 3))),
        (corners, faces.angles),
    ):
        parts.append(_sums(feature, weights, faces.normals))
        rows.append(first + feature)
        first += len(parts[-1])
    features = np.concatenate(rows, axis=1).astype(np.uint32)
    return Pseudonormals(faces.flat, features, np.concatenate(parts))


def _sums(feature: np.ndarray, weights: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the weighted sums of the normals of the faces at each feature, in the order of the
    faces."""
    numbers = feature.ravel()
    return np.stack(
        [np.bincount(numbers, (weights * normals[:, axis, None]).ravel()) for axis in range(3)],
        axis=1,
    )


def _normals_and_angles(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (F, 3) unit normals, 0 where there is none, and (F, 3) angles at the corners."""
    a, b, c = (triangles[:, i].T for i in range(3))
    u, v, w = (difference(*ends) for ends in ((b, a), (c, a), (c, b)))
    n = np.stack([sum(cross_component(u, v, i, (i + 1) % 3)) for i in (1, 2, 0)])
    exponent = np.frexp(np.abs(n).max(axis=0))[1]
    n = np.ldexp(n, -exponent)
    size = length(n.T)
    unit = n / np.where(size > 0, size, 1.0)
    area = np.ldexp(size, exponent)
    cosines = (dot(u[0].T, v[0].T), -dot(u[0].T, w[0].T), dot(v[0].T, w[0].T))
    return unit.T, np.stack([angle_of(area, cosine) for cosine in cosines], axis=1)


def angle_of(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the angle of each vector (x, y) from the x axis, in [-pi, pi], within 1e-15; 0 where y
    is 0. It is + - * / alone, as in kernels/spatial/angles.h: the same on every machine."""
    across, along = np.abs(y), np.abs(x)
    small, big = np.minimum(across, along), np.maximum(across, along)
    turned = small > EIGHTH * big
    above = np.where(turned, small - big, small)
    below = np.where(turned, small + big, np.where(big > 0, big, 1.0))
    t = above / below
    z = t * t
    p = np.full_like(z, COEFFICIENTS[-1])
    for coefficient in COEFFICIENTS[-2::-1]:
        p = p * z + coefficient
    angle = t + t * z * p
    angle = np.where(turned, PI / 4 + angle, angle)
    angle = np.where(across > along, PI / 2 - angle, angle)
    angle = np.where(x < 0, PI - angle, angle)
    angle = np.where(y < 0, -angle, angle)
    return np.where(y == 0, 0.0, angle)
