"""Pictures of volumes by both methods against float64 ones, which clip every cell on every ray."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers.tets import (
    FIVE,
    SIX,
    boxes,
    cube,
    draw,
    grid_corners,
    grid_points,
    ramp,
    rays_of,
    reference_picture,
    tet_grid,
    tet_mesh,
    wavy,
)

from voxtool.camera import Camera, Rays
from voxtool.choices import METHODS
from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.pictures.rendering import plan_render
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.scene import VolumeScene
from voxtool.tets.pictures.transfer import LocalTransfer, TransferFunction
from voxtool.tets.volume.mesh import UnstructuredMesh
from voxtool.tets.volume.volume import TetVolume

NEAR = 2e-5  # of a colour: float32 planes, depths and scalars
CLOSE = 1e-5  # of a colour, of one method from the other
VIEWS = [("iso", None), ("iso", 30.0), ("front", None), ("left", 100.0)]
INTEGRATORS = ("linear", "average", "sampled:3", "preintegrated")
GREY = TransferFunction([0.0], [[0.5] * 3], [0.7])  # pyright: ignore[reportArgumentType]
LAYER = TransferFunction(np.array([0.5, 0.8, 1.1]), np.eye(3), np.array([0.0, 9.0, 0.0]))


def grid_mesh(
    shape: tuple[int, int, int] = (4, 3, 5), seed: int | None = None, holes: float = 0.0
) -> UnstructuredMesh:
    """A grid with a scalar that is not linear."""
    points, cells = tet_grid(shape, seed, holes)
    return tet_mesh(points, cells, wavy(points))


def assert_drawn(
    content: TetVolume | UnstructuredMesh,
    mesh: UnstructuredMesh,
    transfer: TransferFunction,
    rays: Rays,
    device,
    near: float = NEAR,
) -> np.ndarray:
    """Both methods draw the picture of the reference, which is returned."""
    wanted = reference_picture(mesh, transfer, rays)
    for method in METHODS:
        found = draw(content, rays, transfer, device, method)
        assert np.isfinite(found).all()
        assert np.abs(found - wanted).max() < near, method
    return wanted


class Altered:
    """A device of which some attributes are others."""

    def __init__(self, device, **attributes: Any) -> None:
        vars(self).update(attributes, device=device)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.device, name)


# ---- the same picture


@pytest.mark.parametrize(("view", "fov"), VIEWS)
@pytest.mark.parametrize("holes", [0.0, 0.4])
@pytest.mark.parametrize("extinction", [0.3, 30.0, 1e4])
def test_picture_is_the_references_in_both_layouts(device, view, fov, holes, extinction) -> None:
    mesh = grid_mesh(seed=1, holes=holes)
    transfer, rays = ramp(-1.5, 1.5, extinction), rays_of(mesh, view, fov)
    wanted = reference_picture(mesh, transfer, rays)
    assert wanted[..., 3].max() > 0.1
    # where the light is gone within 1e-4 of the mesh, rounding shows the more
    share = max(1, extinction / 10)
    for layout in ("raycast", "projection"):
        volume = build_tet(mesh, layout)
        cast, projected = (draw(volume, rays, transfer, device, method) for method in METHODS)
        for error, near in ((cast - wanted, NEAR), (projected - cast, CLOSE)):
            assert np.abs(error).max() < near * share
            assert np.sqrt(np.square(error).mean()) < near


@pytest.mark.parametrize("fov", [None, 40.0])
def test_mirrored_rays_give_the_mirrored_picture(device, fov) -> None:
    mesh, transfer = grid_mesh((3, 3, 3), seed=3), ramp(-1.5, 1.5, 2.0)
    rays, volume = rays_of(mesh, "iso", fov), build_tet(mesh)
    for method in METHODS:
        upright = draw(volume, rays, transfer, device, method)
        mirrored = draw(volume, replace(rays, right=-rays.right), transfer, device, method)
        assert np.array_equal(mirrored, upright[:, ::-1])


@pytest.mark.parametrize("seed", range(6))
def test_random_meshes_cameras_and_transfer_functions(device, seed) -> None:
    random = np.random.default_rng(seed)
    shape = tuple(random.integers(1, 7, 3).tolist())
    mesh = grid_mesh(shape, seed, random.choice([0.1, 0.5, 0.9]))
    low, high = np.sort(random.uniform(-2, 2, 2)).tolist()
    transfer = ramp(low, high, 5.0, int(random.integers(2, 9)), seed)
    eye = tuple((random.normal(size=3) * random.choice([0.3, 2, 9])).tolist())
    camera = Camera(eye, (0.1, 0.2, 0.3), (0.2, 1.0, 0.1), fov=float(random.uniform(5, 140)))
    assert_drawn(mesh, mesh, transfer, camera.rays(*random.integers(20, 60, 2).tolist()), device)


def test_constant_cells_and_hexahedra(device) -> None:
    shape, scalars = (3, 4, 2), np.random.default_rng(7).random(24)
    mesh, cut = boxes(grid_points(shape), shape, scalars)
    inside = Camera((1.1, 1.2, 0.9), (2.0, 3.0, 1.0), fov=100).rays(30, 30)
    for rays in [*(rays_of(mesh, view, fov) for view, fov in VIEWS), inside]:
        for layout in ("raycast", "hexahedra"):
            assert_drawn(build_tet(mesh, layout), cut, ramp(0.0, 1.0, 3.0), rays, device)


@pytest.mark.parametrize("integrator", ["average", "sampled:1", "sampled:64", "preintegrated"])
@pytest.mark.parametrize("fov", [None, 30.0])
def test_other_integrators_come_near(device, integrator, fov) -> None:
    mesh, transfer = grid_mesh((6, 6, 6), seed=8), ramp(-1.5, 1.5, 2.0)
    volume, rays = build_tet(mesh), rays_of(mesh, "iso", fov)
    wanted = reference_picture(mesh, transfer, rays)
    cast, projected = (draw(volume, rays, transfer, device, m, integrator) for m in METHODS)
    assert np.abs(projected - cast).max() < CLOSE
    exact = np.abs(draw(volume, rays, transfer, device) - wanted).max()
    assert exact < np.abs(cast - wanted).max() < {"sampled:64": 1e-3}.get(integrator, 0.1)


def test_sizes_that_are_no_multiple_of_a_tile(device) -> None:
    mesh, transfer = grid_mesh((3, 3, 3), seed=14), ramp(-1.5, 1.5, 2.0)
    volume = build_tet(mesh)
    for size in [*itertools.product((1, 3, 17), (1, 5, 18)), (8, 8), (65, 1), (3, 40)]:
        assert_drawn(volume, mesh, transfer, rays_of(mesh, "iso", 30.0, size), device)


@pytest.mark.slow
def test_devices_and_lanes_agree_bit_for_bit() -> None:
    """One picture, on every device and also with one ray a work-item."""
    mesh, transfer = grid_mesh((6, 5, 6), seed=15, holes=0.1), ramp(-1.5, 1.5, 20.0, steps=7)
    volume, devices = build_tet(mesh), [opened(index) for index, _ in usable_devices()]
    for (i, (view, fov)), method, (j, integrator) in itertools.product(
        enumerate(VIEWS), METHODS, enumerate(INTEGRATORS)
    ):
        how = volume, rays_of(mesh, view, fov, (35, 27)), transfer
        # single rays by every second pair of a view and an integrator: each is one more program
        lanes = (None, 1) if (i + j) % 2 else (None,)
        pictures = {
            draw(*how, device, method, integrator, lanes=n).tobytes()
            for device, n in itertools.product(devices, lanes)
        }
        assert len(pictures) == 1


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_table_of_control_points_changes_no_picture(method: str, device) -> None:
    """Points in one part of the scalars, at the ends of parts, steps, and beyond the scalars."""
    mesh, rng = grid_mesh((4, 4, 3), seed=16), np.random.default_rng(5)
    volume = build_tet(mesh)
    low, high = volume.scalar_range
    parts = np.arange(0, 17) / 16
    crowd = 0.51 + 1e-3 * np.arange(9)
    for at in (parts, np.sort(np.concatenate([crowd, parts])), np.repeat(parts[:8], 2),
               np.linspace(-0.5, 1.5, 33), parts[:1]):  # fmt: skip
        colours, extinctions = rng.random((len(at), 3)), 3 * rng.random(len(at))
        transfer = TransferFunction(low + (high - low) * at, colours, extinctions)
        job = plan_render(volume, rays_of(mesh, "iso", 30.0, (17, 12)), transfer=transfer,
                          method=method, device=device)  # fmt: skip
        first = job.with_(buckets=0).run()
        assert first.any()
        for buckets, lanes in ((4, None), (16, 1), (256, None)):
            assert np.array_equal(first, job.with_(buckets=buckets, lanes=lanes).run())


def test_parts_of_scalars() -> None:
    points = np.sort(np.random.default_rng(6).random(40).astype(np.float32))
    transfer = LocalTransfer(points, np.zeros((41, 16), np.float32), np.zeros((41, 10)))
    for parts in (1, 8, 256):
        begin = np.arange(parts, dtype=np.float32) / np.float32(parts)
        expected = [np.count_nonzero(points < low) for low in begin]
        assert transfer.below(parts).tolist() == expected


@pytest.mark.parametrize(
    "how",
    [("splat",), *(("raycast", i) for i in ("cubic", "sampled", "sampled:0", "linear:2")),
     ("projection", "sampled:99999")],
)  # fmt: skip
def test_unknown_methods_and_integrators_are_refused(how) -> None:
    with pytest.raises(VoxtoolError, match="choose"):
        VolumeScene(build_tet(cube(5)), GREY, *how)


# ---- eyes in the volume


@pytest.mark.parametrize("fov", [20.0, 90.0, 150.0])
@pytest.mark.parametrize("eye", [(0.1, -0.2, 0.15), (0.9, 0.9, 0.9), (-1.1, 0.05, 0.0)])
def test_eye_inside_and_near(device, fov, eye) -> None:
    mesh = grid_mesh((5, 5, 5), seed=2)
    rays = Camera(eye, (1.0, 0.3, -0.4), fov=fov).rays(36, 28)
    assert_drawn(mesh, mesh, ramp(-1.5, 1.5, 2.0), rays, device)


def test_eye_in_a_hole_and_in_a_transparent_cell(device) -> None:
    points, cells = tet_grid((5, 5, 5), seed=3)
    middle = np.abs(points[cells].mean(axis=1)).max(axis=1) < 0.45
    rays = Camera((0.0, 0.02, 0.01), (1.0, 0.3, -0.4), fov=90).rays(36, 28)
    hollow = tet_mesh(points, cells[~middle], wavy(points))
    ball = tet_mesh(points, cells, np.square(points).sum(axis=1))
    shell = replace(LAYER, scalars=[0.0, 0.8, 1.2], extinctions=[0, 0, 3])
    for mesh, transfer in ((hollow, ramp(-1.5, 1.5, 2.0)), (ball, shell)):
        assert_drawn(mesh, mesh, transfer, rays, device)


@pytest.mark.parametrize(
    "eye", [(0.0, 0.0, 0.0), (0.5, 0.2, 0.1), (0.5, 0.5, 0.3), (1.0, 0.1, 0.2)]
)
def test_eye_on_a_vertex_a_face_and_an_edge_of_a_grid(device, eye) -> None:
    mesh = grid_mesh((4, 4, 4))
    rays = Camera(eye, (-0.37, 0.31, -0.43), fov=110).rays(30, 22)
    assert_drawn(mesh, mesh, ramp(-1.5, 1.5, 2.0), rays, device)


@pytest.mark.parametrize("holes", [0.0, 0.4])
def test_eye_on_vertices_edges_and_faces(device, holes) -> None:
    """Cells meet there that are no neighbours of each other, where others are gone."""
    mesh, transfer = grid_mesh((4, 4, 4), seed=2, holes=holes), ramp(-1.5, 1.5, 2.0)
    volume, random, cells = build_tet(mesh), np.random.default_rng(3), mesh.cells[0][1]
    for corners in mesh.points[cells[random.permutation(len(cells))[:8]]]:
        for count in (1, 2, 3):
            eye = corners[:count].mean(axis=0)
            rays = Camera(tuple(eye), tuple(eye + random.normal(size=3)), fov=120.0).rays(24, 20)
            wanted = reference_picture(mesh, transfer, rays)
            error = np.abs(draw(volume, rays, transfer, device) - wanted).max(axis=2)
            # a ray along a face that begins on it may have either side
            assert np.count_nonzero(error > 1e-3) <= 1
            assert np.sort(error.ravel())[-3] < 1e-3


@pytest.mark.parametrize("off", [0.0, 1e-7, -1e-7, 1e-6, -3e-6])
def test_eye_in_planes_of_faces_seen_along_axes(device, off) -> None:
    """Beyond a boundary face through the eye is nothing, within a cell's neighbour what it has."""
    points, cells = tet_grid((4, 4, 4))
    mesh = tet_mesh((points + 1) / 2, cells, points[:, 0])
    volume, transfer = build_tet(mesh), replace(GREY, extinctions=[1.7])
    eyes = [(0, 0, 0), (0, 0, 0.5), (0.5, 0, 0.5), (0.41, 0, 0.37), (0.3, 0.25, 0.6)]
    for eye, way in itertools.product(np.add(eyes, (0, off, 0)), np.eye(3)[[0, 2]]):
        for turn in (1, -1):
            camera = Camera(tuple(eye), tuple(eye + turn * way), (0.13, 0.93, 0.37), fov=70)
            rays = camera.rays(32, 32)
            wanted = reference_picture(mesh, transfer, rays)
            for method in METHODS:
                # a ray at a small angle to a plane so near to the eye leaves sooner or later
                error = np.abs(draw(volume, rays, transfer, device, method) - wanted)
                assert error.max() < NEAR + 5e3 * abs(off), (eye, way, method)


