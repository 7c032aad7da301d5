"""OFF and STL: the same meshes as trimesh reads, and errors that name the place."""

from __future__ import annotations

import io
import re

import meshes
import numpy as np
import pytest
import trimesh

from voxtool import load_mesh
from voxtool.errors import MeshError
from voxtool.files import numbers, off, stl
from voxtool.mesh.mesh import Mesh


def read(data: bytes, kind: str) -> Mesh:
    return load_mesh(io.BytesIO(data), kind)


def refusal(data: bytes, kind: str) -> str:
    with pytest.raises(MeshError) as caught:
        read(data, kind)
    assert str(caught.value).isprintable()
    return str(caught.value)


def solid(seed: int = 0) -> trimesh.Trimesh:
    vertices, faces = meshes.icosphere(2)
    vertices = vertices * np.random.default_rng(seed).uniform(0.5, 1.5, (len(vertices), 1))
    return trimesh.Trimesh(vertices, faces, process=False)


def theirs(data: bytes, kind: str) -> trimesh.Trimesh:
    mesh = trimesh.load(io.BytesIO(data), kind, process=False, maintain_order=True)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def assert_same(mesh: Mesh, other: trimesh.Trimesh) -> None:
    assert np.array_equal(mesh.vertices, other.vertices)
    assert np.array_equal(mesh.faces, other.faces)


# ---- OFF


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\n\n", b" # comment, 1 2 3\n", b"\t \n"])
@pytest.mark.parametrize("block", [1, 700, 1 << 21])
def test_off_is_as_trimesh_reads_it(end: bytes, block: int, monkeypatch) -> None:
    monkeypatch.setattr(numbers.blocks_of, "__defaults__", (0, block))
    data = solid().export(file_type="off", digits=17).encode().rstrip() + b"\n"
    assert_same(read(data.replace(b"\n", end), "off"), theirs(data, "off"))
    assert_same(read(data.rstrip(), "off"), theirs(data, "off"))


def test_off_with_polygons_colours_and_normals() -> None:
    rows = b"0 0 0 9 9 9\n1 0 0 9 9 9\n1 1 0 9 9 9\n\n0 1 0 9 9 9\n.5 -1e-1 +2. 9 9 9\n"
    faces = b"3 0 1 4 255 0 0\n5 0 1 2 3 4 0.5 0.25 1\n2 0 1\n4 3 2 1 0\n"
    mesh = read(b"# by hand\n CNOFF # colours\n 5 4 0\n" + rows + faces, "off")
    assert mesh.vertices.tolist()[4] == [0.5, -0.1, 2]
    fans = [[0, 1, 4], [0, 1, 2], [0, 2, 3], [0, 3, 4], [3, 2, 1], [3, 1, 0]]
    assert mesh.faces.tolist() == fans
    assert read(b"OFF 3 1\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2", "off").faces.tolist() == [[0, 1, 2]]


OFF = b"OFF\n# three\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"OFF", b"OFF BINARY", "not readable as OFF: it does not begin with OFF and the numbers"),
        (b"OFF", b"4OFF", "not readable as OFF"),
        (b"3 1 0", b"3 x 0", "not readable as OFF"),
        (b"3 1 0", b"4 1 0", "3 vertices|line 8|4 vertices"),
        (b"3 1 0", b"3 2 0", "3 vertices and 1 faces where the header promises 3 and 2"),
        (b"3 1 0", b"3 999 0", "cannot hold the 3 vertices and 999 faces"),
        (b"1 0 0\n", b"1 nan 0\n", "line 5: 'nan' is not a number"),
        (b"1 0 0\n", b"1 0-1 0\n", "line 5: '0-1' is not a number"),
        (b"1 0 0\n", b"1 0 0 \v\n", r"line 5: '.x0b' is not a number"),
        (b"1 0 0\n", b"1 1e999 0\n", "vertex 1 is not finite"),
        (b"1 0 0\n", b"1 0\n", "line 5: a vertex of 2 numbers where 3 are needed"),
        (b"3 0 1 2", b"4 0 1 2", "line 7: a face of 4 vertices names 3"),
        (b"3 0 1 2", b"2.5 0 1 2", "line 7: a face of 2.5 vertices"),
        (b"3 0 1 2", b"-3 0 1 2", "line 7: a face of -3 vertices"),
        (b"3 0 1 2", b"1e999 0 1 2", "line 7: a face of inf vertices"),
        (b"3 0 1 2", b"3 0 1 1e999", "line 7: the face names vertex inf"),
        (b"3 0 1 2", b"1e300 0 1 2", r"line 7: a face of 1e\+300 vertices"),
        (b"3 0 1 2", b"3 0 1 3", "line 7: the face names vertex 3 where there are 3, counted from"),
        (b"3 0 1 2", b"3 0 1 1.5", "line 7: the face names vertex 1.5"),
        (b"3 0 1 2", b"3 0 1 -1", "line 7: the face names vertex -1"),
    ],
)
def test_off_refusals(old: bytes, new: bytes, message: str) -> None:
    assert len(read(OFF, "off").faces) == 1
    assert old in OFF
    with np.errstate(all="raise"):
        assert re.search(message, refusal(OFF.replace(old, new), "off"))


