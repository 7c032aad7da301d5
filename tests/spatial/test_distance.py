"""Distances to a mesh against rational arithmetic, brute force and analytic shapes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import model
from helpers import meshes
from helpers.distance import around, brute, exact
from helpers.meshes import mesh_of
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
from voxtool.errors import DeviceError, MeshError, VoxtoolError
from voxtool.files.meshes.mesh import load_mesh
from voxtool.mesh.mesh import Mesh
from voxtool.spatial import bvh
from voxtool.spatial.bvh import Frame, build_tree, distinct_faces
from voxtool.spatial.distance import TriangleDistance, others_within
from voxtool.spatial.pseudonormals import pseudonormals

if TYPE_CHECKING:
    from voxtool.opencl import Device

EXACT = 1e-15  # error, of the mesh's extent or of the distance, whichever is larger
SHAPE = (8, 8, 8)


def check(mesh: Mesh, points: np.ndarray, device: Device, oracle=exact) -> np.ndarray:
    found = TriangleDistance(mesh, device)(points)
    together = TriangleDistance(mesh, device, packets_from=1)(points)
    assert np.array_equal(together, found)
    expected = oracle(points, mesh.vertices[mesh.faces])
    low, high = mesh.bounds
    allowed = EXACT * np.maximum((high - low).max(), expected)
    assert found.dtype == np.float64
    assert (np.abs(found - expected) <= allowed).all()
    return found


# ---- against the oracles


@given(
    meshes.fixed_triangles(SHAPE, max_triangles=6),
    st.lists(st.tuples(*[st.integers(-1024, 3072)] * 3), min_size=1, max_size=8),
    st.integers(-40, 40),
)
@settings(max_examples=40)
def test_any_triangles_at_any_scale(device: Device, triangles, points, exponent) -> None:
    vertices, faces = triangles
    scale = 2.0**exponent
    mesh = mesh_of(vertices * scale, faces)
    check(mesh, np.concatenate([points * np.full(3, scale), mesh.vertices]), device)


@given(meshes.closed_meshes(SHAPE), st.integers(0, 1 << 16))
@settings(max_examples=12)
def test_closed_meshes(device: Device, vertices_and_faces, seed) -> None:
    mesh = mesh_of(*vertices_and_faces)
    check(mesh, around(mesh, np.random.default_rng(seed), 6), device)


@pytest.mark.parametrize("seed", range(5))
def test_slivers_and_needles(device: Device, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(12):
        a, b = rng.uniform(-1, 1, (2, 3))
        height, short = 10.0 ** -rng.uniform(0, 17, 2)
        c = a + rng.uniform(-0.3, 1.3) * (b - a) + height * rng.normal(size=3)
        if rng.integers(2):
            b = a + short * rng.normal(size=3)
        mesh = mesh_of(rng.permutation([a, b, c]))
        points = [around(mesh, rng, 3, 10.0 ** -rng.uniform(-1, 16)), mesh.vertices]
        check(mesh, np.concatenate(points), device)


def test_every_region_of_a_triangle_of_every_shape(device: Device) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(-4, 9, 2)] * 2, [0, 3]), axis=-1).reshape(-1, 3)
    for apex in [(0, 1), (2, 1), (4, 1), (2, 4), (-1, 2), (6, 1), (2, 0), (0, 0), (9, 0)]:
        corners = np.array([(0, 0, 0), (4, 0, 0), (*apex, 0)])
        for turn in range(3):
            for flipped in (corners, corners[::-1]):
                mesh = mesh_of(np.roll(flipped, turn, axis=0))
                check(mesh, grid.astype(np.float64), device, brute if turn else exact)


def test_degenerate_faces_are_segments_and_points(device: Device) -> None:
    points = np.array([(0.0, 3, 4), (5, 3, 4), (10, 0, 0), (13, 4, 0), (-3, 0, -4), (2, 0, 0)])
    segment = mesh_of([(0, 0, 0), (10, 0, 0), (10, 0, 0), (0, 0, 0), (10, 0, 0), (5, 0, 0)])
    assert TriangleDistance(segment, device)(points).tolist() == [5, 5, 0, 5, 5, 0]
    point = mesh_of([(10, 0, 0)] * 3)
    assert TriangleDistance(point, device)(points[2:4]).tolist() == [0, 5]
    both = mesh_of([(10, 0, 0)] * 3 + [(0, 0, 0), (4, 0, 0), (0, 0, 0)])
    check(both, points, device)


@pytest.mark.parametrize("count", [1, 2, 4, 5, 31, 32, 33, 256, 257, 2049])
def test_any_number_of_triangles(device: Device, count: int) -> None:
    rng = np.random.default_rng(count)
    mesh = mesh_of(meshes.random_triangles(rng, count, size=2)[0] / 256)
    check(mesh, around(mesh, rng, 50), device, brute)


def test_equal_centroids_and_triangles(device: Device) -> None:
    rng = np.random.default_rng(1)
    half = rng.integers(1, 1 << 20, (10_000, 3))
    corners = np.stack([half, -half, 0 * half], axis=1)
    mesh = mesh_of(corners / (1 << 20))
    check(mesh, rng.uniform(-1, 1, (60, 3)), device, brute)
    many, one = mesh_of(np.tile(corners[0], (1000, 1))), mesh_of(corners[0])
    points = around(one, rng, 100)
    assert np.array_equal(check(one, points, device), TriangleDistance(many, device)(points))


@pytest.mark.parametrize("exponent", [-490, -40, 0, 40, 490])
def test_scale_changes_no_bit(device: Device, exponent: int) -> None:
    mesh = mesh_of(*meshes.torus())
    points = around(mesh, np.random.default_rng(3), 300)
    expected = check(mesh, points, device, brute)
    scaled = replace(mesh, vertices=np.ldexp(mesh.vertices, exponent))
    found = TriangleDistance(scaled, device)(np.ldexp(points, exponent))
    assert np.array_equal(found, np.ldexp(expected, exponent))


def test_far_from_the_origin(device: Device) -> None:
    mesh = mesh_of(*meshes.icosphere(2, (1e6, -1e6, 1e6), 0.01))
    check(mesh, around(mesh, np.random.default_rng(4), 100), device, brute)


@pytest.mark.parametrize("far", [3, 6.9, 7, 100, 2.0**20, 2.0**40, 2.0**80])
def test_points_far_away(device: Device, far: float) -> None:
    mesh = mesh_of(*meshes.icosphere(2))
    directions = np.random.default_rng(5).normal(size=(100, 3))
    found = check(mesh, far * directions, device, brute)
    near = TriangleDistance(mesh, device)(directions)  # in blocks of their own, and in one
    mixed = TriangleDistance(mesh, device)(np.concatenate([directions, far * directions]))
    assert np.array_equal(mixed, np.concatenate([near, found]))


def test_a_huge_triangle_among_tiny_ones(device: Device) -> None:
    small, faces = meshes.icosphere(3, radius=1e-6)
    mesh = mesh_of(*meshes.join((small, faces), (np.eye(3) * 1e3 - 400, np.array([(0, 1, 2)]))))
    points = np.concatenate([small[::20] * 3, around(mesh, np.random.default_rng(6), 50)])
    check(mesh, points, device, brute)


# ---- analytic shapes


def test_a_box(device: Device) -> None:
    measure = TriangleDistance(mesh_of(*meshes.box((0, 0, 0), (4, 6, 8))), device)
    points = [(2, 3, 4), (1, 3, 4), (2, 3, 11), (7, 10, 4), (6, 9, 14), (0, 0, 0), (4, 2, 7)]
    assert np.abs(measure(points) - [2, 1, 3, 5, 7, 0, 0]).max() < 8 * EXACT


# ---- what changes nothing


def test_neither_order_nor_company_changes_a_bit(device: Device) -> None:
    vertices, faces = meshes.torus()
    rng = np.random.default_rng(8)
    mesh = mesh_of(vertices, faces)
    points = around(mesh, rng, 1500)
    expected = TriangleDistance(mesh, device)(points)
    shuffled = TriangleDistance(mesh_of(vertices, rng.permutation(faces)), device)
    order = rng.permutation(len(points))
    assert np.array_equal(shuffled(points[order]), expected[order])
    assert np.array_equal(shuffled(points[:7]), expected[:7])
    for parameters in ({"block": 1000}, {"near": 0.0}, {"packets_from": 1}):  # 0: float64 boxes
        assert np.array_equal(TriangleDistance(mesh, device, **parameters)(points), expected)


def test_packets_find_the_same_faces(device: Device) -> None:
    vertices, faces = meshes.torus()
    mesh = mesh_of(vertices, faces)
    normals = pseudonormals(mesh)
    # at a vertex, several faces are equally near
    points = np.concatenate([vertices, 1.01 * vertices])
    for sides in (None, normals):
        alone = TriangleDistance(mesh, device, normals=sides)
        together = TriangleDistance(mesh, device, normals=sides, packets_from=1)
        for a, b in zip(alone.blocks(points), together.blocks(points), strict=True):
            for one, other in zip(alone.at_block(a, True), together.at_block(b, True), strict=True):
                assert np.array_equal(one, other)


@pytest.mark.parametrize("thin", [1.0, 2.0**-30])
def test_other_faces_within_reach(device: Device, thin: float) -> None:
    """Also of faces that lie upon each other; copies of a face are not in the tree."""
    rng = np.random.default_rng(25)
    triangles = rng.uniform(-1, 1, (300, 1, 3)) + rng.normal(0, 0.1, (300, 3, 3)) * [1, 1, thin]
    triangles[200:] = triangles[:100] + np.array([0, 0, 2e-3])
    triangles[1:3] = triangles[0]
    mesh = Mesh(triangles.reshape(-1, 3), np.arange(900, dtype=np.int32).reshape(-1, 3))
    some = distinct_faces(mesh)
    assert some is not None
    tree, local = build_tree(device, mesh, some=some), Frame.of(mesh).local(triangles)
    faces = rng.choice(some, 200)
    points = (rng.dirichlet(np.ones(3), 200)[:, :, None] * local[faces]).sum(axis=1)
    reaches = np.exp2(rng.uniform(-30, -2, 200)) * (rng.random(200) < 0.9)
    others = [local[some[some != face]] for face in faces]
    nearest = np.array([brute(p[None], t)[0] for p, t in zip(points, others, strict=True)])
    found = others_within(device, tree, points, reaches, faces)
    clear = np.abs(nearest - reaches) > 1e-12
    assert clear.mean() > 0.8
    assert 20 < np.count_nonzero(found) < 180
    assert np.array_equal(found[clear], (nearest <= reaches)[clear])
    assert not len(others_within(device, tree, points[:0], reaches[:0], faces[:0]))


@cache
def _bunny() -> tuple[Mesh, np.ndarray]:
    mesh = load_mesh(model("stanford-bunny.obj"))
    rng = np.random.default_rng(9)
    low, high = mesh.bounds
    far = rng.uniform(low - 20 * (high - low), high, (500, 3))
    return mesh, np.concatenate(
        [around(mesh, rng, 10_000, 0.01), rng.uniform(low, high, (5000, 3)), far]
    )


def test_the_bunny_against_brute_force(device: Device) -> None:
    mesh, points = _bunny()
    check(mesh, points[:: len(points) // 12], device, brute)


ROUNDED = """
#include "spatial/nearest_packets.cl"
__kernel void measure(__global const double *points, __global const double *leaves,
                      __global const float *rounded, const uint n, __global double *squares)
{
    const uint gid = get_global_id(0), slot = gid / POINTS;
    const double3 p = vload3(gid, points);
    const float3 q = convert_float3(p);
    const triangle t = triangle_of(leaves, slot);
    ways way;
    long16 feature;
    squares[2 * gid] = triangle_ways(&t, p.x, p.y, p.z, &way, &feature).x;
    squares[2 * gid + 1] = rounded_squares(rounded + FIELDS * slot, q.x, q.y, q.z).x;
}
"""


def test_rounded_triangles_are_no_further_than_doubt(device: Device) -> None:
    rng = np.random.default_rng(11)
    n = 1 << 12
    a, b = rng.uniform(-1, 1, (2, n, 3))
    thin, short = 10.0 ** -rng.uniform(0, 17, (2, n, 1))
    b = np.where(rng.integers(2, size=(n, 1)), b, a + short * rng.normal(size=(n, 3)))
    c = a + rng.uniform(-0.3, 1.3, (n, 1)) * (b - a) + thin * rng.normal(size=(n, 3))
    corners = np.clip(np.stack([a, b, c], axis=1), -1, 1)
    corners[0] = [(-1, -1, -1), (1, 1, 1), (1, -1, 1)]  # the frame
    tree = bvh.build_tree(device, mesh_of(corners.reshape(-1, 3)))
    slots = tree.face_of.size
    ends = corners[tree.face_of.get()]
    weights = rng.dirichlet((0.5, 0.5, 0.5), (slots, 16)) + rng.normal(size=(slots, 16, 3)) * 1e-3
    apart = 10.0 ** -rng.uniform(-0.9, 8, (slots, 16, 1)) * rng.normal(size=(slots, 16, 3))
    points = np.clip(weights @ ends + apart, -8, 8)
    rounded = device.empty(slots * bvh.FIELDS, np.float32)
    device.kernel("spatial/nearest_packets.cl", "round_triangles")(slots, tree.leaves, rounded)
    squares = device.empty(2 * 16 * slots, np.float64)
    device.kernel(ROUNDED, "measure")(
        16 * slots, device.put(points), tree.leaves, rounded, squares, local=16
    )
    exact, found = np.sqrt(squares.get().reshape(-1, 2).T)
    assert (found - exact).max() < 2.0**-16  # half of DOUBT
    assert (found - exact).max() > 2.0**-24  # single precision shows


# ---- the tree


def test_the_tree_encloses_every_triangle_once(device: Device) -> None:
    mesh = mesh_of(*meshes.torus(sides=(40, 25)))
    tree = bvh.build_tree(device, mesh)
    nodes = tree.nodes.get().reshape(-1, 2, 3, bvh.ARITY).astype(np.float64)
    leaves = tree.leaves.get().reshape(-1, bvh.FIELDS, bvh.LEAF)
    local = tree.frame.local(mesh.vertices)

    def corners(leaf: int) -> np.ndarray:
        a, e, g = (leaves[leaf, i : i + 3].T for i in (0, 3, 6))
        return np.stack([a, a + e, a + leaves[leaf, 9][:, None] * e + g], axis=1)

    found = np.concatenate([corners(i) for i in range(len(leaves))])[: len(mesh.faces)]
    order = [np.lexsort(np.round(t.mean(axis=1), 12).T) for t in (found, local[mesh.faces])]
    assert np.allclose(
        np.sort(found[order[0]], axis=1), np.sort(local[mesh.faces][order[1]], axis=1), atol=1e-15
    )

    def enclosed(node: int, low: np.ndarray, high: np.ndarray) -> int:
        """Leaves below; each box holds its children's boxes, or its triangles."""
        if node >= tree.first_leaf:
            triangles = corners(node - tree.first_leaf)
            assert (triangles >= low).all()
            assert (triangles <= high).all()
            return 1
        count = 0
        for i in range(bvh.ARITY):
            from_, to = nodes[node, 0, :, i], nodes[node, 1, :, i]
            if np.isinf(from_).any():
                assert (from_ == np.inf).all()
                assert (to == -np.inf).all()
                continue
            assert (from_ >= low).all()
            assert (to <= high).all()
            count += enclosed(bvh.ARITY * node + 1 + i, from_, to)
        return count

    assert enclosed(0, np.full(3, -np.inf), np.full(3, np.inf)) == len(leaves)