# ---- hard meshes


@pytest.mark.parametrize("pieces", [5, 6, 24])
@pytest.mark.parametrize("fov", [None, 35.0])
def test_a_cube_however_it_is_cut(device, pieces, fov) -> None:
    """A linear field in a box: the same as that of another cut."""
    mesh, one = cube(pieces), cube(6)
    assert_drawn(mesh, one, ramp(0.7, 4.8, 5.0, steps=5), rays_of(one, "iso", fov), device)


@pytest.mark.parametrize("parts", [1, 2, 7])
def test_no_hole_and_no_double_through_vertices_edges_and_faces(device, parts) -> None:
    """Rays straight down the edges, faces and vertices of a grid: every pixel has the same way."""
    volume = build_tet(grid_mesh((8, 8, 8)))
    # pixel centres on the grid's lines, and on 1/parts of its steps
    camera = Camera((0, 0, 5), (0, 0, 0), fov=None, height=0.25 * 9)
    rays = camera.rays(9 * parts, 9 * parts)
    x = np.abs((np.arange(9 * parts) + 0.5 - 4.5 * parts) * 0.25 / parts)
    inside, border = (x < 1)[:, None] & (x < 1), (x == 1)[:, None] | (x == 1)
    cast, projected = (draw(volume, rays, GREY, device, method) for method in METHODS)
    assert np.abs(projected - cast).max() < 1e-6
    np.testing.assert_allclose(cast[inside][:, 3], -np.expm1(-1.4), atol=1e-6)
    assert not cast[~inside & ~border].any()
    assert set(np.round(cast[border][:, 3] / -np.expm1(-1.4), 5)) <= {0.0, 1.0}


