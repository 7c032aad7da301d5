"""Reading meshes, refusing what is none, and describing what is wrong with one."""

from __future__ import annotations

import gzip
import hashlib
import io
import itertools
import pickle
import struct
import sys
from collections import Counter
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from conftest import model
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.errors import MeshError, printable
from voxtool.files.meshes import obj
from voxtool.files.meshes.mesh import as_mesh, load_mesh
from voxtool.files.storage.numbers import OddityError
from voxtool.mesh.collinear import collinear
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.mesh.topology import check_topology

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
TETRAHEDRON_OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"

V3 = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def read(data: bytes, file_type: str | None = None) -> Mesh:
    return load_mesh(io.BytesIO(data), file_type)


def refusal(data: bytes, tmp_path: Path, name: str = "m.obj") -> str:
    """The message of the error that a file of these bytes meets: one line that names the file."""
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(MeshError) as caught:
        load_mesh(path)
    message = str(caught.value)
    assert message.isprintable()  # so one line, too
    assert message.startswith(printable(path))
    return message


# --- reading -------------------------------------------------------------------------------------


def test_obj_keeps_order_and_every_bit(tmp_path):
    rng = np.random.default_rng(5)
    points = rng.standard_normal((200, 3)) * 10.0 ** rng.integers(-300, 300, (200, 3))
    faces = rng.integers(0, 200, (300, 3))
    path = tmp_path / "m.obj"
    lines = ["v " + " ".join(map(repr, p)) for p in points.tolist()]
    lines += ["f " + " ".join(str(i + 1) for i in f) for f in faces.tolist()]
    path.write_text("\n".join(lines))
    mesh = load_mesh(path)
    assert mesh.vertices.tobytes() == points.tobytes()
    assert (mesh.faces == faces).all()
    assert mesh.faces.dtype == np.int32
    assert mesh.vertices.flags.c_contiguous
    assert mesh.faces.flags.c_contiguous
    assert mesh.name == str(path)
    assert len(mesh.source_sha256) == 64


def by_line(text: bytes) -> tuple[list, list]:
    """Return the vertices and faces that the slow reader finds in an OBJ text."""
    return tuple(array.tolist() for array in obj._by_line("m", text, False)[:2])  # pyright: ignore


ODDITIES = (
    b"vt 0 0\n", b"vn 0 0 1\n", b"o x\n", b"g\n", b"# v 1 2\n", b"\n", b"l 1 2\n", b"f 1 2\n",
    b"v 1 2 3 0.5 .5 1\r\n", b"v\t1e-3 +2. -.5\n", b"f 1//2 2/ 3/-1/+1\n", b"f -1 -2 -3 -3\n",
    b"f 3 2 1 2 3\n",
)  # fmt: skip


@given(st.lists(st.sampled_from(ODDITIES)), st.booleans(), st.integers(1, 64))
def test_both_readers_of_obj_agree(lines, ended, size):
    text = b"".join([V3, *lines])
    text = text if ended else text.removesuffix(b"\n").removesuffix(b"\r")
    try:
        quick = obj._quick(text, False, size)[:2]
        assert tuple(array.tolist() for array in quick) == by_line(text)
    except OddityError:
        assert not ended  # a last face of two vertices may be cut


def test_what_the_quick_reader_leaves_to_the_other():
    rng = np.random.default_rng(6)
    text = b"".join(b"v %r %r %r\n" % tuple(p) for p in rng.random((9, 3)).tolist())
    text += b"".join(b"f %d %d %d\n" % tuple(f) for f in rng.integers(1, 10, (20, 3)).tolist())
    expected = by_line(text)
    for odd in (text.replace(b"f ", b"\tf\t"), text.replace(b"\n", b"\r"), text + b"v 0 0 # \\\n0"):
        with pytest.raises(OddityError):
            obj._quick(odd, False)
    assert (read(text.replace(b"f ", b"\tf\t")).faces == expected[1]).all()
    for other in (text.replace(b"\n", b"\r\n"), b"\xef\xbb\xbf" + text):
        mesh = read(other)
        assert (mesh.vertices.tolist(), mesh.faces.tolist()) == expected