def test_the_curve_visits_neighbours(device: Device) -> None:
    bits = 3
    cells = np.indices((1 << bits,) * 3).reshape(3, -1).T.astype(np.uint32)
    source = f"""#include "spatial/hilbert.h"
__kernel void places(__global const uint *cells, __global uint *out) {{
    out[get_global_id(0)] = (uint)hilbert_index(vload3(get_global_id(0), cells), {bits});
}}"""
    out = device.zeros(len(cells), np.uint32)
    device.kernel(source, "places")(len(cells), device.put(cells), out)
    places = out.get()
    assert sorted(places) == list(range(len(cells)))
    steps = np.abs(np.diff(cells[np.argsort(places)].astype(int), axis=0)).sum(axis=1)
    assert (steps == 1).all()


# ---- what is refused


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([(0, 0, 0), (0, np.nan, 0)], r"point 1, \(0\.0, nan, 0\.0\), is not finite or too far"),
        ([(np.inf, 0, 0)], "point 0, .* is not finite or too far"),
        ([(1e300, 0, 0)], "too far from the mesh: remove it"),
        ([1, 2, 3], r"points of shape \(3,\): give \(N, 3\)"),
        ([("a", "b", "c")], "not an array of numbers"),
    ],
)
def test_points_that_are_refused(device: Device, points, message: str) -> None:
    with pytest.raises(VoxtoolError, match=message) as caught:
        TriangleDistance(mesh_of(*meshes.box(0, 1)), device)(points)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_an_extent_whose_square_has_no_number(device: Device, scale: float) -> None:
    vertices, faces = meshes.box(0, 1)
    with pytest.raises(MeshError, match="scale the mesh"):
        TriangleDistance(mesh_of(vertices * scale, faces), device)


def test_no_points_and_no_faces(device: Device) -> None:
    assert TriangleDistance(mesh_of(*meshes.box(0, 1)), device)(np.empty((0, 3))).shape == (0,)
    with pytest.raises(MeshError, match="no faces"):
        TriangleDistance(mesh_of(np.zeros((3, 3)), np.empty((0, 3))), device)


def test_a_device_without_double_precision(device: Device, monkeypatch) -> None:
    """It does octrees and surfaces; a line says so where it cannot do the work."""
    monkeypatch.setattr(device, "info", replace(device.info, fp64=False))
    box = mesh_of(*meshes.box(0, 1))
    message = r"no double precision.*choose another device.*this one does octrees"
    with pytest.raises(DeviceError, match=message):
        TriangleDistance(box, device)
    for fill in ("parity", "nonzero", "flood"):
        octree = voxtool.voxelize(box, dim=16, fill=fill, device=device)
        assert len(voxtool.extract(octree, style="surface-nets", device=device).faces)
    with pytest.raises(DeviceError, match="which pictures need"):
        voxtool.render(octree, device=device)
    with pytest.raises(DeviceError, match="winding numbers need"):
        voxtool.voxelize(mesh_of(*meshes.open_box(0, (1, 1, 1))), dim=16, device=device)