@pytest.mark.parametrize("view", ["iso", "front", "left"])
def test_a_straight_grid_in_perspective_has_no_hole(device, view) -> None:
    mesh = grid_mesh((8, 8, 8))
    assert_drawn(mesh, mesh, GREY, rays_of(mesh, view, 40.0, (65, 65)), device)


def test_silhouette_is_that_of_the_boundary(device) -> None:
    mesh = grid_mesh(seed=4, holes=0.6)
    volume, thick = build_tet(mesh), replace(GREY, extinctions=[1e6])
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov, (200, 150))
        seen = draw(volume, rays, thick, device)[..., 3] > 0
        wanted = reference_picture(mesh, thick, rays)[..., 3] > 0
        assert np.array_equal(seen, wanted), (view, fov)


def test_unmatched_seams_show_no_gap(device) -> None:
    """Half of the box is cut in six, half in five: their faces do not match."""
    corners = grid_corners((2, 2, 2))
    odd = np.indices((2, 2, 2)).reshape(3, -1).sum(axis=0) % 2 == 1
    cells = np.vstack([corners[~odd][:, SIX].reshape(-1, 4), corners[odd][:, FIVE].reshape(-1, 4)])
    points = grid_points((2, 2, 2)) - 1
    mesh = tet_mesh(points, cells, points[:, 1])
    volume = build_tet(mesh)
    assert np.count_nonzero(volume.neighbours < 0) > 48
    for view, fov in VIEWS:
        assert_drawn(volume, mesh, GREY, rays_of(mesh, view, fov, (64, 48)), device)


