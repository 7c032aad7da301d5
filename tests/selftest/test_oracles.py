"""The oracles themselves: cases counted by hand, and what must hold between them."""

from itertools import permutations, product

import numpy as np
import pytest
from helpers import meshes
from helpers.oracles import (
    active_nodes,
    expected_octree_nodes,
    solid,
    surface6,
    surface26,
    to_dense,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.selftest import shapes

SHAPE = (8, 8, 8)


def cells(x, y, z):
    return set(product(x, y, z))


def test_triangle_in_a_lattice_plane():
    # y + z <= 6 in the plane x = 3
    triangle = meshes.fixed([(3, 0, 0), (3, 6, 0), (3, 0, 6)])[None]
    touched = surface26(triangle, SHAPE)
    assert touched == {
        (i, j, k)
        for i in (2, 3)
        for j in range(8)
        for k in range(8)
        if j + k <= 6 and max(j, k) < 7
    }
    # moved centres with y + z <= 6 and half a voxel more across the edge, in 2-D: j + k + 1 < 7
    assert surface6(triangle, SHAPE) == {
        (2, j, k) for j in range(6) for k in range(6) if j + k <= 5
    }


@pytest.mark.parametrize("axis", range(3))
def test_square_in_a_lattice_plane(axis):
    corners = np.array([(3, 1, 2), (3, 5, 2), (3, 5, 4), (3, 1, 4)])
    quad = meshes.fixed(np.roll(corners, axis, axis=1))[[(0, 1, 2), (0, 2, 3)]]
    thick = cells(*np.roll(np.array([(2, 3), range(6), range(1, 5)], object), axis))
    thin = cells(*np.roll(np.array([(2,), range(5), range(1, 4)], object), axis))
    assert surface26(quad, SHAPE) == thick
    assert surface6(quad, SHAPE) == thin


@pytest.mark.parametrize(
    ("point", "thick", "thin"),
    [
        ((3, 4, 5), cells((2, 3), (3, 4), (4, 5)), {(2, 3, 4)}),
        ((3.5, 4.5, 5.5), {(3, 4, 5)}, {(3, 4, 5)}),
        ((3, 4.5, 5), cells((2, 3), (4,), (4, 5)), {(2, 4, 4)}),
        ((0, 0, 0), {(0, 0, 0)}, set()),
        ((8, 8, 8), {(7, 7, 7)}, {(7, 7, 7)}),
        ((8.5, 1, 1), set(), set()),
    ],
)
def test_point(point, thick, thin):
    triangle = meshes.fixed([point] * 3)[None]
    assert surface26(triangle, SHAPE) == thick
    assert surface6(triangle, SHAPE) == thin
    assert solid(triangle, SHAPE) == set()


@pytest.mark.parametrize("axis", range(3))
def test_segment_along_lattice_edges(axis):
    ends = meshes.fixed(np.roll([(1, 3, 4), (4, 3, 4)], axis, axis=1))
    around = [range(5), (2, 3), (3, 4)]
    lower = [range(4), (2,), (3,)]
    for order in [(0, 0, 1), (0, 1, 0), (1, 0, 0), (1, 1, 0)]:
        triangle = ends[list(order)][None]
        assert surface26(triangle, SHAPE) == cells(*(around[(a - axis) % 3] for a in range(3)))
        assert surface6(triangle, SHAPE) == cells(*(lower[(a - axis) % 3] for a in range(3)))


def test_diagonal_through_lattice_corners():
    """A segment along x = y = z meets the cubes of its diagonal and their neighbours at corners."""
    triangle = meshes.fixed([(1, 1, 1), (3, 3, 3), (3, 3, 3)])[None]
    assert surface26(triangle, SHAPE) == set.union(*(cells(*[(c - 1, c)] * 3) for c in (1, 2, 3)))


def test_a_hair_is_enough():
    """One unit beside the lattice plane the voxels of only one side touch."""
    triangle = np.array([[(769, 100, 100), (769, 300, 100), (769, 100, 300)]])
    assert {i for i, _, _ in surface26(triangle, SHAPE)} == {3}
    assert {i for i, _, _ in surface6(triangle, SHAPE)} == {3}
    assert {i for i, _, _ in surface6(triangle - [1, 0, 0], SHAPE)} == {2}
    # and far from its corners, the edge from (0, 0, 1) to (2**30, 2**30, 0) is still above 0
    far = 1 << 30
    needle = [[(0, 0, 1), (far, far, 0), (far, far, 0)]]
    assert (3, 3, 0) in surface26(needle, SHAPE)
    assert (3, 4, 0) in surface26(needle, SHAPE)  # it touches in the point (4, 4)
    assert (3, 5, 0) not in surface26(needle, SHAPE)


@pytest.mark.parametrize("order", list(permutations(range(3))))
@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (2, 6, range(2, 6)),
        (2.5, 6.5, range(2, 6)),  # a centre on the low side is in, on the high out
        (2.50390625, 6.50390625, range(3, 7)),
        (-5, 3, range(3)),  # crossings before the grid count
        (-100, 100, range(8)),
        (9, 12, range(0)),
    ],
)
def test_solid_box(order, low, high, expected):
    """The same voxels for any order of the axes and any winding of the faces."""
    vertices, faces = meshes.box(low, high)
    triangles = meshes.fixed(vertices[:, order])[faces]
    mixed = triangles.copy()
    mixed[::3] = mixed[::3, ::-1]
    for turned in (triangles, triangles[:, ::-1], np.roll(triangles, 1, axis=1), mixed):
        assert solid(turned, SHAPE) == cells(*[expected] * 3)