@pytest.mark.parametrize(
    ("text", "faces"),
    [
        pytest.param(
            V3 + b"v 1 1 0\nv 2 2 0\nf 1 2 4 3\nf 1 2 3\nf 1 2 5 4 3\n",
            [[0, 1, 3], [0, 3, 2], [0, 1, 2], [0, 1, 4], [0, 4, 3], [0, 3, 2]],
            id="polygons become fans",
        ),
        pytest.param(
            b"# \xe9crit \xe0 la main\nmtllib nowhere.mtl\no a\n" + V3 + b"v 0 0 1\nvt 0 0\n"
            b"vn 0 0 1\nusemtl red\ng x\nf 1/1/1 2/1/1 3/1/1\nusemtl blue\ns 1\n"
            b"f 1//1 2//1 4//1\no b\nusemtl red\nf 2/1 3/1 4/1\nl 1 2\n",
            [[0, 1, 2], [0, 1, 3], [1, 2, 3]],
            id="groups, objects and materials are merged in order",
        ),
        pytest.param(
            V3 + b"v 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvt .5 .5\nf 1/1 2/2 3/3\nf 3/4 2/1 4/2\n",
            [[0, 1, 2], [2, 1, 3]],
            id="texture seams do not split vertices",
        ),
        pytest.param(
            V3 + b"f -3 -2 -1\nv 0 0 1\nv 0 0 2\nf -2 -5 -1\n",
            [[0, 1, 2], [3, 0, 4]],
            id="relative indices count from their line",
        ),
        pytest.param(
            b"v 0 0 0 1 0.5 0 # red\nv 1 0 0 1\nv 0 1 0\nf 1 \\\n 2 3 # face\n# a \\\nf 3 2 1\n",
            [[0, 1, 2], [2, 1, 0]],
            id="continued lines, comments, colours and weights",
        ),
        pytest.param(
            V3 + b"v 2 0 0\nf 1 1 2\nf 3 3 3\nf 1 2 4\nf 1 2\n",
            [[0, 0, 1], [2, 2, 2], [0, 1, 3]],
            id="degenerate faces are kept",
        ),
    ],
)
def test_faces_of_obj(text, faces):
    mesh = read(text)
    assert mesh.faces.tolist() == faces
    assert len(mesh.vertices) == text.count(b"v ")


def test_bounds_are_of_used_vertices():
    mesh = read(V3 + b"v 9 9 9\nf 1 2 3\n")
    assert mesh.bounds.tolist() == [[0, 0, 0], [1, 1, 0]]
    assert len(mesh.vertices) == 4
    zero = mesh_from_arrays([[-0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    assert not np.signbit(zero.bounds).any()


@pytest.mark.parametrize("kind", ["obj", "stl", "stl_ascii", "ply", "ply_ascii", "off", "glb"])
@pytest.mark.parametrize("packed", [False, True])
def test_each_format_comes_back(kind, packed, tmp_path):
    solid = trimesh.Trimesh(POINTS, TETRAHEDRON, process=False)
    if kind == "ply_ascii":
        data = solid.export(file_type="ply", encoding="ascii")
    else:
        data = solid.export(file_type=kind)
    data = data.encode() if isinstance(data, str) else data
    data = gzip.compress(data, mtime=0) if packed else data
    path = tmp_path / f"m.{kind.removesuffix('_ascii')}{'.gz' * packed}"
    path.write_bytes(data)
    mesh = load_mesh(path)
    assert mesh.vertices[mesh.faces].tolist() == POINTS[TETRAHEDRON].tolist()
    assert mesh.source_sha256 == hashlib.sha256(data).hexdigest()
    assert mesh.units == ("m" if kind == "glb" else "")
    by_content = load_mesh(io.BytesIO(data))
    assert by_content.vertices.tobytes() == mesh.vertices.tobytes()
    assert (by_content.faces == mesh.faces).all()


def test_standard_input(monkeypatch):
    for data in (TETRAHEDRON_OBJ, gzip.compress(TETRAHEDRON_OBJ, mtime=0)):
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(data)))
        mesh = load_mesh("-")
        assert mesh.name == "standard input"
        assert (mesh.faces == TETRAHEDRON).all()
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(b"")))
    with pytest.raises(MeshError, match="standard input: the file is empty"):
        load_mesh("-")


def test_scene_transforms_and_mirrors():
    solid = trimesh.Trimesh(POINTS, TETRAHEDRON, process=False)
    scene = trimesh.Scene()
    shift, mirror = np.eye(4), np.diag([-1.0, 1.0, 1.0, 1.0])
    shift[:3, 3] = 10, 20, 30
    scene.add_geometry(solid, node_name="first")
    scene.add_geometry(solid, node_name="second", transform=shift)
    scene.graph.update(frame_from="second", frame_to="third", matrix=mirror, geometry="geometry_0")
    mesh = read(scene.export(file_type="glb"))
    assert len(mesh.faces) == 12
    moved = np.array([10, 20, 30])
    mirrored = POINTS * [-1, 1, 1] + moved
    expected = [POINTS[TETRAHEDRON], (POINTS + moved)[TETRAHEDRON], mirrored[TETRAHEDRON[:, ::-1]]]
    triangles = mesh.vertices[mesh.faces].reshape(3, 4, 3, 3)
    assert sorted(triangles.tolist()) == sorted(e.tolist() for e in expected)


