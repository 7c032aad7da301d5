"""Checking a surface: fans around vertices, handles, the volume inside, T-junctions.

The counts that `check_topology` makes by positions are tested in test_mesh.py.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from fractions import Fraction

import numpy as np
import pytest
from helpers import meshes, oracles
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import (
    SurfaceCheck,
    check_surface,
    check_topology,
    closed_chain,
    net_faces,
    volume,
    watertight,
)


def mesh_of(pair: tuple) -> Mesh:
    vertices, faces = pair
    return Mesh(np.asarray(vertices, np.float64), np.asarray(faces).astype(np.int32))


def quads(*corners: list) -> Mesh:
    """Rectangles (4, 3) as two triangles each; nothing is shared."""
    starts = 4 * np.arange(len(corners))[:, None, None]
    faces = (starts + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return mesh_of((np.concatenate(corners), faces))


CUBE = meshes.box(0, 2)
TORUS = meshes.torus(sides=(8, 6))
NO_MESH = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))

GOOD = {
    "watertight": True, "manifold": True, "boundary_edges": 0, "nonmanifold_edges": 0,
    "nonmanifold_vertices": 0, "inconsistent_edges": 0, "duplicate_faces": 0, "shells": 1,
}  # fmt: skip


def check(mesh: Mesh, weld: bool = True, **expected) -> SurfaceCheck:
    found = check_surface(mesh, weld=weld)
    assert watertight(mesh) == check_topology(mesh).watertight
    expected = GOOD | expected
    assert {key: found.as_dict()[key] for key in expected} == expected
    return found


# Manifolds


OPEN = {"watertight": False, "genus": None}
BAD = OPEN | {"manifold": False}
FAN = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]
MOEBIUS = [(i, (i + 1) % 5, (i + 2) % 5) for i in range(5)]  # five vertices, five triangles
POINTS, SOLID = meshes.tetrahedron()


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        (CUBE, {"genus": 0, "euler": 2}),
        (TORUS, {"genus": 1, "euler": 0}),
        (meshes.join(TORUS, (TORUS[0] + 9, TORUS[1]), CUBE), {"genus": 2, "shells": 3, "euler": 2}),
        (meshes.open_box(0, 1), OPEN | {"boundary_edges": 4, "euler": 1}),
        (  # a bow tie: two open fans at a vertex
            (FAN, [[0, 1, 2], [0, 3, 4]]),
            BAD | {"boundary_edges": 6, "nonmanifold_vertices": 1, "shells": 2},
        ),
        ((FAN, [[0, 1, 2], [0, 2, 3], [0, 3, 4]]), OPEN | {"boundary_edges": 5}),
        ((FAN, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]]), OPEN | {"boundary_edges": 4}),
        ((POINTS, [*SOLID[:3], SOLID[3, ::-1]]), BAD | {"inconsistent_edges": 3}),
        (
            (POINTS, [*SOLID, SOLID[0]]),
            BAD
            | {"duplicate_faces": 1, "nonmanifold_edges": 3, "nonmanifold_vertices": 3}
            | {"closed": False},
        ),
        # a pillow of two faces bounds nothing, but each vertex has a closed fan
        (
            (POINTS, [[0, 1, 2], [2, 1, 0]]),
            {"manifold": False, "duplicate_faces": 1, "genus": None},
        ),
        (
            (np.random.default_rng(1).random((5, 3)), MOEBIUS),
            BAD | {"boundary_edges": 5, "euler": 0, "inconsistent_edges": 5},
        ),
        ((CUBE[0], [*CUBE[1], [0, 0, 1], [2, 2, 2]]), {"genus": 0, "degenerate_faces": 2}),
    ],
)
def test_shapes(pair: tuple, expected: dict) -> None:
    check(mesh_of(pair), **expected)


def test_summaries() -> None:
    assert check(mesh_of(CUBE)).summary() == (
        "closed: 0 boundary edges, 0 non-manifold edges, 0 inconsistent edges, 0 duplicate faces, "
        "0 degenerate faces, 1 shell, Euler characteristic 2, 0 non-manifold vertices, genus 0"
    )
    found = check_surface(mesh_of(meshes.open_box(0, 1))).summary()
    assert found.startswith("not closed: 4 boundary edges, ")
    assert found.endswith(", 0 non-manifold vertices")


def test_a_soup_is_a_manifold_by_positions_alone() -> None:
    vertices, faces = TORUS
    soup = mesh_of((vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)))
    check(soup, genus=1)
    triangles = {"watertight": False, "boundary_edges": faces.size, "shells": len(faces)}
    check(soup, weld=False, genus=None, **triangles)
    assert check_topology(soup).closed
    assert not check_topology(soup, weld=False).closed
    assert check_topology(soup, weld=False).boundary_edges == faces.size


def test_two_cubes_that_share_a_vertex() -> None:
    pair = mesh_of(meshes.join(CUBE, meshes.box(2, 4)))
    found = check(
        pair, manifold=False, nonmanifold_vertices=1, genus=None, shells=2, watertight=True
    )
    assert found.summary().endswith(", 1 non-manifold vertex")
    check(pair, weld=False, genus=0, shells=2)


def test_two_cubes_that_share_an_edge() -> None:
    pair = mesh_of(meshes.join(CUBE, meshes.box([2, 2, 0], [4, 4, 2])))
    check(
        pair, manifold=False, watertight=False, nonmanifold_edges=1, nonmanifold_vertices=2,
        genus=None,
    )  # fmt: skip
    check(pair, weld=False, genus=0, shells=2)


def test_a_shell_that_meets_itself_in_a_vertex() -> None:
    """One shell: what is connected through edges may still be pinched."""
    vertices, faces = TORUS
    vertices = vertices.copy()
    vertices[3] = vertices[3 + 4 * 6]  # across the hole
    check(mesh_of((vertices, faces)), manifold=False, nonmanifold_vertices=1, genus=None, euler=-1)
    check(mesh_of((vertices, faces)), weld=False, genus=1)


def test_no_faces() -> None:
    for weld in (True, False):
        check(NO_MESH, weld, watertight=False, shells=0, euler=0, genus=None, faces=0)
    assert volume(NO_MESH) == 0
    assert closed_chain(NO_MESH)


def pinched_by_hand(faces: list[list[int]]) -> int:
    """Vertices whose link is not one path or circle, by dictionaries."""
    around: dict[int, list] = defaultdict(list)
    for f in faces:
        for a, b, c in zip(f, f[1:] + f[:1], f[2:] + f[:2], strict=True):
            around[a].append((b, c))
    bad = 0
    for arcs in around.values():
        degree = Counter(end for arc in arcs for end in arc)
        joined = {arcs[0][0]}
        while True:
            more = {e for arc in arcs for e in arc if joined & set(arc)} | joined
            if more == joined:
                break
            joined = more
        bad += max(degree.values()) > 2 or len(joined) < len(degree)
    return bad


@given(st.lists(st.permutations(range(6)), min_size=1, max_size=14))
@settings(max_examples=400, deadline=None)
def test_nonmanifold_vertices_equal_those_by_hand(rows: list[list[int]]) -> None:
    faces = [list(row[:3]) for row in rows]
    mesh = mesh_of((np.random.default_rng(2).random((6, 3)), np.array(faces)))
    for weld in (True, False):
        assert check_surface(mesh, weld=weld).nonmanifold_vertices == pinched_by_hand(faces)


@pytest.mark.parametrize("span", [1, 2, 3, 50])
@pytest.mark.parametrize("count", [0, 1, 2, 500])
def test_positions_are_numbered_in_their_order(count: int, span: int) -> None:
    points = np.random.default_rng(count).integers(-span, span, (count, 3)) * -0.5
    found = Mesh(points, np.zeros((0, 3), np.int32)).positions
    rising = sorted({(z, y, x) for x, y, z in points.tolist()})
    assert found.tolist() == [rising.index((z, y, x)) for x, y, z in points.tolist()]


SIDES = [list(side) for side in itertools.permutations(range(4), 3)]  # of a tetrahedron
WHOLE = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]


@given(st.lists(st.sampled_from([*SIDES, [0, 0, 1]]), max_size=6), st.booleans())
@settings(max_examples=400, deadline=None)
def test_watertight_is_what_a_diagnosis_says(more: list[list[int]], whole: bool) -> None:
    faces = np.array(WHOLE * whole + more).reshape(-1, 3)
    mesh = mesh_of((np.random.default_rng(2).random((4, 3)), faces))
    assert watertight(mesh) == check_topology(mesh).watertight


def test_a_check_holds_the_diagnosis() -> None:
    for pair in (CUBE, TORUS, meshes.open_box(0, 1)):
        for weld in (True, False):
            diagnosis = check_topology(mesh_of(pair), weld=weld)
            found = check_surface(mesh_of(pair), weld=weld)
            assert diagnosis.as_dict().items() <= found.as_dict().items()
            assert found.summary().startswith(diagnosis.summary())
            assert diagnosis.watertight == found.watertight


# Volume


@given(st.lists(st.permutations(range(4)).map(lambda p: p[:3]) | st.just([0, 0, 1]), min_size=1))
def test_net_faces_equal_those_by_hand(rows: list[list[int]]) -> None:
    points = np.random.default_rng(3).random((4, 3))
    soup = Mesh(
        points[rows].reshape(-1, 3), np.arange(3 * len(rows), dtype=np.int32).reshape(-1, 3)
    )
    some = net_faces(soup)
    triangles = soup.vertices[soup.faces]
    kept = triangles if some is None else triangles[some]
    expected, found = (oracles.boundary(oracles.counted(t)) for t in (triangles, kept))
    assert oracles.boundary(kept) == expected == found
    sets = [{frozenset(map(tuple, t)) for t in part.tolist()} for part in (triangles, kept)]
    assert sets[0] == sets[1]  # the surface stays


def test_volume_of_solids() -> None:
    assert volume(mesh_of(CUBE)) == 8
    assert volume(mesh_of((CUBE[0], CUBE[1][:, ::-1]))) == -8
    assert volume(mesh_of((CUBE[0] + 2.0**40, CUBE[1]))) == 8
    assert volume(mesh_of((CUBE[0] * 1e-6, CUBE[1]))) == pytest.approx(8e-18, rel=1e-14)
    vertices, faces = meshes.torus(sides=(200, 200))
    assert volume(mesh_of((vertices, faces))) == pytest.approx(4 * math.pi**2, rel=1e-3)


def test_volume_does_not_see_the_order_of_faces() -> None:
    vertices, faces = meshes.icosphere(3, (0.1, 0.2, 0.3))
    rng = np.random.default_rng(4)
    found = {volume(mesh_of((vertices, rng.permutation(faces)))) for _ in range(20)}
    assert len(found) == 1


@given(meshes.closed_meshes())
@settings(max_examples=50, deadline=None)
def test_volume_equals_the_exact_one(pair) -> None:
    vertices, faces = pair
    mesh = mesh_of((vertices * 0.1, faces))
    exact = Fraction(0)
    for f in mesh.vertices[mesh.faces].tolist():
        (a, b, c), (d, e, g), (h, i, j) = (map(Fraction, p) for p in f)
        exact += a * (e * j - g * i) + b * (g * h - d * j) + c * (d * i - e * h)
    assert volume(mesh) == pytest.approx(float(exact / 6), abs=1e-12 * np.ptp(mesh.vertices) ** 3)


# T-junctions


def t_cube() -> list:
    """A box of rectangles; its low z is two of them, whose common edge ends within others."""
    x, y, z = (np.array([0.1, 0.7, 1.3]), np.array([-0.0, 2.0]), np.array([-1.0, 0.0]))
    return [
        [[x[0], y[0], z[1]], [x[2], y[0], z[1]], [x[2], y[1], z[1]], [x[0], y[1], z[1]]],
        [[x[0], y[0], z[0]], [x[2], y[0], z[0]], [x[2], y[0], z[1]], [x[0], y[0], z[1]]],
        [[x[0], y[1], z[0]], [x[0], y[1], z[1]], [x[2], y[1], z[1]], [x[2], y[1], z[0]]],
        [[x[0], 0.0, z[0]], [x[0], y[0], -0.0], [x[0], y[1], z[1]], [x[0], y[1], z[0]]],
        [[x[2], y[0], z[0]], [x[2], y[1], z[0]], [x[2], y[1], z[1]], [x[2], y[0], z[1]]],
        [[x[0], y[0], z[0]], [x[0], y[1], z[0]], [x[1], y[1], z[0]], [x[1], y[0], z[0]]],
        [[x[1], y[0], z[0]], [x[1], y[1], z[0]], [x[2], y[1], z[0]], [x[2], y[0], z[0]]],
    ]


@pytest.mark.parametrize("turn", range(3))
def test_t_junctions_close_a_chain(turn: int) -> None:
    sides = [np.roll(side, turn, axis=1) for side in t_cube()]
    box = quads(*sides)
    check(box, watertight=False, boundary_edges=6, nonmanifold_vertices=0, genus=None)
    assert closed_chain(box)
    assert volume(box) == pytest.approx(1.2 * 2 * 1)
    for missing in range(7):
        assert not closed_chain(quads(*sides[:missing], *sides[missing + 1 :]))
        flipped = [s[::-1] if i == missing else s for i, s in enumerate(sides)]
        assert not closed_chain(quads(*flipped))
    moved = [s.copy() for s in sides]
    moved[6][:2, turn] += 1e-9  # a slit along the common edge
    assert not closed_chain(quads(*moved))


def test_closed_meshes_are_closed_chains() -> None:
    for pair in (CUBE, TORUS, meshes.tetrahedron(), meshes.join(CUBE, meshes.box([2, 2, 0], 4))):
        assert closed_chain(mesh_of(pair))
        for face in range(3):
            assert not closed_chain(mesh_of((pair[0], np.delete(pair[1], face, axis=0))))
            turned = pair[1].copy()
            turned[face] = turned[face, ::-1]
            assert not closed_chain(mesh_of((pair[0], turned)))


def test_edges_of_many_faces_cancel_by_direction() -> None:
    """Not parity: four faces on an edge cancel if two run along it each way."""
    assert closed_chain(mesh_of(meshes.join(CUBE, meshes.box([2, 2, 0], [4, 4, 2]))))
    twice = mesh_of((CUBE[0], np.vstack([CUBE[1], CUBE[1]])))
    assert closed_chain(twice)  # all of it is doubled
    sheet = meshes.open_box(0, 1)
    assert not closed_chain(mesh_of(meshes.join(sheet, sheet)))
    assert check_topology(mesh_of(meshes.join(sheet, sheet))).even
    assert closed_chain(mesh_of(meshes.join(sheet, (sheet[0], sheet[1][:, ::-1]))))


def test_junctions_off_the_axes_are_open() -> None:
    """Exact on any line, but only lines along the axes are looked at."""
    sides = [np.array(side, float) @ [[1, 1, 0], [-1, 1, 0], [0, 0, 1]] for side in t_cube()]
    assert check_surface(quads(*sides)).boundary_edges == 6
    assert not closed_chain(quads(*sides))


def chain_by_hand(mesh: Mesh) -> bool:
    """The definition: along every line, the running sum of directed edges is zero between
    positions; edges off the axes must cancel in pairs."""
    lines: dict = defaultdict(Counter)
    pairs: Counter = Counter()
    for f in (mesh.vertices + 0.0)[mesh.faces].tolist():
        for p, q in itertools.pairwise([*f, f[0]]):
            axes = [i for i in range(3) if p[i] != q[i]]
            if len(axes) == 1:
                line = (axes[0], *(p[i] for i in range(3) if i != axes[0]))
                lines[line][p[axes[0]]] += 1
                lines[line][q[axes[0]]] -= 1
            elif axes:
                pairs[tuple(p), tuple(q)] += 1
    for ends in lines.values():
        running = list(itertools.accumulate(n for _, n in sorted(ends.items())))
        if any(running):
            return False
    return all(n == pairs[q, p] for (p, q), n in list(pairs.items()))


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_chains_equal_those_by_hand(data: st.DataObject) -> None:
    """Boxes of rectangles cut at random, one of them perhaps missing or flipped."""
    sides = []
    for _ in range(data.draw(st.integers(1, 2))):
        low = np.array(data.draw(st.tuples(*[st.integers(0, 2)] * 3)))
        high = low + data.draw(st.tuples(*[st.integers(1, 3)] * 3))
        for axis, end in itertools.product(range(3), (0, 1)):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            cut = data.draw(st.integers(low[u], high[u]))
            for a, b in ((low[u], cut), (cut, high[u])):
                side = np.empty((4, 3))
                side[:, axis] = (low, high)[end][axis]
                side[:, u], side[:, v] = [a, b, b, a], [low[v], low[v], high[v], high[v]]
                sides.append(side if end else side[::-1])
    change = data.draw(st.sampled_from(["", "", "missing", "flipped", "moved"]))
    one = data.draw(st.integers(0, len(sides) - 1))
    if change == "missing":
        del sides[one]
    elif change == "flipped":
        sides[one] = sides[one][::-1]
    elif change == "moved":
        sides[one][0, 0] += 1
    mesh = quads(*sides)
    assert closed_chain(mesh) == chain_by_hand(mesh)
    if not change:
        assert closed_chain(mesh)
