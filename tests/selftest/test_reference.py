"""The reference picture of a volume: closed forms, limits, and where rays meet cells."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import mpmath
import numpy as np
import pytest
from helpers.tets import tet_grid

from voxtool.camera import Camera, Rays
from voxtool.selftest.reference import reference, segments, weights
from voxtool.tets.pictures.transfer import TransferFunction

TETRAHEDRON = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)])
ONE = np.array([(0, 1, 2, 3)])
RAINBOW = np.array([(0, 0, 1), (0, 1, 1), (0, 1, 0), (1, 1, 0), (1, 0, 0.0)])


def constant_of(extinction: float) -> TransferFunction:
    return TransferFunction(np.zeros(1), np.array([(0.2, 0.5, 0.8)]), np.array([extinction]))


def ramp(extinction: float) -> TransferFunction:
    return TransferFunction(np.array([0.0, 1]), RAINBOW[[0, 4]], np.array([0, extinction]))


def five(factor: float = 1.0) -> TransferFunction:
    return TransferFunction(np.linspace(0, 1, 5), RAINBOW, factor * np.array([0, 0.5, 0, 2, 4]))


def steps() -> TransferFunction:
    return TransferFunction(
        np.array([0, 0.4, 0.4, 0.6, 0.6, 1]), RAINBOW[[0, 0, 1, 1, 4, 4]],
        np.array([0, 0, 3.0, 3, 0.5, 0.5]),
    )  # fmt: skip


def look(
    columns: int = 8, rows: int = 8, *, eye=(0.5, 0.5, 5), target=(0.5, 0.5, 0), **more
) -> Rays:
    """Down the z axis at the unit cube, which the picture is as large as; y is up."""
    return Camera(eye, target, **{"fov": None, "height": 1.0, **more}).rays(columns, rows)


def kuhn(n: int = 1, jitter: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The unit cube as n^3 cubes of six tetrahedra, the vertices inside it moved."""
    points, cells = tet_grid((n, n, n))
    points = points / 2 + 0.5
    moved = np.random.default_rng(1).uniform(-jitter, jitter, points.shape) / n
    return points + ((points > 0) & (points < 1)).all(axis=1, keepdims=True) * moved, cells


def light_weights(a: float, b: float) -> list[float]:
    """The weights of the near and the far colour, by Gauss's quadrature of the emission."""
    cuts = np.array([0, 0.1, 0.4, 1])
    half = np.diff(cuts)[:, None] / 2
    nodes, shares = np.polynomial.legendre.leggauss(40)
    s = cuts[:-1, None] + half * (1 + nodes)
    light = half * shares * (a + s * (b - a)) * np.exp(-s * (a + s * (b - a) / 2))
    return [float(((1 - s) * light).sum()), float((s * light).sum())]


def integral(start: float, end: float, length: float, transfer: TransferFunction) -> np.ndarray:
    """(4,) RGBA of a ray whose scalar is linear from start to end, piece by piece."""
    points, nodes = transfer.scalars, np.column_stack([transfer.colours, transfer.extinctions])
    inside = {p for p in points.tolist() if min(start, end) < p < max(start, end)}
    colour, depth = np.zeros(3), 0.0
    for a, b in pairwise([start, *sorted(inside, reverse=start > end), end]):
        i = np.searchsorted(points, (a + b) / 2)
        if 0 < i < len(points):
            share = ((np.array([[a], [b]]) - points[i - 1]) / (points[i] - points[i - 1])).clip(
                0, 1
            )
            ends = nodes[i - 1] + share * (nodes[i] - nodes[i - 1])
        else:
            ends = nodes[[min(i, len(points) - 1)] * 2]
        depths = length * (b - a) / (end - start) * ends[:, 3]
        colour += np.exp(-depth) * (light_weights(*depths) @ ends[:, :3])
        depth += depths.mean()
    return np.array([*colour, -np.expm1(-depth)])


# ---- weights


def exact_weights(a: float, b: float) -> tuple[float, float]:
    """1 - Ψ and Ψ - ζ in closed form, in as many digits as their differences need."""
    with mpmath.workdps(60):
        a, b = mpmath.mpf(a), mpmath.mpf(b)
        m, delta = (a + b) / 2, (b - a) / 2
        if delta == 0:
            psi = -mpmath.expm1(-m) / m if m else mpmath.mpf(1)
        else:
            root = mpmath.sqrt(delta)  # imaginary where the extinction falls
            x, y = a / (2 * root), b / (2 * root)
            scale = mpmath.sqrt(mpmath.pi) / (2 * root) * mpmath.exp(x * x)
            psi = (scale * (mpmath.erf(y) - mpmath.erf(x))).real
        return float(1 - psi), float(psi - mpmath.exp(-m))


