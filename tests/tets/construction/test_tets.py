"""Cells to tetrahedra and their textures, against brute force, exact arithmetic and geometry."""

from __future__ import annotations

from fractions import Fraction
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import model
from helpers.tets import (
    CUBE,
    PYRAMID,
    SIX,
    SOLIDS,
    VOLUMES,
    Matched,
    assembly,
    assert_matched,
    built,
    cube,
    face_sets,
    grid_corners,
    grid_points,
    lattice,
    linear,
    oriented,
    six_volumes,
    split,
    tet_mesh,
    unstructured,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool import read_unstructured
from voxtool.errors import MemoryLimitError, MeshError, VoxtoolError
from voxtool.opencl import default_device
from voxtool.tets.construction.conforming import SIGN, hexahedra, scaled, tetrahedron_shapes
from voxtool.tets.construction.merge import first_at_place, first_within
from voxtool.tets.construction.neighbours import match_faces
from voxtool.tets.construction.textures import build_tet, plan_tet
from voxtool.tets.volume.cells import HEXAHEDRON_FACES, TETRAHEDRON_FACES
from voxtool.tets.volume.mesh import volume_cells
from voxtool.tets.volume.volume import BLOCK, FACES
from voxtool.vector import cross, dot

if TYPE_CHECKING:
    from collections.abc import Sequence

ONE = CUBE[[0, 1, 3, 4]]


# ---- splitting


def renumbered(kind: str, order: Sequence[int]) -> Matched:
    """The tetrahedra of one cell, point i of which has the number order[i]."""
    number = np.array(order)
    found = split(unstructured(SOLIDS[kind][np.argsort(number)], [(kind, [number])]))
    volumes = six_volumes(found.vertices, found.cells)
    assert (volumes > 0).all()
    assert volumes.sum() == pytest.approx(VOLUMES[kind], rel=1e-14)
    assert found.report["turned"] == 0
    return found


@pytest.mark.parametrize("kind", ["wedge", "pyramid"])
def test_every_numbering_of_a_cell_fills_it(kind: str) -> None:
    for order in permutations(range(len(SOLIDS[kind]))):
        assert_matched(renumbered(kind, order))


@given(st.permutations(range(8)))
@settings(max_examples=300)
def test_every_numbering_of_a_hexahedron_fills_it(order: list[int]) -> None:
    found = renumbered("hexahedron", order)
    assert assert_matched(found) == 12
    # each face is cut from its smallest vertex, so five do where none is cut from the far one
    apex = CUBE[order.index(0)]
    far = int(np.flatnonzero((1 - apex == CUBE).all(axis=1))[0])
    cuts = [min(face, key=lambda i: order[i]) for face in HEXAHEDRON_FACES if far in face]
    at_far = [i == far or (CUBE[i] == CUBE[far]).sum() == 1 for i in cuts]
    assert len(found.cells) == (6 if any(at_far) else 5)


@pytest.mark.parametrize("seed", range(4))
def test_cells_of_all_kinds_are_split_alike_where_they_meet(seed: int) -> None:
    shape = (3, 4, 3)
    mesh = assembly(shape, seed)
    assert {kind for kind, _ in mesh.cells} == {"hexahedron", "wedge", "pyramid"}
    found = split(mesh)
    volumes = six_volumes(found.vertices, found.cells)
    assert (volumes > 0).all()
    assert volumes.sum() == pytest.approx(6 * np.prod(shape), rel=1e-12)
    x, y, z = shape
    assert assert_matched(found) == 2 * 2 * (x * y + y * z + z * x)
    for name in ("turned", "zero_volume", "folded_faces", "non_manifold_faces", "collapsed"):
        assert found.report[name] == 0
    built(mesh)


def test_a_hexahedron_with_coincident_points_is_what_is_left() -> None:
    """A wedge that is written as a hexahedron: two edges of the top are one."""
    points = np.concatenate([CUBE[:6], [CUBE[5], CUBE[4]]])
    points[[4, 5, 6, 7], 1] = 0
    found = split(unstructured(points, [("hexahedron", [range(8)])]))
    assert found.report["collapsed"] == 1
    assert found.report["merged_points"] == 2
    assert six_volumes(found.vertices, found.cells).sum() == pytest.approx(3)
    assert assert_matched(found) == 8


def test_curved_cells_are_taken_by_their_corners() -> None:
    points = np.concatenate([ONE, (ONE[[0, 1, 2, 0, 1, 2]] + ONE[[1, 2, 0, 3, 3, 3]]) / 2])
    found = split(unstructured(points, [("tetra10", [range(10)]), ("triangle6", [range(6)])]))
    assert len(found.cells) == 1
    assert len(found.vertices) == 4
    assert (found.report["curved"], found.report["points"]) == (1, 4)
    assert found.report["cells"] == {"tetra10": 1}
    assert found.report["ignored"] == {"triangle6": 1}


# ---- merging


@given(
    st.lists(st.tuples(*[st.integers(0, 2)] * 3), min_size=4, max_size=24),
    st.sampled_from([0.0, 0.2, 0.5, 1.0, 1.5]),
    st.integers(0, 100),
)
def test_merging_is_that_of_every_pair(corners, distance: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    points = np.array(corners, float) + random.choice([0.0, -0.0, 0.125, 0.4], (len(corners), 3))
    group = list(range(len(points)))
    for i in range(len(points)):
        for j in range(i):
            gap = sum(
                (Fraction(a) - Fraction(b)) ** 2 for a, b in zip(points[i], points[j], strict=True)
            )
            if gap <= Fraction(distance) ** 2:
                old, new = max(group[i], group[j]), min(group[i], group[j])
                group = [new if g == old else g for g in group]
    first = first_at_place(default_device(), points)
    if distance:
        first = first_within(points, first, distance)
    assert first.tolist() == group


def test_merging_far_from_the_origin_and_of_many_points() -> None:
    random = np.random.default_rng(1)
    points = random.uniform(0, 1, (3000, 3)) + np.array([1e6, -1e6, 0])
    close = points[random.permutation(3000)[:500]] + random.uniform(-1e-5, 1e-5, (500, 3))
    both = np.concatenate([points, close])
    distance = 3e-5
    gaps = np.sqrt(((close[:, None] - points[None]) ** 2).sum(axis=2))
    first = first_within(both, first_at_place(default_device(), both), distance)
    alone = (gaps <= distance).sum(axis=1) == 1
    assert np.count_nonzero(alone) > 490
    assert np.array_equal(first[3000:][alone], gaps.argmin(axis=1)[alone])


def test_a_seam_is_open_until_its_points_are_merged() -> None:
    points, hexes = lattice((2, 1, 1))
    apart = np.concatenate([points[hexes[0]], points[hexes[1]] + (1e-9, 0, 0)])
    mesh = unstructured(apart, [("hexahedron", np.arange(16).reshape(2, 8))])
    seam = split(mesh)
    assert assert_matched(seam) == 24
    whole = split(mesh, merge_distance=2e-9)
    assert assert_matched(whole) == 20
    assert whole.report["merged_points"] == 4
    assert len(whole.vertices) == 12
    touching = np.concatenate([points[hexes[0]], points[hexes[1]]])
    touching[0] = -0.0  # is 0.0
    found = split(unstructured(touching, mesh.cells))
    assert assert_matched(found) == 20
    assert found.report["merged_points"] == 4


def test_the_first_point_keeps_its_scalar_and_the_others_are_counted() -> None:
    points = np.concatenate([ONE, ONE[[1, 2, 3]], [(1.0, 1.0, 1.0)]])
    scalars = np.array([0.0, 1, 2, 3, 1, 5, 3, 9])
    found = split(tet_mesh(points, [(0, 1, 2, 3), (4, 6, 5, 7)], scalars))
    assert found.report["merged_points"] == 3
    assert found.report["merged_scalars"] == 1
    assert found.scalars.tolist() == [0, 1, 2, 3, 9]
    assert assert_matched(found) == 6


def test_too_many_pairs_are_refused() -> None:
    points = np.random.default_rng(0).uniform(0, 1, (2000, 3))
    mesh = tet_mesh(points, np.arange(2000).reshape(-1, 4))
    with pytest.raises(
        MemoryLimitError, match=r"a merge distance of 0\.5 compares more than 65,536"
    ):
        plan_tet(mesh, merge_distance=0.5).with_(max_pairs=1 << 16).run()
    split(mesh, 1e-6, max_pairs=1 << 16)


@pytest.mark.parametrize("distance", [-1.0, np.nan, np.inf])
def test_no_merge_distance(distance: float) -> None:
    with pytest.raises(VoxtoolError, match="give a length from 0 on"):
        split(cube(5), distance)


# ---- turning and dropping


def test_inverted_cells_are_turned() -> None:
    mesh = cube(24)
    ((_, cells),) = mesh.cells
    turned = cells.copy()
    turned[::3] = turned[::3][:, [0, 2, 1, 3]]
    found, other = split(mesh), split(tet_mesh(mesh.points, turned))
    assert (found.report["turned"], other.report["turned"]) == (0, 8)
    assert (six_volumes(other.vertices, other.cells) > 0).all()
    assert np.array_equal(np.sort(other.cells), np.sort(found.cells))
    assert assert_matched(other) == 24


def test_both_windings_of_wedges_are_in_use_and_not_counted() -> None:
    points = SOLIDS["wedge"]
    for cell in ([0, 1, 2, 3, 4, 5], [0, 2, 1, 3, 5, 4]):
        found = split(unstructured(points, [("wedge", [cell])]))
        assert found.report["turned"] == 0
        assert (six_volumes(found.vertices, found.cells) > 0).all()


def nearly_flat(seed: int) -> np.ndarray:
    """(100, 4, 3): tetrahedra whose fourth vertex is in the plane of the others, or nearly."""
    random = np.random.default_rng(seed)
    corners = random.integers(-(1 << 20), 1 << 20, (100, 4, 3)).astype(float)
    corners[:, 3] = 2 * corners[:, 0] + corners[:, 1] - 2 * corners[:, 2]
    corners[::3, 3, 2] += random.choice([-1.0, 1.0], corners[::3, 3, 2].shape)
    return corners * 2.0**-20 + (1000.0 if seed % 2 else 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_the_sign_of_a_volume_is_exact(seed: int) -> None:
    corners = nearly_flat(seed)
    points, cells = corners.reshape(-1, 3), np.arange(400).reshape(-1, 4)
    shapes = tetrahedron_shapes(
        default_device().put(cells.astype(np.uint32)), len(cells), scaled(points)
    )
    sign = (shapes.get() & SIGN).astype(int) - 1
    whole = np.vectorize(lambda x: int(Fraction(x) * 2**60), otypes=[object])(corners)
    (ux, uy, uz), (vx, vy, vz), (wx, wy, wz) = ((whole[:, i] - whole[:, 0]).T for i in (1, 2, 3))
    exact = ux * (vy * wz - vz * wy) + uy * (vz * wx - vx * wz) + uz * (vx * wy - vy * wx)
    assert sign.tolist() == [(x > 0) - (x < 0) for x in exact]
    assert {-1, 0, 1} == set(sign.tolist())


def test_cells_of_zero_volume_are_dropped_and_counted() -> None:
    flat = np.array([(0, 0, 0), (0.1, 0.1, 0.3), (0.7, 0.7, 0.2), (0.3, 0.3, 0.9)])
    thin = ONE * (1, 1, 1e-15) + (4, 0, 0)
    needle = ONE * (1, 1e-6, 1e-6) + (6, 0, 0)
    points = np.concatenate([ONE, flat, thin, needle, ONE[:1]])
    cells = [*np.arange(16).reshape(4, 4), (0, 1, 2, 16)]
    found = split(tet_mesh(points, cells))
    assert found.report["zero_volume"] == 2
    assert found.report["coincident"] == 1
    assert found.report["flat"] == 1
    assert len(found.cells) == 2
    assert len(found.vertices) == 8
    assert found.report["duplicates"] == 0


def test_what_flat_cells_held_is_said() -> None:
    thin, needle = ONE * (1, 1, 2e-15) + (4, 0, 0), ONE * (1, 1e-10, 1e-10) + (6, 0, 0)
    points = np.concatenate([ONE, thin, needle])
    cells, scalars = np.arange(12).reshape(3, 4), np.arange(12.0)
    report = split(tet_mesh(points, cells, scalars)).report
    assert report["flat"] == 2
    assert report["flat_volume"] == pytest.approx((2e-15 + 1e-20) / 6, rel=1e-12)
    assert report["flat_scalars"] == [4, 11]
    report = split(tet_mesh(points, cells, [np.array([7.0, -2, 5])])).report
    assert report["flat_scalars"] == [-2, 5]
    assert "flat_scalars" not in split(tet_mesh(ONE, cells[:1])).report


@pytest.mark.parametrize("width", [1e-3, 3.5e-8, 2e-9])
def test_needles_are_kept(width: float) -> None:
    points = np.concatenate([ONE * (1, width, width), ONE - 2])
    volume = built(tet_mesh(points, np.arange(8).reshape(2, 4)))
    assert (len(volume.cells), volume.report["flat"]) == (2, 0)


@pytest.mark.parametrize("thin", [1e-3, 1e-7, 1e-12, 1e-13])
@pytest.mark.parametrize("layout", ["raycast", "projection"])
def test_heights_of_flat_cells_are_those_of_fractions(thin: float, layout: str) -> None:
    """In float32 both sides of the layer are the same."""
    random = np.random.default_rng(3)
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    points = grid_points((3, 3, 3))
    points[:, 2] = np.array([0, 0.7, 0.7 + thin, 3])[points[:, 2].astype(int)]
    points = points @ turn + (0.1, -7, 0.3)
    mesh = tet_mesh(points, grid_corners((3, 3, 3))[:, SIX].reshape(-1, 4))
    volume = built(mesh, layout)
    exact = []
    for cell in mesh.cells[0][1]:
        o, a, b, c = np.vectorize(Fraction, otypes=[object])(points[cell])
        volume_ = abs(dot(a - o, cross(b - o, c - o)))
        faces = [np.delete(points[cell], i, axis=0) for i in range(4)]
        area = max(float(np.linalg.norm(np.cross(b - a, c - a))) for a, b, c in faces)
        exact.append(float(volume_) / area / volume.scale)
    assert volume.heights is not None
    assert volume.heights.shape == (len(volume.cells), 1)
    found = np.sort(volume.heights[:, 0])
    assert np.abs(found / np.sort(exact) - 1).max() < 2e-7


def test_a_cell_that_is_there_already_is_dropped() -> None:
    found = split(tet_mesh(CUBE, [(0, 1, 3, 4), (2, 1, 6, 3), (4, 3, 1, 0), (0, 3, 1, 4)]))
    assert found.report["duplicates"] == 2
    assert found.cells[0].tolist() == [0, 1, 3, 4]
    assert len(found.cells) == 2


# ---- faces


@given(st.lists(st.permutations(range(7)), min_size=1, max_size=20))
def test_faces_are_matched_as_by_comparing_all(orders: list[list[int]]) -> None:
    cells = np.array(sorted({tuple(sorted(o[:4])) for o in orders}), np.int32)
    odd = np.array([o[4] % 2 == 1 for o in orders[: len(cells)]])
    cells[odd] = cells[odd][:, [1, 0, 2, 3]]
    on_device = default_device().put(cells.astype(np.uint32))
    across, counts = match_faces(on_device, 4, len(cells), 7)
    neighbours = across.get().reshape(-1, 4)
    expected = np.full_like(neighbours, -1)
    many = folded = 0
    for sides in face_sets(cells).values():
        if len(sides) > 2:
            many += 1
        if len(sides) != 2:
            continue
        windings = []
        for cell, face in sides:
            loop = [int(cells[cell, i]) for i in TETRAHEDRON_FACES[face]]
            at = loop.index(min(loop))
            windings.append(loop[at:] + loop[:at])
        if windings[0] == windings[1]:
            folded += 1
        else:
            (a, i), (b, j) = sides
            expected[a, i], expected[b, j] = b, a
    assert np.array_equal(neighbours, expected)
    assert counts == {"non_manifold_faces": many, "folded_faces": folded}


def test_faces_of_three_cells_and_of_two_on_one_side_have_no_neighbours() -> None:
    points = np.concatenate([ONE, [(1.0, 1.0, 1.0), (-1.0, -1.0, -1.0), (2.0, 2.0, 2.0)]])
    three = oriented(points, np.array([(0, 1, 2, 3), (1, 2, 3, 4), (1, 2, 3, 6)]))
    two = np.array([(0, 1, 2, 3), (0, 1, 2, 4)])
    for cells, name in ((three, "non_manifold_faces"), (two, "folded_faces")):
        found = split(tet_mesh(points, cells))
        assert found.report[name] == 1
        assert (found.neighbours == -1).all()
    assert built(tet_mesh(points, three)).report["boundary_faces"] == 12


# ---- what is refused


@pytest.mark.parametrize(
    ("cells", "change", "message"),
    [
        ([], {}, "m: no volume cells (it has no cells): give a mesh of tetrahedra"),
        ([("triangle", [(0, 1, 2)]), ("line", [(0, 1), (1, 2)])], {}, "1 triangle, 2 line"),
        ([("polyhedron8", [(0, 1, 2, 3, 4, 5, 6, 7)])], {}, "has 1 cell of kind polyhedron8"),
        ([("tetra", [(0, 1, 3, 4), (0, 1, 3, 8)])], {}, "tetra 1 names point 8 where there are 8"),
        ([("tetra", [(0, 1, 3, -1)])], {}, "tetra 0 names point -1 where there are 8"),
        ([("tetra", [(0, 1, 3)])], {}, "tetra cells of shape (1, 3)"),
        ([("tetra", [(0, 1, 2, 3)])], {}, "m: all of its cells have zero volume"),
        (None, {"points": (4, np.nan)}, "position is not finite at 1 point, the first is point 4"),
        (None, {"points": (1, -np.inf)}, "the first is point 1"),
        (None, {"scalars": ([3, 4], np.nan)}, "s is not finite at 2 points, the first is point 3"),
        (None, {"scalars": (0, np.inf)}, "s is not finite at 1 point, the first is point 0 (inf)"),
    ],
)  # fmt: skip
def test_bad_meshes(cells, change, message: str) -> None:
    mesh = unstructured(
        CUBE.copy(), [("tetra", [(0, 1, 3, 4)])] if cells is None else cells, name="m"
    )
    for name, (where, value) in change.items():
        getattr(mesh, name)[where] = value
    for build in (split, build_tet):
        with pytest.raises(MeshError) as caught:
            build(mesh)
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


def test_what_no_volume_cell_uses_may_be_anything() -> None:
    mesh = tet_mesh(np.concatenate([ONE, [(np.nan, 0, 0)]]), [(0, 1, 2, 3)])
    assert np.isnan(mesh.scalars).any()
    assert len(built(mesh).vertices) == 4


def test_shapes_that_do_not_fit() -> None:
    cells = [("tetra", [(0, 1, 2, 3)])]
    for mesh, message in (
        (unstructured(ONE[:, :2], cells, np.zeros(4)), r"points of shape \(4, 2\)"),
        (unstructured(ONE, cells, np.zeros(5)), r"s of shape \(5,\) for 4 points"),
        (unstructured(ONE, cells, [np.zeros(2)]), r"s of shape \(2,\) for 1 tetra cells"),
        (unstructured(ONE, cells, [np.array([np.nan])]), "s is not finite at 1 tetra, the first"),
    ):
        with pytest.raises(MeshError, match=message):
            split(mesh)


# ---- textures


@pytest.mark.parametrize("layout", ["raycast", "projection"])
@pytest.mark.parametrize("pieces", [5, 6, 24])
def test_a_cube(pieces: int, layout: str) -> None:
    volume = built(cube(pieces), layout)
    assert len(volume.cells) == pieces
    outside = 24 if pieces == 24 else 12
    assert volume.report["boundary_faces"] == np.count_nonzero(volume.neighbours < 0) == outside
    assert assert_matched(volume) == outside
    low, high = volume.bounds()
    assert (low.tolist(), high.tolist()) == ([0, 0, 0], [1, 1, 1])
    assert (volume.origin, volume.scale) == ((0.5, 0.5, 0.5), 0.5)
    assert volume.scalar_range == (1, 4.5)
    # the scalar is linear: 3 + x - 2 y + z / 2 over 3.5, x = 1/2 + X/2
    assert np.allclose(volume.gradients[:, :3], np.array([0.5, -1, 0.25]) / 3.5, atol=1e-7)
    if layout == "raycast":
        assert np.allclose(volume.gradients[:, 3], (2.75 - 1) / 3.5, atol=1e-7)
        assert volume.bytes_a_cell() == 96  # table 5 of [TetVol]
    else:
        assert volume.anchors is not None
        assert np.array_equal(volume.anchors, volume.cells[:, :2])
        floats = 4 * len(volume.vertices) / pieces + 4 * 3 + 2 + 3  # table 4
        assert volume.bytes_a_cell() == pytest.approx(4 * floats)


@pytest.mark.parametrize("seed", range(3))
def test_planes_are_those_of_the_faces(seed: int) -> None:
    mesh = assembly((3, 3, 3), seed)
    volume = built(mesh)
    corners = volume.vertices[:, :3].astype(float)[volume.cells]
    for i, face in enumerate(FACES["raycast"]):
        a, b, c = (corners[:, k] for k in face)
        outward = np.cross(b - a, c - a)
        outward /= np.linalg.norm(outward, axis=1)[:, None]
        normal, offset = volume.normals[i, :, :3].astype(float), volume.normals[i, :, 3]
        assert np.allclose(normal, outward, atol=1e-5)
        for k in range(4):
            height = (normal * corners[:, k]).sum(axis=1) + offset
            if k in face:
                assert np.abs(height).max() < 2e-7
            else:
                assert (height < -1e-3).all()
    heights = volume.report["plane_error"]
    assert 0 < heights < 2e-7
    projection = built(mesh, "projection")
    assert np.array_equal(projection.normals, volume.normals[:, :, :3])
    assert np.array_equal(projection.gradients, volume.gradients[:, :3])
    for name in ("vertices", "cells", "neighbours", "ranges"):
        assert np.array_equal(getattr(projection, name), getattr(volume, name))


def test_gradients_give_the_scalars_of_the_vertices() -> None:
    mesh = assembly((3, 3, 3), 5)
    random = np.random.default_rng(5).uniform(-7, 40, len(mesh.points))
    volume = built(unstructured(mesh.points, mesh.cells, random))
    corners = volume.vertices[volume.cells].astype(float)
    g = volume.gradients.astype(float)
    value = (g[:, None, :3] * corners[:, :, :3]).sum(axis=2) + g[:, 3:]
    error = np.abs(value - corners[:, :, 3]).max()
    assert error == pytest.approx(volume.report["scalar_error"])
    assert error < 1e-5
    low, high = volume.scalar_range
    world = np.array(volume.origin) + volume.scale * volume.vertices[:, :3].astype(float)
    gap = np.abs(world[:, None] - mesh.points[None]).max(axis=2)
    assert (gap.min(axis=1) < 1e-6).all()
    stored = low + (high - low) * volume.vertices[:, 3].astype(float)
    assert np.allclose(stored, random[gap.argmin(axis=1)], atol=1e-5)


def test_scalars_of_cells_are_constant() -> None:
    mesh = assembly((3, 3, 3), 2)
    values = [
        np.random.default_rng(i).uniform(0, 9, len(block))
        for i, (_, block) in enumerate(mesh.cells)
    ]
    volume = built(unstructured(mesh.points, mesh.cells, values))
    assert volume.constant
    assert not volume.vertices[:, 3].any()
    assert not volume.gradients[:, :3].any()
    low, high = volume.scalar_range
    everything = np.concatenate(values)
    assert (low, high) == (everything.min(), everything.max())
    # the share of the volume that has each value is that of its cells
    corners = volume.vertices[:, :3].astype(float)[volume.cells]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) * volume.scale**3
    total = (volumes * (low + (high - low) * volume.gradients[:, 3])).sum()
    parts = []
    for (kind, block), value in zip(mesh.cells, values, strict=True):
        for cell, v in zip(block, value, strict=True):
            one = split(unstructured(mesh.points, [(kind, [cell])]))
            parts.append(six_volumes(one.vertices, one.cells).sum() * v)
    assert total == pytest.approx(sum(parts), rel=1e-5)
    with pytest.raises(VoxtoolError, match="one a cell, and the layout projection holds"):
        build_tet(unstructured(mesh.points, mesh.cells, values), "projection")


def test_one_scalar_everywhere() -> None:
    volume = built(tet_mesh(ONE, [(0, 1, 2, 3)], np.full(4, 7.5)))
    assert volume.scalar_range == (7.5, 7.5)
    assert not volume.vertices[:, 3].any()
    assert not volume.gradients.any()
    assert not volume.ranges.any()


def test_cells_are_in_morton_order_and_vertices_in_that_of_their_use() -> None:
    points, hexes = lattice((8, 8, 8))
    random = np.random.default_rng(3)
    volume = built(unstructured(points, [("hexahedron", random.permutation(hexes))]))
    first = np.unique(volume.cells, return_index=True)[1]
    assert (np.diff(first) > 0).all()
    centroid = volume.vertices[:, :3][volume.cells].mean(axis=1)
    octant = (centroid > 0) @ (1, 2, 4)
    assert (np.diff(octant) >= 0).all()
    scalars = volume.vertices[:, 3][volume.cells]
    for block, (low, high) in enumerate(volume.ranges):
        own = scalars[BLOCK * block : BLOCK * (block + 1)]
        assert (low, high) == (own.min(), own.max())


@pytest.mark.parametrize("exponent", [-40, 40, 300])
def test_a_power_of_two_changes_origin_and_scale_alone(exponent: int) -> None:
    mesh = assembly((3, 2, 2), 1)
    moved = mesh.points + np.array([10.3, -7.7, 0.1])
    one = built(unstructured(moved, mesh.cells, linear(mesh.points)), merge_distance=1e-3)
    factor = 2.0**exponent
    two = built(
        unstructured(moved * factor, mesh.cells, linear(mesh.points)), merge_distance=1e-3 * factor
    )
    for name, array in one.arrays().items():
        assert array.tobytes() == two.arrays()[name].tobytes(), name
    assert two.scale == one.scale * factor
    assert two.origin == tuple(x * factor for x in one.origin)


def test_the_order_of_the_cells_in_the_file_does_not_show() -> None:
    mesh = assembly((3, 3, 3), 7)
    kinds = [(kind, np.random.default_rng(0).permutation(block)) for kind, block in mesh.cells]
    assert built(unstructured(mesh.points, kinds)).digest() == built(mesh).digest()


def test_a_mesh_far_from_the_origin_keeps_its_shape() -> None:
    mesh = assembly((2, 2, 2), 4)
    far = built(unstructured(mesh.points + 2.0**20, mesh.cells, linear(mesh.points)))
    near = built(mesh)
    assert np.allclose(far.vertices, near.vertices, atol=1e-7)
    assert np.allclose(far.normals, near.normals, atol=1e-6)


def test_slivers_keep_their_planes() -> None:
    """A slab thinner than float32 tells apart at the place: its normals are right all the same."""
    points = np.concatenate([CUBE * (1, 1, 1e-9), CUBE + np.array([0, 0, 1e-9])])
    mesh = unstructured(points, [("hexahedron", [range(8), range(8, 16)])])
    volume = built(mesh)
    assert (volume.report["flat"], volume.report["zero_volume"]) == (0, 0)
    assert volume.report["plane_error"] < 2e-7
    assert (np.abs(volume.normals[:, :, :3]).max(axis=2) > 0.57).all()


def test_too_small_and_too_far_apart() -> None:
    tiny = ONE * 2.0**-41
    points = np.concatenate([tiny, [(1.0, 0, 0), (-1, 0, 0), (0, 1.0, 0), (0, -1, 1)]])
    mesh = tet_mesh(points, [(0, 1, 2, 3), (4, 5, 6, 7)], np.arange(8.0))
    volume = built(mesh)
    assert (volume.report["flat"], volume.report["zero_volume"]) == (1, 0)
    assert len(volume.cells) == 1
    points[:4] *= 3
    volume = built(tet_mesh(points, [(0, 1, 2, 3), (4, 5, 6, 7)], np.arange(8.0)))
    assert volume.report["flat"] == 0
    assert np.abs(volume.gradients).max() > 1e10
    with pytest.raises(MeshError, match="a range that float64 does not hold"):
        build_tet(tet_mesh(ONE, [(0, 1, 2, 3)], np.array([-1e308, 0, 0, 1e308])))
    with pytest.raises(MeshError, match="scale them to what float64 computes with"):
        build_tet(tet_mesh((ONE - 0.5) * 1.7e308 * 2, [(0, 1, 2, 3)], np.arange(4.0)))


def test_unknown_layout() -> None:
    with pytest.raises(VoxtoolError, match="layout 'table 6' is unknown: choose raycast"):
        build_tet(cube(5), "table 6")


# ---- hexahedra


def boxes(seed: int = 0) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Points of boxes of uneven sides, their cells and a scalar for each."""
    points, cells = lattice((4, 3, 2))
    points = np.sqrt(points + 1) @ np.array([(1, 0, 0), (0.25, 1, 0), (0, 0.5, 2)])
    return points, cells, [np.random.default_rng(seed).uniform(0, 1, len(cells))]


def test_hexahedra_stay_whole() -> None:
    points, cells, values = boxes()
    turned = cells.copy()
    turned[5:9] = turned[5:9][:, [4, 5, 6, 7, 0, 1, 2, 3]]
    volume = built(unstructured(points, [("hexahedron", turned)], values), "hexahedra")
    assert volume.cells.shape == (24, 8)
    assert volume.report["turned"] == 4
    assert np.count_nonzero(volume.neighbours < 0) == 2 * (4 * 3 + 3 * 2 + 2 * 4)
    assert volume.normals.shape == (6, 24, 4)
    assert volume.bytes_a_cell() == 6 * 16 + 16 + 6 * 4
    centre = volume.vertices[:, :3][volume.cells].mean(axis=1)
    for cell, face in zip(*np.nonzero(volume.neighbours >= 0), strict=True):
        towards = centre[volume.neighbours[cell, face]] - centre[cell]
        assert (volume.normals[face, cell, :3] * towards).sum() > 0
    split = built(unstructured(points, [("hexahedron", cells)], values))
    assert split.scalar_range == volume.scalar_range
    assert sorted(set(split.gradients[:, 3])) == sorted(set(volume.gradients[:, 3]))


def test_hexahedra_that_cannot_stay_whole_are_refused() -> None:
    points, cells, values = boxes()
    block = [("hexahedron", cells)]
    bent = points.copy()
    bent[cells[7][6]] += 1e-3
    touched = int(np.count_nonzero((cells == cells[7][6]).any(axis=1)))
    line = CUBE.copy()
    line[[4, 5, 6, 7]] = [(0.1, 0.5, 1), (0.4, 0.5, 1), (0.6, 0.5, 1), (0.9, 0.5, 1)]
    dent = CUBE.copy()
    dent[6] = 0.2
    twice = cells.copy()
    twice[3, 1] = twice[3, 0]
    for mesh, message in (
        (unstructured(bent, block, values), f"{touched} of 24 hexahedra are not convex"),
        (unstructured(line, [("hexahedron", [range(8)])], [np.ones(1)]), "1 of 1 hexahedra"),
        (unstructured(dent, [("hexahedron", [range(8)])], [np.ones(1)]), "1 of 1 hexahedra"),
        (unstructured(points, [("hexahedron", twice)], values), "a vertex twice, the first is 3"),
        (unstructured(points, block), "s is one a point and --layout hexahedra takes one a cell"),
        (unstructured(np.concatenate([points, PYRAMID + 9]),
                      [*block, ("pyramid", [range(60, 65)])], [*values, np.ones(1)]),
         "has pyramid cells beside hexahedra"),
    ):  # fmt: skip
        with pytest.raises(MeshError) as caught:
            build_tet(mesh, "hexahedra")
        assert message in str(caught.value)
        assert "--layout raycast" in str(caught.value)
    almost = points.copy()
    almost[cells[7][6]] += 1e-7
    built(unstructured(almost, block, values), "hexahedra")


def test_flat_and_double_hexahedra_are_dropped() -> None:
    points = np.concatenate([CUBE, CUBE * (1, 1, 1e-16)])
    points[8:, 0] += 5
    cells = [range(8), range(8, 16), (4, 5, 6, 7, 0, 1, 2, 3)]
    mesh = unstructured(points, [("hexahedron", cells)], [np.array([1.0, 2.0, 3.0])])
    found = hexahedra(default_device(), volume_cells(mesh))
    assert (found.report["duplicates"], found.report["flat"]) == (1, 1)
    assert found.scalars.tolist() == [1]
    assert len(found.vertices) == 8


# ---- plan


@pytest.mark.parametrize("layout", ["raycast", "projection"])
def test_the_plan_foretells(layout: str) -> None:
    mesh = assembly((4, 4, 4), 0)
    job = plan_tet(mesh, layout)
    plan, volume = job.plan, built(mesh, layout)
    assert plan.cells == {kind: len(block) for kind, block in mesh.cells}
    assert len(volume.cells) <= plan.predicted_cells <= 1.2 * len(volume.cells)
    assert volume.plan == plan.decisions()
    assert "splitting" not in job.left_out
    assert "splitting" in plan_tet(cube(5), layout).left_out
    stages: list[str] = []
    assert job.run(stages.append).digest() == job.run().digest() == volume.digest()
    assert stages == plan.stages


def test_more_than_max_memory_is_refused_before_it_starts() -> None:
    mesh = cube(24)
    stages: list[str] = []
    needed = plan_tet(mesh).cost.device
    build_tet(mesh, max_memory=needed)
    with pytest.raises(MemoryLimitError, match=r"24 cells would need .* about 12 fit"):
        plan_tet(mesh, max_memory=needed // 2).run(stages.append)
    assert stages == []


# ---- a real mesh


BLUNT_FIN = {
    "raycast": "fdccc315b2f811c4fa4ce8786a6d3a5c60a56b1ca35cb66e8110986fd3956af8",
    "projection": "6f843a965482f434ac68c5cea0f64c6da827a2102027f9bb08657d41721ca1e5",
}


def test_blunt_fin() -> None:
    mesh = read_unstructured(model("bluntfin.vtu"), "density")
    assert sum(len(block) for _, block in mesh.cells) == 187_395
    volume = built(mesh)
    report = volume.report
    assert (report["zero_volume"], report["flat"]) == (77, 0)
    assert report["merged_points"] == 39
    assert len(volume.cells) == 187_395 - 77
    assert volume.bytes_a_cell() == 96
    assert report["plane_error"] < 1e-7
    assert volume.digest() == BLUNT_FIN["raycast"]
    assert build_tet(mesh, "projection").digest() == BLUNT_FIN["projection"]
    assert report["non_manifold_faces"] == report["folded_faces"] == report["turned"] == 0
