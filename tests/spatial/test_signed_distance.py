"""Signs of distances and winding numbers against crossings, formulas and solid angles."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import model, opened, usable_devices
from helpers import meshes
from helpers.distance import around, brute, exact
from helpers.meshes import mesh_of
from helpers.signs import inside, winding
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
from voxtool import distance
from voxtool.errors import VoxtoolError
from voxtool.files.meshes.mesh import load_mesh
from voxtool.mesh.mesh import Mesh
from voxtool.selftest.contacts import beside_edges
from voxtool.spatial import bvh
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.fill_rule import inside_as_wound
from voxtool.spatial.pseudonormals import angle_of, pseudonormals
from voxtool.spatial.signed_distance import SignedDistance
from voxtool.spatial.winding_number import WindingNumber

if TYPE_CHECKING:
    from voxtool.opencl import Device

SIGNS = ("pseudonormal", "winding")
CLEAR = 1e-12  # of the extent: beyond this from the surface, signs are exact
WINDING = 1e-3  # error of winding numbers
both = pytest.mark.parametrize("sign", SIGNS)


def signed(mesh: Mesh, points: np.ndarray, device: Device, sign: str) -> np.ndarray:
    """Signed distances, whose sizes are those of the unsigned ones."""
    found = SignedDistance(mesh, sign, device)(points)
    assert np.array_equal(np.abs(found), TriangleDistance(mesh, device)(points))
    assert not np.signbit(found[found == 0]).any()
    return found


def check(mesh: Mesh, points: np.ndarray, device: Device, sign: str, expected=None) -> np.ndarray:
    """That the clear signs are what the crossings say, or `expected` does."""
    found = signed(mesh, points, device, sign)
    clear = np.abs(found) > CLEAR * np.ptp(mesh.bounds, axis=0).max()
    if expected is None:
        expected = inside(points[clear], mesh.vertices[mesh.faces])
    else:
        expected = expected[clear]
    wrong = (found[clear] < 0) != expected
    assert not wrong.any(), points[clear][wrong]
    return found


def lattice(low: float, high: float, n: int) -> np.ndarray:
    return np.stack(np.meshgrid(*[np.linspace(low, high, n)] * 3), axis=-1).reshape(-1, 3)


def beside(mesh: Mesh, rng: np.random.Generator, n: int, spread: float) -> np.ndarray:
    """n points near faces, edges and vertices."""
    return around(mesh, rng, n, spread)[n:]


# ---- the angle


def directions() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(2, 20_000)) * 10.0 ** rng.uniform(-20, 20, (2, 20_000))
    t = np.linspace(0, 2 * np.pi, 4097)
    grid = np.indices((7, 7)).reshape(2, -1) - 3.0
    return np.concatenate([x, np.cos(t), grid[0]]), np.concatenate([y, np.sin(t), grid[1]])


def test_the_angle_is_that_of_numpy() -> None:
    x, y = directions()
    expected = np.where(y == 0, 0, np.arctan2(y, x))
    error = np.abs(angle_of(y, x) - expected)
    assert (error <= 1e-15 * np.maximum(np.abs(expected), 1e-300)).all()


def test_the_angle_on_the_device_is_that_on_the_host(device: Device) -> None:
    x, y = (a[: len(a) // 4 * 4] for a in directions())
    source = """#include "spatial/angles.h"