# ---- STL


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl_is_as_trimesh_reads_it(kind: str) -> None:
    data = solid().export(file_type=kind)
    data = data.encode() if isinstance(data, str) else data
    assert_same(read(data, "stl"), theirs(data, "stl"))
    assert (len(data) == stl.binary_size(data)) == (kind == "stl")


@pytest.mark.parametrize("block", [1, 700, 1 << 21])
def test_stl_of_several_solids_in_any_letters(block: int, monkeypatch) -> None:
    monkeypatch.setattr(numbers.blocks_of, "__defaults__", (0, block))
    one, two = (solid(seed).export(file_type="stl_ascii") for seed in (0, 1))
    two = two.upper().replace("\n", "\r\n").replace("ENDSOLID", "endsolid")
    mesh = read(f"{one}\n{two}\n".encode(), "stl")
    both = [theirs(text.lower().encode(), "stl") for text in (one, two)]
    assert np.array_equal(mesh.vertices, np.concatenate([part.vertices for part in both]))
    assert np.array_equal(mesh.faces, np.arange(len(mesh.vertices)).reshape(-1, 3))


STL = (
    b"solid a vertex 7 8 9\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n"
    b"vertex 0 1 0\nendloop\nendfacet\nendsolid a\n"
)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"vertex 1 0 0", b"vertex 1 0 x", "vertex 1 of the STL is '1 0 x', which is not three"),
        (b"vertex 1 0 0", b"vertex 1 0", "vertex 1 of the STL is '1 0', which"),
        (b"vertex 1 0 0", b"vertex 1 0 0 4", "vertex 1 of the STL is '1 0 0 4', which"),
        (b"vertex 1 0 0", b"vertex 1\v0 0", r"vertex 1 of the STL is '1.x0b0 0', which"),
        (b"vertex 1 0 0", b"vertex 1 0-0", "vertex 1 of the STL is '1 0-0', which"),
        (b"vertex 1 0 0", b"vertex 1 0 1e999", "vertex 1 is not finite"),
        (b"vertex 1 0 0\n", b"", "2 vertices in an STL of triangles"),
        (b"endsolid a", b"", "'endsolid' is missing at its end"),
        (b"vertex", b"vortex", "no faces"),
    ],
)
def test_stl_refusals(old: bytes, new: bytes, message: str) -> None:
    assert read(STL, "stl").faces.tolist() == [[0, 1, 2]]
    assert old in STL
    assert re.search(message, refusal(STL.replace(old, new), "stl"))


def test_signalling_numbers_of_a_binary_stl_are_refused_without_a_warning() -> None:
    data = bytearray(solid().export(file_type="stl"))
    data[96:100] = b"\x01\x00\xa0\x7f"
    with np.errstate(all="raise"):
        assert "vertex 0 is not finite" in refusal(bytes(data), "stl")


def test_no_import_of_trimesh() -> None:
    from helpers_files import run_python

    code = "import io\nvoxtool.load_mesh(io.BytesIO(eval(sys.argv[1])), sys.argv[2])\n"
    for data, kind in ((OFF, "off"), (STL, "stl")):
        done = run_python(f"{code}print('trimesh' in sys.modules)", data, kind)
        assert done.stdout == b"False\n", done.stderr
    assert off.parse("a", OFF)[1].dtype == np.int64
