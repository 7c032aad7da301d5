"""Mesh files: what is written is read back, in order, or refused in one line."""

from __future__ import annotations

import io
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import meshes
from helpers.files import run_python
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
from voxtool import files
from voxtool.errors import FileError, MeshError
from voxtool.files import MESH_FORMATS, NORMAL_FORMATS, write_mesh
from voxtool.files.meshes import mesh_writers
from voxtool.files.meshes.mesh import load_mesh
from voxtool.mesh.appearance import Appearance
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.mesh.srgb import to_linear

TEXT = ("obj", "off")
SINGLE = ("ply", "stl", "glb")  # float32


@pytest.fixture
def torus() -> Mesh:
    vertices, faces = meshes.torus(centre=(0.3, -7.1, 2.9))
    order = np.random.default_rng(3).permutation(len(faces))
    return mesh_from_arrays(vertices, faces[order])


def empty(vertices: int = 0) -> Mesh:
    return Mesh(np.ones((vertices, 3)), np.empty((0, 3), np.int32))


def side_of(mesh: Mesh) -> float:
    with np.errstate(over="ignore"):
        return float(np.ptp(mesh.bounds, axis=0).max())


def assert_back(path: Path | io.BytesIO, mesh: Mesh, kind: str) -> Mesh:
    """The file holds the mesh: the same faces, and vertices within what the format promises."""
    back = load_mesh(path, kind)
    if kind == "stl":
        assert np.array_equal(back.faces, np.arange(3 * len(mesh.faces)).reshape(-1, 3))
        vertices = mesh.vertices[mesh.faces].reshape(-1, 3)
    else:
        assert np.array_equal(back.faces, mesh.faces)
        vertices = mesh.vertices
    assert back.vertices.shape == vertices.shape
    if kind in SINGLE:
        assert np.array_equal(back.vertices, vertices.astype(np.float32))
    else:
        largest = np.abs(vertices).max()
        off = np.abs(back.vertices - vertices)
        assert off.max() <= min(1e-17 * largest, 1e-9 * side_of(mesh))
        assert not off[np.abs(vertices) >= largest / 10].any()
    return back


# Round trips


@pytest.mark.parametrize("kind", MESH_FORMATS)
def test_round_trip(torus: Mesh, kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind.upper()}"
    write_mesh(torus, path)
    assert_back(path, torus, kind)
    write_mesh(torus, tmp_path / "a.dat", format=kind)
    assert (tmp_path / "a.dat").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("kind", MESH_FORMATS)
