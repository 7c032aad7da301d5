"""OFF, PLY and STL: the same meshes as trimesh reads, and errors that name the place."""

from __future__ import annotations

import io
import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers import meshes

from voxtool import load_mesh
from voxtool.errors import MeshError
from voxtool.files.meshes import off, stl
from voxtool.files.storage import numbers
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
    from helpers.files import run_python

    code = "import io\nvoxtool.load_mesh(io.BytesIO(eval(sys.argv[1])), sys.argv[2])\n"
    for data, kind in ((OFF, "off"), (STL, "stl")):
        done = run_python(f"{code}print('trimesh' in sys.modules)", data, kind)
        assert done.stdout == b"False\n", done.stderr
    assert off.parse("a", OFF)[1].dtype == np.int64


# ---- PLY

TYPE_NAMES = {
    "f4": "float",
    "f8": "double",
    "u1": "uchar",
    "i4": "int",
    "u2": "ushort",
    "i2": "short",
}


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("block", [1, 700, 1 << 21])
def test_ply_is_as_trimesh_reads_it(encoding: str, block: int, monkeypatch) -> None:
    monkeypatch.setattr(numbers.blocks_of, "__defaults__", (0, block))
    data: Any = solid().export(file_type="ply", encoding=encoding.partition("_")[0])
    mesh, other = read(data, "ply"), theirs(data, "ply")
    if encoding == "ascii":  # trimesh rounds the numbers of the text
        lines = data.partition(b"end_header\n")[2].splitlines()[: len(mesh.vertices)]
        assert np.array_equal(mesh.vertices, np.loadtxt(lines))
        mesh = Mesh(mesh.vertices.astype(np.float32).astype(np.float64), mesh.faces)
    assert_same(mesh, other)


def ply_of(polygons: list[list[int]], points: np.ndarray, format: str, *, lists: bool) -> bytes:
    """A PLY of polygons with colours, an element before and one after, and if `lists` a list of
    texture coordinates before the corners of each face, and one of flags after them."""
    number = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[format]
    rows: list[tuple[str, list[Any]]] = []
    for i in range(3):
        rows += [("u1 f4 f4 i2", [2, 0.5, i, -i])]
    for i, point in enumerate(points.tolist()):
        rows += [("f4 f8 u1 f8 f8", [1.5, point[2], i % 256, *point[:2]])]
    for i, polygon in enumerate(polygons):
        types = "u1 u2" + " i4" * len(polygon)
        row: list[Any] = [i % 7, len(polygon), *polygon]
        if lists:
            types = "u1 u1" + " f4" * (i % 3) + types[2:] + " i4" + " u1" * (i % 2)
            row = [i % 7, i % 3, *[0.25] * (i % 3), *row[1:], i % 2, *[9] * (i % 2)]
        rows += [(types, row)]
    rows += [("u1 i4", [1, 7])] * 2
    head = ["ply", f"format {format} 1.0", "comment by hand", "element tristrips 3"]
    head += ["property list uchar float s", "property short t", f"element vertex {len(points)}"]
    head += [
        f"property {kind} {name}"
        for kind, name in (
            ("float", "quality"),
            ("double", "z"),
            ("uchar", "red"),
            ("double", "x"),
            ("double", "y"),
        )
    ]
    head += [f"element face {len(polygons)}", "property uchar red"]
    head += ["property list uchar float texcoord"] * lists
    head += ["property list ushort int vertex_indices"]
    head += ["property list int uchar flags"] * lists
    head += ["element edge 2", "property list uchar int e", "end_header", ""]
    if format == "ascii":
        body = "".join(" ".join(map(repr, row)) + "\n" for _, row in rows).encode()
    else:
        body = b"".join(
            np.array(value, number + kind).tobytes()
            for types, row in rows
            for kind, value in zip(types.split(), row, strict=True)
        )
    return "\n".join(head).encode() + body


@pytest.mark.parametrize("format", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("lists", [False, True])
@pytest.mark.parametrize("corners", [(3, 3), (5, 5), (2, 7)])
def test_ply_of_polygons(format: str, lists: bool, corners: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(300, 3))
    polygons = [rng.integers(0, 300, rng.integers(corners[0], corners[1] + 1)).tolist()
                for _ in range(40)]  # fmt: skip
    mesh = read(ply_of(polygons, points, format, lists=lists), "ply")
    assert np.array_equal(mesh.vertices, points)
    fans = [[p[0], b, c] for p in polygons for b, c in pairwise(p[1:])]
    assert mesh.faces.tolist() == fans


PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"1 0 0\n", b"1 x 0\n", "line 11: 'x' is not a number"),
        (b"1 0 0\n", b"1 0\n", "line 11: a vertex of 2 numbers where 3 are needed"),
        (b"3 0 1 2", b"3 0 1 1.5", "line 13: the face names vertex 1.5"),
        (b"3 0 1 2", b"1e300 0 1 2", r"line 13: a face of 1e\+300 vertices"),
        (b"float z", b"float y", "its vertices have 2 properties y, not one|0 properties z"),
        (b"float z", b"list uchar float z", "its vertices have a list among their properties"),
        (b"list uchar int", b"list uchar float", "numbers that are not whole"),
        (b"list uchar int", b"list float int", "line 8: .* does not belong in a PLY header"),
        (b"list uchar int", b"int", "its faces have 0 lists vertex_indices"),
        (b"vertex 3", b"vertex 99999", "cannot hold the 99,999 vertices"),
        (b"property list", b"property uchar red\nproperty list", "line 14: a face of 0 vertices|3"),
        (b"property list", b"property list int int e\nproperty list", "ends before its list"),
        (b"format ascii", b"format binary_little_endian", "truncated"),
        (b"format ascii", b"format binary_big_endian", "truncated"),
    ],
)  # fmt: skip
def test_ply_refusals(old: bytes, new: bytes, message: str) -> None:
    assert len(read(PLY, "ply").faces) == 1
    assert old in PLY
    with np.errstate(all="raise"):
        assert re.search(message, refusal(PLY.replace(old, new), "ply"))


def test_a_list_that_ends_beyond_a_binary_ply() -> None:
    data = ply_of([[0, 1, 2], [0, 1, 2, 3]], np.eye(4, 3), "binary_little_endian", lists=True)
    for end in range(data.index(b"end_header") + 11, len(data)):
        if end < len(data) - 10:  # the edges that follow are not needed
            assert "truncated" in refusal(data[:end], "ply")
        else:
            assert len(read(data[:end], "ply").faces) == 3