@pytest.mark.parametrize("squeeze", [1e-3, 1e-5, 1e-7])
def test_slivers_and_needles(device, squeeze) -> None:
    """Layers thick and thin along every axis: boxes, plates and rods, sheared."""
    points, cells = tet_grid((6, 6, 6))
    numbers = np.rint(3 * points + 3).astype(int)
    planes = np.cumsum([-2.0, 1, squeeze, 1, squeeze, 1, squeeze])
    points = planes[numbers] @ [[1, 0.1, 0], [0, 1, 0.2], [0.15, 0, 1]]
    mesh = tet_mesh(points, cells, wavy(numbers))
    volume = build_tet(mesh)
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov)
        assert_drawn(volume, mesh, ramp(-1.5, 13.0, 3.0), rays, device, near=5e-4)


@pytest.mark.parametrize("way", [(1, -1, 0), (1, 2, 0), (1, 1, 0), (0, 0, 1)])
def test_rays_through_the_edges_of_notches(device, way) -> None:
    """Rays straight through the edges between boxes of which a third is gone. A ray on an edge may
    have what is on either side, but it must not end there."""
    shape = (8, 8, 8)
    kept = np.random.default_rng(0).random(512) > 0.3
    points = grid_points(shape) / 4 - 1
    mesh = tet_mesh(points, grid_corners(shape)[kept][:, SIX].reshape(-1, 4), points[:, 0])
    up = (0, 1, 0) if way == (0, 0, 1) else (0, 0, 1)
    camera = Camera(
        tuple(-5.0 * np.array(way)), (0, 0, 0), up, fov=None, height=49 * 0.125 * 0.5**0.5
    )
    rays = camera.rays(49, 49)
    found = draw(mesh, rays, GREY, device)
    error = np.full((49, 49), np.inf)
    for x, y in ((0, 0), (1, 2), (2, -1), (-1, -2), (-2, 1), (1, -2), (-1, 2), (2, 1), (-2, -1)):
        aside = 1e-5 * (x * rays.right + y * rays.down)
        wanted = reference_picture(mesh, GREY, replace(rays, origin=rays.origin + aside))
        error = np.minimum(error, np.abs(found - wanted).max(axis=2))
    assert error.max() < 1e-4


