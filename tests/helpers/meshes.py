"""Small meshes for tests: makers, and hypothesis strategies.

Every mesh is a pair: vertices (V, 3) and faces (F, 3) int64. Makers keep the type of their
numbers: whole numbers stay whole; spheres and tori are float64. `fixed` turns voxels into 1/256
voxel, and the strategies draw vertices in these units.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import strategies as st

import voxtool
from voxtool.selftest.shapes import BOX_FACES, OCTAHEDRON_FACES, TETRAHEDRON_FACES, join, subdivide

if TYPE_CHECKING:
    from collections.abc import Sequence

    Mesh = tuple[np.ndarray, np.ndarray]

UNIT = 256  # a voxel


def mesh_of(vertices: Any, faces: Any = None, name: str = "") -> voxtool.Mesh:
    """Return a Mesh, unchecked; without faces, of three vertices after the other."""
    vertices = np.ascontiguousarray(vertices, np.float64).reshape(-1, 3)
    faces = np.arange(len(vertices)) if faces is None else faces
    return voxtool.Mesh(vertices, np.array(faces, np.int32).reshape(-1, 3), name=name)


def fixed(vertices: np.ndarray) -> np.ndarray:
    """Vertices in voxels to int64 in 1/256 voxel."""
    return np.rint(np.asarray(vertices, np.float64) * UNIT).astype(np.int64)


def box(low: Sequence | float, high: Sequence | float) -> Mesh:
    """12 outward triangles; vertex 4 i + 2 j + k is the corner (i, j, k)."""
    ends = np.stack(np.broadcast_arrays(low, high, np.zeros(3, np.int64))[:2])
    corners = np.indices((2, 2, 2)).reshape(3, -1).T
    return ends[corners, np.arange(3)], BOX_FACES.copy()


def open_box(low: Sequence | float, high: Sequence | float, missing: int = 5) -> Mesh:
    """A box without one side: 0 to 5 stand for -x, +x, -y, +y, -z, +z."""
    vertices, faces = box(low, high)
    return vertices, np.delete(faces, (2 * missing, 2 * missing + 1), axis=0)


def tetrahedron(
    p: Sequence = (1, 1, 1),
    q: Sequence = (5, 1, 1),
    r: Sequence = (1, 5, 1),
    s: Sequence = (1, 1, 5),
) -> Mesh:
    """4 triangles, outward whatever the order of the corners."""
    vertices = np.array([p, q, r, s])
    a, b, c = (vertices[1:] - vertices[0]).astype(object)  # unbounded
    flipped = (np.cross(a, b) * c).sum() < 0
    return vertices, TETRAHEDRON_FACES[:, ::-1].copy() if flipped else TETRAHEDRON_FACES.copy()


def octahedron(centre: Sequence | float = 0, radius: float = 1) -> Mesh:
    """8 outward triangles."""
    corners = np.concatenate([s * np.eye(3, dtype=np.int64)[a] for a in range(3) for s in (1, -1)])
    return corners.reshape(6, 3) * radius + np.asarray(centre), OCTAHEDRON_FACES.copy()


def icosphere(subdivisions: int = 2, centre: Sequence | float = 0.0, radius: float = 1.0) -> Mesh:
    """20 * 4**subdivisions outward triangles with their vertices on a sphere."""
    g = (1 + np.sqrt(5)) / 2
    rows = [(0.0, a, b * g) for a in (-1, 1) for b in (-1, 1)]
    vertices = np.concatenate([np.roll(rows, shift, axis=1) for shift in range(3)])
    near = ((vertices[:, None] - vertices) ** 2).sum(axis=2) < 4.5  # the edges have length 2
    faces = np.array(
        [
            (i, j, k)
            for i in range(12)
            for j in range(i + 1, 12)
            for k in range(i + 1, 12)
            if near[i, j] and near[j, k] and near[k, i]
            and np.linalg.det(vertices[[i, j, k]]) > 1
        ]
    )  # fmt: skip
    for _ in range(subdivisions):
        vertices, faces = subdivide((vertices, faces))
    vertices = vertices / np.sqrt((vertices**2).sum(axis=1, keepdims=True))
    return vertices * radius + np.asarray(centre, np.float64), faces


def torus(
    centre: Sequence | float = 0.0,
    major: float = 2.0,
    minor: float = 1.0,
    sides: tuple[int, int] = (24, 12),
) -> Mesh:
    """2 * sides[0] * sides[1] outward triangles around the z axis."""
    n, m = sides
    u, v = (2 * np.pi * np.arange(count) / count for count in sides)
    ring = major + minor * np.cos(v)
    x, y = np.outer(np.cos(u), ring), np.outer(np.sin(u), ring)
    z = np.broadcast_to(minor * np.sin(v), (n, m))
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3) + np.asarray(centre, np.float64)
    i, j = (a.ravel() for a in np.indices((n, m)))
    at = [((i + a) % n) * m + (j + b) % m for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate([np.stack([at[0], at[1], at[2]], 1), np.stack([at[0], at[2], at[3]], 1)])
    return vertices, faces


def tube(
    points: np.ndarray, radius: float | np.ndarray, sides: int = 8, *, closed: bool = False
) -> Mesh:
    """A closed tube about a curve, without a sharp turn: (n, 3) points that it passes through in
    order, back to the first one if it is closed, and its radius, or that at each point."""
    points = np.asarray(points, float)
    n = len(points)
    along = np.gradient(points, axis=0)
    if closed:
        along = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.cross(along[0], [0.3, 0.5, 0.81])
    turns = 2 * np.pi * np.arange(sides)[:, None] / sides
    rings = []
    for point, direction, size in zip(points, along, np.broadcast_to(radius, n), strict=True):
        across = across - direction * (across @ direction)
        across /= np.linalg.norm(across)
        other = np.cross(direction, across)
        rings.append(point + size * (np.cos(turns) * across + np.sin(turns) * other))
    ring, side = np.meshgrid(np.arange(n if closed else n - 1), np.arange(sides), indexing="ij")
    twist = np.zeros_like(ring)  # of the last ring to the first
    if closed:
        gaps = np.linalg.norm(rings[-1][0] - rings[0], axis=1)
        twist[-1] = int(np.argmin(gaps))
    a, b = ring * sides + side, ring * sides + (side + 1) % sides
    after = (ring + 1) % n * sides
    c, d = after + (side + twist) % sides, after + (side + 1 + twist) % sides
    faces = [np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]
    vertices = np.concatenate(rings)
    if not closed:
        k, k1 = np.arange(sides), (np.arange(sides) + 1) % sides
        first, last = np.full(sides, len(vertices)), np.full(sides, len(vertices) + 1)
        faces.append(np.stack([first, k1, k], -1))
        faces.append(np.stack([last, k + (n - 1) * sides, k1 + (n - 1) * sides], -1))
        vertices = np.concatenate([vertices, points[[0, -1]]])
    return vertices, np.concatenate(faces)


def plate(normal: Sequence, half: float, thickness: float, centre: Sequence) -> Mesh:
    """A square plate across a normal, of sides 2 half."""
    axis = np.asarray(normal, float) / np.linalg.norm(normal)
    u = np.cross(axis, [0.2, 0.5, 0.7])
    u /= np.linalg.norm(u)
    frame = np.stack([u, np.cross(axis, u), axis])
    vertices, faces = box([-half, -half, -thickness / 2], [half, half, thickness / 2])
    return vertices @ frame + np.asarray(centre), faces


def random_triangles(
    rng: np.random.Generator,
    n: int,
    shape: Sequence[int] = (16, 16, 16),
    size: float | None = None,
    margin: float = 1.0,
) -> Mesh:
    """n triangles that share no vertex, in 1/256 voxel.

    size : half the side of the cube that holds a triangle, in voxels; by default the whole grid.
    margin : how far beyond the grid the cubes' centres (or the vertices) may lie, in voxels.
    """
    low, high = -round(margin * UNIT), np.asarray(shape) * UNIT + round(margin * UNIT)
    if size is None:
        vertices = rng.integers(low, high, (n, 3, 3), endpoint=True)
    else:
        reach = max(1, round(size * UNIT))
        centres = rng.integers(low, high, (n, 1, 3), endpoint=True)
        vertices = centres + rng.integers(-reach, reach, (n, 3, 3), endpoint=True)
    return vertices.reshape(-1, 3), np.arange(3 * n).reshape(n, 3)


def hard_triangles(n: int) -> np.ndarray:
    """Return triangles, (n, 3, 3), of any size and shape: many are slivers, needles or points."""
    rng = np.random.default_rng(16)
    a, e, f = rng.uniform(-1, 1, (3, n, 3)) * np.array([0.5, 0.25, 0.25])[:, None, None]
    e *= np.exp2(-rng.integers(0, 48, (n, 1)))
    f *= np.exp2(-rng.integers(0, 48, (n, 1)))
    thin = rng.random((n, 1)) < 0.5
    third = a + np.where(thin, rng.uniform(0, 1, (n, 1)) * e + f * np.exp2(-20), f)
    return np.stack([a, a + e, third], axis=1)


def _coordinate(low: int, high: int, step: int) -> st.SearchStrategy[int]:
    return st.integers(-(-low // step), high // step).map(lambda i: i * step)


def _point(shape: Sequence[int], beyond: int, step: int) -> st.SearchStrategy[tuple]:
    """A point up to `beyond` voxels outside the grid, a multiple of `step` units on each axis."""
    ends = [(-beyond * UNIT, (n + beyond) * UNIT) for n in shape]
    return st.tuples(*(_coordinate(low, high, step) for low, high in ends))


STEPS = st.sampled_from([1, 32, UNIT // 2, UNIT])


@st.composite
def _triangle(draw: st.DrawFn, shape: Sequence[int], reach: int) -> np.ndarray:
    kinds = ("any", "lattice", "plane", "tiny", "point", "segment", "line", "outside", "spanning",
             "ramp")  # fmt: skip
    kind = draw(st.sampled_from(kinds))
    step = 1 if kind == "any" else draw(STEPS)
    near = _point(shape, 1, step)
    corners = np.array([draw(near) for _ in range(3)], np.int64)
    if kind == "plane":
        axis = draw(st.integers(0, 2))
        corners[:, axis] = draw(_coordinate(0, shape[axis] * UNIT, UNIT // 2))
    elif kind == "ramp":  # parallel to an axis
        axis = draw(st.integers(0, 2))
        corners[1] = corners[0]
        corners[1, axis] = draw(_coordinate(0, shape[axis] * UNIT, step))
    elif kind == "tiny":
        small = st.tuples(*[st.integers(-24, 24)] * 3)
        corners = corners[0] + np.array([draw(small) for _ in range(3)], np.int64)
    elif kind == "point":
        corners[1:] = corners[0]
    elif kind == "segment":
        corners[draw(st.integers(0, 2))] = corners[draw(st.integers(0, 2))]
    elif kind == "line":
        along = np.array(draw(_point((1, 1, 1), 1, step)), np.int64)
        times = st.integers(-4, 4)
        corners = corners[0] + np.array([[draw(times)] for _ in range(3)]) * along
    elif kind == "outside":
        axis = draw(st.integers(0, 2))
        span = (shape[axis] + 2) * UNIT
        corners[:, axis] += draw(st.sampled_from([-1, 1])) * span
    elif kind == "spanning":
        corners = np.array([draw(_point(shape, reach, step)) for _ in range(3)], np.int64)
    return corners


@st.composite
def fixed_triangles(
    draw: st.DrawFn, shape: Sequence[int], max_triangles: int = 4, reach: int = 64
) -> Mesh:
    """Up to max_triangles loose triangles, in 1/256 voxel: random, tiny, on lattice planes,
    degenerate (points, segments, collinear), partly and wholly outside the grid, spanning it.

    reach : how far beyond the grid spanning triangles go, in voxels; 4096 and more call for more
        than 64 bits.
    """
    corners = draw(st.lists(_triangle(shape, reach), min_size=1, max_size=max_triangles))
    return np.concatenate(corners), np.arange(3 * len(corners)).reshape(-1, 3)


@st.composite
def closed_meshes(
    draw: st.DrawFn, shape: Sequence[int] = (16, 16, 16), beyond: int = 2, parts: int = 2
) -> Mesh:
    """Up to `parts` closed meshes as one, in 1/256 voxel: boxes, octahedra and tetrahedra, some
    subdivided, some dented, snapped to a lattice, a half-lattice or finer. Every edge has two
    faces, but the parts may cross each other and themselves, have faces without area, be inside
    out in places, and leave the grid."""
    return join(*(draw(_closed(shape, beyond)) for _ in range(draw(st.integers(1, parts)))))


@st.composite
def _closed(draw: st.DrawFn, shape: Sequence[int], beyond: int) -> Mesh:
    step = draw(STEPS)
    point = _point(shape, beyond, step)
    kind = draw(st.sampled_from(["box", "tetrahedron", "octahedron"]))
    if kind == "tetrahedron":
        vertices, faces = tetrahedron(*(draw(point) for _ in range(4)))
    else:
        low, high = np.sort([draw(point), draw(point)], axis=0)
        if kind == "box":
            vertices, faces = box(low, high)
        else:
            vertices, faces = octahedron(1, 1)  # within [0, 2]
            vertices = low + vertices * (high - low) // 2
    if draw(st.booleans()):
        vertices, faces = subdivide((vertices, faces))
    vertices = vertices // step * step
    for index in draw(st.lists(st.integers(0, len(vertices) - 1), max_size=3)):
        vertices[index] = draw(point)
    return vertices, faces