@pytest.mark.parametrize(("missing", "columns"), [(0, range(6, 8)), (1, range(2, 8))])
def test_solid_of_an_open_box_reaches_to_the_end(missing, columns):
    vertices, faces = meshes.open_box(2, 6, missing)
    assert solid(meshes.fixed(vertices)[faces], SHAPE) == cells(columns, range(2, 6), range(2, 6))


def test_two_shells_are_a_hollow():
    hollow = meshes.join(meshes.box(1, 7), meshes.box(3, 5))
    full = solid(meshes.fixed(hollow[0])[hollow[1]], SHAPE)
    assert full == cells(*[range(1, 7)] * 3) - cells(*[range(3, 5)] * 3)


@pytest.mark.parametrize(
    ("x", "surface_nodes", "solid_nodes"),
    [
        (7, {0}, {0}),
        (7.49609375, {0}, {0}),
        (7.5, {0}, {0, 1}),
        (8, {0, 1}, {0, 1}),
        (8.5, {1}, {0, 1}),
        (8.50390625, {1}, {1}),
        (-0.5, set(), {0}),
        (16.5, {2}, {1, 2}),
        (24, {2}, {2}),
        (24.5, set(), {2}),
        (25, set(), set()),
    ],
)
def test_active_nodes(x, surface_nodes, solid_nodes):
    triangle = meshes.fixed([(x, 1, 1), (x, 3, 1), (x, 1, 3)])[None]
    shape = (17, 9, 8)
    assert active_nodes(triangle, shape, False) == cells(surface_nodes, (0,), (0,))
    assert active_nodes(triangle, shape, True) == cells(solid_nodes, (0,), (0,))
    across = triangle[..., [1, 0, 2]]  # only x is wider
    expected = cells((0,), surface_nodes & {0, 1}, (0,))
    assert active_nodes(across, (8, 9, 8), False) == expected
    assert active_nodes(across, (8, 9, 8), True) == expected


def test_octree_nodes_of_the_contract():
    # 16 x 16 x 16 of 32: one leaf of level 2 inside, its seven sisters outside
    nodes = expected_octree_nodes(set(), to_dense(cells(*[range(16)] * 3), (32, 32, 32)))
    assert nodes.refined == {1: set(), 2: set(), 3: {(0, 0, 0)}}
    assert nodes.inside == {1: set(), 2: {(0, 0, 0)}, 3: set()}
    # an active node is refined although it is full, and so are those above it
    nodes = expected_octree_nodes({(3, 0, 2)}, np.ones((32, 32, 32), bool))
    assert nodes.refined == {1: {(3, 0, 2)}, 2: {(1, 0, 1)}, 3: {(0, 0, 0)}}
    assert nodes.inside[1] == cells((2, 3), (0, 1), (2, 3)) - {(3, 0, 2)}
    assert nodes.inside[2] == cells(*[(0, 1)] * 3) - {(1, 0, 1)}
    assert nodes.inside[3] == set()
    # beyond the grid's shape no voxel is set, so a full grid that is no power of two is mixed
    nodes = expected_octree_nodes(set(), np.ones((9, 8, 8), bool))
    assert nodes.refined == {1: {(1, 0, 0)}, 2: {(0, 0, 0)}}
    assert nodes.inside == {1: {(0, 0, 0)}, 2: set()}
    assert expected_octree_nodes(set(), np.ones(SHAPE, bool)) == ({1: set()}, {1: {(0, 0, 0)}})
    assert expected_octree_nodes(set(), np.zeros(SHAPE, bool)) == ({1: set()}, {1: set()})


