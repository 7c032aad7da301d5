"""Faces through which others pass, against rational arithmetic."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import model
from helpers import meshes
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.files.meshes.mesh import load_mesh
from voxtool.mesh.mesh import Mesh
from voxtool.selftest.contacts import beside_edges
from voxtool.selftest.oracles import whole
from voxtool.spatial.bvh import build_tree
from voxtool.spatial.fill_rule import inside_of_closed
from voxtool.spatial.pseudonormals import pseudonormals
from voxtool.spatial.self_intersections import TESTS, UNDECIDED, find_self_intersections

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.opencl import Device

Point = tuple[Any, ...]  # whole numbers


def crossings(device: Device, vertices, faces=None, tests: int = TESTS) -> np.ndarray:
    vertices = np.asarray(vertices, np.float64).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3) if faces is None else np.asarray(faces)
    mesh = Mesh(vertices, faces.astype(np.int32))
    tree = build_tree(device, mesh, pseudonormals(mesh).flat)
    found = find_self_intersections(device, mesh, tree, tests)
    assert tests < TESTS or found.max(initial=0) < UNDECIDED
    return found if tests < TESTS else found != 0


# ---- the oracle


def minus(a: Sequence, b: Sequence) -> Point:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def dot(a: Sequence, b: Sequence) -> Any:
    return sum(x * y for x, y in zip(a, b, strict=True))


def cross(a: Sequence, b: Sequence) -> Point:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def turn(a: Sequence, b: Sequence, c: Sequence) -> Any:
    """Twice the area of a triangle in the plane."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def within(p: Sequence, triangle: Sequence[Sequence]) -> bool:
    """Return whether a point of the plane is in a triangle, or on its border."""
    a, b, c = triangle
    sides = [turn(a, b, p), turn(b, c, p), turn(c, a, p)]
    return min(sides) >= 0 or max(sides) <= 0


def segments_meet(a: Sequence, b: Sequence, c: Sequence, d: Sequence) -> bool:
    """Return whether two segments of the plane meet."""
    ends = ((a, (c, d)), (b, (c, d)), (c, (a, b)), (d, (a, b)))
    for p, (q, r) in ends:
        if turn(q, r, p) == 0 and dot(minus(p, q), minus(p, r)) <= 0:
            return True
    return turn(a, b, c) * turn(a, b, d) < 0 and turn(c, d, a) * turn(c, d, b) < 0


def segment_meets(p: Sequence, q: Sequence, triangle: Sequence[Sequence]) -> bool:
    """Return whether a segment meets a triangle that has an area."""
    a, b, c = triangle
    normal = cross(minus(b, a), minus(c, a))
    along = max(range(3), key=lambda axis: abs(normal[axis]))

    def seen(point: Sequence) -> Sequence:
        return [x for axis, x in enumerate(point) if axis != along]

    at_p, at_q = dot(normal, minus(p, a)), dot(normal, minus(q, a))
    flat = [seen(corner) for corner in triangle]
    if at_p == at_q == 0:
        edges = zip(flat, [*flat[1:], flat[0]], strict=True)
        return within(seen(p), flat) or any(segments_meet(seen(p), seen(q), *e) for e in edges)
    if at_p * at_q > 0:
        return False
    crossed = [at_p * y - at_q * x for x, y in zip(p, q, strict=True)]  # times at_p - at_q
    return within(seen(crossed), [[(at_p - at_q) * x for x in corner] for corner in flat])


def has_area(t: Sequence) -> bool:
    return any(cross(minus(t[1], t[0]), minus(t[2], t[0])))


def meet(t: Any, u: Any) -> bool:
    """Return whether two triangles meet outside the corners that they share. If they share one, a
    ray from it in both triangles leaves one of them first, across its opposite edge; if they share
    two, they fold back onto each other."""
    corners = [tuple(corner) for corner in whole(np.concatenate([t, u]))[0]]
    t, u = corners[:3], corners[3:]
    shared = set(t) & set(u)
    if not (has_area(t) and has_area(u)):
        return False
    if len(shared) == 3:
        return True
    if len(shared) == 2:
        p, q = shared
        (a,), (b,) = (set(v) - shared for v in (t, u))
        normal = cross(minus(q, p), minus(a, p))
        inward = cross(normal, minus(q, p))
        return dot(normal, minus(b, p)) == 0 and dot(inward, minus(b, p)) > 0
    for one, other in ((t, u), (u, t)):
        for p, q in zip(one, [*one[1:], one[0]], strict=True):
            if not shared & {p, q} and segment_meets(p, q, other):
                return True
    return False


