"""The example mesh: closed, manifold, outward, and the same file on every machine."""

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow
SCRIPT = Path(__file__).parents[2] / "examples" / "make_bunny.py"
GOLDEN = "4ed00535ee5ae830ed83661f190ad5295ec88743e14226235b5b1a763512a256"


def make(path, *options):
    subprocess.run([sys.executable, SCRIPT, "-o", path, *options], check=True, capture_output=True)
    return path.read_bytes()


def parse(text):
    rows = [line.split() for line in text.decode("ascii").splitlines()]
    vertices = np.array([row[1:] for row in rows if row[0] == "v"], np.float64)
    return vertices, np.array([row[1:] for row in rows if row[0] == "f"], np.int64) - 1


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    return make(tmp_path_factory.mktemp("bunny") / "bunny.obj")


@pytest.fixture(scope="module")
def mesh(text):
    return parse(text)


def directed_edges(faces):
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def check_closed_surface(vertices, faces):
    """Every edge runs once each way, and the faces around every vertex are one fan."""
    edges = directed_edges(faces)
    there, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 1).all()
    assert np.array_equal(there, np.unique(edges[:, ::-1], axis=0))
    assert np.array_equal(np.unique(faces), np.arange(len(vertices)))
    # a walk from face to face around each vertex comes back after all of them
    tips, left, right = (np.roll(faces, -turn, axis=1).ravel().tolist() for turn in range(3))
    follow = dict(zip(zip(tips, left, strict=True), right, strict=True))
    valence = np.bincount(tips).tolist()
    for tip, first in dict(zip(tips, left, strict=True)).items():
        at, steps = follow[tip, first], 1
        while at != first:
            at, steps = follow[tip, at], steps + 1
        assert steps == valence[tip]


def euler_number(vertices, faces):
    return len(vertices) - len(directed_edges(faces)) // 2 + len(faces)


def test_closed_manifold_of_genus_0(mesh):
    check_closed_surface(*mesh)
    assert euler_number(*mesh) == 2


def test_one_piece(mesh):
    vertices, faces = mesh
    a, b = directed_edges(faces).T
    reached = np.zeros(len(vertices), bool)
    reached[0] = True
    count = 0
    while count != (count := np.count_nonzero(reached)):
        reached[b[reached[a]]] = True
    assert reached.all()


def test_outward(mesh):
    a, b, c = np.moveaxis(mesh[0][mesh[1]], 1, 0)
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(1.05, abs=0.05)


def test_size(mesh):
    vertices, faces = mesh
    assert 65_000 <= len(faces) <= 75_000
    assert np.ptp(vertices[:, 1]) == pytest.approx(2.32, abs=0.02)


def test_no_vertices_coincide_and_no_face_is_degenerate(mesh):
    vertices, faces = mesh
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    a, b, c = np.moveaxis(np.rint(vertices[faces] * 1e6).astype(np.int64), 1, 0)
    assert np.cross(b - a, c - a).any(axis=1).all()


def test_same_file_everywhere(text, tmp_path):
    assert make(tmp_path / "again.obj") == text
    assert hashlib.sha256(text).hexdigest() == GOLDEN


@pytest.mark.parametrize("triangles", [2_000, 9_000, 200_000])
def test_other_sizes(triangles, tmp_path):
    vertices, faces = parse(make(tmp_path / "other.obj", "--triangles", str(triangles)))
    check_closed_surface(vertices, faces)
    assert euler_number(vertices, faces) == 2
    assert len(faces) == pytest.approx(triangles, rel=0.1)
    assert len(np.unique(vertices, axis=0)) == len(vertices)


def test_refuses_too_few_triangles(tmp_path):
    command = [sys.executable, SCRIPT, "-o", tmp_path / "none.obj", "--triangles", "10"]
    assert subprocess.run(command, capture_output=True).returncode == 2
    assert not list(tmp_path.iterdir())
