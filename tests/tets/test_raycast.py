"""The ray caster of volumes against a float64 picture by clipping every cell on every ray."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers_volume import (
    FIVE,
    SIX,
    Pictures,
    grid_corners,
    grid_points,
    mesh_of,
    ramp,
    rays_of,
    reference_picture,
    tet_grid,
)

from voxtool.camera import Camera
from voxtool.errors import VoxtoolError
from voxtool.tets.mesh import UnstructuredMesh
from voxtool.tets.textures import build_tet
from voxtool.tets.transfer import TransferFunction

NEAR = 2e-5  # of a colour: float32 planes, depths and scalars
GREY = TransferFunction(np.array([0.0]), np.full((1, 3), 0.5), np.array([0.7]))


def picture_of(mesh, transfer, rays, device, layout="raycast", **how) -> np.ndarray:
    return Pictures(build_tet(mesh, layout), device).render(rays, transfer, **how)


def wavy(points: np.ndarray) -> np.ndarray:
    return np.sin(3 * points[:, 0]) + points[:, 1] * points[:, 2]


VIEWS = [("iso", None), ("iso", 30.0), ("front", None), ("left", 100.0)]


@pytest.mark.parametrize(("view", "fov"), VIEWS)
@pytest.mark.parametrize("holes", [0.0, 0.4])
@pytest.mark.parametrize("extinction", [0.3, 30.0, 1e4])
def test_picture_is_the_references(device, view, fov, holes, extinction) -> None:
    points, cells = tet_grid((4, 3, 5), seed=1, holes=holes)
    mesh = mesh_of(points, cells, wavy(points))
    transfer, rays = ramp(-1.5, 1.5, extinction), rays_of(mesh, view, fov)
    wanted = reference_picture(mesh, transfer, rays)
    found = picture_of(mesh, transfer, rays, device)
    assert wanted[..., 3].max() > 0.1
    # where the light is gone within 1e-4 of the mesh, what rounding moves shows the more
    assert np.abs(found - wanted).max() < NEAR * max(1, extinction / 10)
    assert np.sqrt(np.square(found - wanted).mean()) < NEAR


@pytest.mark.parametrize("fov", [20.0, 90.0, 150.0])
def test_eye_inside(device, fov) -> None:
    points, cells = tet_grid((5, 5, 5), seed=2)
    mesh = mesh_of(points, cells, wavy(points))
    camera = Camera((0.1, -0.2, 0.15), (1.0, 0.3, -0.4), fov=fov)
    rays, transfer = camera.rays(36, 28), ramp(-1.5, 1.5, 2.0)
    wanted = reference_picture(mesh, transfer, rays)
    assert (wanted[..., 3] > 0).all()
    assert np.abs(picture_of(mesh, transfer, rays, device) - wanted).max() < NEAR


def test_eye_in_a_hole_and_in_a_transparent_cell(device) -> None:
    points, cells = tet_grid((5, 5, 5), seed=3)
    middle = np.abs(points[cells].mean(axis=1)).max(axis=1) < 0.45
    transfer = ramp(-1.5, 1.5, 2.0)
    rays = Camera((0.0, 0.02, 0.01), (1.0, 0.3, -0.4), fov=90).rays(36, 28)
    hollow = mesh_of(points, cells[~middle], wavy(points))
    wanted = reference_picture(hollow, transfer, rays)
    assert np.abs(picture_of(hollow, transfer, rays, device) - wanted).max() < NEAR
    ball = mesh_of(points, cells, np.square(points).sum(axis=1))
    shell = TransferFunction(
        np.array([0.0, 0.8, 1.2]), np.full((3, 3), 0.5), np.array([0.0, 0.0, 3.0])
    )
    wanted = reference_picture(ball, shell, rays)
    assert np.abs(picture_of(ball, shell, rays, device) - wanted).max() < NEAR


@pytest.mark.parametrize("kind", ["five", "six", "twenty-four"])
@pytest.mark.parametrize("fov", [None, 35.0])
def test_a_cube_however_it_is_cut(device, kind, fov) -> None:
    """A linear field in a box: the same as the box itself, of which the reference has one cut."""
    points = grid_points((1, 1, 1))
    if kind == "twenty-four":
        quads = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
        middles = [points[list(quad)].mean(axis=0) for quad in quads]
        points = np.vstack([points, *middles, [[0.5, 0.5, 0.5]]])
        cells = np.array(
            [
                (quad[i], quad[(i + 1) % 4], 8 + side, 14)
                for side, quad in enumerate(quads)
                for i in range(4)
            ]
        )
    else:
        cells = FIVE if kind == "five" else SIX
    linear = points @ [0.5, -0.3, 0.8]
    rays = rays_of(mesh_of(points, cells, linear), "iso", fov)
    transfer = ramp(-0.3, 1.3, 5.0, steps=5)
    box = grid_points((1, 1, 1))
    wanted = reference_picture(mesh_of(box, SIX, box @ [0.5, -0.3, 0.8]), transfer, rays)
    found = picture_of(mesh_of(points, cells, linear), transfer, rays, device)
    assert np.abs(found - wanted).max() < NEAR


@pytest.mark.parametrize("parts", [1, 2, 7])
def test_no_hole_and_no_double_through_vertices_edges_and_faces(device, parts) -> None:
    """Rays straight down the edges, faces and vertices of a grid: every pixel has the same way."""
    points, cells = tet_grid((8, 8, 8))
    mesh = mesh_of(points, cells, points[:, 0])
    # pixel centres on the grid's lines, and on 1/parts of its steps
    camera = Camera((0, 0, 5), (0, 0, 0), fov=None, height=0.25 * 9)
    rays = camera.rays(9 * parts, 9 * parts)
    found = picture_of(mesh, GREY, rays, device)
    x = (np.arange(9 * parts) + 0.5 - 4.5 * parts) * 0.25 / parts
    inside = (np.abs(x) < 1)[:, None] & (np.abs(x) < 1)
    np.testing.assert_allclose(found[inside][:, 3], -np.expm1(-1.4), atol=1e-6)
    border = (np.abs(x) == 1)[:, None] | (np.abs(x) == 1)
    assert not found[~inside & ~border].any()
    assert set(np.round(found[border][:, 3] / -np.expm1(-1.4), 5)) <= {0.0, 1.0}


@pytest.mark.parametrize("view", ["iso", "front", "left"])
def test_a_straight_grid_in_perspective_has_no_hole(device, view) -> None:
    points, cells = tet_grid((8, 8, 8))
    mesh = mesh_of(points, cells, points[:, 0])
    rays = rays_of(mesh, view, 40.0, (65, 65))
    wanted = reference_picture(mesh, GREY, rays)
    assert np.abs(picture_of(mesh, GREY, rays, device) - wanted).max() < NEAR


def test_silhouette_is_that_of_the_boundary(device) -> None:
    points, cells = tet_grid((4, 3, 5), seed=4, holes=0.6)
    mesh = mesh_of(points, cells, points[:, 0])
    thick = TransferFunction(np.array([0.0]), np.ones((1, 3)), np.array([1e6]))
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov, (200, 150))
        seen = picture_of(mesh, thick, rays, device)[..., 3] > 0
        wanted = reference_picture(mesh, thick, rays)[..., 3] > 0
        assert np.array_equal(seen, wanted), (view, fov)


def test_unmatched_seams_show_no_gap(device) -> None:
    """Half of the box is cut in six, half in five: their faces do not match."""
    corners = grid_corners((2, 2, 2))
    odd = np.indices((2, 2, 2)).reshape(3, -1).sum(axis=0) % 2 == 1
    cells = np.vstack([corners[~odd][:, SIX].reshape(-1, 4), corners[odd][:, FIVE].reshape(-1, 4)])
    points = grid_points((2, 2, 2)) - 1
    mesh = mesh_of(points, cells, points[:, 1])
    volume = build_tet(mesh)
    assert np.count_nonzero(volume.neighbours < 0) > 48
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov, (64, 48))
        wanted = reference_picture(mesh, GREY, rays)
        assert np.abs(picture_of(mesh, GREY, rays, device) - wanted).max() < NEAR


@pytest.mark.parametrize("squeeze", [1e-3, 1e-5, 1e-7])
def test_slivers_and_needles(device, squeeze) -> None:
    """Layers thick and thin along every axis: boxes, plates and rods, sheared."""
    points, cells = tet_grid((6, 6, 6))
    numbers = np.rint(3 * points + 3).astype(int)
    planes = np.cumsum([-2.0, 1, squeeze, 1, squeeze, 1, squeeze])
    points = planes[numbers] @ [[1, 0.1, 0], [0, 1, 0.2], [0.15, 0, 1]]
    mesh = mesh_of(points, cells, wavy(numbers))
    transfer = ramp(-1.5, 13.0, 3.0)
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov)
        found = picture_of(mesh, transfer, rays, device)
        wanted = reference_picture(mesh, transfer, rays)
        assert np.isfinite(found).all()
        assert np.abs(found - wanted).max() < 5e-4


def test_layouts_give_the_same_picture(device) -> None:
    points, cells = tet_grid((4, 3, 5), seed=6, holes=0.2)
    mesh = mesh_of(points, cells, wavy(points))
    rays, transfer = rays_of(mesh, "iso", 30.0), ramp(-1.5, 1.5, 3.0)
    table5, table4 = (
        picture_of(mesh, transfer, rays, device, layout) for layout in ("raycast", "projection")
    )
    assert np.abs(table4 - table5).max() < NEAR


def test_constant_cells_and_hexahedra(device) -> None:
    points, corners = grid_points((3, 4, 2)), grid_corners((3, 4, 2))
    order = [0, 4, 6, 2, 1, 5, 7, 3]  # as VTK numbers a hexahedron's corners
    scalars = np.random.default_rng(7).random(len(corners))
    mesh = UnstructuredMesh(points, [("hexahedron", corners[:, order])], [scalars], "s")
    cut = mesh_of(points, corners[:, SIX].reshape(-1, 4), [np.repeat(scalars, 6)])
    transfer = ramp(0.0, 1.0, 3.0)
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov)
        wanted = reference_picture(cut, transfer, rays)
        for layout in ("raycast", "hexahedra"):
            found = picture_of(mesh, transfer, rays, device, layout)
            assert np.abs(found - wanted).max() < NEAR, (layout, view)
    inside = Camera((1.1, 1.2, 0.9), (2.0, 3.0, 1.0), fov=100).rays(30, 30)
    wanted = reference_picture(cut, transfer, inside)
    assert np.abs(picture_of(mesh, transfer, inside, device, "hexahedra") - wanted).max() < NEAR


@pytest.mark.parametrize("integrator", ["average", "sampled:1", "sampled:64", "preintegrated"])
def test_other_integrators_come_near(device, integrator) -> None:
    points, cells = tet_grid((6, 6, 6), seed=8)
    mesh = mesh_of(points, cells, wavy(points))
    rays, transfer = rays_of(mesh, "iso", 30.0), ramp(-1.5, 1.5, 2.0)
    wanted = reference_picture(mesh, transfer, rays)
    volume = Pictures(build_tet(mesh), device)
    error = np.abs(volume.render(rays, transfer, integrator=integrator) - wanted).max()
    exact = np.abs(volume.render(rays, transfer) - wanted).max()
    assert exact < error < {"sampled:64": 1e-3}.get(integrator, 0.1)


def test_transparent_blocks_are_left_out(device) -> None:
    """A shell of a ball: most of the cells are never visited, and the picture is the same."""
    points, cells = tet_grid((16, 16, 16), seed=9)
    mesh = mesh_of(points, cells, np.square(points).sum(axis=1))
    clear, full = np.array([0.0, 0.0, 1.0, 0.0, 0.0]), np.array([1e-9, 1e-9, 1.0, 1e-9, 1e-9])
    at, colours = np.array([0.0, 0.3, 0.4, 0.5, 3.0]), np.random.default_rng(1).random((5, 3))
    volume = Pictures(build_tet(mesh), device)
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov)
        some = volume.render(rays, TransferFunction(at, colours, 20 * clear))
        left_out = 1 - volume.scene(TransferFunction(at, colours, clear)).cells_shown / len(cells)
        assert 0.3 < left_out < 1
        every = volume.render(rays, TransferFunction(at, colours, 20 * full))
        assert volume.scene(TransferFunction(at, colours, full)).cells_shown == len(cells)
        assert np.abs(some - every).max() < NEAR
    nothing = TransferFunction(at, colours, 0 * clear)
    assert not volume.render(rays, nothing).any()
    assert volume.scene(nothing).cells_shown == 0


@pytest.mark.parametrize("power", [-40, 40])
def test_scaling_by_powers_of_two_is_exact(device, power) -> None:
    points, cells = tet_grid((3, 3, 3), seed=10)
    for fov in (None, 30.0):
        pictures = []
        for scale in (1.0, 2.0**power):
            mesh = mesh_of(scale * points, cells, wavy(points))
            transfer = ramp(-1.5, 1.5, 2.0 / scale)
            pictures.append(picture_of(mesh, transfer, rays_of(mesh, "iso", fov), device))
        assert np.array_equal(*pictures)


def test_far_away_and_tiny(device) -> None:
    """Moved by a million sizes, and in units of 1e-9: the same within float64's rounding."""
    points, cells = tet_grid((3, 3, 3), seed=11)
    transfer, mesh = ramp(-1.5, 1.5, 2.0), mesh_of(points, cells, wavy(points))
    wanted = picture_of(mesh, transfer, rays_of(mesh, "iso", 30.0), device)
    moved = mesh_of(points + 2e6, cells, wavy(points))
    assert (
        np.abs(picture_of(moved, transfer, rays_of(moved, "iso", 30.0), device) - wanted).max()
        < 1e-4
    )
    tiny, dense = mesh_of(1e-9 * points, cells, wavy(points)), ramp(-1.5, 1.5, 2e9)
    assert np.abs(picture_of(tiny, dense, rays_of(tiny, "iso", 30.0), device) - wanted).max() < NEAR


