"""Bounds of the Hausdorff distance: distances that are known, and another algorithm's bounds."""

from __future__ import annotations

import json

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.distance import brute
from helpers.meshes import mesh_of

import voxtool
from voxtool.errors import MemoryLimitError, MeshError, VoxtoolError
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.spatial import hausdorff as module
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.hausdorff import (
    DirectedHausdorff,
    _cut,
    bound,
    directed_hausdorff,
    faces_beyond,
    hausdorff,
)

ROUNDING = 2.0**-40  # of the extents


def soup(rng: np.random.Generator, n: int, size: float) -> Mesh:
    corners = rng.uniform(size=(n, 1, 3)) + size * rng.normal(size=(n, 3, 3))
    return mesh_of(corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3))


def patch(side: int, seed: int, height: float = 0.0) -> Mesh:
    """The square [0, 1]^2 at a height, with 2 side^2 triangles whose vertices are moved about."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(*[np.arange(side + 1.0)] * 2)
    x[1:-1, 1:-1] += rng.uniform(-0.3, 0.3, (side - 1, side - 1))
    y[1:-1, 1:-1] += rng.uniform(-0.3, 0.3, (side - 1, side - 1))
    first = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    faces = np.concatenate(
        [first[:, None] + (0, 1, side + 1), first[:, None] + (1, side + 2, side + 1)]
    )
    return mesh_of(
        np.stack([x / side, y / side, np.full_like(x, height)], axis=-1).reshape(-1, 3), faces
    )


def holds(found: DirectedHausdorff, distance: float, tolerance: float, size: float = 1.0) -> None:
    """Check that the bounds enclose a distance and are as close as asked."""
    assert found.lower <= distance <= found.upper
    assert found.upper - found.lower <= tolerance + ROUNDING * size
    there = np.linalg.norm(found.point - found.nearest)
    assert there == pytest.approx(found.lower, abs=ROUNDING * size)


# ---- distances that are known


@pytest.mark.parametrize("tolerance", [0.1, 1e-4, 1e-9])
def test_known_distances(device: Device, tolerance: float) -> None:
    small, large = mesh_of(*meshes.box(1, 3)), mesh_of(*meshes.box(0, 4))
    found = hausdorff(small, large, tolerance, device)
    holds(found.a_to_b, 1, tolerance, 4)
    holds(found.b_to_a, np.sqrt(3), tolerance, 4)
    assert (found.lower, found.upper) == (found.b_to_a.lower, found.b_to_a.upper)
    moved = mesh_of(large.vertices + np.array([0.25, 0, 0]), large.faces)
    holds(directed_hausdorff(large, moved, tolerance, device=device), 0.25, tolerance, 4)
    # the point farthest from three points lies between them
    corners = np.array([(1.0, 0, 2), (-0.5, 0.75**0.5, 2), (-0.5, -(0.75**0.5), 2)])
    points = mesh_of(corners, [(0, 0, 0), (1, 1, 1), (2, 2, 2)])
    whole = mesh_of(corners, [(0, 1, 2)])
    holds(directed_hausdorff(whole, points, tolerance, device=device), 1, tolerance)
    holds(directed_hausdorff(points, whole, tolerance, device=device), 0, tolerance)


@pytest.mark.parametrize("height", [0.0, 1e-5, 0.125])
def test_parallel_patches(device: Device, height: float) -> None:
    pair = patch(7, 1), patch(9, 2, height)
    for tolerance in (1e-2, 1e-4, 1e-8):
        found = hausdorff(*pair, tolerance, device)
        for way in (found.a_to_b, found.b_to_a):
            holds(way, height, tolerance)
            assert way.pieces < 100_000  # bisection alone takes 1 / tolerance


def test_a_mesh_and_itself(device: Device) -> None:
    mesh = mesh_of(*meshes.torus())
    found = hausdorff(mesh, mesh, device=device)
    assert found.lower == 0
    assert 0 < found.upper < 4 * ROUNDING
    assert found.a_to_b.pieces == len(mesh.faces)


def test_a_sphere_in_a_sphere(device: Device) -> None:
    inner, outer = (mesh_of(*meshes.icosphere(2, (1, 2, 3), r)) for r in (1, 1.25))
    found = hausdorff(inner, outer, 1e-6, device)
    holds(found.b_to_a, 0.25, 1e-6, 2)  # at the vertices
    a, b, c = (inner.vertices[inner.faces] - (1, 2, 3)).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    planes = 0.25 * (normal * a).sum(axis=1) / np.linalg.norm(normal, axis=1)  # parallel faces
    assert planes.min() <= found.a_to_b.upper
    assert found.a_to_b.lower <= planes.max() < 0.2475


# ---- another algorithm


def oracle(mesh: Mesh, other: Mesh, width: float) -> tuple[float, float]:
    """Bounds of the directed distance: faces are quartered until the distance at the centroid and
    the distance from there to the corners decide."""
    triangles, others = mesh.vertices[mesh.faces], other.vertices[other.faces]
    lower = float(brute(triangles.reshape(-1, 3), others).max())
    upper = 0.0
    while len(triangles):
        middle = triangles.mean(axis=1)
        distance = brute(middle, others)
        farthest = distance + np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
        lower = max(lower, float(distance.max()))
        open_ = farthest > lower + width
        upper = max(upper, float(farthest[~open_].max(initial=0)))
        a, b, c = triangles[open_].transpose(1, 0, 2)
        d, e, f = (b + c) / 2, (c + a) / 2, (a + b) / 2
        parts = [(a, f, e), (f, b, d), (e, d, c), (d, e, f)]
        triangles = np.concatenate([np.stack(part, axis=1) for part in parts])
    return lower, max(lower, upper)


@pytest.mark.parametrize("seed", range(6))
def test_another_algorithm_agrees(device: Device, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair = soup(rng, 1 + 4 * seed, 0.3), soup(rng, 16 - 3 * seed, (0.01, 0.3)[seed % 2])
    for mesh, other in (pair, pair[::-1]):
        low, high = oracle(mesh, other, 0.02)
        for tolerance in (1e-2, 1e-6):
            found = directed_hausdorff(mesh, other, tolerance, device=device)
            assert found.lower <= high
            assert found.upper >= low
            assert found.upper - found.lower <= tolerance
            exact = brute(found.point[None], other.vertices[other.faces])[0]
            assert found.lower <= exact <= found.lower + 4 * ROUNDING


def lies_in(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Whether each of (n, 3) points is in any of (m, 3, 3) triangles, up to rounding."""
    a, b, c = triangles.transpose(1, 0, 2)
    e, f, p = b - a, c - a, points[:, None] - a
    ee, ef, ff = (e * e).sum(-1), (e * f).sum(-1), (f * f).sum(-1)
    pe, pf = (p * e).sum(-1), (p * f).sum(-1)
    size = ee * ff - ef * ef
    u, v = (ff * pe - ef * pf) / size, (ee * pf - ef * pe) / size
    away = np.linalg.norm(p - u[..., None] * e - v[..., None] * f, axis=-1)
    return ((u > -1e-9) & (v > -1e-9) & (u + v < 1 + 1e-9) & (away < 1e-9)).any(axis=1)