SIZES = (0, 1e-7, 1e-3, 0.3, 1, 1.7, 2, 5, 20, 37, 100)


@pytest.mark.parametrize("a", SIZES)
def test_weights_are_those_of_the_closed_form(a: float) -> None:
    b = np.array(SIZES)
    found = weights(np.full(len(b), a), b)
    for near, far, other in zip(*found, b, strict=True):
        assert (near, far) == pytest.approx(exact_weights(a, other), rel=1e-12, abs=0)


@pytest.mark.parametrize("large", [1e3, 1e4, 1e5])
def test_weights_of_very_opaque_pieces(large: float) -> None:
    a = np.array([large, large, 0, 1.0, large])
    b = np.array([large, 0, large, large, 1.0])
    near, far = weights(a, b)
    # 1 - Ψ, and Ψ, whose e^-m is nothing: by the closed form's asymptotic or error function
    for i in range(5):
        with mpmath.workdps(30):
            x, size = mpmath.mpf(a[i]), (mpmath.mpf(b[i]) - a[i]) / 2
            ends = [0, *(mpmath.mpf(2) ** -k for k in range(24, -1, -1))]
            psi = mpmath.quad(lambda s, x=x, size=size: mpmath.exp(-s * (x + size * s)), ends)
        assert far[i] == pytest.approx(float(psi), rel=1e-12)
        assert near[i] == pytest.approx(float(1 - psi), rel=1e-12)


# ---- one ray


def test_a_tetrahedron_of_one_extinction() -> None:
    rays, transfer = look(), constant_of(2.0)
    found = reference(TETRAHEDRON, ONE, np.zeros(4), transfer, rays).reshape(8, 8, 4)
    x = (np.arange(8) + 0.5) / 8
    thickness = np.maximum(1 - x[None] - x[::-1, None], 0)  # the upper row has the largest y
    alpha = -np.expm1(-2 * thickness)
    assert np.allclose(found[..., 3], alpha, rtol=1e-13, atol=1e-15)
    assert np.allclose(found[..., :3], alpha[..., None] * transfer.colours, rtol=1e-13, atol=1e-15)
    assert (found[thickness == 0] == 0).all()


@pytest.mark.parametrize("transfer", [ramp(3), ramp(1e-6), ramp(500), five(), five(100), steps()])
@pytest.mark.parametrize("behind", [False, True])
def test_a_cube_of_six_tetrahedra_with_a_linear_scalar(
    transfer: TransferFunction, behind: bool
) -> None:
    vertices, cells = kuhn()
    rays = look(eye=(0.5, 0.5, -4 if behind else 5))
    ends = (-0.2, 0.9) if behind else (0.9, -0.2)
    found = reference(vertices, cells, 1.1 * vertices[:, 2] - 0.2, transfer, rays)
    expected = integral(*ends, 1.0, transfer)
    # rays of the diagonal are in faces of the tetrahedra
    assert np.allclose(found, expected, rtol=1e-11, atol=1e-14)


def test_constant_cells_take_the_later_of_two_points_that_are_equal() -> None:
    rays, extinctions = look(), {0.3: 0.0, 0.4: 3.0, 0.5: 3.0, 0.6: 0.5, 0.9: 0.5, 2.0: 0.5}
    for scalar, extinction in extinctions.items():
        cells = reference(TETRAHEDRON, ONE, np.array([scalar]), steps(), rays, constant=True)
        alike = reference(TETRAHEDRON, ONE, np.full(4, scalar), steps(), rays)
        assert np.array_equal(cells, alike)
        expected = reference(TETRAHEDRON, ONE, np.zeros(4), constant_of(extinction), rays)
        assert np.allclose(cells[:, 3], expected[:, 3], rtol=1e-14)