def test_once_around_is_the_same_picture(device) -> None:
    points, cells = tet_grid((3, 4, 3), seed=12)
    mesh = mesh_of(points, cells, wavy(points))
    camera = Camera.fit((-1, -1, -1), (1, 1, 1), "iso")
    volume, transfer = Pictures(build_tet(mesh), device), ramp(-1.5, 1.5, 2.0)
    first, round_, half = (
        volume.render(camera.turned(turn).rays(40, 40), transfer) for turn in (0, 360, 180)
    )
    assert np.array_equal(first, round_)
    assert not np.array_equal(first, half)


def test_opaque_in_front_hides_what_is_behind(device) -> None:
    points, cells = tet_grid((2, 2, 6), seed=13)
    mesh = mesh_of(points, cells, points[:, 2])
    wall = TransferFunction(
        np.array([-1.5, 0.5, 0.6, 1.5]), np.eye(4)[:, :3], np.array([1.0, 1.0, 1e5, 1e5])
    )
    rays = rays_of(mesh, "front", None, (16, 16))
    found = picture_of(mesh, wall, rays, device)[6:10, 6:10]
    assert (found[..., 3] == 1).all()
    assert np.abs(found - reference_picture(mesh, wall, rays)[6:10, 6:10]).max() < 1e-4