def test_ply_polygons_and_texture_coordinates():
    text = (
        b"ply\nformat ascii 1.0\ncomment x\nelement vertex 4\nproperty double x\n"
        b"property double y\nproperty double z\nproperty float s\nproperty float t\n"
        b"element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        b"0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n0 1 0.1 0 1\n4 0 1 2 3\n3 0 2 1\n"
    )
    mesh = read(text)
    assert len(mesh.vertices) == 4
    assert mesh.vertices[3, 2] == 0.1
    assert sorted(map(sorted, mesh.faces.tolist())) == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]


# --- refusing ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (b"", ["the file is empty"]),
        (V3, ["3 points and no faces"]),
        (V3 + b"f 1 2\n", ["3 points and no faces"]),
        (b"# nothing\n", ["no faces"]),
        (V3 + b"f 1 2 4\n", ["line 4", "vertex 4", "there are 3"]),
        (V3 + b"\nf 1/9/9 2/2/2 8/8/8\n", ["line 5", "vertex 8", "there are 3"]),
        (V3 + b"f 1 2 0\n", ["line 4", "vertex 0", "there are 3", "counted from 1"]),
        (V3 + b"f -1 -2 -4\n", ["line 4", "vertex -4", "3 stand above"]),
        (V3 + b"f 1 2 99999999999999999999\n", ["line 4", "99999999999999999999"]),
        (V3 + b"v nan 0 0\nf 1 2 4\n", ["line 4", "'nan' is not finite"]),
        (V3 + b"v 0 -INF 0\nf 1 2 4\n", ["line 4", "'-INF' is not finite"]),
        (V3 + b"v 0 0 1e999\nf 1 2 4\n", ["line 4", "'1e999' is not finite"]),
        (V3 + b"v 0 0,5 0\nf 1 2 4\n", ["line 4", "'0,5' is not a number"]),
        (V3 + b"v 1/2 0 0\nf 1 2 4\n", ["line 4", "'1/2' is not a number"]),
        (V3 + b"v 1_0 0 0\nf 1 2 4\n", ["line 4", "'1_0' is not a number"]),
        (V3 + b"v 1 0 1-e5\nf 1 2 4\n", ["line 4", "'1-e5' is not a number"]),
        (V3 + b"f 1 2 3.5\n", ["line 4", "'3.5' is no vertex"]),
        (V3 + b"v 0 0\nf 1 2 4\n", ["line 4", "2 coordinates where 3 are needed"]),
        (V3 + b"f 1 2 3\nv 0.5 0", ["line 5", "2 coordinates", "truncated"]),
        (V3 + b"f 1 2 3\nf 1 2", ["line 5", "the last face has 2 vertices", "truncated"]),
        (b"v 1 2 3\nv 1 2 3\nv 1 2 3\nf 1 2 3\n", ["all points", "equal", "1.0, 2.0, 3.0"]),
        (V3 + b"f 2 2 2\n", ["all points", "equal"]),
        (b"\x00\x01\x02" * 99, ["no text"]),
        (b"\x7fELF" + np.random.default_rng(1).bytes(64) + b"\0", ["no text"]),
        (b"ply\nformat ascii 1.0\n", ["no text", "looks like .ply"]),
        (b"\x89HDF\r\n\x1a\n" + b"\0" * 99, ["voxtool output", "not a mesh", "give the mesh"]),
        (b"<?xml version='1.0'?>\n<octree/>", ["XML", "not a mesh", "give the mesh"]),
    ],
)
def test_obj_refusals(text, parts, tmp_path):
    message = refusal(text, tmp_path)
    assert all(part in message for part in parts)