def test_many_entries_are_sorted(device) -> None:
    """A thousand cells behind each other that are no neighbours, in any order."""
    depths = np.random.default_rng(5).permutation(1000)
    corners = np.array([(-1, -1, 0), (3, -1, 0), (-1, 3, 0), (0, 0, 0.5)])
    points = (corners + depths[:, None, None] * (0, 0, 1)).reshape(-1, 3)
    mesh = tet_mesh(points, np.arange(4000).reshape(-1, 4), np.repeat(depths % 7, 4))
    for z in (-9.0, 1009.0):
        rays = Camera((0, 0, z), (0, 0, 500), fov=None, height=0.1).rays(3, 3)
        wanted = assert_drawn(mesh, mesh, ramp(0, 6, 0.02, steps=7), rays, device, near=5e-3)
        assert 0.5 < wanted[..., 3].max() < 1


# ---- positions, sizes, opacities


@pytest.mark.parametrize("power", [-40, 40])
@pytest.mark.parametrize("fov", [None, 30.0])
def test_scaling_by_powers_of_two_is_exact(device, power, fov) -> None:
    mesh, pictures = grid_mesh((3, 3, 3), seed=10), []
    for scale in (1.0, 2.0**power):
        scaled = replace(mesh, points=scale * mesh.points)
        transfer = ramp(-1.5, 1.5, 2.0 / scale)
        pictures.append(draw(scaled, rays_of(scaled, "iso", fov), transfer, device))
    assert np.array_equal(*pictures)


def test_far_away_and_tiny(device) -> None:
    """Moved by a million sizes, and in units of 1e-9: the same within float64's rounding."""
    mesh, transfer = grid_mesh((3, 3, 3), seed=11), ramp(-1.5, 1.5, 2.0)
    wanted = draw(mesh, rays_of(mesh, "iso", 30.0), transfer, device)
    for points, extinction, near in ((mesh.points + 2e6, 2, 1e-4), (1e-9 * mesh.points, 2e9, NEAR)):
        moved, transfer = replace(mesh, points=points), ramp(-1.5, 1.5, extinction)
        found = draw(moved, rays_of(moved, "iso", 30.0), transfer, device)
        assert np.abs(found - wanted).max() < near


