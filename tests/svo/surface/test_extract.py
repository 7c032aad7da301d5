"""Surfaces of octrees against dense numpy, exact fractions, analytic shapes and invariants."""

from __future__ import annotations

import math
import pickle
import re
import warnings
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from helpers.octree import ball, octree_from_dense
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import voxtool
from voxtool import choices
from voxtool.errors import MemoryLimitError, MeshWarning, VoxtoolError
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import check_surface, closed_chain, volume
from voxtool.svo.surface.extract import extract, plan_extract
from voxtool.svo.surface.isosurface import LATTICE, NEAREST, Isosurface, Lost
from voxtool.svo.surface.plan import COMPACTIONS, NAIVE_SAMPLES, SCAN

CUBES, FACES, NETS, _ = choices.STYLES
STYLES = ((CUBES, 0), (CUBES, 1), (CUBES, 2), (CUBES, "voxel"), (FACES, "voxel"),
          (FACES, 0), (NETS, "voxel"), (NETS, 0), (NETS, 1), (NETS, 2))  # fmt: skip
ISOVALUES = (0.5, 0.25, 1 / 64, 0.01, 0.3, 63 / 64, 0.99, 1e-9, 1 - 1e-12)


def lattice_mesh(surface: Isosurface) -> Mesh:
    """The surface in samples."""
    return Mesh(surface.points / LATTICE, surface.faces)