@pytest.mark.parametrize("fov", [None, 40.0])
def test_mirrored_rays_give_the_mirrored_picture(device, fov) -> None:
    points, cells = tet_grid((3, 3, 3), seed=3)
    mesh = mesh_of(points, cells, wavy(points))
    volume = Pictures(build_tet(mesh), device)
    rays, transfer = rays_of(mesh, "iso", fov), ramp(-1.5, 1.5, 2.0)
    upright = volume.render(rays, transfer)
    mirrored = volume.render(replace(rays, right=-rays.right), transfer)
    assert np.array_equal(mirrored, upright[:, ::-1])


def test_sizes_that_are_no_multiple_of_a_tile(device) -> None:
    points, cells = tet_grid((3, 3, 3), seed=14)
    mesh, transfer = mesh_of(points, cells, wavy(points)), ramp(-1.5, 1.5, 2.0)
    volume = Pictures(build_tet(mesh), device)
    for size in itertools.product((1, 3, 17), (1, 5, 18)):
        rays = rays_of(mesh, "iso", 30.0, size)
        wanted = reference_picture(mesh, transfer, rays)
        assert np.abs(volume.render(rays, transfer) - wanted).max() < NEAR


def test_devices_agree_bit_for_bit(device_index) -> None:
    """The first device's picture is every device's."""
    from conftest import opened, usable_devices

    points, cells = tet_grid((6, 5, 6), seed=15, holes=0.1)
    mesh, transfer = mesh_of(points, cells, wavy(points)), ramp(-1.5, 1.5, 20.0, steps=7)
    first = opened(usable_devices()[0][0])
    for integrator in ("linear", "average", "sampled:3", "preintegrated"):
        for view, fov in VIEWS:
            rays = rays_of(mesh, view, fov, (65, 47))
            wanted, found = (
                picture_of(mesh, transfer, rays, d, integrator=integrator)
                for d in (first, opened(device_index))
            )
            assert np.array_equal(wanted, found)