@pytest.mark.parametrize(
    ("name", "data", "parts"),
    [
        ("m.foo", b"hello", ["unknown mesh format .foo", ".obj .stl .ply .off .glb .gltf"]),
        ("m.3mf", b"PK", ["not readable as 3MF", "File is not a zip file"]),
        ("m.dae", b"<COLLADA/>", ["unknown mesh format .dae"]),
        ("m.svo.h5", b"\x89HDF\r\n\x1a\n", ["voxtool output", "not a mesh"]),
        ("m.svo.xml", b"<?xml version='1.0'?>", ["XML", "not a mesh"]),
        ("m.vtu", b"<VTKFile>", ["VTK", "not a mesh"]),
        ("m.obj.gz", TETRAHEDRON_OBJ, ["not packed with gzip"]),
        ("m.obj.gz", gzip.compress(TETRAHEDRON_OBJ, mtime=0)[:-12], ["truncated", "gzip"]),
        ("m.obj.gz", gzip.compress(TETRAHEDRON_OBJ, mtime=0)[:20] + b"x" * 20, ["gzip"]),
        ("m.obj.gz", gzip.compress(b"", mtime=0), ["empty"]),
        ("m.obj.gz", gzip.compress(V3 + b"f 1 2 7\n", mtime=0), ["line 4", "vertex 7"]),
        ("m\n\x1b[31m.obj", b"", ["empty"]),
        ("m.stl", b"\0" * 84, ["no faces"]),
        ("m.stl", b"\0" * 50, ["truncated"]),
        ("m.stl", b"\0" * 80 + struct.pack("<I", 9) + b"\0" * 99, ["9 triangles", "534", "183"]),
        ("m.stl", b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", ["truncated"]),
        ("m.stl", b"solid\nvertex 0 0 x\nvertex 1 0 0\nvertex 0 1 0\nendsolid\n", ["STL"]),
        ("m.ply", b"ply\nformat ascii 1.0\nend_header\n", []),
        ("m.off", b"OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", ["header promises", "3 and 2"]),
        ("m.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", ["OFF"]),
        ("m.off", b"OFF\n99999999999 1 0\n", ["99,999,999,999 vertices", "at most"]),
        ("m.off", b"OFF\n3 99999 0\n", ["cannot hold", "99,999 faces", "truncated"]),
        ("m.off", b"hello", ["OFF"]),
        ("m.glb", b"glTF\x02\0\0\0" + b"\0" * 30, ["GLB"]),
        ("m.gltf", b"{}", []),
        ("m.gltf", b"[" * 100000, ["GLTF"]),
        ("m.gltf", b'{"accessors": [{"count": 999999999999}]}', ["at most"]),
    ],
)
def test_other_refusals(name, data, parts, tmp_path):
    message = refusal(data, tmp_path, name)
    assert all(part in message for part in parts)


PLY_HEADER = (
    b"ply\nformat %s 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face %d\nproperty list uchar int vertex_indices\nend_header\n"
)


PLY_ROWS = b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
PLY = PLY_HEADER % (b"ascii", 3, 1) + PLY_ROWS
BINARY_PLY = trimesh.Trimesh(POINTS, TETRAHEDRON, process=False).export(file_type="ply")


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (PLY[:-2] + b"5\n", "line 13: the face names vertex 5 where there are 3"),
        (PLY.replace(b"1 0 0\n", b"nan 0 0\n"), "line 11: 'nan' is not a number"),
        (PLY[:-4], "line 13: a face of 3 vertices names 1"),
        (PLY_HEADER % (b"ascii", 3, 2) + PLY_ROWS, "header promises 3 and 2"),
        (
            PLY_HEADER % (b"binary_little_endian", 3, 1 << 31),
            "2,147,483,648 triangles, at most 2,147,483,647",
        ),
        (BINARY_PLY[:-5], "4 face rows end beyond its"),
        (BINARY_PLY[:60], "does not belong in a PLY header"),
    ],
)
def test_ply_refusals(data, part, tmp_path):
    assert len(read(PLY).faces) == 1
    assert part in refusal(data, tmp_path, "m.ply")


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_damaged_files_never_escape(data):
    """Whatever is cut or overwritten: a mesh or a MeshError of one line."""
    solid = trimesh.Trimesh(POINTS, TETRAHEDRON, process=False)
    kind = data.draw(st.sampled_from(["obj", "stl", "stl_ascii", "ply", "off", "glb"]))
    blob = solid.export(file_type=kind)
    blob = bytearray(blob.encode() if isinstance(blob, str) else blob)
    for _ in range(data.draw(st.integers(0, 3))):
        blob[data.draw(st.integers(0, len(blob) - 1))] = data.draw(st.integers(0, 255))
    blob = bytes(blob[: data.draw(st.integers(0, len(blob)))])
    message = ""
    try:
        read(blob, kind.removesuffix("_ascii"))
    except MeshError as error:
        message = str(error)
    assert message.isprintable()