def test_once_around_is_the_same_picture(device) -> None:
    volume, transfer = build_tet(grid_mesh((3, 4, 3), seed=12)), ramp(-1.5, 1.5, 2.0)
    camera = Camera.fit((-1, -1, -1), (1, 1, 1), "iso")
    first, round_, half = (
        draw(volume, camera.turned(turn).rays(40, 40), transfer, device) for turn in (0, 360, 180)
    )
    assert np.array_equal(first, round_)
    assert not np.array_equal(first, half)


def test_opaque_in_front_hides_what_is_behind(device) -> None:
    points, cells = tet_grid((2, 2, 6), seed=13)
    mesh = tet_mesh(points, cells, points[:, 2])
    wall = TransferFunction(
        np.array([-1.5, 0.5, 0.6, 1.5]), np.eye(4)[:, :3], np.array([1.0, 1.0, 1e5, 1e5])
    )
    rays = rays_of(mesh, "front", None, (16, 16))
    found = draw(mesh, rays, wall, device)[6:10, 6:10]
    assert (found[..., 3] == 1).all()
    assert np.abs(found - reference_picture(mesh, wall, rays)[6:10, 6:10]).max() < 1e-4


@pytest.mark.parametrize(
    ("fov", "constant", "integrator"),
    [  # of constant cells, each integrator has one kind of view: each is one more program
        pytest.param(fov, constant, how, marks=pytest.mark.soak if constant and (i + j) % 2 else ())
        for (i, fov), constant, (j, how) in itertools.product(
            enumerate((None, 40.0)), (False, True), enumerate(INTEGRATORS)
        )
    ],
)
def test_opaque_pictures_end_at_one(device, fov, constant, integrator) -> None:
    """No colour and no alpha is beyond 1, by any integrator, however opaque."""
    points, cells = tet_grid((3, 3, 3), seed=6)
    scalars = [wavy(points[cells].mean(axis=1))] if constant else wavy(points)
    mesh = tet_mesh(points, cells, scalars)
    volume, rays = build_tet(mesh), rays_of(mesh, "iso", fov)
    for extinction, method in itertools.product((1e2, 1e6, 1e20), METHODS):
        white = replace(ramp(-1.5, 1.5, extinction), colours=np.ones((4, 3)))
        found = draw(volume, rays, white, device, method, integrator)
        assert found.min() >= 0
        assert found[..., 3].max() <= 1
        assert found.max() <= 1 + 1e-6


# ---- what is left out, memory


def test_transparent_blocks_are_left_out(device) -> None:
    """A shell of a ball: most of the cells are never visited, and the picture is the same."""
    points, cells = tet_grid((16, 16, 16), seed=9)
    mesh = tet_mesh(points, cells, np.square(points).sum(axis=1))
    clear, full = np.array([0.0, 0.0, 1.0, 0.0, 0.0]), np.array([1e-9, 1e-9, 1.0, 1e-9, 1e-9])
    at, colours = np.array([0.0, 0.3, 0.4, 0.5, 3.0]), np.random.default_rng(1).random((5, 3))
    shell, ball, nothing = (
        VolumeScene(build_tet(mesh), TransferFunction(at, colours, 20 * extinctions))
        for extinctions in (clear, full, 0 * clear)
    )
    assert 0 < shell.cells_shown < 0.7 * len(cells)
    assert (ball.cells_shown, nothing.cells_shown) == (len(cells), 0)
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov)
        assert np.abs(shell.draw(rays, device) - ball.draw(rays, device)).max() < NEAR
    assert not nothing.draw(rays_of(mesh, "iso", None), device).any()