def test_oracle() -> None:
    """On triangles whose answers are seen."""
    t = np.array([(0, 0, 0), (4, 0, 0), (0, 4, 0)])
    for u, meets in (
        ([(1, 1, -1), (1, 1, 1), (5, 5, 1)], True),
        ([(1, 1, 0), (1, 1, 1), (5, 5, 1)], True),  # a corner on the face
        ([(1, 1, 1), (1, 2, 1), (5, 5, 1)], False),
        ([(2, 2, 0), (4, 4, 0), (4, 5, 0)], True),  # in the plane, on the edge
        ([(3, 2, 0), (4, 4, 0), (4, 5, 0)], False),
        ([(1, 1, 0), (2, 1, 0), (1, 2, 0)], True),  # within
        ([(0, 0, 0), (1, 1, 1), (2, 1, 1)], False),  # from a corner up
        ([(0, 0, 0), (1, 1, 1), (1, 1, -1)], True),  # through it
        ([(0, 0, 0), (4, 0, 0), (1, 1, 0)], True),  # folded along an edge
        ([(0, 0, 0), (4, 0, 0), (1, 1, 1)], False),
        ([(0, 0, 0), (4, 0, 0), (1, -1, 0)], False),
        ([(4, 0, 0), (0, 0, 0), (0, 4, 0)], True),  # the same
        ([(1, 1, -1), (1, 1, 0), (1, 1, 1)], False),  # no area
    ):
        assert meet(t, u) == meets == meet(u, t), u


# ---- pairs of triangles

numbers = st.integers(-6, 6)
points = st.tuples(numbers, numbers, numbers)
KINDS = ("any", "plane", "corner", "corner in a plane", "edge", "on the face", "on an edge")


@st.composite
def pairs(draw: st.DrawFn) -> np.ndarray:
    """(2, 3, 3) whole numbers."""
    kind = draw(st.sampled_from(KINDS))
    t, u = (np.array([draw(points) for _ in range(3)]) * 4 for _ in range(2))
    if "plane" in kind:
        for v in (t, u):
            v[:, 2] = v[:, 0] - v[:, 1]
    if "corner" in kind:
        u[0] = t[0]
    elif kind == "edge":
        u[:2] = t[1::-1]
    elif kind == "on the face":
        u[0] = (2 * t[0] + t[1] + t[2]) // 4
    elif kind == "on an edge":
        u[0] = (t[0] + t[1]) // 2
    return np.stack([t[draw(st.permutations(range(3)))], u[draw(st.permutations(range(3)))]])


@given(pairs())
@settings(max_examples=100)
def test_pairs(device: Device, pair: np.ndarray) -> None:
    if not np.ptp(pair.reshape(-1, 3), axis=0).any():
        return  # a point: a mesh without any length
    assert crossings(device, pair).tolist() == [meet(*pair)] * 2


@pytest.mark.parametrize("seed", range(3))
def test_many_pairs(device: Device, seed: int) -> None:
    """On so small a lattice that most touch, lie in a plane, or share corners."""
    rng = np.random.default_rng(seed)
    pair = rng.integers(-1 - seed, 2 + seed, (1500, 2, 3, 3))
    place = np.stack(np.unravel_index(np.arange(len(pair)), (12, 12, 12)), axis=1) * 16
    found = crossings(device, pair + place[:, None, None]).reshape(-1, 2)
    expected = np.array([meet(*p) for p in pair])
    assert 100 < np.count_nonzero(expected) < 1400
    wrong = np.flatnonzero((found != expected[:, None]).any(axis=1))
    assert not len(wrong), pair[wrong[0]].tolist()


@given(pairs(), st.integers(20, 52), points, st.booleans())
@settings(max_examples=100)
def test_what_nearly_meets(
    device: Device, pair: np.ndarray, exponent: int, way: tuple, tilted: bool
) -> None:
    """Moved by as little as a unit in the last place: exactly what meets is found."""
    pair = pair.astype(np.float64) / 64  # within a cube of one side
    pair[1, : 1 if tilted else 3] += np.ldexp(np.array(way, np.float64), -exponent)
    if np.ptp(pair.reshape(-1, 3), axis=0).any():
        assert crossings(device, pair).tolist() == [meet(*pair)] * 2, pair.tolist()