def test_no_such_file_folder_and_permission(tmp_path, monkeypatch):
    with pytest.raises(MeshError, match=r"nowhere\.obj: there is no such file"):
        load_mesh(tmp_path / "nowhere.obj")
    with pytest.raises(MeshError, match="is a folder"):
        load_mesh(tmp_path)
    path = tmp_path / "m.obj"
    path.write_bytes(TETRAHEDRON_OBJ)

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("builtins.open", refuse)
    with pytest.raises(MeshError, match=r"m\.obj: no permission"):
        load_mesh(path)


def test_unpacked_size_is_bounded(tmp_path):
    (tmp_path / "bomb.obj.gz").write_bytes(gzip.compress(bytes(50 << 20), mtime=0))
    with pytest.raises(MeshError, match=r"bomb\.obj\.gz: more than 5 MiB"):
        load_mesh(tmp_path / "bomb.obj.gz", max_bytes=5 << 20)


@pytest.mark.parametrize(
    ("vertices", "faces", "part"),
    [
        (POINTS, np.empty((0, 3), int), "no faces"),
        (POINTS, [[0, 1, 4]], "face 0 names vertex 4 where there are 4"),
        (POINTS, [[0, 1, 2], [0, -1, 2]], "face 1 names vertex -1"),
        (POINTS, [[0, 1, 2.5]], "whole numbers"),
        (POINTS[:, :2], [[0, 1, 2]], r"shape \(4, 2\)"),
        (POINTS * np.nan, [[0, 1, 2]], "vertex 0 is not finite"),
        (POINTS, [[1, 1, 1]], "equal"),
        ("abc", [[1, 1, 1]], "not arrays of numbers"),
    ],
)
def test_array_refusals(vertices, faces, part):
    with pytest.raises(MeshError, match=part):
        mesh_from_arrays(vertices, faces)


# --- the data ------------------------------------------------------------------------------------


def test_a_mesh_cannot_be_written_to():
    vertices, faces = POINTS.copy(), TETRAHEDRON.copy()
    mesh = mesh_from_arrays(vertices, faces)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices *= 10  # pyright: ignore
    vertices *= 10
    faces[:] = 0
    assert (mesh.vertices == POINTS).all()
    assert (mesh.faces == TETRAHEDRON).all()
    assert mesh.bounds.tolist() == [[0, 0, 0], [1, 1, 1]]


def test_meshes_are_values():
    mesh = mesh_from_arrays(POINTS, TETRAHEDRON, name="a.obj")
    assert mesh == mesh_from_arrays(POINTS, TETRAHEDRON, name="a.obj")
    assert mesh != mesh_from_arrays(2 * POINTS, TETRAHEDRON, name="a.obj")
    again = pickle.loads(pickle.dumps(mesh))
    assert again == mesh
    assert not again.vertices.flags.writeable
    assert repr(mesh) == "Mesh('a.obj', 4 vertices, 4 faces)"


@pytest.mark.parametrize(
    ("vertices", "faces", "says"),
    [
        (
            np.zeros((3, 3)),
            np.zeros((1, 3), np.int64),
            r"b.obj: faces of type int64 and shape \(1, 3\)",
        ),
        (np.zeros((3, 3)), np.zeros((1, 3), np.uint64), "faces of type uint64"),
        (np.zeros((3, 3)), np.zeros(0, np.int32), r"faces of type int32 and shape \(0,\)"),
        (np.zeros((3, 3), np.float32), np.zeros((1, 3), np.int32), "vertices of type float32"),
        (np.zeros((3, 2)), np.zeros((1, 3), np.int32), r"vertices of .* shape \(3, 2\)"),
    ],
)
def test_a_mesh_refuses_arrays_that_kernels_would_misread(vertices, faces, says):
    with pytest.raises(MeshError, match=says):
        Mesh(vertices, faces, name="b.obj")


def test_what_holds_a_mesh_becomes_one(tmp_path):
    mesh = mesh_from_arrays(POINTS, TETRAHEDRON)
    (tmp_path / "m.obj").write_bytes(TETRAHEDRON_OBJ)
    assert as_mesh(mesh) is mesh
    assert as_mesh(mesh.to_trimesh()) == mesh
    assert as_mesh((POINTS, TETRAHEDRON)) == mesh
    for path in (tmp_path / "m.obj", str(tmp_path / "m.obj")):
        assert (as_mesh(path).faces == TETRAHEDRON).all()
    with pytest.raises(MeshError, match="int is no mesh: give a Mesh, "):
        as_mesh(3)