__kernel void turn(__global const double *y, __global const double *x, __global double *out) {
    const uint i = get_global_id(0);
    vstore4(angle_of(vload4(i, y), vload4(i, x)), i, out);
}"""
    groups = len(x) // 4 // 64 * 64  # whole work-groups
    out = device.zeros(4 * groups, np.float64)
    device.kernel(source, "turn")(groups, device.put(y), device.put(x), out)
    assert np.array_equal(out.get(), angle_of(y, x)[: 4 * groups])


# ---- formulas


def to_sphere(p: np.ndarray) -> np.ndarray:
    return np.sqrt((p**2).sum(axis=1)) - 1


def to_torus(p: np.ndarray) -> np.ndarray:
    return np.sqrt((np.sqrt(p[:, 0] ** 2 + p[:, 1] ** 2) - 2) ** 2 + p[:, 2] ** 2) - 1


def to_box(p: np.ndarray) -> np.ndarray:
    beyond = np.maximum(-p, p - (4, 6, 8))
    return np.sqrt((np.maximum(beyond, 0) ** 2).sum(axis=1)) + np.minimum(beyond.max(axis=1), 0)


@both
@pytest.mark.parametrize(
    ("pair", "formula", "error"),
    [
        (meshes.icosphere(4), to_sphere, 0.0015),  # of which faces are within
        (meshes.torus(sides=(96, 48)), to_torus, 0.01),
        (meshes.box(0, (4, 6, 8)), to_box, 1e-14),
    ],
)
def test_formulas(device: Device, sign: str, pair, formula, error: float) -> None:
    mesh = mesh_of(*pair)
    low, high = mesh.bounds
    points = np.random.default_rng(7).uniform(low - 3, high + 3, (4000, 3))
    points[::2] = np.rint(points[::2] * 2) / 2
    expected = formula(points)
    if error > 1e-9:
        points, expected = points[np.abs(expected) > error], expected[np.abs(expected) > error]
    found = check(mesh, points, device, sign, expected < 0)
    assert np.abs(found - expected).max() < error


# ---- edges, vertices, planes of faces


@both
@pytest.mark.parametrize("shape", ["tetrahedron", "box", "octahedron"])
def test_points_in_planes_on_diagonals_near_edges(device: Device, sign: str, shape: str) -> None:
    vertices, faces = {
        "tetrahedron": meshes.tetrahedron((0, 0, 0), (4, 0, 0), (0, 4, 0), (0, 0, 4)),
        "box": meshes.box(0, 4),
        "octahedron": meshes.octahedron(2, 2),
    }[shape]
    mesh = mesh_of(vertices, faces)
    rng = np.random.default_rng(10)
    near = [beside(mesh, rng, 40, 10.0**-e) for e in (1, 3, 6, 9, 11)]
    check(mesh, np.concatenate([lattice(-4, 8, 7), *near]), device, sign)


@pytest.mark.parametrize("sharp", [1e-1, 1e-3, 1e-5, 1e-7])  # of a blade: see pseudonormals.py
def test_wedges_and_needles(device: Device, sharp: float) -> None:
    rng = np.random.default_rng(11)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    wedge = meshes.tetrahedron((0, 0, 0), (0, 0, 1), (1, sharp, 0.5), (1, -sharp, 0.5))
    needle = meshes.tetrahedron((0, 0, 0), (1, sharp, 0), (1, -sharp, sharp), (1, -sharp, -sharp))
    for (vertices, faces), signs in ((wedge, SIGNS[sharp < 1e-6 :]), (needle, SIGNS)):
        mesh = mesh_of(vertices @ turn, faces)
        along = np.stack([np.linspace(-1, 2, 31), np.zeros(31), np.full(31, 0.01)], axis=1)
        sideways = along * (1, 0, 0) + rng.normal(size=(31, 3)) * (0, 2 * sharp, 0.1)
        tip = rng.normal(size=(60, 3)) * (0.1, 0.1, 0.1)
        points = np.concatenate([along, sideways, tip]) @ turn
        for sign in signs:
            check(mesh, points, device, sign)


@both
def test_saddle_vertices(device: Device, sign: str) -> None:
    """A prism over a star whose top's middle is pulled up or down: nearest vertices that are
    neither convex nor concave."""
    n = 8
    for height in (2.0, 1.0, 0.25):
        t = 2 * np.pi * np.arange(n) / n
        rim = np.stack([np.cos(t), np.sin(t), 1 + 0.5 * (-1.0) ** np.arange(n)], axis=1)
        vertices = np.concatenate([rim, rim * (1, 1, 0), [(0, 0, height), (0, 0, 0)]])
        i, j = np.arange(n), (np.arange(n) + 1) % n
        middle = np.full(n, 2 * n)
        faces = np.concatenate(
            [
                np.stack(f, axis=1)
                for f in (
                    (i, j, middle),
                    (j + n, i + n, middle + 1),
                    (i + n, j + n, j),
                    (i + n, j, i),
                )
            ]
        )
        mesh = mesh_of(np.rint(vertices * 64) / 64, faces)
        rng = np.random.default_rng(12)
        top = np.array((0, 0, height)) + 0.2 * rng.normal(size=(60, 3))
        check(mesh, np.concatenate([top, beside(mesh, rng, 40, 0.05)]), device, sign)


def test_a_seam_and_every_order_of_corners_change_nothing(device: Device) -> None:
    vertices, faces = meshes.octahedron(0, 3)
    rng = np.random.default_rng(13)
    points = np.concatenate([lattice(-4, 4, 9), rng.normal(size=(200, 3)) * 4])
    expected = check(mesh_of(vertices, faces), points, device, "pseudonormal")
    for _ in range(6):
        turned = np.array([np.roll(face, rng.integers(3)) for face in rng.permutation(faces)])
        corners = vertices[turned].reshape(-1, 3).astype(np.float64)
        corners[corners == 0] *= rng.choice([-1, 1])  # -0.0 is 0.0
        loose = mesh_of(corners, np.arange(24).reshape(8, 3))
        found = SignedDistance(loose, "pseudonormal", device)(points)
        assert np.abs(found - expected).max() < 1e-14


# ---- random closed meshes


@st.composite
def hulls(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """The hull of up to 9 points, no four of which are in a plane, with outward faces."""
    rng = np.random.default_rng(draw(st.integers(0, 1 << 30)))
    size = draw(st.sampled_from([20, 1000, 1 << 15]))
    stretch = draw(st.sampled_from([(1, 1, 1), (1, 40, 1), (40, 40, 1)]))
    vertices = rng.integers(-size, size, (draw(st.integers(4, 9)), 3)) * np.array(stretch)
    faces = []
    for i, j, k in combinations(range(len(vertices)), 3):
        a, b, c = vertices[[i, j, k]].astype(object)
        normal = np.cross(b - a, c - a)
        sides = [((v - a) * normal).sum() for v in np.delete(vertices, (i, j, k), 0).astype(object)]
        if all(s < 0 for s in sides):
            faces.append((i, j, k))
        elif all(s > 0 for s in sides):
            faces.append((i, k, j))
        elif any(s == 0 for s in sides):
            return meshes.tetrahedron((0, 0, 0), (size, 0, 1), (0, size, 0), (1, 0, size))
    return vertices, np.array(faces)


@given(hulls(), st.integers(0, 1 << 20), st.sampled_from(SIGNS))
@settings(max_examples=15)
def test_convex_hulls(device: Device, hull, seed: int, sign: str) -> None:
    mesh = mesh_of(*hull)
    rng = np.random.default_rng(seed)
    spread = [beside(mesh, rng, 8, 10.0**-e) for e in (0, 1, 2, 4, 8)]
    check(mesh, np.concatenate([*spread, 2.0 * mesh.vertices]), device, sign)


@given(
    st.lists(st.tuples(st.booleans(), st.integers(0, 1 << 20)), min_size=1, max_size=5),
    st.sampled_from(SIGNS),
)
@settings(max_examples=10)
def test_solids_far_apart(device: Device, kinds, sign: str) -> None:
    parts = []
    for number, (box, seed) in enumerate(kinds):
        corners = np.random.default_rng(seed).integers(-12, 13, (4, 3))
        if box or not round(np.linalg.det(corners[1:] - corners[0])):
            part = meshes.box(corners[:2].min(axis=0), corners[:2].max(axis=0) + 1)
        else:
            part = meshes.tetrahedron(*corners)
        parts.append((part[0] + (40 * number, 0, 0), part[1]))
    vertices, faces = meshes.join(*parts)
    mesh = mesh_of(vertices, faces)
    rng = np.random.default_rng(kinds[0][1])
    points = np.concatenate([beside(mesh, rng, 12, 0.02), beside(mesh, rng, 12, 1e-7)])
    points = np.concatenate([points, np.rint(points), np.rint(points * 2) / 2])
    check(mesh, points, device, sign)


# ---- orientation, shells, openings


def test_inside_out_flips_the_sign(device: Device) -> None:
    vertices, faces = meshes.torus()
    points = np.random.default_rng(14).uniform(-3.5, 3.5, (2000, 3))
    one, other = mesh_of(vertices, faces), mesh_of(vertices, faces[:, ::-1])
    found = [SignedDistance(m, "pseudonormal", device)(points) for m in (one, other)]
    assert np.abs(found[0] + found[1]).max() < 1e-14
    numbers = [WindingNumber(m, device)(points) for m in (one, other)]
    assert np.abs(numbers[0] + numbers[1]).max() < 1e-12
    assert (numbers[1] < 0.5).all()


@both
def test_nested_shells(device: Device, sign: str) -> None:
    """A ball with a hollow in it and a ball in the hollow."""
    shells = [meshes.icosphere(3, radius=r) for r in (4.0, 2.0, 1.0)]
    shells[1] = (shells[1][0], shells[1][1][:, ::-1])
    mesh = mesh_of(*meshes.join(*shells))
    points = np.random.default_rng(15).uniform(-5, 5, (3000, 3))
    radius = np.sqrt((points**2).sum(axis=1))
    clear = np.abs(radius[:, None] - (4, 2, 1)).min(axis=1) > 0.05
    expected = ((radius > 2) & (radius < 4)) | (radius < 1)
    check(mesh, points[clear], device, sign, expected[clear])


def half_sphere() -> Mesh:
    vertices, faces = meshes.icosphere(4)
    return mesh_of(vertices, faces[(vertices[faces][:, :, 2] >= -1e-9).all(axis=1)])


def test_half_a_sphere(device: Device) -> None:
    mesh = half_sphere()
    points = np.random.default_rng(16).uniform(-1.5, 1.5, (300, 3))
    expected = winding(points, mesh.vertices[mesh.faces])
    measure = WindingNumber(mesh, device)
    assert np.abs(measure(points) - expected).max() < WINDING
    axis = np.array([(0, 0, z) for z in (-0.5, -0.01, 0.01, 0.5, 0.9)])
    z = axis[:, 2]
    slope = np.sqrt(1 + z * z)  # of the cone to the rim: a disc seen from height z
    expected = 0.5 * (1 + z / slope)
    assert np.abs(measure(axis) - expected).max() < 0.05  # the rim is ragged
    assert inside_as_wound(mesh, device).sign == "winding"
    found = SignedDistance(mesh, "winding", device)
    assert (found([(0, 0, 0.5), (0, 0, 0.9)]) < 0).all()
    assert (found([(0, 0, -0.5), (0, 0, 1.1)]) > 0).all()


def test_faces_back_to_back_bound_nothing(device: Device) -> None:
    vertices = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]
    mesh = mesh_of(vertices, [(0, 1, 2), (0, 2, 1)])
    points = lattice(-2.5, 6.5, 10)
    for sign in SIGNS:
        assert (SignedDistance(mesh, sign, device)(points) > 0).all()


def test_equal_distances_to_two_sheets_go_to_the_first_face(device: Device) -> None:
    up = np.array([(-9, -9, 1), (9, -9, 1), (0, 9, 1)])
    points = np.array([(0.0, 0, 0), (0.5, 0.25, 0), (-1, -2, 0)])
    for first, expected in ((up, -1), (up * (1, 1, -1), 1)):
        mesh = mesh_of([*first, *(first * (1, 1, -1))], [(0, 1, 2), (3, 4, 5)])
        found = SignedDistance(mesh, "pseudonormal", device)(points)
        assert found.tolist() == [expected] * 3


def test_what_suits_a_mesh(device: Device) -> None:
    def default_sign(mesh: Mesh) -> str:
        return inside_as_wound(mesh, device).sign

    vertices, faces = meshes.box(0, 2)
    turned = faces.copy()
    turned[0] = turned[0][::-1]
    assert default_sign(mesh_of(vertices, faces)) == "pseudonormal"
    assert default_sign(mesh_of(vertices, turned)) == "winding"
    assert default_sign(mesh_of(vertices, faces[1:])) == "winding"
    capped = [*faces, (0, 4, 8), (0, 8, 4)]  # closed, with flat faces between three positions
    assert default_sign(mesh_of([*vertices, (1, 0, 0)], capped)) == "winding"


# ---- degenerate faces


@both
def test_degenerate_faces_change_nothing(device: Device, sign: str) -> None:
    vertices, faces = meshes.box(0, 4)
    rng = np.random.default_rng(17)
    middle = np.array([(2, 0, 0), (1, 1, 0), (3, 0, 0), (4, 4, 2)])  # on edges and in a face
    more = np.concatenate([vertices, middle])
    flat = np.array([0, 0, 0, 0, 4, 4, 0, 8, 4, 8, 0, 4, 8, 10, 0, 7, 6, 11, 9, 9, 9, 0, 6, 9])
    flat = flat.reshape(-1, 3)
    near = beside(mesh_of(vertices, faces), rng, 200, 1e-3)
    points = np.concatenate([lattice(-2, 6, 9), near])
    expected = check(mesh_of(vertices, faces), points, device, sign)
    for _ in range(4):
        where = rng.integers(0, 13, len(flat))
        mesh = mesh_of(more, np.insert(faces, where, flat, axis=0))
        found = SignedDistance(mesh, sign, device)(points)
        assert np.array_equal(np.signbit(found), np.signbit(expected))
        assert np.abs(found - expected).max() < 1e-15


def test_a_segment_beside_a_solid_has_no_side(device: Device) -> None:
    vertices, faces = meshes.box(0, 4)
    mesh = mesh_of(
        [*vertices, (6, 2, 2), (8, 2, 2), (1, 2, 2), (2, 2, 2)], [*faces, (8, 9, 8), (10, 11, 11)]
    )
    points = np.array([(7, 3, 2), (1.5, 2.25, 2), (9, 2, 2), (2, 2, 2), (3, 2, 2)])
    for sign in SIGNS:
        assert SignedDistance(mesh, sign, device)(points).tolist() == [1, -0.25, 1, 0, -1]
    alone = mesh_of([(6, 2, 2), (8, 2, 2)], [(0, 1, 0)])
    for sign in SIGNS:
        assert SignedDistance(alone, sign, device)(points[:1]).tolist() == [1]
    assert WindingNumber(alone, device)(points).tolist() == [0] * 5


def test_pseudonormals_of_a_corner() -> None:
    vertices, faces = meshes.box(0, 1)
    found = pseudonormals(mesh_of(vertices, faces))
    normals = found.normals[found.features]
    corner = normals[:, 4:][faces == 7]
    assert np.abs(corner - np.pi / 2).max() < 1e-15  # three right angles
    plain = np.cross(*(vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2)))
    assert np.array_equal(normals[:, 0], plain)
    assert not found.flat.any()


# ---- the winding number


@pytest.mark.parametrize("shape", ["torus", "ball", 3001, 1, 2, 3, 4, 5, 31, 32, 33, 257])
def test_winding_numbers_are_solid_angles(device: Device, shape: str | int) -> None:
    """Closed meshes, and any number of loose triangles, against sums of solid angles."""
    rng = np.random.default_rng(18)
    if isinstance(shape, int):
        mesh = mesh_of(*meshes.random_triangles(rng, shape, size=1.0 if shape > 1000 else 2.0))
    else:
        ball = meshes.icosphere(4)
        mesh = mesh_of(*(ball if shape == "ball" else meshes.torus(sides=(60, 40))))
    points = np.concatenate([beside(mesh, rng, 150, e) for e in (0.5, 0.05, 0.005)])
    points = np.concatenate([points, 1e3 * points[:50]])
    expected = winding(points, mesh.vertices[mesh.faces])
    found = WindingNumber(mesh, device)(points)
    scale = np.abs(expected).max() if shape == 3001 else 3 if isinstance(shape, int) else 1
    assert np.abs(found - expected).max() < WINDING * max(scale, 1)


def test_the_surface_is_in_between(device: Device) -> None:
    measure = WindingNumber(mesh_of(*meshes.box(0, 4)), device)
    on = measure([(2, 1, 0), (0, 0, 2), (0, 0, 0), (4, 1, 2)])
    assert np.abs(on - [0.5, 0.25, 0.125, 0.5]).max() < 1e-12


def test_far_away_it_is_nothing(device: Device) -> None:
    measure = WindingNumber(half_sphere(), device)
    points = np.array([(0, 0, 1e3), (0, 0, 1e12), (0, 0, 1e30), (1e100, 0, 0)])
    assert np.abs(measure(points)).max() < 1e-6
    assert measure(points)[2:].tolist() == [0, 0]


def test_the_levels_of_the_tree(device: Device) -> None:
    for count in (1, 4, 5, 32, 33, 256, 257, 2049):
        mesh = mesh_of(*meshes.random_triangles(np.random.default_rng(1), count))
        tree = bvh.build_tree(device, mesh)
        first, nodes = tree.parts()[-1]
        assert (first + nodes) * 6 * bvh.ARITY == tree.nodes.size
        assert tree.first_leaf == bvh.ARITY * first + 1


# ---- the same everywhere


@cache
def _armadillo() -> tuple[Mesh, np.ndarray]:
    mesh = load_mesh(model("armadillo.obj"))
    rng = np.random.default_rng(19)
    points = [beside(mesh, rng, 4000, e) for e in (0.3, 0.01, 1e-4)]
    return mesh, np.concatenate([*points, 30 * points[0]])


def test_all_devices_agree_bit_for_bit() -> None:
    mesh, points = _armadillo()
    devices = [opened(index) for index, _ in usable_devices()]
    for sign in SIGNS:
        found = [SignedDistance(mesh, sign, d)(points) for d in devices]
        assert all(np.array_equal(found[0], other) for other in found[1:])
    found = [WindingNumber(mesh, d)(points) for d in devices]
    assert all(np.array_equal(found[0], other) for other in found[1:])


def test_the_armadillo(device: Device) -> None:
    mesh, points = _armadillo()
    found = [SignedDistance(mesh, sign, device)(points) for sign in SIGNS]
    assert np.array_equal(*found)
    assert 0.2 < (found[0] < 0).mean() < 0.5
    assert inside_as_wound(mesh, device).sign == "pseudonormal"
    some = points[::500]
    expected = winding(some, mesh.vertices[mesh.faces])
    assert np.abs(WindingNumber(mesh, device)(some) - expected).max() < WINDING
    shuffled = replace(mesh, faces=np.random.default_rng(20).permutation(mesh.faces))
    assert np.array_equal(SignedDistance(shuffled, "pseudonormal", device)(points), found[0])


@both
@pytest.mark.parametrize("exponent", [-490, -40, 40, 490])
def test_scale_changes_no_bit(device: Device, exponent: int, sign: str) -> None:
    mesh = mesh_of(*meshes.torus())
    points = beside(mesh, np.random.default_rng(21), 500, 0.1)
    expected = SignedDistance(mesh, sign, device)(points)
    scaled = replace(mesh, vertices=np.ldexp(mesh.vertices, exponent))
    found = SignedDistance(scaled, sign, device)(np.ldexp(points, exponent))
    assert np.array_equal(found, np.ldexp(expected, exponent))


def test_no_sign_and_no_such_sign(device: Device) -> None:
    mesh = mesh_of(*meshes.box(0, 2))
    assert SignedDistance(mesh, "none", device)([(1, 1, 1)]).tolist() == [1]
    assert voxtool.SignedDistance(mesh, device=device)([(1, 1, 1)]).tolist() == [-1]
    with pytest.raises(VoxtoolError, match="choose one of pseudonormal, winding, parity"):
        SignedDistance(mesh, "odd", device)
    with pytest.raises(VoxtoolError, match="choose one of auto, parity, nonzero"):
        voxtool.SignedDistance(mesh, "odd", device)
    with pytest.raises(VoxtoolError, match="fills whole voxels"):
        voxtool.SignedDistance(mesh, "flood", device)


# ---- gradient, nearest point and face


def check_located(mesh: Mesh, points: np.ndarray, device: Device, sign: str) -> None:
    """That what is found of points holds together, against the distance to every face."""
    measure = SignedDistance(mesh, sign, device)
    found = measure(points, gradient=True, nearest=True, face=True)
    assert np.array_equal(found.distance, measure(points))
    extent = np.ptp(mesh.bounds, axis=0).max()
    triangles = mesh.vertices[mesh.faces]
    each = np.stack([brute(points, t[None]) for t in triangles], axis=1)
    allowed = 4e-15 * np.maximum(extent, each.min(axis=1))
    nearly = each <= each.min(axis=1, keepdims=True) + allowed[:, None]
    assert nearly[np.arange(len(points)), found.face].all()
    sure = nearly.sum(axis=1) == 1
    assert np.array_equal(found.face[sure], nearly.argmax(axis=1)[sure])
    own = [
        exact(p[None], triangles[[f]])[0] for p, f in zip(found.nearest, found.face, strict=True)
    ]
    assert (np.array(own) <= 4e-15 * extent).all()
    way = points - found.nearest
    long = np.sqrt((way * way).sum(axis=1))
    assert (np.abs(long - np.abs(found.distance)) <= allowed).all()
    clear = long > 1e-9 * extent
    uphill = np.where(found.distance < 0, -1, 1)[clear, None] * way[clear] / long[clear, None]
    assert np.abs(found.gradient[clear] - uphill).max() < 1e-5
    assert np.abs((found.gradient[clear] ** 2).sum(axis=1) - 1).max() < 1e-14


@pytest.mark.parametrize("sign", [*SIGNS, "none"])
def test_gradient_nearest_and_face(device: Device, sign: str) -> None:
    rng = np.random.default_rng(22)
    for vertices, faces in (meshes.torus(), meshes.join(meshes.box(0, 4), meshes.box(5, 6))):
        mesh = mesh_of(vertices, faces)
        check_located(mesh, beside(mesh, rng, 60, 0.2), device, sign)
    flat = mesh_of([*vertices, (9, 9, 9), (8, 9, 9)], [*faces, (16, 17, 16)])
    check_located(flat, rng.uniform(-2, 10, (60, 3)), device, sign)


def test_of_equally_near_faces_the_first_is_named(device: Device) -> None:
    vertices, faces = meshes.box(0, 4)
    rng = np.random.default_rng(23)
    points = np.array([(2, 2, 2), (4, 4, 4), (5, 5, 5), (2, 2, 5), (-1, 2, 2)], float)
    for _ in range(3):
        mesh = mesh_of(vertices, rng.permutation(faces))
        near = [brute(points, t[None]) for t in mesh.vertices[mesh.faces]]
        first = np.argmin(near, axis=0)
        for sign in (*SIGNS, "none"):
            assert np.array_equal(SignedDistance(mesh, sign, device)(points, face=True).face, first)


def test_on_the_surface_the_gradient_is_the_normal(device: Device) -> None:
    mesh = mesh_of([*meshes.box(0, 4)[0], (6, 2, 2), (8, 2, 2)], [*meshes.box(0, 4)[1], (8, 9, 8)])
    found = distance(mesh, [(2, 1, 4), (1, 0, 2), (7, 2, 2)], gradient=True, device=device)
    assert found.distance.tolist() == [0, 0, 0]
    assert found.gradient.tolist() == [[0, 0, 1], [0, -1, 0], [0, 0, 0]]
    far = distance(mesh, [[1e9] * 3], nearest=True, device=device)
    assert far.nearest.tolist() == [[4, 4, 4]]


def test_one_point(device: Device) -> None:
    mesh = mesh_of(*meshes.box(0, 4))
    measure = SignedDistance(mesh, "pseudonormal", device)
    assert measure([1, 2, 2]) == -1
    found = measure([-1, 2, 2], gradient=True, nearest=True, face=True)
    assert (found.distance, found.gradient.tolist(), found.nearest.tolist()) == (
        1, [-1, 0, 0], [0, 2, 2],
    )  # fmt: skip
    assert measure(np.empty((0, 3)), gradient=True).gradient.shape == (0, 3)
    again = pickle.loads(pickle.dumps(measure))
    assert again([1, 2, 2]) == -1
    assert repr(again) == "SignedDistance(mesh, 12 faces, sign 'pseudonormal')"


def test_the_tree_is_built_once(device: Device) -> None:
    mesh = mesh_of(*meshes.torus())
    stages: list[str] = []
    with device.reporting(stages.append):
        for _ in range(3):
            distance(mesh, [(0, 0, 0)], device=device)
    decided = ["self-intersections"]
    assert [stage for stage in stages if stage != "tree"] == [
        *decided, "pseudo-normals", *["distance"] * 3,
    ]  # fmt: skip


@pytest.mark.parametrize("seed", range(2))
def test_signs_beside_slivers(device: Device, seed: int) -> None:
    """Convex meshes whose faces are split 1e-8 to 1e-15 beside their edges, and folded by rounding:
    at points down to 1e-12 from slivers and edges, against the planes of the faces as they were."""
    rng = np.random.default_rng(seed)
    vertices, faces = meshes.icosphere(1) if seed else meshes.box(0.0, 1.0)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    vertices = vertices @ q.T
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1)[:, None] * np.sign(np.linalg.det(q))
    split = beside_edges(vertices, faces, 12, 15, rng)
    mesh = meshes.mesh_of(*beside_edges(*split, 13, 15, rng))
    triangles = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=4000)]]
    weights = rng.dirichlet([1, 1, 1], 4000)
    weights[::2, 2] = 0  # on edges
    on = np.einsum("nk,nkj->nj", weights / weights.sum(axis=1)[:, None], triangles)
    way = rng.normal(size=on.shape)
    points = on + 10.0 ** -rng.uniform(1, 12, (4000, 1)) * way
    beyond = ((points[:, None] - a) * normals).sum(axis=-1).max(axis=1)
    sure = np.abs(beyond) > 1e-13
    assert np.count_nonzero(sure) > 3000
    inside = SignedDistance(mesh, "winding", device)(points) < 0
    assert np.array_equal(inside[sure], (beyond < 0)[sure])
