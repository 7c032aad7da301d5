"""Isosurfaces of volumes against float64 by another algorithm, on both methods; no cracks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers.tets import SIX, grid_corners, grid_points, ramp, rays_of, tet_mesh

from voxtool.choices import METHODS
from voxtool.errors import VoxtoolError
from voxtool.pictures.rendering import plan_render, render
from voxtool.selftest.isosurfaces import brightness, isosurfaces, rises
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.transfer import TransferFunction

if TYPE_CHECKING:
    from voxtool.camera import Rays
    from voxtool.opencl import Device
    from voxtool.tets.volume.mesh import UnstructuredMesh
    from voxtool.tets.volume.volume import TetVolume

CLEAR = TransferFunction(np.zeros(1), np.zeros((1, 3)), np.zeros(1))
ORANGE = (1.0, 0.5, 0.25)
# How surfaces are seen: view, fov, isovalues, opacity, and whether within a transfer function.
SHOWN = (
    ("iso", 30, (0.31,), 1.0, False),
    ("front", None, (0.31, -0.213, 0.7), 0.4, False),
    ("iso", 40, (0.7, 0.31), 0.5, True),
    ("left", None, (0.1,), 1.0, True),
)
both_methods = pytest.mark.parametrize("method", METHODS)


@cache
def shaken(linear: bool = False) -> UnstructuredMesh:
    """A box of 4 x 5 x 6 cubes of six tetrahedra, whose inner points are moved; the scalar is
    linear, or curved in itself."""
    shape = np.array((4, 5, 6))
    points = grid_points(shape.tolist()) / (shape / 2) - 1
    inner = (np.abs(points) < 1).all(axis=1)
    points[inner] += np.random.default_rng(3).uniform(-0.06, 0.06, (inner.sum(), 3))
    cells = grid_corners(shape.tolist())[:, SIX].reshape(-1, 4)
    x, y, z = points.T
    scalars = 0.3 * x + 0.5 * y - 0.7 * z if linear else x * x + y * z + 0.3 * np.abs(z)
    return tet_mesh(points, cells, scalars)


@cache
def volume_of(linear: bool, layout: str, device: Device) -> TetVolume:
    return build_tet(shaken(linear), layout, device=device)


def oracle(
    mesh: UnstructuredMesh, rays: Rays, isovalues: tuple[float, ...], opacity: float,
    transfer: TransferFunction,
) -> np.ndarray:  # fmt: skip
    """Return the picture of orange surfaces within a transfer function, (H, W, 4) float64."""
    scalars, tint = np.asarray(mesh.scalars), (*ORANGE, opacity)
    found = isosurfaces(mesh.points, mesh.cells[0][1], scalars, transfer, rays, isovalues, tint)
    return found.reshape(*rays.size[::-1], 4)


@pytest.mark.parametrize(
    ("method", "layout", "view", "fov", "isovalues", "opacity", "within"),
    [  # each method has each layout, and each view both: each of all three is one more program
        pytest.param(method, layout, *shown, marks=pytest.mark.soak if (i + j + k) % 2 else ())
        for (i, shown), (j, method), (k, layout) in product(
            enumerate(SHOWN), enumerate(METHODS), enumerate(("raycast", "projection"))
        )
    ],
)
def test_surfaces_are_where_the_scalar_is(
    method: str, layout: str, view: str, fov: float | None, isovalues: tuple[float, ...],
    opacity: float, within: bool, device: Device,
) -> None:  # fmt: skip
    rays = rays_of(shaken(), view, fov, (31, 23))
    transfer = ramp(-0.5, 1.0, 1.5) if within else CLEAR
    expected = oracle(shaken(), rays, isovalues, opacity, transfer)
    found = render(
        volume_of(False, layout, device), rays, isovalues=isovalues, opacity=opacity,
        colour=ORANGE, method=method, device=device,
        **({"transfer": transfer} if within else {}),
    )  # fmt: skip
    assert np.abs(found - expected).max() < 2e-5
    assert (expected[..., 3] > 0.3).mean() > 0.1


@both_methods
@pytest.mark.parametrize("lanes", [1, 16])
def test_surfaces_have_no_cracks(lanes: int, method: str, device: Device) -> None:
    """The isosurface of a linear scalar is a plane: every ray through it meets it once, whatever
    the cells, also where it passes along their faces."""
    volume = volume_of(True, "raycast", device)
    for fov in (30, None) if lanes > 1 else (30,):
        rays = rays_of(shaken(True), "top", fov, (120, 90))
        for isovalue in (0.0, 0.123):
            found = render(
                volume, rays, isovalues=(isovalue,), opacity=0.5, method=method, lanes=lanes,
                device=device,
            )  # fmt: skip
            inside = found[..., 3] != 0
            assert inside.mean() > 0.1
            assert (found[inside, 3] == 0.5).all()
            # a convex outline: each row is one run without a gap
            assert (np.abs(np.diff(inside.astype(int), axis=1)).sum(axis=1) <= 2).all()


@both_methods
@pytest.mark.parametrize("fov", [None, 30])
def test_a_ray_through_edges_that_have_the_isovalue(fov, method: str, device: Device) -> None:
    """The middle ray enters and leaves the box by edges, whose scalar there is the isovalue. It may
    meet the surface in any cell at these edges, or miss it, as rays do that differ by rounding; the
    two ends are rounded apart."""
    mesh, cells = shaken(), shaken().cells[0][1]
    rays = rays_of(mesh, "front", fov, (31, 23))
    found = render(
        volume_of(False, "raycast", device), rays, isovalues=(0.3,), opacity=0.5, colour=ORANGE,
        method=method, device=device,
    )  # fmt: skip
    ends = []
    for z in (1, -1):
        x, y = mesh.points[:, 0], mesh.points[:, 1]
        edge = (mesh.points[:, 2] == z) & (np.abs(x) < 1e-9) & (np.abs(y) < 0.3)
        beside = cells[edge[cells].sum(axis=1) == 2]
        gradients = rises(mesh.points[beside], np.asarray(mesh.scalars)[beside])
        shades = brightness(gradients, np.tile(rays.direction, (len(beside), 1)), rays)
        ends.append([(0.0, 0.0), *((shade, 0.5) for shade in shades)])
        assert len(beside) == 3
    right = [
        (near_alpha * near + (1 - near_alpha) * alpha * far, 1 - (1 - near_alpha) * (1 - alpha))
        for near, near_alpha in ends[0]
        for far, alpha in ends[1]
    ]
    assert np.abs(found[11, 15, [0, 3]] - right).max(axis=1).min() < 2e-5


@both_methods
def test_surfaces_beside_what_the_transfer_function_shows(method: str, device: Device) -> None:
    """They take the map's colours, and an opaque one hides what is behind; by other integrators,
    too."""
    volume, rays = volume_of(False, "raycast", device), rays_of(shaken(), "iso", 30)
    transfer = ramp(-0.5, 1.0, 1.5)
    red = replace(transfer, colours=np.tile((1.0, 0.0, 0.0), (len(transfer.scalars), 1)))
    ways = {"transfer": red, "method": method, "device": device}
    alone = render(volume, rays, **ways)
    for integrator in ("linear", "sampled:4"):
        both = render(volume, rays, isovalues=(0.31,), integrator=integrator, **ways)
        met = render(volume, rays, isovalues=(0.31,), method=method, device=device)[..., 3] == 1
        assert (both[met, 3] == 1).all()
        assert not both[..., 1:3].any()
        assert np.allclose(both[~met, 3], alone[~met, 3], atol=5e-3)
    faint = render(volume, rays, isovalues=(0.31,), opacity=1e-4, **ways)
    assert np.allclose(faint, alone, atol=1e-3)


def test_what_has_no_surface(device: Device) -> None:
    volume = volume_of(False, "raycast", device)
    constant = tet_mesh(shaken().points, shaken().cells[0][1], None)
    constant = replace(constant, scalars=[np.arange(len(shaken().cells[0][1]), dtype=float)])
    with pytest.raises(VoxtoolError, match="it is one number a cell, so none has a surface"):
        plan_render(build_tet(constant, device=device), isovalues=(3.0,), device=device)
    for options, message in (
        ({"isovalues": (np.nan,)}, "give up to 64 finite numbers"),
        ({"isovalues": tuple(range(65))}, "give up to 64 finite numbers"),
        ({"isovalues": (0.3,), "opacity": 0.0}, "isosurfaces of opacity 0: give more than 0"),
        ({"isovalues": (0.3,), "colour": (2, 0, 0)}, "colour"),
    ):
        with pytest.raises(VoxtoolError, match=message):
            plan_render(volume, device=device, **options)
    with pytest.warns(UserWarning, match=r"is from .* so no surface has these isovalues"):
        assert not render(volume, isovalues=(99.0,), size=(20, 20), device=device).any()