@pytest.mark.parametrize("layout", ["raycast", "projection"])
@pytest.mark.parametrize("steep", [1, 1000])
def test_textures_of_what_shows_alone_give_the_same_picture(device, layout, steep) -> None:
    points, cells = tet_grid((12, 12, 12), seed=9, holes=0.1)
    points[:, 2] *= 1 if steep == 1 else 1e-3  # flat cells have heights
    diagonal = points[:, 0] + points[:, 1]
    volume = build_tet(tet_mesh(points, cells, diagonal), layout)
    layer = replace(LAYER, scalars=[1.0, 1.2, 1.4], extinctions=steep * LAYER.extinctions)
    eye, up = (0.35, 0.35, 0.3 * points[:, 2].max()), (0.0, 0.0, 1.0)
    inside = Camera(eye, (1.0, 0.9, 0.0), up, fov=100.0).rays(30, 23)
    mesh = tet_mesh(points, cells, diagonal)
    for rays, method in itertools.product([rays_of(mesh, "iso", 30.0), inside], METHODS):
        part, whole = (VolumeScene(volume, layer, method, table=(16, 8)) for _ in range(2))
        assert len(part.drawn.cells) == part.cells_shown < len(cells) / 2
        part.drawn.validate()
        vars(whole)["drawn"] = volume
        picture = part.draw(rays, device)
        assert picture.any()
        assert np.array_equal(picture, whole.draw(rays, device))
        assert "of textures are not uploaded" in part.left_out["transparent cells"]


def layered(kind: str) -> TetVolume:
    """A volume whose first blocks of cells LAYER leaves out."""
    shape = (7, 6, 8)
    if kind == "hexahedra":
        straight = grid_points(shape) / (np.array(shape) / 2) - 1
        middles = straight[grid_corners(shape)].mean(axis=1).sum(axis=1)
        return build_tet(boxes(straight, shape, middles)[0], "hexahedra")
    points, cells = tet_grid(shape, seed=9, holes=0.1)
    diagonal = points.sum(axis=1)
    if kind == "constant":
        return build_tet(tet_mesh(points, cells, [diagonal[cells].mean(axis=1)]))
    return build_tet(tet_mesh(points, cells, diagonal), kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["raycast", "projection", "constant", "hexahedra"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("inside", "integrator"),
    [  # a table is the only memory of an integrator
        (False, "linear"),
        (True, "preintegrated"),
        pytest.param(False, "preintegrated", marks=pytest.mark.soak),
        pytest.param(True, "linear", marks=pytest.mark.soak),
    ],
)
def test_what_memory_held_before_never_shows(device, kind, method, inside, integrator) -> None:
    """NaN, huge numbers and denormals in new memory: the same picture."""
    words = [0]

    def dirty(size, dtype):
        array = device.empty(size, dtype)
        count = -(-max(size * np.dtype(dtype).itemsize, 4) // 4)
        device.write(array, np.full(count, words[0], np.uint32))
        return array

    volume, altered = layered(kind), Altered(device, empty=dirty)
    assert not VolumeScene(volume, LAYER).blocks[0]
    camera = Camera((0.35, 0.35, 0.4), (0.1, -0.3, 0.2), fov=100.0)
    outside = Camera.fit((-1, -1, -1), (1, 1, 1), "iso", fov=None)
    pictures = []
    for words[0] in (0, 0x7FC00000, 0xFF7FFFFF, 1):
        rays = (camera if inside else outside).rays(19, 17)
        pictures.append(draw(volume, rays, LAYER, altered, method, integrator))
    assert pictures[0].any()
    assert np.isfinite(pictures[0]).all()
    assert len({picture.tobytes() for picture in pictures}) == 1


def test_pictures_beyond_limits_are_refused(device) -> None:
    mesh = grid_mesh((2, 2, 2), seed=1)
    volume, rays = build_tet(mesh), rays_of(mesh, "iso", None)
    with pytest.raises(MemoryLimitError, match="choose a smaller picture"):
        draw(volume, rays, GREY, device, max_entries=10)
    with pytest.raises(MemoryLimitError, match="pairs of a cell and a tile: choose a smaller"):
        draw(volume, rays, GREY, device, "projection", max_pairs=10)
    info = replace(device.info, max_allocation=16 * 40 * 32 - 1)
    for method in METHODS:
        with pytest.raises(MemoryLimitError, match="40 x 32 pixels"):
            draw(volume, rays, GREY, Altered(device, info=info), method)


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
    """A random transfer function of some points, and the light of the middle ray."""
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
    mesh = tet_mesh(corners, [(0, 1, 2, 3)], corners[:, 2])
    transfer, wanted = transfer_and_light(points, extinction)
    rays = Camera((0.25, 0.25, 5), (0.25, 0.25, 0), fov=None, height=0.1).rays(1, 1)
    for method in METHODS:
        red, _, _, alpha = draw(mesh, rays, transfer, device, method)[0, 0]
        np.testing.assert_allclose((red, alpha), wanted, rtol=2e-6, atol=1e-12)