def coverage(dense: np.ndarray, side: int) -> np.ndarray:
    """Set voxels of the samples of a dense array, which is padded to whole ones."""
    shape = [-(-n // side) for n in dense.shape]
    padded = np.zeros([n * side for n in shape], int)
    padded[tuple(map(slice, dense.shape))] = dense
    a, b, c = shape
    return padded.reshape(a, side, b, side, c, side).sum(axis=(1, 3, 5))


def inside(surface: Isosurface, dense: np.ndarray) -> np.ndarray:
    """Return the samples that are inside, as a bool array with a layer of empty ones around."""
    share = [Fraction(int(n), surface.side**3) for n in range(surface.side**3 + 1)]
    enough = np.array([s >= Fraction(surface.isovalue) for s in share])
    enough[-1] = True  # the isovalue is rounded, to 1 at most
    return np.pad(enough[coverage(dense, surface.side)], 1)


def cut_edges(samples: np.ndarray) -> int:
    return sum(np.count_nonzero(np.diff(samples, axis=a)) for a in range(3))


def assert_manifold(surface: Isosurface, shells: int = 1, genus: int | None = None) -> None:
    """The surface is closed, 2-manifold by index, has no triangle of zero area and uses every
    vertex; with a genus, also that number of shells and handles."""
    found = check_surface(lattice_mesh(surface), weld=False)
    assert found.watertight, found
    assert found.manifold, found
    assert found.degenerate_faces == 0
    assert len(np.unique(surface.faces)) == len(surface.points)
    assert genus is None or (found.shells, found.genus) == (shells, genus)


@st.composite
def patterns(draw: st.DrawFn) -> np.ndarray:
    """Sets of voxels of every kind: scattered, in aligned boxes (whose octrees have inside leaves
    that touch empty ones), and both; up to the border of their grid."""
    shape = tuple(draw(st.lists(st.integers(8, 20), min_size=3, max_size=3)))
    rng = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    scattered = rng.random(shape) < draw(st.sampled_from([0.02, 0.3, 0.5, 0.8, 0.97]))
    side = draw(st.sampled_from([1, 2, 4, 8]))
    boxes = rng.random([-(-n // side) for n in shape]) < draw(st.sampled_from([0.3, 0.5, 0.8]))
    boxes = np.kron(boxes, np.ones((side,) * 3, bool)).astype(bool)
    boxes = boxes[tuple(map(slice, shape))]
    return draw(st.sampled_from([scattered, boxes, scattered & boxes, scattered | boxes]))


@given(patterns(), st.sampled_from(STYLES), st.sampled_from(ISOVALUES))
@settings(max_examples=60)
def test_every_pattern_has_a_closed_manifold_surface(device, dense, style, isovalue) -> None:
    octree = octree_from_dense(dense)
    assume(style[1] == "voxel" or style[1] < octree.depth)
    surface = extract(octree, style=style[0], level=style[1], isovalue=isovalue, device=device)
    samples = inside(surface, dense)
    edges = cut_edges(samples)
    if not edges:
        assert len(surface.faces) == 0
        return
    assert_manifold(surface)
    if style[0] == CUBES:
        assert len(surface.points) == edges
    else:
        assert len(surface.faces) == 2 * edges
    if style[0] == FACES:
        assert volume(lattice_mesh(surface)) == pytest.approx(samples.sum(), rel=1e-12)
    assert surface.lost == lost(coverage(dense, surface.side), samples)


def lost(covered: np.ndarray, samples: np.ndarray) -> Lost:
    """Voxels of samples outside, and of those with no inside sample around them."""
    near = np.lib.stride_tricks.sliding_window_view(samples, (3, 3, 3)).any(axis=(3, 4, 5))
    out = ~samples[1:-1, 1:-1, 1:-1]
    return Lost(int(covered[out].sum()), int(covered[~near].sum()))


def crossings(dense: np.ndarray, surface: Isosurface) -> set[tuple[int, int, int]]:
    """Return the vertices of marching cubes: t = (iso - a) / (b - a), rounded once."""
    n = surface.side**3
    covered = np.pad(coverage(dense, surface.side), 1)
    isovalue = Fraction(max(round(Fraction(surface.isovalue) * n * 2**16), 1), 2**16)
    found = set()
    for axis in range(3):
        low = np.moveaxis(covered, axis, 0)[:-1]
        high = np.moveaxis(covered, axis, 0)[1:]
        for place in zip(*np.nonzero((low >= isovalue) != (high >= isovalue)), strict=True):
            a, b = int(low[place]), int(high[place])
            outer, inner = min(a, b), max(a, b)
            t = math.floor((isovalue - outer) / (inner - outer) * LATTICE + Fraction(1, 2))
            t = min(max(t, NEAREST), LATTICE - NEAREST)
            point = [int(place[0])] + [int(p) for p in place[1:]]
            point.insert(axis, point.pop(0))
            point = [(p - 1) * LATTICE + LATTICE // 2 for p in point]
            point[axis] += t if a < b else LATTICE - t
            found.add(tuple(point))
    return found


@given(patterns(), st.sampled_from([0, 1, 2, 3, "voxel"]), st.sampled_from(ISOVALUES))
@settings(max_examples=40)
def test_smooth_vertices_are_where_fractions_say(device, dense, level, isovalue) -> None:
    octree = octree_from_dense(dense)
    assume(level == "voxel" or level < octree.depth)
    surface = extract(octree, style=CUBES, level=level, isovalue=isovalue, device=device)
    points = {tuple(p) for p in surface.points.tolist()}
    assert len(points) == len(surface.points)
    assert points == crossings(dense, surface)


def test_quads_are_split_along_their_shorter_diagonal(device) -> None:
    dense = np.random.default_rng(3).random((9, 8, 7)) < 0.5
    surface = extract(octree_from_dense(dense), style=NETS, level="voxel", device=device)
    first, second = surface.faces.reshape(-1, 2, 3).transpose(1, 0, 2)
    assert np.array_equal(first[:, [0, 2]], second[:, [0, 1]])  # the diagonal that they share
    a, b, c, d = (surface.points[v].astype(float) for v in (*first.T, second[:, 2]))
    longer = ((c - a) ** 2).sum(axis=1) > ((d - b) ** 2).sum(axis=1)
    flat = [(np.cross(q - p, r - p) == 0).all(axis=1) for p, q, r in ((b, c, d), (b, d, a))]
    assert (flat[0] | flat[1])[longer].all()  # the shorter one would leave a triangle no area


@given(patterns(), st.sampled_from([0, "voxel"]))
@settings(max_examples=30)
def test_nets_stay_in_the_cubes_of_their_blocks(device, dense, level) -> None:
    octree = octree_from_dense(dense)
    nets = extract(octree, style=NETS, level=level, device=device)
    blocks = extract(octree, style=FACES, level=level, device=device)
    assert len(nets.points) == len(blocks.points)
    assert nets.cubes == blocks.cubes
    assert (np.abs(nets.points - blocks.points) <= LATTICE // 2 - NEAREST).all()


@given(patterns(), st.sampled_from([0, "voxel"]))
@settings(max_examples=15)
def test_merged_blocks_are_the_same_boundary_of_fewer_triangles(device, dense, level) -> None:
    octree = octree_from_dense(dense)
    blocks = extract(octree, style=FACES, level=level, device=device)
    merged = extract(octree, style=FACES, level=level, merge=True, device=device)
    assert len(merged.faces) <= len(blocks.faces)
    assert squares(merged) == squares(blocks)
    assert closed_chain(lattice_mesh(merged))
    assert len(np.unique(merged.faces)) == len(merged.points)


def squares(surface: Isosurface) -> dict[tuple[int, ...], int]:
    """The oriented unit squares that the rectangles of a surface cover, each counted."""
    covered: dict[tuple[int, ...], int] = {}
    for first, second in surface.faces.reshape(-1, 2, 3):
        corners = surface.points[[*first, second[2]]] // LATTICE
        low, high = corners.min(axis=0), corners.max(axis=0)
        (axis,) = np.flatnonzero(low == high)
        p, q = corners[1] - corners[0], corners[2] - corners[0]
        sign = int(np.sign(np.cross(p, q)[axis]))
        u, v = (a for a in range(3) if a != axis)
        for i in range(low[u], high[u]):
            for j in range(low[v], high[v]):
                key = (int(axis), sign, int(low[axis]), i, j)
                covered[key] = covered.get(key, 0) + 1
    assert set(covered.values()) <= {1}
    return covered


# ---- ties, borders, leaves


def test_a_tie_is_inside_and_leaves_no_triangle_of_zero_area(device) -> None:
    dense = np.zeros((16, 16, 16), bool)
    dense[4:12, 4:12, 4:10] = True  # the bricks of z = 2 are half full: on the isovalue
    surface = extract(octree_from_dense(dense), style=CUBES, level=0, device=device)
    assert_manifold(surface)
    assert surface.points[:, 2].max() == 2 * LATTICE + LATTICE // 2 + NEAREST
    assert len(surface.points) == cut_edges(inside(surface, dense))


@pytest.mark.parametrize(("style", "level"), STYLES)
def test_a_full_grid_closes_at_its_border(device, style, level) -> None:
    surface = extract(
        octree_from_dense(np.ones((16, 16, 16), bool)), style=style, level=level, device=device
    )
    assert_manifold(surface, genus=0)
    low, high = surface.points.min() / LATTICE, surface.points.max() / LATTICE
    assert -0.5 < low <= 0.5
    assert low + high == pytest.approx(16 / surface.side, abs=1e-3)  # as far beyond as before


def test_an_inside_leaf_beside_an_empty_one_is_no_hole(device) -> None:
    """No node lies between them, so the cubes of [voCCeL] do not meet there."""
    dense = np.zeros((32, 32, 32), bool)
    dense[8:16, 8:24, 8:24] = True
    octree = octree_from_dense(dense)
    assert len(octree.bricks) == 0
    for style, level in ((CUBES, 0), (FACES, "voxel"), (NETS, "voxel")):
        surface = extract(octree, style=style, level=level, device=device)
        assert_manifold(surface, genus=0)
        share = volume(lattice_mesh(surface)) * surface.side**3 / dense.sum()
        assert share == pytest.approx(1) if style == FACES else 0.8 < share < 1  # edges are cut


def test_no_voxel_no_surface(device) -> None:
    octree = octree_from_dense(np.zeros((9, 9, 9), bool))
    for style, level in STYLES:
        surface = extract(octree, style=style, level=level, device=device)
        assert len(surface.points) == len(surface.faces) == 0


def test_voxels_that_touch_in_an_edge_or_a_corner_are_apart(device) -> None:
    dense = np.zeros((8, 8, 8), bool)
    dense[2, 2, 2] = dense[3, 3, 2] = dense[4, 4, 3] = True
    surface = extract(octree_from_dense(dense), style=FACES, device=device)
    assert_manifold(surface, shells=3, genus=0)
    assert len(surface.points) == 24


def test_a_pinched_edge_joins_its_inside(device) -> None:
    """Two voxels missing that touch in an edge, in a block: kept apart along it, the inside would
    use the edge four times."""
    dense = np.zeros((10, 10, 10), bool)
    dense[2:8, 2:8, 2:8] = True
    dense[4, 4, 4] = dense[5, 5, 4] = False
    surface = extract(octree_from_dense(dense), style=FACES, device=device)
    assert_manifold(surface, shells=3, genus=0)


# ---- shapes


@pytest.mark.parametrize(("style", "level"), [(CUBES, 0), (NETS, "voxel")])
def test_a_sphere_converges(device, style, level) -> None:
    """The volume's error falls with the square of the pitch. The area's of smooth surfaces ends at
    half a per cent: coverages are counts of 64 voxels, whose noise tilts the triangles."""
    radius, errors = 0.4, []
    for n in (32, 128):
        octree = octree_from_dense(ball((n, n, n), radius))
        surface = extract(octree, style=style, level=level, device=device)
        mesh = Mesh(surface.points * (surface.side / LATTICE / n), surface.faces)
        errors.append(abs(volume(mesh) / (4 / 3 * math.pi * radius**3) - 1))
    assert 1.7 < np.log2(errors[0] / errors[1]) / 2 < 2.3
    assert errors[1] < 8e-3
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(4 * math.pi * radius**2, rel=6e-3)


def torus(n: int) -> np.ndarray:
    x, y, z = ((g + 0.5) / n - 0.5 for g in np.ogrid[:n, :n, :n])
    return (np.sqrt(x * x + y * y) - 0.3) ** 2 + z * z < 0.12**2


@pytest.mark.parametrize(("style", "level"), [s for s in STYLES if s[1] != 1])
def test_a_torus_has_one_handle(device, style, level) -> None:
    surface = extract(octree_from_dense(torus(96)), style=style, level=level, device=device)
    assert_manifold(surface, genus=1)


def test_normals_point_outside(device) -> None:
    octree = octree_from_dense(ball((64, 64, 64), 0.4))
    for style, level in ((CUBES, 0), (NETS, "voxel")):
        surface = extract(octree, style=style, level=level, device=device)
        away = surface.vertices - (np.array(octree.grid.origin) + 32 * np.array(octree.grid.pitch))
        away /= np.linalg.norm(away, axis=1)[:, None]
        assert np.allclose(np.linalg.norm(surface.normals, axis=1), 1, atol=1e-14)
        assert (surface.normals * away).sum(axis=1).min() > 0.9


def test_normals_of_faces_that_cancel_are_unit(device) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.int32) * LATTICE
    faces = np.array([[0, 1, 2], [0, 2, 1]], np.int32)
    octree = octree_from_dense(ball((8, 8, 8)))
    surface = replace(extract(octree, device=device), points=points[:3], faces=faces)
    assert np.array_equal(np.abs(surface.normals), [[0, 0, 1]] * 3)


def test_vertices_lie_in_the_world_where_the_voxels_do(device) -> None:
    dense = np.zeros((12, 10, 9), bool)
    dense[3:8, 2:9, 4:6] = True
    octree = octree_from_dense(dense)
    octree = replace(octree, grid=Grid(octree.grid.shape, (10, -3, 0.5), (2, 0.5, 1.25)))
    surface = extract(octree, style=FACES, device=device)
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    assert low.tolist() == [16, -2, 5.5]
    assert high.tolist() == [26, 1.5, 8]
    assert volume(surface.mesh()) == pytest.approx(70 * 1.25)


def test_the_mesh_does_not_depend_on_the_root(device) -> None:
    """A surface that touches low sides needs a root above the root: all else is the same."""
    dense = ball((16, 16, 16), 0.3)
    shifted = np.zeros((24, 24, 24), bool)
    shifted[8:, 8:, 8:] = dense
    dense[0, 0, 0] = shifted[8, 8, 8] = True
    for style in (CUBES, FACES, NETS):
        here = extract(octree_from_dense(dense), style=style, level="voxel", device=device)
        there = extract(octree_from_dense(shifted), style=style, level="voxel", device=device)
        assert plan_extract(octree_from_dense(dense), style=style, level="voxel").plan.rooted
        assert here.mesh().faces.shape == there.mesh().faces.shape
        moved = {tuple(p) for p in (here.points + 8 * LATTICE).tolist()}
        assert moved == {tuple(p) for p in there.points.tolist()}


def test_thin_features_are_counted_as_lost(device) -> None:
    dense = np.zeros((32, 32, 32), bool)
    dense[4:20, 4:20, 4:20] = True
    dense[26, 4:20, 4:20] = True  # a sheet a voxel thick, a quarter of its bricks
    octree = octree_from_dense(dense)
    surface = extract(octree, level=0, device=device)
    assert surface.lost == Lost(256, 256)
    kept = extract(octree, level=0, isovalue=0.25, device=device)
    assert kept.lost == Lost(0, 0)
    assert len(kept.faces) > len(surface.faces)


def test_volumes_are_exact(device) -> None:
    """The sum of the tetrahedra from the origin, in Python's integers, wherever the surface is."""
    dense = np.random.default_rng(5).random((11, 9, 30)) < 0.6
    pitch = (0.5, 0.25, 2.0)
    octree = replace(octree_from_dense(dense), grid=Grid(dense.shape, (1e6, -7, 3), pitch))
    for request in (
        {"style": NETS}, {"level": 0}, {"style": CUBES}, {"style": CUBES, "level": 1},
        {"style": FACES}, {"style": FACES, "merge": True},
    ):  # fmt: skip
        surface = extract(octree, device=device, **request)
        six = 0
        for (a, b, c), (d, e, f), (g, h, i) in surface.points[surface.faces].tolist():
            six += a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        exact = Fraction(six, 6) * Fraction(surface.side, LATTICE) ** 3 / 4
        assert surface.volume == pytest.approx(float(exact), rel=1e-15)
        if surface.style == FACES:
            assert surface.volume == pytest.approx(octree.volume, rel=1e-12)


# ---- what is refused


def test_arguments_out_of_range_are_refused(device) -> None:
    octree = octree_from_dense(ball((16, 16, 16)))
    for isovalue in (0, 1, -0.5, 2, math.nan, "half", None):
        with pytest.raises(VoxtoolError, match="between 0 and 1"):
            extract(octree, isovalue=isovalue, device=device)
    for level in (-1, 3, 99, "brick", 1.0):
        with pytest.raises(VoxtoolError, match="'voxel' or a level from 0 to 2"):
            extract(octree, level=level, device=device)
    with pytest.raises(VoxtoolError, match="choose one of marching-cubes, voxel-faces, "):
        extract(octree, style="cubes", device=device)
    with pytest.raises(VoxtoolError, match="surface-nets has no coplanar squares"):
        extract(octree, style=NETS, merge=True, device=device)


def test_numpy_numbers_are_numbers_and_old_styles_are_aliases() -> None:
    octree = octree_from_dense(ball((16, 16, 16)))
    job = plan_extract(octree, level=np.int64(1), isovalue=np.float32(0.25))
    assert job.plan == plan_extract(octree, level=1, isovalue=0.25).plan
    for old, style in choices.STYLE_ALIASES.items():
        assert plan_extract(octree, style=old).plan.style == style


def test_a_surface_has_no_inside(device) -> None:
    octree = octree_from_dense(ball((16, 16, 16)), mode="surface26", fill="none")
    for style, level in STYLES:
        if (style, level) != (FACES, "voxel"):
            with pytest.raises(VoxtoolError, match="--mode solid, or extract --style voxel-faces"):
                extract(octree, style=style, level=level, device=device)
    blocks = extract(octree, style=FACES, device=device)
    assert volume(lattice_mesh(blocks)) == pytest.approx(octree.count)


def test_memory_is_planned(device) -> None:
    octree = octree_from_dense(ball((64, 64, 64)))
    plan = plan_extract(octree, style=NETS)
    assert plan.cost.device > 1_000_000
    with pytest.raises(MemoryLimitError, match="choose level 0"):
        extract(octree, style=NETS, max_memory=plan.cost.device // 2, device=device)
    extract(octree, style=NETS, max_memory=plan.cost.device * 5 // 4, device=device)


def test_a_surface_larger_than_predicted_is_refused_once_it_is_counted(device) -> None:
    octree = octree_from_dense(np.indices((32, 32, 32)).sum(axis=0) % 2 == 0)
    plan = plan_extract(octree, style=FACES)
    with pytest.raises(MemoryLimitError, match="a voxel-faces surface of level voxel would need"):
        extract(octree, style=FACES, max_memory=2 * plan.cost.device, device=device)


# Clusters of 24 voxels a side lie at random in a grid, at the low and the high ends of it too.
CLUSTER = 24


def clusters(dim: int, count: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the corners and the voxels of clusters that do not touch each other."""
    random = np.random.default_rng(seed)
    corners = [np.zeros(3, int), np.full(3, dim - CLUSTER)]
    while len(corners) < count:
        corner = random.integers(0, dim - CLUSTER, 3)
        if all(abs(corner - c).max() > 2 * CLUSTER for c in corners):
            corners.append(corner)
    shapes = [random.random((CLUSTER // 4,) * 3) < 0.6 for _ in corners]
    shapes = [np.kron(shape, np.ones((4, 4, 4), bool)) for shape in shapes]
    return [(c, s ^ (random.random(s.shape) < 0.01)) for c, s in zip(corners, shapes, strict=True)]


def triangles_of(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return triangles as sorted rows of nine coordinates, each from its lowest corner on."""
    corners = points[faces]
    first = np.lexsort(corners.transpose(2, 0, 1)[::-1], axis=-1)[:, 0]
    turned = corners[np.arange(len(corners))[:, None], (first[:, None] + np.arange(3)) % 3]
    return np.unique(turned.reshape(-1, 9), axis=0)


@pytest.mark.parametrize(
    "request_",
    [{"style": CUBES}, {"style": CUBES, "level": 1, "isovalue": 0.2}, {"style": NETS},
     {"style": NETS, "level": 0}, {"style": FACES}, {"style": FACES, "merge": True}],
)  # fmt: skip
def test_a_deep_octree_has_the_surfaces_of_its_parts(device, request_) -> None:
    """Each cluster is extracted by itself from a small grid, whose place is that of its coarsest
    samples."""
    parts = clusters(51_200, 5, 3)
    grid = Grid((51_200,) * 3, (0, 0, 0), (1, 1, 1))
    voxels = np.concatenate([corner + np.argwhere(shape) for corner, shape in parts])
    job = plan_extract(voxtool.Octree.from_voxels(voxels, grid), device=device, **request_)
    found = job.run()
    wanted, cubes, vertices = [], 0, 0
    for corner, shape in parts:
        shift = corner % 8
        dense = np.pad(shape, [(8 + s, 8) for s in shift])
        alone = extract(octree_from_dense(dense), device=device, **request_)
        step = (corner - shift - 8) // alone.side * LATTICE
        wanted.append(triangles_of(alone.points + step, alone.faces))
        cubes += alone.cubes
        vertices += len(alone.points)
    assert (found.cubes, len(found.points)) == (cubes, vertices)
    np.testing.assert_array_equal(
        triangles_of(found.points, found.faces), np.unique(np.concatenate(wanted), axis=0)
    )
    assert job.cost.device < 8e6
    assert len(found.faces) > 500


@pytest.mark.parametrize("voxel", [(0, 0, 0), (65_535,) * 3, (32_767, 32_768, 16_383)])
def test_one_voxel_takes_nothing_for_the_empty_space(device, voxel) -> None:
    grid = Grid((65_536,) * 3, (0, 0, 0), (1, 1, 1))
    octree = voxtool.Octree.from_voxels([voxel], grid)
    for style in (CUBES, FACES, NETS):
        job = plan_extract(octree, style=style, device=device)
        surface = job.run()
        assert (job.cost.device < 20_000, surface.tiles, surface.cubes) == (True, 27, 8)
        assert_manifold(surface, shells=1, genus=0)
        assert ((surface.points.min(axis=0) + surface.points.max(axis=0)) / LATTICE).tolist() == [
            2 * v + 1 for v in voxel
        ]
    with pytest.raises(MemoryLimitError, match=f"of {NAIVE_SAMPLES} that are all visited"):
        job.with_(naive=True).run()


def test_the_plan_says_what_is_left_out() -> None:
    octree = octree_from_dense(ball((64, 64, 64), 0.3))
    job = plan_extract(octree, style=CUBES, level=0)
    assert "loops and quads" in job.left_out
    assert "root above the octree" in job.left_out
    assert job.stages[-3:] == ("lost voxels", "triangles", "read back")
    merged = plan_extract(octree, style=FACES, merge=True)
    assert "sorting" not in merged.left_out
    assert merged.stages[-3:] == ("merge", "triangles", "read back")
    assert "relax" in plan_extract(octree, style=NETS).stages


@pytest.mark.parametrize(
    "request_", [{"style": CUBES}, {"level": 0}, {}, {"style": FACES, "merge": True}]
)
def test_stages_run_as_planned_as_often_as_asked(device, request_) -> None:
    job = plan_extract(octree_from_dense(ball((32, 32, 32))), device=device, **request_)
    began: list[str] = []
    first = job.run(began.append)
    assert tuple(dict.fromkeys(began)) == job.stages
    assert job.run() == first == extract(job.octree, device=device, **request_)


def test_relaxation_can_be_left_out(device) -> None:
    job = plan_extract(octree_from_dense(ball((32, 32, 32))), style=NETS, device=device)
    flat = job.with_(relaxations=0)
    assert "relax" not in flat.stages
    assert "relaxation" in flat.left_out
    assert len(flat.run().points) == len(job.run().points)
    assert flat.run() != job.run()
    with pytest.raises(TypeError, match="level: plan another extraction"):
        job.with_(level=1)


@pytest.mark.parametrize(
    "request_",
    [
        {"style": CUBES, "level": 0},
        {"style": CUBES, "level": 1},
        {"style": CUBES},
        {},
        {"style": FACES},
    ],
)
@pytest.mark.parametrize("shape", [(9, 8, 7), (32, 32, 32), (70, 20, 9)])
def test_naive_extraction_visits_all_cubes_and_gives_the_same(device, shape, request_) -> None:
    dense = np.random.default_rng(7).random(shape) < 0.5
    dense[:, -3:] = True
    job = plan_extract(octree_from_dense(dense), device=device, **request_)
    naive = job.with_(naive=True)
    all_, few = naive.run(), job.run()
    assert all_.digest() == few.digest()
    assert (all_.lost, all_.cubes) == (few.lost, few.cubes)
    assert all_.tiles == naive.plan.visited == naive.describe()["predicted_tiles"] >= few.tiles
    assert "cubes away from nodes" not in naive.left_out


PYRAMIDS = [name for name in COMPACTIONS if name != SCAN]


def assert_same_by_pyramids(octree: voxtool.Octree, device, **request) -> None:
    """Every compaction of marching cubes gives the surface of the scan."""
    job = plan_extract(octree, style=CUBES, device=device, **request)
    assert job.plan.compaction == SCAN
    scan = job.run()
    for name in PYRAMIDS:
        forced = job.with_(compaction=name)
        assert forced.cost.device > job.cost.device
        found = forced.run()
        assert found.digest() == scan.digest()
        assert np.array_equal(found.points, scan.points)
        assert np.array_equal(found.faces, scan.faces)
        assert (found.lost, found.cubes, found.tiles) == (scan.lost, scan.cubes, scan.tiles)


@pytest.mark.parametrize("level", [0, 1, 2, "voxel"])
@given(patterns(), st.sampled_from(ISOVALUES))
@settings(max_examples=10, deadline=None)
def test_outputs_that_walk_a_pyramid_give_the_same(device, level, dense, isovalue) -> None:
    octree = octree_from_dense(dense)
    assume(level == "voxel" or level < octree.depth)
    assert_same_by_pyramids(octree, device, level=level, isovalue=isovalue)


# about length / 4 tiles along a row, at and around powers of 2, 4 and 5
@pytest.mark.parametrize("length", [1, 8, 16, 17, 20, 64, 65, 100, 101, 256, 500, 501])
def test_any_number_of_tiles_makes_a_pyramid(device, length) -> None:
    dense = np.zeros((max(length, 8), 8, 8), bool)
    dense[:length, 5:7, 5:7] = True
    assert_same_by_pyramids(octree_from_dense(dense), device, level="voxel")


def test_no_voxel_makes_a_pyramid_without_outputs(device) -> None:
    assert_same_by_pyramids(octree_from_dense(np.zeros((8, 8, 8), bool)), device, level=0)


def test_only_marching_cubes_have_pyramids() -> None:
    octree = octree_from_dense(ball((16, 16, 16)))
    with pytest.raises(ValueError, match="'pyramid-3': choose one of scan, pyramid-2"):
        plan_extract(octree, style=CUBES).with_(compaction="pyramid-3")
    with pytest.raises(ValueError, match=r"'pyramid-4': choose one of scan$"):
        plan_extract(octree, style=NETS).with_(compaction="pyramid-4")


def test_naive_extraction_is_refused_beyond_its_memory(device) -> None:
    job = plan_extract(octree_from_dense(ball((64, 64, 64))), level="voxel", device=device)
    job.max_memory = job.with_(naive=True).cost.device - 1
    assert len(job.run().faces)
    with pytest.raises(MemoryLimitError, match="choose level 0, or leave out naive"):
        job.with_(naive=True).run()
    huge = replace(job.plan, naive=True, nodes=(8,) * 9 + (1,))
    with pytest.raises(MemoryLimitError, match="2048 samples along a side, of 1024 "):
        huge.refuse_beyond(1 << 60, 1 << 60)


@pytest.mark.parametrize("lanes", [1, 16])
def test_relaxation_moves_halfway_to_the_mean_of_neighbours(device, lanes) -> None:
    """The same vertices as numpy gives, which moves the ends of the quads' edges and truncates
    towards zero."""
    dense = np.random.default_rng(7).random((9, 8, 7)) < 0.5
    job = plan_extract(octree_from_dense(dense), style=NETS, device=device)
    flat = job.with_(relaxations=0).run()
    first, second = flat.faces[::2], flat.faces[1::2]  # of each quad
    ring = np.stack([first[:, 0], first[:, 1], first[:, 2], second[:, 2]], axis=1)
    edges = np.stack([ring, np.roll(ring, -1, axis=1)], axis=2).reshape(-1, 2)
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    count = np.bincount(edges[:, 0])[:, None]
    assert {*count.ravel()} >= {3, 4, 5, 6}
    points = flat.points.astype(np.int64)
    low = (points - LATTICE // 2) // LATTICE * LATTICE + LATTICE // 2
    for _ in range(3):
        apart = np.zeros_like(points)
        np.add.at(apart, edges[:, 0], points[edges[:, 1]] - points[edges[:, 0]])
        points = points + np.sign(apart) * (np.abs(apart) // (2 * count))
        points = np.clip(points, low + NEAREST, low + LATTICE - NEAREST)
    assert np.array_equal(job.with_(relaxations=3, lanes=lanes).run().points, points)


def test_findings_say_what_is_lost_or_empty(device) -> None:
    dense = ball((32, 32, 32), 0.3)
    with warnings.catch_warnings(action="error"):
        extract(octree_from_dense(dense), level=0, device=device)
    dense[2:30, 1, 1:3] = True
    with pytest.warns(MeshWarning, match="56 of them away from the surface: --level voxel"):
        extract(octree_from_dense(dense), level=0, device=device)
    with warnings.catch_warnings(action="error"):
        extract(octree_from_dense(dense), device=device)
    with pytest.warns(MeshWarning, match="no voxel is set, so there is no surface"):
        extract(octree_from_dense(dense & False), device=device)


def test_a_surface_is_a_value(device) -> None:
    surface = extract(octree_from_dense(ball((32, 32, 32))), device=device)
    again = pickle.loads(pickle.dumps(surface))
    assert again == surface != replace(surface, isovalue=0.25)
    assert hash(surface) != hash(again)  # by identity
    for array in (again.points, again.faces, surface.vertices, surface.normals):
        assert not array.flags.writeable
    assert re.fullmatch(
        r"Isosurface\(surface-nets, level voxel, [\d,]+ vertices, [\d,]+ triangles\)", repr(again)
    )
    mesh = surface.to_trimesh()
    assert np.array_equal(mesh.vertices, surface.vertices)
    assert np.array_equal(mesh.faces, surface.faces)