@settings(deadline=None, max_examples=60)
@given(meshes.fixed_triangles((9, 7, 8)), st.data())
def test_surfaces_of_loose_triangles(mesh, data):
    vertices, faces = mesh
    shape = (9, 7, 8)
    thick = surface26(vertices[faces], shape)
    thin = surface6(vertices[faces], shape)
    assert thin <= thick
    for i, j, k in thick:
        assert (i // 8, j // 8, k // 8) in active_nodes(vertices[faces], shape, False)
    # neither the order of the vertices nor of the faces matters
    for order in permutations(range(3)):
        assert surface6(vertices[faces[::-1, order]], shape) == thin
    assert surface26(vertices[faces[::-1, ::-1]], shape) == thick
    assert solid(vertices[faces[::-1, ::-1]], shape) == solid(vertices[faces], shape)
    # every point of a triangle lies in a voxel of the thick surface, if in the grid
    weights = st.integers(0, 16).flatmap(lambda s: st.tuples(st.just(s), st.integers(0, 16 - s)))
    s, t = data.draw(weights)
    point = (vertices[faces] * np.array([16 - s - t, s, t])[:, None]).sum(axis=1)  # 1/4096 voxel
    for cell in point // 4096:
        if (cell >= 0).all() and (cell < shape).all():
            assert tuple(cell.tolist()) in thick


@settings(deadline=None, max_examples=40)
@given(meshes.fixed_triangles(SHAPE, reach=1 << 14), st.permutations(range(3)))
def test_thick_surface_has_no_favourite_axis(mesh, order):
    triangles = mesh[0][mesh[1]]
    turned = {tuple(cell[a] for a in order) for cell in surface26(triangles, SHAPE)}
    assert surface26(triangles[..., order], SHAPE) == turned


@settings(deadline=None, max_examples=60)
@given(meshes.closed_meshes(SHAPE))
def test_thin_surface_of_a_closed_mesh_separates(mesh):
    """No two voxels that share a side are one in and one out, and both off the thin surface."""
    vertices, faces = mesh
    full = to_dense(solid(vertices[faces], SHAPE), SHAPE)
    thin = to_dense(surface6(vertices[faces], SHAPE), SHAPE)
    for axis in range(3):
        a, b = (np.moveaxis(full, axis, 0)[s] for s in (slice(1, None), slice(-1)))
        p, q = (np.moveaxis(thin, axis, 0)[s] for s in (slice(1, None), slice(-1)))
        assert not ((a != b) & ~p & ~q).any()


@settings(deadline=None, max_examples=60)
@given(meshes.closed_meshes(SHAPE))
def test_solid_of_a_closed_mesh(mesh):
    """Moved by whole voxels it is the same, and from the far side it has the same parity."""
    vertices, faces = mesh
    full = solid(vertices[faces], SHAPE)
    wider = tuple(n + 8 for n in SHAPE)
    moved = solid(vertices[faces] + 4 * 256, wider)
    assert {(i - 4, j - 4, k - 4) for i, j, k in moved} & cells(*map(range, SHAPE)) == full
    # a long row ends outside: after the last crossing the parity is even
    long = (SHAPE[0] + 4, *SHAPE[1:])
    assert {cell for cell in solid(vertices[faces], long) if cell[0] == long[0] - 1} == set()


@settings(deadline=None, max_examples=40)
@given(meshes.closed_meshes((16, 16, 8)))
def test_nodes_of_a_closed_mesh(mesh):
    """A node that no triangle touches is all in or all out."""
    triangles, shape = mesh[0][mesh[1]], (16, 16, 8)
    nodes = active_nodes(triangles, shape, True)
    assert active_nodes(triangles, shape, False) <= nodes
    assert (
        expected_octree_nodes(nodes, to_dense(solid(triangles, shape), shape)).refined[1] == nodes
    )


@pytest.mark.parametrize(
    ("mesh", "euler"),
    [
        (meshes.box((1, 2, 3), (4, 6, 8)), 2),
        (meshes.tetrahedron(), 2),
        (meshes.tetrahedron((1, 1, 1), (1, 5, 1), (5, 1, 1), (1, 1, 5)), 2),
        (meshes.octahedron((4, 4, 4), 3), 2),
        (meshes.subdivide(meshes.box(0, 4)), 2),
        (meshes.icosphere(3, (1, 2, 3), 2.0), 2),
        (meshes.torus((4, 4, 4), 2.0, 1.0), 0),
        *((shapes.ball(level), 2) for level in (0, 1, 3)),
    ],
)
def test_makers_make_closed_outward_meshes(mesh, euler):
    vertices, faces = mesh
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 1).all()  # each edge once each way
    assert np.array_equal(there, np.unique(edges[:, ::-1], axis=0))
    assert len(vertices) - len(edges) // 2 + len(faces) == euler
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    assert (np.cross(a, b) * c).sum() > 0
