"""Cell projection: the order of fragments, and the work that it takes."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers.tets import ramp, rays_of, reference_picture, tet_grid, tet_mesh, wavy

from voxtool.camera import Camera, Rays
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.project import PENDING, Projection
from voxtool.tets.pictures.scene import VolumeScene
from voxtool.tets.pictures.transfer import TransferFunction
from voxtool.tets.volume.mesh import UnstructuredMesh

TRUE = 2e-5  # of a colour, from the reference
VIEWS = [("iso", None), ("iso", 30.0), ("front", None), ("left", 100.0)]
THICK = 1e7  # opaque within any cell that is seen


def project(content, rays: Rays, transfer: TransferFunction, device, **decisions) -> Projection:
    volume = build_tet(content) if isinstance(content, UnstructuredMesh) else content
    return VolumeScene(volume, transfer, "projection", **decisions).project(rays, device)


def mesh_with_holes(seed: int, holes: float = 0.4) -> UnstructuredMesh:
    points, cells = tet_grid((4, 3, 5), seed=seed, holes=holes)
    return tet_mesh(points, cells, wavy(points))


def cells_of(corners, scalars) -> UnstructuredMesh:
    """Separate tetrahedra, of corners (n, 4, 3), with a scalar each."""
    points = np.asarray(corners, float).reshape(-1, 3)
    return tet_mesh(points, np.arange(len(points)).reshape(-1, 4), [np.asarray(scalars, float)])


def colours_of(n: int, extinction: float) -> TransferFunction:
    """Red, green, blue, red, ... for scalars 0 to n - 1, of one extinction."""
    return TransferFunction(
        np.arange(float(n)), np.eye(3)[np.arange(n) % 3], np.full(n, extinction)
    )


def down_z(height: float, size: int) -> Rays:
    return Camera((0, 0, 5), (0, 0, 0), fov=None, height=height).rays(size, size)


def counts(found: Projection) -> tuple[int, ...]:
    return found.cells, found.pairs, found.fragments, found.passes


# ---- order


@pytest.mark.parametrize("nearest", [0, 1])
def test_the_nearer_cell_hides_the_farther(device, nearest) -> None:
    flat = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0), (0, 0, 0.3)])
    behind = np.array([(0, 0, 0.0), (0, 0, -1.0)])
    corners = np.stack([flat + behind[nearest], flat + behind[1 - nearest]])
    found = project(cells_of(corners, [0, 1]), down_z(0.4, 16), colours_of(2, THICK), device)
    assert (found.picture == [nearest == 0, nearest == 1, 0, 1]).all()


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
    mesh, rays = cells_of(sticks, [0, 1, 2]), down_z(3.0, 60)
    for extinction in (THICK, 5.0):
        transfer = colours_of(3, extinction)
        found = project(mesh, rays, transfer, device).picture
        assert np.abs(found - reference_picture(mesh, transfer, rays)).max() < TRUE
        for i, (x, y) in enumerate(crossings):  # the stick that ends there is over the next
            at = found[int(30 - 20 * y), int(30 + 20 * x)]
            assert extinction < THICK or np.array_equal(at, [*np.eye(3)[i], 1])


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
    transfer, rays = colours_of(n, 30.0), down_z(0.2 / n, 9)
    found = project(mesh, rays, transfer, device)
    assert found.fragments > 0.9 * n * 25
    assert found.passes >= n // PENDING
    wanted = reference_picture(mesh, transfer, rays)
    assert wanted[..., 3].max() > 0.9
    assert np.abs(found.picture - wanted).max() < 1e-4


@pytest.mark.parametrize(
    ("pending", "perspective"),
    [
        (1, True),
        (3, False),
        pytest.param(1, False, marks=pytest.mark.soak),
        pytest.param(3, True, marks=pytest.mark.soak),
    ],
)
def test_any_number_may_wait(device, pending, perspective) -> None:
    volume, transfer = build_tet(mesh_with_holes(6, 0.1)), ramp(-1.5, 1.5, 5.0)
    passes = []
    for view, fov in (one for one in VIEWS if (one[1] is not None) == perspective):
        rays = rays_of(mesh_with_holes(6, 0.1), view, fov)
        wanted = project(volume, rays, transfer, device)
        found = project(volume, rays, transfer, device, pending=pending)
        assert np.array_equal(found.picture, wanted.picture)
        assert found.fragments == wanted.fragments
        assert wanted.passes == 1
        passes.append(found.passes)
    assert max(passes) > 1


# ---- work


def test_the_same_work_on_every_device_and_with_one_ray_a_work_item() -> None:
    mesh, transfer = mesh_with_holes(4), ramp(-1.5, 1.5, 5.0)
    volume = build_tet(mesh)
    for view, fov in VIEWS:
        rays = rays_of(mesh, view, fov)
        first, *others = (
            project(volume, rays, transfer, opened(index)) for index, _ in usable_devices()
        )
        for other in others:
            assert np.array_equal(first.picture, other.picture)
            assert counts(first) == counts(other)
        assert counts(project(volume, rays, transfer, opened(0), lanes=1))[:3] == counts(first)[:3]


def test_nothing_to_see(device) -> None:
    mesh, transfer = mesh_with_holes(8), ramp(-1.5, 1.5, 2.0)
    away = Camera((0, 0, 5), (0, 0, 9), fov=60).rays(20, 20)
    clear = TransferFunction(np.array([0.0]), np.ones((1, 3)), np.array([0.0]))
    for rays, function in ((away, transfer), (rays_of(mesh, "iso", None), clear)):
        found = project(mesh, rays, function, device)
        assert not found.picture.any()
        assert counts(found) == (0, 0, 0, 0)


def test_fragments_end_where_it_is_opaque(device) -> None:
    points, cells = tet_grid((6, 6, 6), seed=9)
    mesh = tet_mesh(points, cells, wavy(points))
    rays = rays_of(mesh, "iso", 30.0)
    clear, thick = (project(mesh, rays, ramp(-1.5, 1.5, e), device) for e in (1, 1e5))
    assert thick.pairs == clear.pairs
    assert thick.fragments < clear.fragments / 4


def test_fragments_are_each_rays_ways_through_cells(device) -> None:
    """There are as many fragments as float64 finds cells on each ray."""
    points, cells = tet_grid((3, 4, 5), seed=10)
    mesh = tet_mesh(points, cells, points[:, 0])
    volume, rays = build_tet(mesh), rays_of(mesh, "iso", None)
    found = project(volume, rays, ramp(-2, 2, 1.0), device)
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