def test_faces_and_vertices_are_kept_as_they_are(kind: str, tmp_path: Path) -> None:
    """No face is dropped, no vertex welded: duplicates, points, lines and loose vertices."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [9, 9, 9], [2, 0, 0]], float)
    faces = [[2, 1, 0], [0, 3, 2], [0, 0, 1], [3, 3, 3], [0, 1, 5], [2, 1, 0], [1, 0, 2]]
    mesh = mesh_from_arrays(vertices, faces)
    write_mesh(mesh, tmp_path / "a", format=kind)
    assert_back(tmp_path / "a", mesh, kind)


@pytest.mark.parametrize("kind", MESH_FORMATS)
def test_text_of_any_size_and_float32_of_usual_sizes(torus, kind: str, tmp_path: Path) -> None:
    scales = (1e-300, 1e-30, 1e-6, 0.999999, 1e6, 1e30, 1e300)
    for scale in scales if kind in TEXT else (1e-6, 1e6):
        mesh = Mesh(torus.vertices * scale, torus.faces)
        write_mesh(mesh, tmp_path / "a", format=kind)
        assert_back(tmp_path / "a", mesh, kind)


@pytest.mark.parametrize("kind", TEXT)
def test_text_far_from_the_origin(torus: Mesh, kind: str, tmp_path: Path) -> None:
    far = Mesh(torus.vertices * 1e-6 + 1e6, torus.faces)
    write_mesh(far, tmp_path / "a", format=kind)
    assert (assert_back(tmp_path / "a", far, kind).vertices == far.vertices).all()
    # far along x alone: 17 digits of x would lose y and z
    aside = Mesh(torus.vertices * 1e-12 + [1e6, 0, 0], torus.faces)
    write_mesh(aside, tmp_path / "b", format=kind)
    assert_back(tmp_path / "b", aside, kind)


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_text_of_any_floats(data: st.DataObject) -> None:
    number = st.floats(allow_nan=False, allow_infinity=False)
    rows = data.draw(st.lists(st.tuples(number, number, number), min_size=3, max_size=5))
    mesh = Mesh(np.array(rows), np.array([[0, 1, 2]], np.int32))
    if (mesh.bounds[0] == mesh.bounds[1]).all():
        return
    file = io.BytesIO()
    mesh_writers.write_obj(mesh, file)
    assert_back(io.BytesIO(file.getvalue()), mesh, "obj")


@pytest.mark.parametrize("kind", SINGLE)
@pytest.mark.parametrize(
    ("scale", "shift"), [(1e-6, 1e6), (1e60, 0), (1e-60, 0), (1e-3, [1e4, 0, 0]), (1e307, 0)]
)
def test_what_float32_would_ruin_is_refused(torus, kind, scale, shift, tmp_path) -> None:
    mesh = Mesh(torus.vertices * scale + shift, torus.faces)
    with pytest.raises(FileError, match=r"holds float32, which would move .*: write \.obj or \.o"):
        write_mesh(mesh, tmp_path / f"a.{kind}")
    assert list(tmp_path.iterdir()) == []


def test_float32_of_a_mesh_longer_than_float64(tmp_path: Path) -> None:
    vertices = [[-1.5e308, 0, 0], [1.5e308, 0, 0], [0, 1e308, 0]]
    mesh = mesh_from_arrays(vertices, [[0, 1, 2]])
    with pytest.raises(FileError, match="float32"):
        write_mesh(mesh, tmp_path / "a.ply")
    write_mesh(mesh, tmp_path / "a.obj")
    assert_back(tmp_path / "a.obj", mesh, "obj")


def test_float32_tells_a_thousand_cells_apart(torus: Mesh, tmp_path: Path) -> None:
    """A street of 100 m in metres of a national grid is refused, a town is not."""
    unit = (torus.vertices - torus.bounds[0]) / side_of(torus)
    town = Mesh(unit * 5000 + [4.5e6, 5.3e6, 0], torus.faces)
    write_mesh(town, tmp_path / "a.ply")
    with pytest.raises(FileError, match="float32"):
        write_mesh(Mesh(unit * 100 + [4.5e6, 5.3e6, 0], torus.faces), tmp_path / "b.ply")


# Normals


def glb_tree(data: bytes) -> tuple[dict, bytes]:
    """The JSON of a GLB, and its binary chunk."""
    end = 20 + int.from_bytes(data[12:16], "little")
    return json.loads(data[20:end]), data[end + 8 :]


def normals_in(data: bytes, kind: str, count: int) -> np.ndarray:
    """(count, 3) normals as the bytes of a file have them."""
    if kind == "obj":
        lines = [line.split() for line in data.decode().splitlines()]
        corners = [word for line in lines if line[:1] == ["f"] for word in line[1:]]
        assert all(word.split("//")[0] == word.split("//")[1] for word in corners)
        return np.array([line[1:] for line in lines if line[:1] == ["vn"]], float)
    if kind == "ply":
        header, _, body = data.partition(b"end_header\n")
        assert header.count(b"property float") == 6
        return np.frombuffer(body, "<f4", 6 * count).reshape(count, 6)[:, 3:]
    tree, body = glb_tree(data)
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]]
    assert (accessor["count"], accessor["componentType"]) == (count, 5126)
    start = tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
    return np.frombuffer(body, "<f4", 3 * count, start).reshape(count, 3)


@pytest.mark.parametrize(
    ("kind", "scale"), [("obj", 1), ("obj", 1e-9), ("obj", 1e40), ("ply", 1), ("glb", 1)]
)
def test_normals(kind: str, scale: float, tmp_path: Path) -> None:
    vertices, faces = meshes.icosphere(2)
    sphere = mesh_from_arrays(vertices * scale, faces)
    path = tmp_path / f"a.{kind}"
    for normals in (vertices.copy(), -np.roll(vertices, 1, axis=0), vertices / 2):
        write_mesh(sphere, path, normals=normals)
        assert normals.flags.writeable
        assert_back(path, sphere, kind)
        found = normals_in(path.read_bytes(), kind, len(vertices))
        assert np.abs(found - normals).max() <= (1e-9 if kind == "obj" else 2**-24)


@pytest.mark.parametrize("kind", NORMAL_FORMATS)
def test_without_normals_none_are_written(torus: Mesh, kind: str, tmp_path: Path) -> None:
    write_mesh(torus, tmp_path / f"a.{kind}")
    data = (tmp_path / f"a.{kind}").read_bytes()
    assert not any(word in data for word in (b"vn ", b" nx\n", b"NORMAL"))


@pytest.mark.parametrize("kind", ["stl", "off"])
def test_formats_without_normals_refuse_them(torus: Mesh, kind: str, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=rf"\.{kind} holds no vertex normals: write one of \.obj"):
        write_mesh(torus, tmp_path / f"a.{kind}", normals=torus.vertices)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", NORMAL_FORMATS)
def test_normals_that_do_not_fit(torus: Mesh, kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind}"
    with pytest.raises(MeshError, match=r"normals of shape \(287, 3\) for 288 vertices"):
        write_mesh(torus, path, normals=torus.vertices[1:])
    bad = torus.vertices.copy()
    bad[5, 1] = np.nan
    with pytest.raises(MeshError, match="the normal of vertex 5 is not finite"):
        write_mesh(torus, path, normals=bad)
    with pytest.raises(MeshError, match="vertex 5 is not finite"):
        write_mesh(Mesh(bad, torus.faces), path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("scale", [1e-25, 1e-6, 1, 1e30])
def test_stl_normals(scale: float, tmp_path: Path) -> None:
    vertices, faces = meshes.box(-1, 2)
    faces = np.vstack([faces, [[0, 0, 1], [2, 2, 2]]])
    write_mesh(mesh_from_arrays(vertices * scale, faces), tmp_path / "a.stl")
    packed = np.frombuffer((tmp_path / "a.stl").read_bytes()[84:], "V50")
    found = packed.view(np.uint8).reshape(-1, 50)[:, :12].copy().view("<f4")
    axes = np.repeat([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], 2, 0)
    assert np.array_equal(found, np.vstack([axes, np.zeros((2, 3))]))


# Formats


@pytest.mark.parametrize("kind", ["obj", "off"])
def test_text_is_exact(kind: str, tmp_path: Path) -> None:
    """Every coordinate reads back as the same float64: small ones beside large ones, too."""
    rng = np.random.default_rng(7)
    numbers = rng.uniform(-1, 1, (30, 3)) * 10.0 ** rng.integers(-300, 90, (30, 3))
    numbers[0] = -0.51, 1e38, 5e-324
    mesh = mesh_from_arrays(numbers, np.arange(30).reshape(-1, 3))
    write_mesh(mesh, tmp_path / f"a.{kind}")
    back = load_mesh(tmp_path / f"a.{kind}")
    assert np.array_equal(back.vertices.view(np.int64), numbers.view(np.int64))
    assert np.array_equal(back.faces, mesh.faces)


def test_headers(torus: Mesh, tmp_path: Path) -> None:
    for kind in MESH_FORMATS:
        write_mesh(torus, tmp_path / f"a.{kind}")
    openings = {"obj": b"# voxtool ", "ply": b"ply\n", "glb": b"glTF", "off": b"OFF\n288 576 0\n"}
    for kind, opening in openings.items():
        assert (tmp_path / f"a.{kind}").read_bytes().startswith(opening)
    assert len((tmp_path / "a.stl").read_bytes()) == 84 + 50 * 576


@pytest.mark.parametrize("coloured", [False, True])
def test_bytes_are_those_of_trimesh(torus: Mesh, coloured: bool, tmp_path: Path) -> None:
    import trimesh

    rng = np.random.default_rng(0)
    levels = rng.integers(0, 256, (len(torus.vertices), 4), np.uint8)
    light = np.concatenate([to_linear(levels[:, :3]), levels[:, 3:] / 255], axis=1)
    look = (
        Appearance((), np.full(len(torus.faces), -1, np.int32), colours=light) if coloured else None
    )
    mesh = Mesh(torus.vertices, torus.faces, appearance=look)
    peer = trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=mesh.vertices, process=False,
        vertex_colors=levels if coloured else None,
    )  # fmt: skip
    write_mesh(mesh, tmp_path / "a.ply", normals=mesh.vertices)
    assert (tmp_path / "a.ply").read_bytes() == peer.export(file_type="ply", vertex_normal=True)
    write_mesh(mesh, tmp_path / "b.ply")
    assert (tmp_path / "b.ply").read_bytes() == peer.export(file_type="ply", vertex_normal=False)
    write_mesh(mesh, tmp_path / "a.stl")
    written = np.frombuffer((tmp_path / "a.stl").read_bytes()[84:], mesh_writers.STL_FACE)
    exported = np.frombuffer(peer.export(file_type="stl")[84:], mesh_writers.STL_FACE)
    assert np.array_equal(written["corners"], exported["corners"])
    assert np.allclose(written["normal"], exported["normal"], atol=2**-23)


def test_the_glb_keeps_to_its_specification(torus: Mesh, tmp_path: Path) -> None:
    write_mesh(torus, tmp_path / "a.glb", normals=torus.vertices)
    data = (tmp_path / "a.glb").read_bytes()
    assert int.from_bytes(data[8:12], "little") == len(data)
    tree, _ = glb_tree(data)
    primitive = tree["meshes"][0]["primitives"][0]
    position = tree["accessors"][primitive["attributes"]["POSITION"]]
    assert position["count"] == 288
    assert np.array_equal([position["min"], position["max"]], torus.bounds.astype(np.float32))
    assert tree["accessors"][primitive["indices"]]["count"] == 3 * 576


def test_a_glb_beyond_its_limit_is_refused(torus: Mesh) -> None:
    limit = 12 * (576 + 288)
    mesh_writers.write_glb(torus, io.BytesIO(), limit=limit)
    with pytest.raises(FileError, match=r"GLB holds 4 GiB at most.*write \.ply"):
        mesh_writers.write_glb(torus, io.BytesIO(), torus.vertices, limit)


@pytest.mark.parametrize("vertices", [0, 4])
@pytest.mark.parametrize("kind", MESH_FORMATS)
def test_no_faces(kind: str, vertices: int, tmp_path: Path) -> None:
    """A valid file, which other programs open; a mesh to load has faces."""
    path = tmp_path / f"a.{kind}"
    write_mesh(empty(vertices), path)
    with pytest.raises(MeshError):
        load_mesh(path)
    data = path.read_bytes()
    if kind == "obj":
        lines = [line.split() for line in data.splitlines()[1:] if line]
        assert lines == [[b"v", *[b"1.0"] * 3]] * vertices
    elif kind == "off":
        assert data.split()[:4] == [b"OFF", b"%d" % vertices, b"0", b"0"]
    elif kind == "stl":
        assert data == bytes(84)
    elif kind == "ply":
        assert b"element face 0\n" in data
        assert len(data.partition(b"end_header\n")[2]) == 12 * vertices
    else:
        assert "meshes" not in glb_tree(data)[0]
    if kind in NORMAL_FORMATS:
        write_mesh(empty(vertices), path, normals=np.ones((vertices, 3)))


# Paths and streams


def test_bytes_depend_on_the_mesh_alone(tmp_path: Path) -> None:
    """Twice here, and in other processes, whose hashes differ."""
    code = (
        "from helpers import meshes\n"
        "v, f = meshes.icosphere(1, 0.1); m = voxtool.mesh_from_arrays(v, f)\n"
        "for k in sys.argv[2:]: voxtool.write_mesh(m, f'{sys.argv[1]}.{k}')\n"
        "for k in ('obj', 'ply', 'glb'):\n"
        "    for _ in 'ab': voxtool.write_mesh(m, f'{sys.argv[1]}.n.{k}', normals=v)\n"
    )
    for name in ("a", "b"):
        environment = {**os.environ, "PYTHONHASHSEED": str(ord(name))}
        run_python(code, tmp_path / name, *MESH_FORMATS, check=True, env=environment)
    written = sorted(p.name[2:] for p in tmp_path.glob("a.*"))
    assert len(written) == 8
    for name in written:
        assert (tmp_path / f"a.{name}").read_bytes() == (tmp_path / f"b.{name}").read_bytes()


@pytest.mark.parametrize("kind", [None, "glb"])
def test_stdout(kind: str | None, tmp_path: Path) -> None:
    code = f"from helpers import meshes; voxtool.write_mesh(meshes.torus(), '-', format={kind!r})"
    done = run_python(code)
    assert (done.returncode, done.stderr) == (0, b"")
    path = tmp_path / f"a.{kind or 'obj'}"
    write_mesh(mesh_from_arrays(*meshes.torus()), path)
    assert done.stdout == path.read_bytes()


class Terminal(io.TextIOWrapper):
    """Standard output of a person."""

    def isatty(self) -> bool:
        return True


def test_only_text_goes_to_a_terminal(torus: Mesh, monkeypatch) -> None:
    for kind in MESH_FORMATS:
        shown = io.BytesIO()
        monkeypatch.setattr(sys, "stdout", Terminal(shown))
        if kind in TEXT:
            write_mesh(torus, "-", format=kind)
        else:
            with pytest.raises(FileError, match="standard output is a terminal: redirect it"):
                write_mesh(torus, "-", format=kind)
        assert bool(shown.getvalue()) == (kind in TEXT)


def test_what_is_refused_leaves_the_old_file(torus: Mesh, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(b"old")
    with pytest.raises(FileError, match="float32"):
        write_mesh(Mesh(torus.vertices + 1e9, torus.faces), path)
    with pytest.raises(FileError, match=r"a\.ply exists: name another file, or drop --no-clobber"):
        write_mesh(torus, path, clobber=False)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_unknown_names(torus: Mesh, tmp_path: Path) -> None:
    known = r"\.obj, \.ply, \.stl, \.glb, \.off$"
    with pytest.raises(FileError, match=rf"a\.fbx: the name says no format: .* one of {known}"):
        write_mesh(torus, tmp_path / "a.fbx")
    with pytest.raises(FileError, match="format 'fbx' is unknown: choose one of obj, ply, stl"):
        write_mesh(torus, tmp_path / "a.obj", format="fbx", normals=torus.vertices)
    assert list(tmp_path.iterdir()) == []


def test_formats_of_names() -> None:
    assert files.format_of("-", MESH_FORMATS) == "obj"
    assert files.format_of("-", files.SVO_FORMATS) == "svo.h5"
    with pytest.raises(FileError, match="standard output has no extension"):
        files.format_of("-", files.EXPORTS)
    assert set(NORMAL_FORMATS) < set(MESH_FORMATS)


@pytest.mark.parametrize("kind", [*TEXT, *SINGLE])
def test_meshes_far_from_0_are_written_relative_to_an_origin(torus, kind, tmp_path) -> None:
    origin = (5e6, -4e6, 1e7)
    far = Mesh(torus.vertices + origin, torus.faces)
    path = tmp_path / f"far.{kind}"
    if kind in SINGLE:
        with pytest.raises(FileError, match=r"relative to a point of it \(see --origin\)"):
            write_mesh(far, path)
    write_mesh(far, path, origin=origin)
    assert_back(path, Mesh(far.vertices - origin, far.faces), kind)
    grid = voxtool.Grid((8, 8, 8), tuple(o + 0.1 for o in origin), (0.1, 0.2, 0.3))
    octree = voxtool.Octree.from_voxels([(1, 2, 3)], grid)
    surface = voxtool.extract(octree, style="voxel-faces")
    write_mesh(surface, path, origin=origin)
    bounds = load_mesh(path).bounds
    np.testing.assert_allclose(
        bounds, [(0.2, 0.5, 1), (0.3, 0.7, 1.3)], atol=2e-9 if kind in TEXT else 1e-6
    )