def test_colours_are_in_front_of_others() -> None:
    # two slabs, constant cells: the nearer is red and opaque, the farther blue
    vertices, cells = kuhn()
    both = np.concatenate([vertices, vertices - (0, 0, 2)])
    scalars = np.repeat([0.0, 1], len(cells))
    transfer = TransferFunction(np.array([0.0, 1]), RAINBOW[[4, 0]], np.array([1.0, 2]))
    found = reference(
        both, np.concatenate([cells, cells + 8]), scalars, transfer, look(), constant=True
    )
    a, b = -np.expm1([-1.0, -2.0])
    assert np.allclose(found, [a, 0, (1 - a) * b, a + (1 - a) * b], rtol=1e-13)


# ---- where rays meet cells


VIEWS = [  # of a box from outside, in two ways, and from inside
    {"fov": None, "height": 1.5, "eye": (2.0, 1.7, 2.9)},
    {"fov": 25.0, "height": 1.5, "eye": (2.0, 1.7, 2.9)},
    *({"fov": 150.0, "eye": (0.45, 0.55, 0.6), "target": target}
      for target in ((1.4, 0.3, 0.2), (0.55, 0.45, 0.4), (-5, 1.3, 0.1))),
]  # fmt: skip


@pytest.mark.parametrize("view", VIEWS)
def test_a_mesh_of_a_box_is_the_box(view: dict) -> None:
    vertices, cells = kuhn(3, 0.25)
    slope, offset, transfer = np.array([0.5, 0.3, -0.4]), 0.45, five(3)
    rays = look(7, 6, **view)
    found = reference(vertices, cells, vertices @ slope + offset, transfer, rays)
    expected = []
    for start, way in lines_of(rays):
        near, far = box_interval(start, way, 0 if rays.perspective else -np.inf)
        expected.append([0.0] * 4)
        if near < far:
            ends = [float((start + t * way) @ slope + offset) for t in (near, far)]
            expected[-1] = integral(*ends, (far - near) * np.linalg.norm(way), transfer)
    assert np.count_nonzero(np.array(expected)[:, 3]) > 15
    assert np.allclose(found, expected, rtol=1e-10, atol=1e-12)


def lines_of(rays: Rays) -> list[tuple[np.ndarray, np.ndarray]]:
    """Origin and way of each ray, from what Rays says."""
    (width, height), found = rays.size, []
    for row, column in product(range(height), range(width)):
        across = (column + 0.5 - width / 2) * rays.right + (row + 0.5 - height / 2) * rays.down
        if rays.perspective:
            found.append((rays.origin, rays.direction + across))
        else:
            found.append((rays.origin + across, rays.direction))
    return found


def box_interval(start: np.ndarray, way: np.ndarray, near: float) -> tuple[float, float]:
    """The interval of t in which a line is in the unit cube."""
    t = np.sort([-start / way, (1 - start) / way], axis=0)
    return max(float(t[0].max()), near), float(t[1].min())


def test_a_distant_eye_sees_what_parallel_rays_see() -> None:
    vertices, cells = kuhn(2, 0.2)
    scalars = np.random.default_rng(2).uniform(0, 1, len(vertices))
    eye = np.array([1e7, 2e7, 3e7])
    rays = look(12, 12, eye=eye, target=(0.5, 0.5, 0.5), height=1.6)
    distance = np.linalg.norm(eye - 0.5)
    near = replace(rays, right=rays.right / distance, down=rays.down / distance, perspective=True)
    found = reference(vertices, cells, scalars, five(), near)
    expected = reference(vertices, cells, scalars, five(), rays)
    assert np.count_nonzero(expected[:, 3]) > 50
    assert np.allclose(found, expected, atol=2e-6)


def test_cells_behind_the_eye_are_not_seen() -> None:
    vertices, cells = kuhn()
    rays = look(eye=(0.5, 0.5, -2), target=(0.5, 0.5, -5), fov=90.0)
    assert not reference(vertices, cells, vertices[:, 2], ramp(5), rays).any()