@pytest.mark.parametrize("reach", [0.1, 0.3, 0.6])
def test_cuts_lose_nothing(device: Device, reach: float) -> None:
    rng = np.random.default_rng(5)
    one = mesh_of(rng.uniform(-1, 1, (3, 3)), [(0, 1, 2)])
    to = TriangleDistance(one, device)
    corners = to.tree.frame.local(one.vertices)
    pieces = corners.mean(axis=0) + 0.4 * rng.normal(size=(200, 3, 3))
    parts, counts, bounds, covered = _cut(to, pieces, np.zeros(200, np.uint32), reach, 1e-3)
    bounds = np.repeat(bounds, counts)
    grid = np.array([(i, j, 8 - i - j) for i in range(9) for j in range(9 - i)]) / 8
    points = np.einsum("gi,pij->gpj", grid, pieces).reshape(-1, 3)
    left, distances = lies_in(points, parts), brute(points, corners[None])
    assert distances[~left].max() <= covered + 1e-9
    assert 0.9 * reach < covered <= reach
    assert 0.05 < left.mean() < 1
    assert lies_in(parts.reshape(-1, 3), pieces).all()
    assert (bounds >= brute(parts.mean(axis=1), corners[None])).all()


@pytest.mark.parametrize("height", [1e-3, 0.1])
def test_faces_beyond_a_reach(device: Device, height: float) -> None:
    """Faces parallel to others, one of them with a corner that is lifted, and faces beside them."""
    flat, to = patch(9, 1, height), TriangleDistance(patch(12, 2), device)
    vertices = flat.vertices.copy()
    lifted = flat.faces[40, 0]
    vertices[lifted, 2] += 0.2 * height
    vertices[flat.faces[90, 0]] = (1.5, 0.5, 0.0)
    mesh = mesh_of(vertices, flat.faces)
    around = (flat.faces == flat.faces[90, 0]).any(axis=1)
    for reach, named in ((1.3, around), (1.1, around | (flat.faces == lifted).any(axis=1))):
        beyond, largest = faces_beyond(mesh, mesh.faces, to, reach * height)
        assert np.array_equal(beyond, named)
        assert largest[~beyond].max() <= reach * height
        assert largest[~beyond].min() >= height * (1 - 1e-9)
    assert faces_beyond(mesh, mesh.faces[:0], to, height)[0].shape == (0,)