# --- diagnosis -----------------------------------------------------------------------------------


def flat(triangle) -> bool:
    a, b, c = (list(map(Fraction, corner)) for corner in triangle)
    u, v = ([x - y for x, y in zip(corner, a, strict=True)] for corner in (b, c))
    return all(u[i] * v[j] == u[j] * v[i] for i, j in ((0, 1), (1, 2), (2, 0)))


@given(
    st.lists(st.floats(-1e9, 1e9), min_size=9, max_size=9), st.integers(-20, 20),
    st.sampled_from([-1000, -500, 0, 500, 900]), st.booleans(),
)  # fmt: skip
def test_zero_area_is_exact(numbers, k, exponent, moved):
    """Against fractions: a point that float64 puts near a line is on it or it is not."""
    p, q, r = np.ldexp(np.array(numbers), exponent).reshape(3, 3)
    triangle = np.stack([p, q, p + (q - p) * (k / 8)]) + moved * r
    assert collinear(triangle[None])[0] == flat(triangle.tolist())


def naive(points, faces):
    """The same diagnosis by dictionaries."""
    place = [tuple(v + 0.0 for v in p) for p in points.tolist()]
    proper = [[place[i] for i in f] for f in faces if len({place[i] for i in f}) == 3]
    directed = Counter((f[i], f[(i + 1) % 3]) for f in proper for i in range(3))
    uses = Counter(frozenset(edge) for edge in directed.elements())
    shells = []
    for f in proper:
        edges = {frozenset((f[i], f[i - 1])) for i in range(3)}
        joined = [shell for shell in shells if shell & edges]
        shells = [shell for shell in shells if not shell & edges] + [edges.union(*joined)]
    even = all(n % 2 == 0 for n in uses.values())
    return {
        "faces": len(faces),
        "vertices": len(points),
        "closed": even and bool(uses),
        "even": even,
        "boundary_edges": sum(n == 1 for n in uses.values()),
        "nonmanifold_edges": sum(n > 2 for n in uses.values()),
        "inconsistent_edges": sum(
            n == 2 and max(directed[tuple(e)], directed[tuple(e)[::-1]]) == 2
            for e, n in uses.items()
        ),
        "duplicate_faces": len(proper) - len({frozenset(f) for f in proper}),
        "degenerate_faces": len(faces) - len(proper) + sum(map(flat, proper)),
        "shells": len(shells),
        "euler": len({p for f in proper for p in f}) - len(uses) + len(proper),
    }


@given(st.data())
@settings(max_examples=300, deadline=None)
def test_diagnosis_equals_the_naive_one(data):
    coordinate = st.sampled_from([-0.0, 0.0, 1.0, 2.0])
    row = st.tuples(coordinate, coordinate, coordinate)
    points = np.array(data.draw(st.lists(row, min_size=3, max_size=12)))
    index = st.integers(0, len(points) - 1)
    faces = np.array(data.draw(st.lists(st.tuples(index, index, index), min_size=1, max_size=16)))
    mesh = Mesh(points, faces.astype(np.int32))
    assert check_topology(mesh).as_dict() == naive(points, faces.tolist())


# --- real models ---------------------------------------------------------------------------------


def test_real_models_are_counted():
    found = check_topology(load_mesh(model("stanford-bunny.obj")))
    assert (found.faces, found.vertices) == (69451, 35947)
    assert (found.closed, found.boundary_edges, found.shells) == (False, 223, 1)
    assert 2 - found.euler == 5  # holes of a sphere
    found = check_topology(load_mesh(model("armadillo.obj")))
    assert (found.faces, found.closed, found.boundary_edges, found.shells) == (86482, True, 0, 1)


@pytest.mark.parametrize("name", ["stanford-bunny.obj", "spot.obj", "suzanne.obj", "teapot.obj"])
def test_models_are_read_as_their_text_says(name):
    path = model(name)
    points, faces = [], []
    for line in path.read_text().splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            points.append([float(w) for w in words[1:4]])
        elif words[:1] == ["f"]:
            ids = [int(w.split("/")[0]) - 1 for w in words[1:]]
            faces += [[ids[0], b, c] for b, c in itertools.pairwise(ids[1:])]
    mesh = load_mesh(path)
    assert mesh.vertices.tobytes() == np.array(points).tobytes()
    assert (mesh.faces == faces).all()
