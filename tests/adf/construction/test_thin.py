"""Fields of thin scenes: bounds that hold for what a query returns, and signs of the mesh."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.thin import prove

from voxtool.adf.construction.build import build_adf
from voxtool.adf.construction.stages import BLOCK
from voxtool.adf.field.cells import bound_values, cell_of
from voxtool.adf.field.field import DistanceField
from voxtool.adf.surface.extract import extract_field_surface, plan_field_surface
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.opencl import Device
from voxtool.selftest import shapes, thin
from voxtool.selftest.fields import to_box

# in the first half, hanging vertices with a wrong sign would break bounds
SEEDS = (120, 132, 144, 174, 210, 234, *range(100, 114))
TURNED = thin.turn(np.random.default_rng(7))


@pytest.mark.parametrize("seed", SEEDS)
def test_no_point_exceeds_its_bound(device: Device, seed: int) -> None:
    random = np.random.default_rng(seed)
    scene = thin.scene(random, thin.KINDS[seed % len(thin.KINDS)])
    field = thin.build(random, scene, device)
    over, worst = thin.over_bound(random, field, scene, 1000, device)
    assert over == 0, (scene.kind, worst)
    proved, undecided = prove(field, scene, random, 6)
    assert proved > undecided


@pytest.mark.parametrize(
    ("kind", "fill"),
    [*((kind, "pseudonormal") for kind in thin.KINDS), ("wedge", "winding"), ("shell", "winding")],
)
def test_hanging_vertices_have_the_signs_of_the_mesh(device: Device, kind: str, fill: str) -> None:
    random = np.random.default_rng(3)
    scene = thin.scene(random, kind)
    field = build_adf(scene.mesh, device, tolerance=4e-3, max_level=7, sign=fill, measure=False)
    levels, cells = cell_of(field.blocks)
    places = (2 * cells[:, None] + BLOCK.T) * np.ldexp(1.0, -levels - 1)[:, None, None]
    some = random.integers(0, field.voxels.size, 20_000)
    exact = scene.distance(np.array(field.origin) + field.side * places.reshape(-1, 3)[some])
    found = field.voxels.reshape(-1)[some]
    assert (((found < 0) == (exact < 0)) | (np.abs(exact) < thin.EXACT * field.side)).all()
    assert not field.reached["jumps"]


def hollow(wall: float) -> Mesh:
    """Return a ball of radius 1/2 with a wall."""
    vertices, faces = shapes.ball(2)
    inner = (0.5 - wall) * vertices, faces[:, ::-1]
    return mesh_from_arrays(*shapes.join((vertices / 2, faces), inner))


def test_a_guarantee_is_that_of_bounds(device: Device) -> None:
    mesh, tolerance = hollow(2e-3), 4e-3
    plain = build_adf(mesh, device, tolerance=tolerance, max_level=6, measure=False)
    field = build_adf(mesh, device, tolerance=tolerance, max_level=6, guarantee=True, measure=False)
    assert "unproved" not in plain.reached
    over = {}
    for name, each in (("plain", plain), ("guarantee", field)):
        assert each.bounds is not None
        bound = bound_values()[each.bounds]  # 9 % of it may be rounding
        coarse = cell_of(each.blocks)[0] + 1 < 6
        over[name] = np.count_nonzero(bound[coarse] > 1.1 * tolerance)
        if name == "guarantee":
            assert np.count_nonzero(bound > 1.1 * tolerance) <= each.reached["unproved"]
            assert each.reached["unproved"] <= np.count_nonzero(bound > tolerance / 1.1)
    assert over["plain"] > 0
    assert over["guarantee"] == 0


def plate(thickness: float) -> Mesh:
    """Return a tilted plate of 1 by 0.7."""
    vertices, faces = shapes.box(np.zeros(3), np.array([1, 0.7, thickness]))
    return mesh_from_arrays(vertices @ TURNED.T, faces)


def whole(field: DistanceField, shells: int = 1) -> float:
    """Return the volume of a field's surface: closed, in `shells` pieces, without handles."""
    found = extract_field_surface(field).check()
    assert (found["closed"], found["shells"], found["genus"]) == (True, shells, 0)
    return found["volume"]


@pytest.mark.parametrize("leaves", [2, 4, 7])
def test_sheets_of_some_leaves_keep_their_signs(device: Device, leaves: int) -> None:
    """However large the tolerance."""
    edge = 8 / 7 / 64
    field = build_adf(plate(leaves * edge), device, tolerance=edge, max_level=6, measure=False)
    assert whole(field) == pytest.approx(0.7 * leaves * edge, rel=0.2)


@pytest.mark.parametrize("share", [1.0, 0.5, 0.25])
def test_what_is_thinner_than_leaves_is_counted_and_in_one_piece(
    device: Device, share: float
) -> None:
    edge = 8 / 7 / 64
    mesh = plate(share * edge)
    with pytest.warns(match=r"thinner than the leaves in [\d,]+ of them, of level 6.*-max-level"):
        field = build_adf(mesh, device, tolerance=edge / 4, max_level=6, measure=False)
    thin = field.reached["thin"]
    assert 0.7 / edge**2 / 4 < thin["leaves"] < 4 * 0.7 / edge**2
    assert (thin["shells"], thin["volume"]) == (1, pytest.approx(0.7 * share * edge))
    assert whole(field) == pytest.approx(0.7 * share * edge, abs=0.7 * edge / 4)
    job = plan_field_surface(field)
    surface = job.run()
    assert not list(job.notes(surface))
    (note,) = job.details(surface)
    assert "the surface has 1 shell and volume" in note
    assert note.endswith(f"the mesh 1 shell and volume {thin['volume']:.6g}")


@pytest.mark.parametrize("degrees", [2, 10])
def test_a_wedge_is_in_one_piece(device: Device, degrees: float) -> None:
    slope = math.tan(math.radians(degrees))
    vertices, faces = thin.prism(np.array([(0, 0), (1, 0), (1, slope)]), 1.0)
    mesh = mesh_from_arrays(vertices @ TURNED.T, faces)
    field = build_adf(mesh, device, tolerance=4e-3, max_level=7, measure=False)
    assert whole(field) == pytest.approx(slope / 2, rel=0.05)


def test_a_vertex_alone_beside_an_edge_is_no_piece(device: Device) -> None:
    vertices, faces = thin.prism(np.array([(0, 0), (1, 0), (1, math.tan(math.radians(10)))]), 1.0)
    mesh = mesh_from_arrays(vertices @ TURNED.T, faces)
    field = build_adf(mesh, device, tolerance=1e-3, max_level=9, measure=False)
    assert extract_field_surface(field).check()["shells"] == 1


def test_a_hollow_ball_has_its_two_shells(device: Device) -> None:
    field = build_adf(hollow(1e-3), device, tolerance=4e-3, max_level=6, measure=False)
    assert whole(field, shells=2) > 0


def test_flat_faces_stay_flat(device: Device) -> None:
    """A box with faces on faces of leaves, except beside its edges."""
    low, high = np.zeros(3), np.array([1.0, 0.75, 0.5])
    mesh = mesh_from_arrays(*shapes.box(low, high))
    field = build_adf(mesh, device, tolerance=1e-3, max_level=6, measure=False)
    assert whole(field) == pytest.approx(0.375, rel=1e-3)
    places = extract_field_surface(field).vertices
    off = np.abs(to_box(places, low, high))
    ends = np.sort(np.minimum(np.abs(places - low), np.abs(places - high)), axis=1)
    flat = ends[:, 1] > field.side / 64
    assert flat.mean() > 0.5
    assert off[flat].max() < 2.0**-20 * field.side