def test_a_face_whose_middle_alone_is_beyond(device: Device) -> None:
    """A large face over a dent, whose corners and centroid are near."""
    far = mesh_of([(0, 0, 0), (9, 0, 0), (0, 9, 0)], [(0, 1, 2)])
    parts = [(0, 0, 0), (5, 0, 0), (0, 9, 0), (6, 0, 0), (9, 0, 0), (5.9, 3, 0)]
    near = mesh_of(parts, [(0, 1, 2), (3, 4, 5)])
    exact = directed_hausdorff(far, near, 1e-4, device=device)
    for reach in (0.9 * exact.lower, 1.03 * exact.upper):
        beyond, _ = faces_beyond(far, far.faces, TriangleDistance(near, device), reach)
        assert beyond.tolist() == [reach < exact.lower]


# ---- extremes


def test_degenerate_faces_and_slivers(device: Device) -> None:
    line = mesh_of([(0, 0, 0), (1, 0, 0), (4, 0, 0)], [(0, 1, 2), (1, 1, 1)])
    sliver = mesh_of([(0, 3, 0), (4, 3, 0), (2, 3 + 1e-12, 0)], [(0, 1, 2)])
    found = hausdorff(line, sliver, 1e-6, device)
    holds(found.a_to_b, 3, 1e-6, 4)
    holds(found.b_to_a, 3 + 1e-12, 1e-6, 4)