@pytest.mark.parametrize("perspective", [False, True])
def test_segments_of_a_ray_follow_each_other(perspective: bool) -> None:
    vertices, cells = kuhn(3, 0.25)
    rays = look(9, 9, fov=20.0 if perspective else None, eye=(0.5, 0.5, 3))
    pixels = np.stack(np.divmod(np.arange(81), 9), axis=1)
    for found in segments(vertices, cells, vertices[:, 0], rays, pixels):
        assert (found.near < found.far).all()
        kept = found.far - found.near > 1e-13  # rounding leaves shorter ones at edges
        near, far, scalars = found.near[kept], found.far[kept], found.scalars[kept]
        same = np.diff(found.pixel[kept]) == 0
        assert same.sum() > 200
        assert np.allclose(far[:-1][same], near[1:][same], rtol=0, atol=1e-13)
        assert np.allclose(scalars[:-1, 1][same], scalars[1:, 0][same], rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", [6, 7, 8])
def test_rays_in_faces_and_along_edges_belong_to_one_cell(size: int) -> None:
    # pixel centres at multiples of 1/8, 1/16: on vertices, edges, faces of the cubes, and their rim
    vertices, cells = kuhn(2)
    split = vertices[cells].reshape(-1, 3)  # no vertex is shared
    height = size / 8
    rays = look(size, size, height=height)
    alpha = -np.expm1(-1.5)
    for points, corners in ((vertices, cells), (split, np.arange(len(split)).reshape(-1, 4))):
        found = reference(points, corners, np.zeros(len(points)), constant_of(1.5), rays)
        assert np.allclose(found[:, 3], alpha, rtol=1e-13)


@pytest.mark.parametrize("fov", [None, 25.0])
def test_rays_along_edges_whose_places_are_rounded(fov: float | None) -> None:
    vertices, cells = kuhn(4)
    rng = np.random.default_rng(7)
    cells = rng.permuted(cells, axis=1)
    split = np.arange(cells.size).reshape(-1, 4)
    for _ in range(20):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        points = (vertices - 0.5) @ turn
        way = np.ones(3) @ turn  # of the diagonal, where the edges of many cells are
        rays = look(1, 1, eye=tuple(2 * way), target=(0, 0, 0), up=tuple(turn[0]), fov=fov)
        for mesh in ((points, cells), (points[cells].reshape(-1, 3), split)):
            found = reference(*mesh, np.zeros(len(mesh[0])), constant_of(1.0), rays)
            assert found[0, 3] == pytest.approx(-np.expm1(-np.sqrt(3)), abs=1e-12)


def test_a_pixel_centre_on_the_rim_is_on_one_side_of_it() -> None:
    vertices, cells = kuhn()
    rays = look(4, 4, height=4.0, eye=(0.0, 0.0, 5), target=(0.0, 0.0, 0))
    shifted = vertices - 0.5  # corners at pixel centres
    found = reference(shifted, cells, np.zeros(8), constant_of(1.0), rays)
    assert np.count_nonzero(found[:, 3]) == 1


# ---- what makes no difference


def test_order_turn_and_cells_without_volume_make_no_difference() -> None:
    vertices, cells = kuhn(2, 0.2)
    scalars = np.random.default_rng(3).uniform(0, 1, len(vertices))
    rays = look(10, 10, eye=(2.0, 3.0, 4.0), target=(0.5, 0.5, 0.5), height=1.7)
    expected = reference(vertices, cells, scalars, five(), rays)
    rng = np.random.default_rng(4)
    turned = rng.permuted(cells, axis=1)[rng.permutation(len(cells))]
    # cells of three distinct vertices, and of four points of a plane, rounded
    faces = vertices[cells[rng.integers(len(cells), size=200), :3]]
    points = (rng.dirichlet(np.ones(3), (200, 4))[..., None] * faces[:, None]).sum(axis=2)
    flat = len(vertices) + np.arange(4 * len(points)).reshape(-1, 4)
    found = reference(
        np.concatenate([vertices, points.reshape(-1, 3)]),
        np.concatenate([np.array([(0, 1, 2, 0), (4, 4, 4, 4)]), flat, turned]),
        np.concatenate([scalars, rng.uniform(0, 1, 4 * len(points))]),
        five(),
        rays,
    )
    assert np.allclose(found, expected, rtol=1e-12, atol=1e-14)


def test_some_pixels_are_those_of_the_whole_picture() -> None:
    vertices, cells = kuhn(2, 0.2)
    scalars = vertices[:, 0]
    rays = look(11, 9, eye=(2.0, 3.0, 4.0), target=(0.5, 0.5, 0.5), height=1.5)
    whole = reference(vertices, cells, scalars, five(), rays).reshape(9, 11, 4)
    pixels = np.random.default_rng(5).permutation(99)[:20]
    row, column = np.divmod(pixels, 11)
    some = np.stack([column, row], axis=1)
    found = reference(vertices, cells, scalars, five(), rays, some)
    assert np.array_equal(found, whole[row, column])
    rows = reference(vertices, cells, scalars, five(), rays, most=1)  # a band for each row
    assert np.array_equal(rows, whole.reshape(-1, 4))
