"""Boundary loops against traces by dictionaries, and the tubes that show them."""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict

import numpy as np
import pytest
from conftest import model
from helpers import meshes
from helpers.meshes import mesh_of
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.files.meshes.mesh import load_mesh
from voxtool.mesh.loops import Loops, find_loops, tubes
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import check_surface, topology_of, volume


def points(n: int) -> np.ndarray:
    return np.random.default_rng(n).random((n, 3))


def loops_of(mesh: Mesh) -> Loops:
    loops = find_loops(mesh, topology_of(mesh))
    check(mesh, loops)
    return loops


def split(loops: Loops, array: np.ndarray) -> list[np.ndarray]:
    return np.split(array, loops.starts[1:-1])


def check(mesh: Mesh, loops: Loops) -> None:
    """Check the invariants of the loops of any mesh."""
    count = Counter(frozenset(edge) for edge in all_edges(mesh))
    found = Counter(frozenset(edge) for edge in loops.edges.tolist())
    assert found == Counter({edge for edge, n in count.items() if n == 1})
    corners = mesh.faces.tolist()
    for face, (a, b) in zip(loops.faces.tolist(), loops.edges.tolist(), strict=True):
        f = corners[face]
        assert (a, b) in list(zip(f, f[1:] + f[:1], strict=True))  # along its face
    assert loops.starts[-1] == len(loops.edges)
    assert len(loops.closed) == len(loops.lengths) == len(loops.sizes) == len(loops.starts) - 1
    assert (np.diff(loops.lengths) <= 0).all()
    for number, edges in enumerate(split(loops, loops.edges) if len(loops.closed) else []):
        sets = [set(edge) for edge in edges.tolist()]
        for one, other in itertools.pairwise(sets):
            assert one & other
        if loops.closed[number]:
            assert sets[-1] & sets[0]
            degree = Counter(v for edge in sets for v in edge)
            assert all(n % 2 == 0 for n in degree.values())
        ends = mesh.vertices[edges]
        length = math.fsum(math.dist(*pair) for pair in ends.tolist())
        assert loops.lengths[number] == pytest.approx(length, rel=1e-13)
        assert (loops.low[number] == ends.min(axis=(0, 1))).all()
        assert (loops.high[number] == ends.max(axis=(0, 1))).all()


def all_edges(mesh: Mesh) -> list[tuple[int, int]]:
    return [
        pair for f in mesh.faces.tolist() for pair in zip(f, f[1:] + f[:1], strict=True)
        if len(set(f)) == 3
    ]  # fmt: skip


def test_open_box() -> None:
    loops = loops_of(mesh_of(*meshes.open_box(0, (4, 3, 2))))
    assert loops.sizes.tolist() == [4]
    assert loops.lengths.tolist() == [14]
    assert loops.closed.tolist() == [True]
    assert loops.low.tolist() == [[0, 0, 2]]
    assert loops.high.tolist() == [[4, 3, 2]]


def test_no_boundary_and_no_faces() -> None:
    empty = mesh_of(np.zeros((0, 3)), np.zeros((0, 3)))
    for mesh in (mesh_of(*meshes.torus()), empty):
        loops = loops_of(mesh)
        assert loops.starts.tolist() == [0]
        assert loops.edges.shape == (0, 2)
        assert loops.low.shape == (0, 3)
        assert len(tubes(mesh.vertices[loops.edges], 1.0).faces) == 0


def test_the_longest_loop_is_first() -> None:
    """A tube without its ends, of which one is narrower."""
    n = 8
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    i, j = np.arange(n), (np.arange(n) + 1) % n
    wall = np.concatenate([np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)])
    loops = loops_of(mesh_of(np.concatenate([ring, 3 * ring + [0, 0, 5]]), wall))
    side = 2 * math.sin(math.pi / n)
    assert loops.lengths == pytest.approx([3 * n * side, n * side])
    assert loops.low[:, 2].tolist() == [5, 0]


def test_seams_are_no_boundary() -> None:
    """Vertices at one position are one, though the loop names the vertices of its faces."""
    vertices, faces = meshes.open_box(0, 1)
    soup = mesh_of(vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))
    loops = find_loops(soup, topology_of(soup))
    assert loops.sizes.tolist() == [4]
    assert loops.lengths.tolist() == [4]
    assert (soup.vertices[loops.edges][..., 2] == 1).all()


def test_loops_that_touch_stay_apart() -> None:
    """Two squares with a common corner; two holes of a plane with a common corner."""
    bow = mesh_of(points(5), [[0, 1, 2], [0, 3, 4]])
    assert loops_of(bow).sizes.tolist() == [3, 3]

    side = 5
    x, y = np.indices((side, side)).reshape(2, -1)
    grid = np.stack([x, y, 0 * x], axis=1)
    at = [
        (i * side + j, (i + 1) * side + j, (i + 1) * side + j + 1, i * side + j + 1)
        for i in range(side - 1)
        for j in range(side - 1)
        if (i, j) not in ((1, 1), (2, 2))
    ]
    faces = [face for a, b, c, d in at for face in ((a, b, c), (a, c, d))]
    rng = np.random.default_rng(3)
    for _ in range(20):  # in whatever order and from whatever corner the faces are given
        turned = np.array([np.roll(face, rng.integers(3)) for face in rng.permutation(faces)])
        loops = loops_of(mesh_of(grid, turned))
        # in the common corner two fans meet, so each hole's boundary turns around a fan
        assert sorted(loops.sizes.tolist()) == [8, 16]
        assert loops.closed.all()