def test_one_triangle_and_many(device: Device) -> None:
    fine = mesh_of(*meshes.icosphere(4))
    one = mesh_of([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    inside = directed_hausdorff(one, fine, 1e-4, device=device)
    centre = brute(np.zeros((1, 3)), fine.vertices[fine.faces])[0]  # the sphere's, a corner of one
    assert centre <= inside.upper <= inside.lower + 1e-4
    assert inside.lower <= 1
    far = mesh_of(one.vertices + np.array([1e6, 0, 0]), one.faces)
    apart = hausdorff(far, fine, 1e-3, device)
    corner = brute(np.array([(1e6 + 1, 0, 0)]), fine.vertices[fine.faces])[0]
    assert apart.a_to_b.lower <= corner + 1e-6
    assert apart.a_to_b.upper >= corner
    assert apart.upper - apart.lower <= 1e-3


@pytest.mark.parametrize("exponent", [-400, -20, 30, 400])
def test_scales(device: Device, exponent: int) -> None:
    rng = np.random.default_rng(7)
    pair = soup(rng, 5, 0.3), soup(rng, 9, 0.2)
    first, second = (mesh_of(np.ldexp(m.vertices, exponent), m.faces) for m in pair)
    expected = hausdorff(*pair, 1e-3, device)
    found = hausdorff(first, second, float(np.ldexp(1e-3, exponent)), device)
    assert np.ldexp(found.lower, -exponent) == expected.lower
    assert np.ldexp(found.upper, -exponent) == expected.upper
    assert found.a_to_b.pieces == expected.a_to_b.pieces


# ---- what changes nothing, and what does


def test_all_devices_and_batches_agree(monkeypatch) -> None:
    pair = mesh_of(*meshes.icosphere(3)), patch(12, 3)
    found = [hausdorff(*pair, 1e-3, opened(index)) for index, _ in usable_devices()]
    monkeypatch.setattr(module, "PIECES_AT_ONCE", 333)
    some = TriangleDistance(pair[1], opened(usable_devices()[0][0]), block=500, packets_from=100)
    ways = [way.a_to_b for way in found] + [bound(pair[0], pair[0].faces, some, 1e-3)]
    assert all(way == ways[0] for way in ways[1:])
    assert all(way.b_to_a == found[0].b_to_a for way in found[1:])


def test_some_faces(device: Device) -> None:
    sheets = [patch(3, 1, height) for height in (0.0, 0.5, 2.0)]
    vertices, faces = meshes.join(*((m.vertices, m.faces) for m in sheets))
    mesh, level = mesh_of(vertices, faces), np.arange(len(faces)) // 18
    for i, height in enumerate((0.0, 0.5, 2.0)):
        for some in (level == i, np.flatnonzero(level == i)):
            found = directed_hausdorff(mesh, sheets[0], 1e-6, some, device)
            holds(found, height, 1e-6, 4)


def test_fewer_pieces_widen_the_bounds(device: Device) -> None:
    mesh, to = patch(4, 1), TriangleDistance(patch(9, 2), device)
    widths = []
    for most in (1, 20, 100, 10_000):
        found = bound(mesh, mesh.faces, to, 1e-4, most)
        assert found.lower <= ROUNDING
        widths.append(found.upper - found.lower)
    assert widths == sorted(widths, reverse=True)
    assert widths[0] > 10 * widths[-1]
    assert widths[-1] <= 1e-4


def test_the_result_is_json(device: Device) -> None:
    found = voxtool.hausdorff(meshes.box(0, 1), meshes.box(0, 2), device=device)
    told = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert told["upper"] == found.upper >= told["lower"] == found.lower
    assert told["b_to_a"]["point"] == found.b_to_a.point.tolist()
    assert found.tolerance == pytest.approx(1e-5 * np.sqrt(12))
    one = voxtool.directed_hausdorff(meshes.box(0, 1), meshes.box(0, 2), device=device)
    assert one == found.a_to_b


# ---- what is refused


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        *(({"tolerance": t}, VoxtoolError, "greater than 0") for t in (0, -1, np.inf, np.nan)),
        *(({"faces": f}, MeshError, "at least one") for f in ([-1], [12], np.zeros(12, bool))),
        *(({"faces": f}, MeshError, "numbers of faces, or a") for f in ([0.5], [[0]], [True])),
        ({"max_memory": 1000}, MemoryLimitError, "simplify the meshes"),
    ],
)  # fmt: skip
def test_what_is_refused(device: Device, options, error, message: str) -> None:
    box = meshes.box(0, 1)
    with pytest.raises(error, match=message):
        voxtool.directed_hausdorff(box, box, device=device, **options)
