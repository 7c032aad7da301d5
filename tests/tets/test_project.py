"""Cell projection against the ray caster, and against a float64 picture by clipping every cell."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers_volume import (
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

from voxtool.camera import Camera, Rays
from voxtool.errors import MemoryLimitError
from voxtool.tets import project
from voxtool.tets.mesh import UnstructuredMesh
from voxtool.tets.textures import build_tet
from voxtool.tets.transfer import TransferFunction

NEAR = 1e-5  # of a colour, from the ray caster's
TRUE = 2e-5  # from the reference
VIEWS = [("iso", None), ("iso", 30.0), ("front", None), ("left", 100.0)]
INTEGRATORS = ["linear", "average", "sampled:1", "sampled:3", "preintegrated"]
THICK = 1e7  # opaque within any cell that is seen


def wavy(points: np.ndarray) -> np.ndarray:
    return np.sin(3 * points[:, 0]) + points[:, 1] * points[:, 2]


def mesh_with_holes(seed: int = 1, holes: float = 0.4) -> UnstructuredMesh:
    points, cells = tet_grid((4, 3, 5), seed=seed, holes=holes)
    return mesh_of(points, cells, wavy(points))


def cells_of(corners, scalars) -> UnstructuredMesh:
    """Separate tetrahedra, of corners (n, 4, 3), with a scalar each."""
    points = np.asarray(corners, float).reshape(-1, 3)
    return mesh_of(points, np.arange(len(points)).reshape(-1, 4), [np.asarray(scalars, float)])


def colours_of(n: int, extinction: float) -> TransferFunction:
    """For scalars 0 to n - 1: red, green, blue, red, ..., of one extinction."""
    return TransferFunction(
        np.arange(float(n)), np.eye(3)[np.arange(n) % 3], np.full(n, extinction)
    )


def down_z(height: float, size: int) -> Rays:
    return Camera((0, 0, 5), (0, 0, 0), fov=None, height=height).rays(size, size)


# ---- the same picture


@pytest.mark.parametrize(("view", "fov"), VIEWS)
@pytest.mark.parametrize("holes", [0.0, 0.4])
@pytest.mark.parametrize("extinction", [0.3, 30.0, 1e4])
def test_picture_is_the_ray_casters(device, view, fov, holes, extinction) -> None:
    mesh = mesh_with_holes(holes=holes)
    transfer, rays = ramp(-1.5, 1.5, extinction), rays_of(mesh, view, fov)
    for layout in ("raycast", "projection"):
        volume = Pictures(build_tet(mesh, layout), device)
        cast = volume.render(rays, transfer)
        found = volume.render(rays, transfer, method="projection")
        assert cast[..., 3].max() > 0.1
        # depths differ by their rounding: what that is worth grows with the extinction
        assert np.abs(found - cast).max() < NEAR * max(1, extinction / 10)
        assert np.sqrt(np.square(found - cast).mean()) < NEAR


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("fov", [None, 30.0])
def test_integrators_are_the_ray_casters(device, integrator, fov) -> None:
    mesh = mesh_with_holes(seed=2, holes=0.2)
    transfer, rays = ramp(-1.5, 1.5, 2.0, steps=7), rays_of(mesh, "iso", fov)
    volume = Pictures(build_tet(mesh), device)
    cast = volume.render(rays, transfer, integrator=integrator)
    found = volume.render(rays, transfer, "projection", integrator)
    assert np.abs(found - cast).max() < NEAR
    if integrator != "linear":
        assert np.abs(found - volume.render(rays, transfer, "projection")).max() > 10 * NEAR


@pytest.mark.parametrize("seed", range(6))
def test_random_meshes_cameras_and_transfer_functions(device, seed) -> None:
    random = np.random.default_rng(seed)
    shape = tuple(random.integers(1, 7, 3).tolist())
    points, cells = tet_grid(shape, seed=seed, holes=random.choice([0.1, 0.5, 0.9]))
    mesh = mesh_of(points, cells, wavy(points))
    low, high = np.sort(random.uniform(-2, 2, 2)).tolist()
    transfer = ramp(low, high, 5.0, int(random.integers(2, 9)), seed)
    eye = tuple((random.normal(size=3) * random.choice([0.3, 2, 9])).tolist())
    camera = Camera(eye, (0.1, 0.2, 0.3), (0.2, 1.0, 0.1), fov=float(random.uniform(5, 140)))
    rays = camera.rays(*random.integers(20, 60, 2).tolist())
    found = Pictures(build_tet(mesh), device).render(rays, transfer, "projection")
    wanted = reference_picture(mesh, transfer, rays)
    assert np.abs(found - wanted).max() < TRUE


def test_constant_cells_and_hexahedra(device) -> None:
    points, corners = grid_points((3, 4, 2)), grid_corners((3, 4, 2))
    order = [0, 4, 6, 2, 1, 5, 7, 3]  # as VTK numbers a hexahedron's corners
    scalars = np.random.default_rng(7).random(len(corners))
    mesh = UnstructuredMesh(points, [("hexahedron", corners[:, order])], [scalars], "s")
    cut = mesh_of(points, corners[:, SIX].reshape(-1, 4), [np.repeat(scalars, 6)])
    transfer = ramp(0.0, 1.0, 3.0)
    inside = Camera((1.1, 1.2, 0.9), (2.0, 3.0, 1.0), fov=100).rays(30, 30)
    for rays in [*(rays_of(mesh, view, fov) for view, fov in VIEWS), inside]:
        wanted = reference_picture(cut, transfer, rays)
        for layout in ("raycast", "hexahedra"):
            volume = Pictures(build_tet(mesh, layout), device)
            assert np.abs(volume.render(rays, transfer, "projection") - wanted).max() < TRUE


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (7, 5), (9, 17), (65, 1), (3, 40)])
def test_sizes(device, size) -> None:
    mesh, transfer = mesh_with_holes(seed=3), ramp(-1.5, 1.5, 2.0)
    volume = Pictures(build_tet(mesh), device)
    for fov in (None, 60.0):
        rays = rays_of(mesh, "iso", fov, size)
        found = volume.render(rays, transfer, "projection")
        assert found.shape == (size[1], size[0], 4)
        assert found.any()
        assert np.abs(found - volume.render(rays, transfer)).max() < NEAR


def test_the_same_on_every_device() -> None:
    mesh, transfer = mesh_with_holes(seed=4), ramp(-1.5, 1.5, 5.0)
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov)
        first, *others = (
            Pictures(build_tet(mesh), opened(index)).project(rays, transfer)
            for index, _ in usable_devices()
        )
        for other in others:
            assert np.array_equal(first.picture, other.picture)
            assert vars(first).keys() == vars(other).keys()
            for name in ("cells", "pairs", "fragments", "passes"):
                assert getattr(first, name) == getattr(other, name)


# ---- order


@pytest.mark.parametrize("nearest", [0, 1])
def test_the_nearer_cell_hides_the_farther(device, nearest) -> None:
    flat = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0), (0, 0, 0.3)])
    behind = np.array([(0, 0, 0.0), (0, 0, -1.0)])
    corners = np.stack([flat + behind[nearest], flat + behind[1 - nearest]])
    volume = Pictures(build_tet(cells_of(corners, [0, 1])), device)
    found = volume.render(down_z(0.4, 16), colours_of(2, THICK), "projection")
    assert (found == [nearest == 0, nearest == 1, 0, 1]).all()


@pytest.mark.parametrize("turn", [0, 40, 100])
def test_cells_that_overlap_in_a_cycle(device, turn) -> None:
    """Three sticks on the sides of a triangle: each begins under the last and ends over the next,
    so no order of the cells is right for all rays."""
    angles = np.radians([90, 210, 330]) + np.radians(turn)
    corners = np.stack([np.cos(angles), np.sin(angles)], 1)
    sticks, crossings = [], []
    for i in range(3):
        start, end = corners[i], corners[(i + 1) % 3]
        along = end - start
        side = 0.1 * np.array([-along[1], along[0]]) / np.sqrt(along @ along)
        low, high = start - 0.2 * along, end + 0.2 * along
        ends = np.array([low - side, low + side, high - side, high + side])
        sticks.append(np.column_stack([ends, [-0.5, -0.5, 0.5, 0.45]]))
        crossings.append(end)
    mesh, transfer = cells_of(sticks, [0, 1, 2]), colours_of(3, THICK)
    volume = Pictures(build_tet(mesh), device)
    rays = down_z(3.0, 60)
    found = volume.render(rays, transfer, "projection")
    for i, (x, y) in enumerate(crossings):  # the stick that ends there is over the next
        at = found[int(30 - 20 * y), int(30 + 20 * x)]
        assert np.array_equal(at, [*np.eye(3)[i], 1])
    assert np.abs(found - reference_picture(mesh, transfer, rays)).max() < TRUE
    half = colours_of(3, 5.0)
    found = volume.render(rays, half, "projection")
    assert np.abs(found - reference_picture(mesh, half, rays)).max() < TRUE


def spokes(n: int) -> np.ndarray:
    """(n, 4, 3): thin cells, one behind another on the axis, that rise outwards, each in its own
    direction: the farther on the axis, the nearer its tip."""
    wide, thick = 0.05 / n, 0.5 / n
    cells = []
    for k in range(n):
        z, angle = -k / n, 2.4 * k
        c, s = np.cos(angle), np.sin(angle)
        flat = np.array([
            (-wide, -wide, z), (-wide, wide, z), (-wide, 0, z - thick), (1, 0, (k + 1) / n),
        ])  # fmt: skip
        cells.append(flat @ [(c, s, 0), (-s, c, 0), (0, 0, 1)])
    return np.array(cells)


def test_more_cells_than_may_wait_and_all_out_of_order(device) -> None:
    n = 200
    mesh = cells_of(spokes(n), np.random.default_rng(5).permutation(n))
    transfer = colours_of(n, 30.0)
    volume = Pictures(build_tet(mesh), device)
    rays = down_z(0.2 / n, 9)
    found = volume.project(rays, transfer)
    assert found.fragments > 0.9 * n * 25
    assert found.passes >= n // project.PENDING
    wanted = reference_picture(mesh, transfer, rays)
    assert wanted[..., 3].max() > 0.9
    assert np.abs(found.picture - wanted).max() < 1e-4


@pytest.mark.parametrize("pending", [1, 2, 4])
def test_any_number_may_wait(device, pending) -> None:
    mesh, transfer = mesh_with_holes(seed=6, holes=0.1), ramp(-1.5, 1.5, 5.0)
    volume = Pictures(build_tet(mesh), device)
    views = [rays_of(mesh, view, fov) for view, fov in VIEWS]
    wanted = [volume.project(rays, transfer) for rays in views]
    found = [volume.project(rays, transfer, pending=pending) for rays in views]
    for one, other in zip(found, wanted, strict=True):
        assert np.array_equal(one.picture, other.picture)
        assert one.fragments == other.fragments
        assert other.passes == 1
    assert max(one.passes for one in found) > 1


def test_one_ray_a_work_item_gives_the_same(device) -> None:
    """As a GPU is given it."""
    mesh, transfer = mesh_with_holes(seed=7), ramp(-1.5, 1.5, 5.0)
    volume = Pictures(build_tet(mesh), device)
    rays = rays_of(mesh, "iso", 30.0)
    wanted = volume.project(rays, transfer)
    found = volume.project(rays, transfer, lanes=1)
    assert np.array_equal(found.picture, wanted.picture)
    assert (found.pairs, found.fragments) == (wanted.pairs, wanted.fragments)


# ---- places that are hard


@pytest.mark.parametrize("parts", [1, 2, 7])
def test_no_hole_and_no_double_through_vertices_edges_and_faces(device, parts) -> None:
    """Rays straight down the edges, faces and vertices of a grid: every pixel has the same way."""
    points, cells = tet_grid((8, 8, 8))
    mesh = mesh_of(points, cells, points[:, 0])
    grey = TransferFunction(np.array([0.0]), np.full((1, 3), 0.5), np.array([0.7]))
    # pixel centres on the grid's lines, and on 1/parts of its steps
    volume, rays = Pictures(build_tet(mesh), device), down_z(0.25 * 9, 9 * parts)
    found = volume.render(rays, grey, "projection")
    assert np.abs(found - volume.render(rays, grey)).max() < 1e-6
    x = (np.arange(9 * parts) + 0.5 - 4.5 * parts) * 0.25 / parts
    inside = (np.abs(x) < 1)[:, None] & (np.abs(x) < 1)
    np.testing.assert_allclose(found[inside][:, 3], -np.expm1(-1.4), atol=1e-6)
    border = (np.abs(x) == 1)[:, None] | (np.abs(x) == 1)
    assert not found[~inside & ~border].any()
    assert set(np.round(found[border][:, 3] / -np.expm1(-1.4), 5)) <= {0.0, 1.0}


@pytest.mark.parametrize("fov", [20.0, 90.0, 150.0])
@pytest.mark.parametrize("eye", [(0.1, -0.2, 0.15), (0.9, 0.9, 0.9), (-1.1, 0.05, 0.0)])
def test_eye_inside_and_near(device, fov, eye) -> None:
    points, cells = tet_grid((5, 5, 5), seed=2)
    mesh = mesh_of(points, cells, wavy(points))
    rays = Camera(eye, (1.0, 0.3, -0.4), fov=fov).rays(36, 28)
    transfer = ramp(-1.5, 1.5, 2.0)
    found = Pictures(build_tet(mesh), device).render(rays, transfer, "projection")
    assert np.abs(found - reference_picture(mesh, transfer, rays)).max() < TRUE


@pytest.mark.parametrize(
    "eye", [(0.0, 0.0, 0.0), (0.5, 0.2, 0.1), (0.5, 0.5, 0.3), (1.0, 0.1, 0.2)]
)
def test_eye_on_a_vertex_a_face_and_an_edge(device, eye) -> None:
    points, cells = tet_grid((4, 4, 4))
    mesh = mesh_of(points, cells, wavy(points))
    rays = Camera(eye, (-0.37, 0.31, -0.43), fov=110).rays(30, 22)
    transfer = ramp(-1.5, 1.5, 2.0)
    wanted = reference_picture(mesh, transfer, rays)
    volume = Pictures(build_tet(mesh), device)
    for method in ("projection", "raycast"):
        assert np.abs(volume.render(rays, transfer, method) - wanted).max() < TRUE


@pytest.mark.parametrize("squeeze", [1e-3, 1e-5, 1e-7])
def test_slivers_and_needles(device, squeeze) -> None:
    """Half of a grid squeezed flat along one axis, half along another, a quarter along both."""
    straight, cells = tet_grid((4, 4, 6))
    points = np.where((straight < 0) & [True, False, True], squeeze * straight, straight)
    points = points @ [(1.0, 0.1, 0.2), (0.0, 1.0, 0.3), (0.0, 0.0, 1.0)]
    mesh = mesh_of(points, cells, wavy(straight))
    transfer = ramp(-1.5, 1.5, 3.0)
    volume = Pictures(build_tet(mesh), device)
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov)
        found = volume.render(rays, transfer, "projection")
        assert np.abs(found - reference_picture(mesh, transfer, rays)).max() < TRUE


# ---- what is done and what is left


def test_nothing_to_see(device) -> None:
    mesh, transfer = mesh_with_holes(seed=8), ramp(-1.5, 1.5, 2.0)
    volume = Pictures(build_tet(mesh), device)
    away = Camera((0, 0, 5), (0, 0, 9), fov=60).rays(20, 20)
    found = volume.project(away, transfer)
    assert not found.picture.any()
    assert (found.cells, found.pairs, found.fragments, found.passes) == (0, 0, 0, 0)
    clear = TransferFunction(np.array([0.0]), np.ones((1, 3)), np.array([0.0]))
    found = volume.project(rays_of(mesh, "iso", None), clear)
    assert not found.picture.any()
    assert found.cells == 0


def test_fragments_end_where_it_is_opaque(device) -> None:
    points, cells = tet_grid((6, 6, 6), seed=9)
    mesh = mesh_of(points, cells, wavy(points))
    volume = Pictures(build_tet(mesh), device)
    rays = rays_of(mesh, "iso", 30.0)
    clear, thick = (volume.project(rays, ramp(-1.5, 1.5, extinction)) for extinction in (1, 1e5))
    assert thick.pairs == clear.pairs
    assert thick.fragments < clear.fragments / 4


def test_fragments_are_each_rays_ways_through_cells(device) -> None:
    """Of rays along x, through cubes cut in six: as many cells as float64 finds."""
    points, cells = tet_grid((3, 4, 5), seed=10)
    mesh = mesh_of(points, cells, points[:, 0])
    volume = build_tet(mesh)
    rays = rays_of(mesh, "iso", None)
    found = Pictures(volume, device).project(rays, ramp(-2, 2, 1.0))
    local = rays.local(volume.origin, volume.scale)
    width, height = rays.size
    corners = volume.vertices[volume.cells, :3].astype(float)
    ways = 0
    for row in range(height):
        x = np.arange(width) + 0.5 - width / 2
        start = local.origin + x[:, None] * local.right + (row + 0.5 - height / 2) * local.down
        begin, end = np.full((2, width, len(corners)), -np.inf)
        end = -end
        for a, b, c in (corners[:, face].swapaxes(0, 1) for face in volume.faces):
            normal = np.cross(b - a, c - a)
            along = normal @ local.direction
            depth = ((normal * a).sum(axis=1) - start @ normal.T) / along
            begin = np.where(along < 0, np.maximum(begin, depth), begin)
            end = np.where(along > 0, np.minimum(end, depth), end)
        ways += np.count_nonzero(begin < end)
    assert abs(found.fragments - ways) <= ways / 1000


def test_too_many_pairs(device) -> None:
    mesh = mesh_with_holes()
    volume = Pictures(build_tet(mesh), device)
    with pytest.raises(MemoryLimitError, match="pairs of a cell and a tile: choose a smaller"):
        volume.project(rays_of(mesh, "iso", None, (64, 64)), ramp(-1.5, 1.5, 1.0), max_pairs=100)
