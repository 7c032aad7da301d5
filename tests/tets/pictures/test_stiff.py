"""Random stiff volumes by both methods, against layers that are cut by fractions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.tets import draw, ramp, reference_picture, tet_grid, tet_mesh, wavy

from voxtool.camera import Camera, Rays
from voxtool.choices import METHODS
from voxtool.errors import VoxtoolError
from voxtool.selftest.isosurfaces import isosurfaces
from voxtool.selftest.stiff_volumes import BOUNDS, KINDS, error_of
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.scene import STEEP, VolumeScene
from voxtool.tets.pictures.transfer import TransferFunction
from voxtool.tets.volume.mesh import UnstructuredMesh
from voxtool.tets.volume.volume import TetVolume

EXACT = 1e-6  # of a colour
FEW, MANY = 4, 1000  # scenes of a kind


@pytest.mark.parametrize("kind", KINDS)
def test_random_stiff_scenes(device, kind: str) -> None:
    assert error_of(device, kind, range(100, 100 + FEW)) < BOUNDS[kind]


@pytest.mark.soak
@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_many_stiff_scenes(device, kind: str, seed: int) -> None:
    assert error_of(device, kind, range(seed, seed + MANY)) < BOUNDS[kind]


def rounded(volume: TetVolume) -> UnstructuredMesh:
    """The mesh of a volume's vertices, which float32 has rounded."""
    return tet_mesh(volume.points(), volume.cells, volume.scalars())


def shaken(seed: int, holes: float = 0.3) -> TetVolume:
    points, cells = tet_grid((4, 3, 5), seed, holes)
    return build_tet(tet_mesh(points, cells, wavy(points)))


EYES = [(0.1, -0.2, 0.15), (3.0, 2.0, -4.0), (0.0, 0.0, 0.0)]


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("layout", ["raycast", "projection"])
@pytest.mark.parametrize("extinction", [40.0, 1e4])
def test_steep_functions_in_meshes_of_any_shape(device, eye, layout, extinction) -> None:
    """Errors come from rounding the vertices, and from single precision in the light."""
    points, cells = tet_grid((4, 3, 5), 2, 0.3)
    volume = build_tet(tet_mesh(points, cells, wavy(points)), layout)
    transfer = replace(ramp(-1.5, 1.5, 1.0), extinctions=[0, extinction, 0, extinction / 9])
    rays = Camera(eye, (1.0, 0.3, -0.4), (0.2, 1.0, 0.1), fov=80.0).rays(31, 23)
    wanted = reference_picture(rounded(volume), transfer, rays)
    assert wanted[..., 3].max() > 0.5
    for method in METHODS:
        assert VolumeScene(volume, transfer, method).walks
        assert np.abs(draw(volume, rays, transfer, device, method) - wanted).max() < EXACT


@pytest.mark.parametrize("fov", [None, 40.0])
def test_steep_functions_of_constant_cells(device, fov) -> None:
    points, cells = tet_grid((3, 3, 3), 4)
    values = np.random.default_rng(7).random(len(cells))
    volume = build_tet(tet_mesh(points, cells, [values]))
    mesh = tet_mesh(volume.points(), volume.cells, [volume.scalars()])
    rays = Camera((3.0, 2.0, 5.0), (0.1, 0.0, 0.0), fov=fov, height=2.0).rays(30, 20)
    transfer = ramp(0.0, 1.0, 300.0)
    found = draw(volume, rays, transfer, device)
    assert np.abs(found - reference_picture(mesh, transfer, rays)).max() < EXACT


@pytest.mark.parametrize("fov", [None, 40.0])
def test_isosurfaces_within_a_steep_function(device, fov) -> None:
    volume, values, tint = shaken(5), [-0.7, 0.1, 0.9], (1.0, 0.5, 0.25, 0.5)
    mesh = rounded(volume)
    rays = Camera((3.0, 2.0, 5.0), (0.1, 0.0, 0.0), fov=fov, height=2.0).rays(30, 20)
    transfer = TransferFunction(np.array([-1.0, 1.0]), np.eye(3)[:2], np.array([0.0, 60.0]))
    wanted = isosurfaces(
        mesh.points, mesh.cells[0][1], np.asarray(mesh.scalars), transfer, rays, values, tint
    )
    how = {"isovalues": values, "opacity": tint[3], "colour": tint[:3]}
    error = np.abs(draw(volume, rays, transfer, device, **how).reshape(-1, 4) - wanted)
    # a ray that leaves where the scalar is an isovalue meets the surface, or does not
    assert np.quantile(error.max(axis=1), 0.995) < EXACT
    assert wanted[:, 3].max() > 0.9


def test_a_spike_is_where_its_scalars_are(device) -> None:
    """A spike between two vertices that no block but theirs has is seen, and leaves none out."""
    points, cells = tet_grid((2, 2, 40))
    volume, near = build_tet(tet_mesh(points, cells, points[:, 2])), 1e-13
    at = 0.123456789 + near * np.arange(3)
    spike = TransferFunction(at, np.ones((3, 3)), np.array([0.0, 1 / near, 0.0]))
    scene = VolumeScene(volume, spike)
    assert 0 < scene.cells_shown < len(cells) / 2
    rays = Camera((0.1, 0.2, 9.0), (0.1, 0.2, 0.0), fov=None, height=1.0).rays(9, 9)
    width = np.diff(at)
    depth = float((width * (1 / near)).sum()) / 2
    for method in METHODS:
        found = draw(volume, rays, spike, device, method)[..., 3]
        assert np.abs(found + np.expm1(-depth)).max() < EXACT


def test_steep_is_what_the_volume_has(device) -> None:
    """Beyond the range of its scalars an extinction makes no difference."""
    volume = shaken(1)
    low, high = volume.scalar_range
    at = np.array([low, high, high + 1, high + 2])
    for extinctions, steep in (([1, 1, 1, 1e9], False), ([1, STEEP + 9, 1, 1], True)):
        transfer = TransferFunction(at, np.ones((4, 3)), np.array(extinctions, float))
        scene = VolumeScene(volume, transfer)
        assert scene.walks == steep
        assert ("ray walking" in scene.stages) == steep
    assert not VolumeScene(volume, transfer, integrator="average").walks


# ---- rays that are not perpendicular


def skewed(perspective: bool) -> Rays:
    direction, right = np.array([0.36, -0.48, 0.8]), np.array([0.03, 0.02, 0.01])
    down = np.array([-0.01, 0.04, 0.02])
    return Rays(-4 * direction, direction, right, down, perspective, (40, 30))


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_rays_of_any_directions_are_traced(device, perspective: bool, method: str) -> None:
    volume, transfer, rays = shaken(3), ramp(-1.5, 1.5, 3.0), skewed(perspective)
    rays = replace(rays, right=4 * rays.right, down=4 * rays.down) if not perspective else rays
    for own in (
        rays,
        replace(rays, right=-rays.right),
        replace(rays, direction=1.25 * rays.direction),
    ):
        wanted = reference_picture(rounded(volume), transfer, own)
        assert wanted[..., 3].max() > 0.5
        assert np.abs(draw(volume, own, transfer, device, method) - wanted).max() < EXACT


def test_rays_that_no_integrator_but_linear_traces(device) -> None:
    with pytest.raises(VoxtoolError, match="perpendicular"):
        draw(shaken(3), skewed(True), ramp(-1.5, 1.5, 3.0), device, "raycast", "average")