@pytest.mark.parametrize(
    "integrator", ["cubic", "sampled", "sampled:0", "linear:2", "sampled:99999"]
)
def test_unknown_integrators_are_refused(device, integrator) -> None:
    points, cells = tet_grid((1, 1, 1))
    mesh = mesh_of(points, cells, points[:, 0])
    with pytest.raises(VoxtoolError, match="choose"):
        picture_of(mesh, GREY, rays_of(mesh, "iso", None), device, integrator=integrator)


def test_unknown_methods_are_refused(device) -> None:
    points, cells = tet_grid((1, 1, 1))
    mesh = mesh_of(points, cells, points[:, 0])
    with pytest.raises(VoxtoolError, match="choose"):
        picture_of(mesh, GREY, rays_of(mesh, "iso", None), device, method="splat")


# ---- one tetrahedron, whose middle ray is known


def light_of_a_ramp(transfer: TransferFunction, front: float, back: float, length: float):
    """Red and alpha of a ray on which the scalar is linear, by quadrature with mpmath."""
    from mpmath import exp, linspace, mp, mpf, quad

    mp.dps = 20
    points = [front, *sorted(transfer.scalars, reverse=True), back]
    cuts = [p for p in points if back <= p <= front]
    red, through = mpf(0), mpf(1)
    for begin, end in itertools.pairwise(cuts):
        if begin == end:
            continue
        distance = mpf(length) * (begin - end) / (front - back)
        middle = np.array([(begin + end) / 2])
        inner = transfer.evaluate(middle + (np.array([begin, end]) - middle) * (1 - 1e-12))
        c0, c1 = (mpf(float(c)) for c in inner[0][:, 0])
        t0, t1 = (mpf(float(t)) for t in inner[1])

        def lost(x, t0=t0, t1=t1, d=distance):
            return exp(-d * (t0 * x + (t1 - t0) * x * x / 2))

        def sent(x, c0=c0, c1=c1, t0=t0, t1=t1, d=distance, lost=lost):
            return d * (c0 + (c1 - c0) * x) * (t0 + (t1 - t0) * x) * lost(x)

        steep = [mpf(0), *(mpf(2) ** -k for k in range(16, 0, -1)), *linspace(mpf(0.5), 1, 4)[1:]]
        red += through * quad(sent, steep)
        through *= lost(mpf(1))
    return float(red), float(1 - through)