@pytest.mark.parametrize("seed", range(2))
def test_slivers(device: Device, seed: int) -> None:
    """Triangles as thin as 1e-16, nearly parallel, far from the origin or with corners near it, one
    through a point of the other, or as near as rounding."""
    rng = np.random.default_rng(seed)
    found, expected = [], []
    for _ in range(150):
        thin = 10.0 ** -rng.uniform(0, 16)
        a, b = rng.uniform(-1, 1, (2, 3))
        t = np.array([a, b, (a + b) / 2 + thin * rng.normal(size=3)])
        on = rng.dirichlet([1, 1, 1]) @ t
        along = (b - a) + 10.0 ** -rng.uniform(0, 16) * rng.normal(size=3)
        u = np.array([on - along, on + along, on + thin * rng.normal(size=3)])
        pair = np.stack([t, u]) + rng.choice([0, 1e3])
        pair[0, 0] *= rng.choice([1.0, 1e-40])
        expected.append([meet(*pair)] * 2)
        found.append(crossings(device, pair).tolist())
    assert found == expected
    assert 30 < np.count_nonzero(expected) // 2 < 140


# ---- meshes


def met(triangles: np.ndarray) -> np.ndarray:
    """Return which of (n, 3, 3) triangles meet others, (n,) bool."""
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    found = np.zeros(len(triangles), bool)
    for i in range(len(triangles)):
        near = ((low[:i] <= high[i]) & (high[:i] >= low[i])).all(axis=1)
        for j in np.flatnonzero(near):
            if meet(triangles[i], triangles[j]):
                found[[i, j]] = True
    return found


def test_every_face_that_is_met(device: Device) -> None:
    """Against all pairs: meshes that cross others and themselves, and loose triangles."""
    rng = np.random.default_rng(5)
    loose = meshes.random_triangles(rng, 80, (8, 8, 8), size=2)
    closed = meshes.join(
        meshes.box(0, 8), meshes.box(3, 12), meshes.octahedron((20, 4, 4), 4),
        meshes.tetrahedron((20, 4, 8), (22, 5, 13), (18, 5, 13), (20, 2, 14)),
    )  # fmt: skip
    for vertices, faces in (loose, closed, meshes.subdivide(closed)):
        expected = met(vertices[faces])
        assert expected.any()
        assert not expected.all()
        assert np.array_equal(crossings(device, vertices, faces), expected)


@pytest.mark.parametrize("seed", range(4))
def test_splits_beside_edges(device: Device, seed: int) -> None:
    """Faces split 1e-8 to 1e-15 beside their edges, as thin as rounding, some of them folded by
    it: exactly what meets is found, and a mesh without it is simple."""
    rng = np.random.default_rng(seed)
    vertices, faces = meshes.icosphere(1) if seed % 2 else meshes.box(0.0, 1.0)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    vertices, faces = beside_edges(vertices @ q.T, faces, 12, 15, rng)
    vertices, faces = beside_edges(vertices, faces, 13, 15, rng)
    expected = met(vertices[faces])
    assert np.array_equal(crossings(device, vertices, faces), expected)
    inside = inside_of_closed(meshes.mesh_of(vertices, faces), device)
    assert inside is not None
    assert inside.simple != expected.any()


@pytest.mark.parametrize("exponent", [-300, -20, 20, 300])
def test_scale_changes_nothing(device: Device, exponent: int) -> None:
    vertices, faces = meshes.random_triangles(np.random.default_rng(1), 50, (8, 8, 8), size=2)
    one, other = (crossings(device, v, faces) for v in (vertices, np.ldexp(vertices, exponent)))
    assert np.array_equal(one, other)


def test_corners_are_shared_by_position(device: Device) -> None:
    """Vertices in the same place are one corner, whatever their numbers; also 0 and -0."""
    vertices, faces = meshes.icosphere(1)
    assert not crossings(device, vertices, faces).any()
    assert not crossings(device, vertices[faces]).any()
    apart = [(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (-0.0, -0.0, -0.0), (-1, 0, 1), (0, -1, 1)]
    assert not crossings(device, apart).any()


def test_faces_near_too_many_others_are_undecided(device: Device) -> None:
    angle = np.linspace(0, 6, 301)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    fan = np.stack([0 * angle[:-1], np.arange(1, 301), np.arange(2, 302)], axis=1)
    vertices = np.concatenate([[(0, 0, 1)], ring])
    assert not crossings(device, vertices, fan).any()
    few = crossings(device, vertices, fan, tests=0)
    assert (few == UNDECIDED).sum() > 200
    assert (few != 1).all()


def test_faces_without_area_meet_nothing(device: Device) -> None:
    triangle = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]
    for flat in ([(1, 1, -1), (1, 1, 0), (1, 1, 1)], [(1, 1, 0)] * 3):
        assert not crossings(device, [*triangle, *flat]).any()


@pytest.mark.parametrize(
    ("name", "some"),
    [("stanford-bunny", False), ("armadillo", False), ("fandisk", False), ("suzanne", True)],
)
def test_real_models(device: Device, name: str, some: bool) -> None:
    mesh = load_mesh(model(f"{name}.obj"))
    found = crossings(device, mesh.vertices, mesh.faces)
    assert found.any() == some