def test_a_book_of_three_pages() -> None:
    """The ends of an edge of three faces: two pages are joined, and one chain is left."""
    book = mesh_of(points(5), [[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    loops = loops_of(book)
    assert loops.sizes.sum() == 6
    assert sorted(loops.closed.tolist()) == [False, True]


def fan_pairs(mesh: Mesh) -> list[tuple[int, int, bool]]:
    """Boundary edges that follow each other about a vertex, found by turning from face to face; and
    whether an edge of more than two faces was met at either."""
    faces_at = defaultdict(list)
    for number, f in enumerate(mesh.faces.tolist()):
        for a, b in zip(f, f[1:] + f[:1], strict=True):
            faces_at[frozenset((a, b))].append(number)
    border = [edge for edge, faces in faces_at.items() if len(faces) == 1]
    pairs = []
    for edge in border:
        for vertex in edge:
            face, now = faces_at[edge][0], edge
            while True:
                (last,) = set(mesh.faces[face].tolist()) - now
                now = frozenset((vertex, last))
                if len(faces_at[now]) != 2:
                    break
                (face,) = [f for f in faces_at[now] if f != face] or [face]
            pairs.append((edge, now, len(faces_at[now]) == 1))
    return pairs


@given(
    st.lists(
        st.permutations(range(7)), min_size=1, max_size=12, unique_by=lambda r: tuple(sorted(r[:3]))
    )
)
@settings(max_examples=400)
def test_loops_follow_the_fans(rows) -> None:
    mesh = mesh_of(points(7), [row[:3] for row in rows])
    loops = loops_of(mesh)
    loop_of = {}
    if len(loops.closed):
        for number, edges in enumerate(split(loops, loops.edges)):
            loop_of |= {frozenset(edge): number for edge in edges.tolist()}
    root = {edge: edge for edge in loop_of}

    def find(edge):
        while root[edge] != edge:
            edge = root[edge]
        return edge

    pairs = fan_pairs(mesh)
    for one, other, joined in pairs:
        if joined:
            assert loop_of[one] == loop_of[other]
            root[find(one)] = find(other)
    if all(joined for _, _, joined in pairs):
        assert len({find(edge) for edge in root}) == len(loops.closed)
        assert loops.closed.all()


def by_hand(mesh: Mesh) -> list[float]:
    """Lengths of loops on a mesh without vertices in which loops touch, the longest first."""
    numbers = {}
    at = [numbers.setdefault(tuple(p), len(numbers)) for p in (mesh.vertices + 0.0).tolist()]
    where = {number: place for place, number in numbers.items()}
    edges = {(at[a], at[b]) for a, b in all_edges(mesh)}
    following = {}
    for a, b in edges:
        if (b, a) not in edges:
            assert a not in following
            following[a] = b
    lengths = []
    while following:
        first, now = following.popitem()
        parts = [math.dist(where[first], where[now])]
        while now != first:
            after = following.pop(now)
            parts.append(math.dist(where[now], where[after]))
            now = after
        lengths.append(math.fsum(parts))
    return sorted(lengths, reverse=True)


@pytest.mark.parametrize(("name", "sizes"), [("stanford-bunny.obj", [80, 42, 40, 39, 22]),
                                             ("spot.obj", [])])  # fmt: skip
def test_models(name: str, sizes: list[int]) -> None:
    mesh = load_mesh(model(name))
    loops = find_loops(mesh, topology_of(mesh))
    assert loops.sizes.tolist() == sizes
    assert loops.closed.all()
    assert loops.lengths == pytest.approx(by_hand(mesh), rel=1e-12)


# Tubes


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_tubes(scale: float) -> None:
    ends = scale * np.random.default_rng(1).normal(size=(50, 2, 3))
    ends[:3, 1] = ends[:3, 0] + scale * np.eye(3)  # along the axes
    made = tubes(ends, 0.01 * scale)
    assert made.vertices.shape == (300, 3)
    assert made.faces.shape == (400, 3)
    found = check_surface(made)
    assert found.watertight
    assert found.shells == 50
    assert found.genus == 0
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    area = 3 * math.sqrt(3) / 4 * (0.01 * scale) ** 2
    assert volume(made) == pytest.approx(area * length.sum(), rel=1e-9)
    corners = made.vertices.reshape(50, 2, 3, 3)
    away = np.linalg.norm(corners - ends[:, :, None], axis=-1)
    assert away == pytest.approx(np.full(away.shape, 0.01 * scale), rel=1e-6)