@functools.cache
def transfer_and_light(points: int, extinction: float):
    """A random transfer function of so many points, and the light of the middle ray."""
    random = np.random.default_rng(points)
    scalars = np.linspace(0, 0.5, points) if points < 5 else np.array([0.03, 0.1, 0.11, 0.3, 0.46])
    transfer = TransferFunction(
        scalars, random.random((points, 3)), extinction * random.random(points)
    )
    return transfer, light_of_a_ramp(transfer, 0.5, 0.0, 0.5)


@pytest.mark.parametrize("points", [1, 2, 5])
@pytest.mark.parametrize("extinction", [1e-6, 0.02, 1.0, 30.0, 2e4])
def test_one_tetrahedron(device, points, extinction) -> None:
    """A constant, a linear and a piecewise linear transfer function, all regimes."""
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)])
    mesh = mesh_of(corners, np.array([(0, 1, 2, 3)]), corners[:, 2])
    transfer, wanted = transfer_and_light(points, extinction)
    rays = Camera((0.25, 0.25, 5), (0.25, 0.25, 0), fov=None, height=0.1).rays(1, 1)
    for method in ("raycast", "projection"):
        red, _, _, alpha = picture_of(mesh, transfer, rays, device, method=method)[0, 0]
        np.testing.assert_allclose((red, alpha), wanted, rtol=2e-6, atol=1e-12)
