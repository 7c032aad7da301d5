"""Meshes of volume cells are read through meshio; what is damaged or hostile is refused in one
line."""

from __future__ import annotations

import hashlib
import sys
import threading
import warnings
import zlib
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from helpers.files import refusal, run_python
from helpers.tets import built, cube, lattice, linear, split

from voxtool import read_unstructured
from voxtool.errors import DeviceWarning, FileError, MemoryLimitError, VoxtoolError
from voxtool.files.cells import through_meshio
from voxtool.tets.volume.mesh import UnstructuredMesh


def mixed() -> meshio.Mesh:
    """A box of two cubes, one whole and one cut in two wedges, and a triangle on its side."""
    points, cells = lattice((2, 1, 1))
    whole, cut = cells
    blocks = [
        ("hexahedron", whole[None]),
        ("wedge", cut[[[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]]]),
        ("triangle", whole[None, :3]),
    ]
    vectors = np.stack([points[:, 0], points[:, 1] - 3, points[:, 2] * 4], axis=1)
    return meshio.Mesh(
        points,
        blocks,
        point_data={"s": linear(points), "v": vectors},
        cell_data={"c": [np.array([1.0]), np.array([2.0, 3.0]), np.array([9.0])]},
    )


def volume_of(mesh: UnstructuredMesh) -> float:
    found = split(mesh)
    p = found.vertices[found.cells]
    return float(np.linalg.det(p[:, 1:] - p[:, :1]).sum() / 6)


def written(path: Path, mesh: meshio.Mesh, **options: Any) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        meshio.write(path, mesh, **options)
    return path


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.vtu", {}),
        ("a.vtu", {"compression": "lzma"}),
        ("a.vtu", {"compression": None}),
        ("a.vtu", {"binary": False}),
        ("a.vtk", {}),
        ("a.vtk", {"binary": False}),
        ("a.vtk", {"file_format": "vtk42"}),
        ("a.msh", {"file_format": "gmsh"}),
        ("a.msh", {"file_format": "gmsh22"}),
        ("A.EXO", {"file_format": "exodus"}),
        ("a.inp", {"file_format": "avsucd"}),
    ],
)
def test_formats_with_scalars_at_points(name: str, options: dict, tmp_path: Path, capfd) -> None:
    mesh = mixed()
    if name in ("a.msh", "a.inp"):  # which meshio writes of one kind of cells, or without data
        mesh.cell_data = {}
        mesh.cells = mesh.cells[: 1 if options["file_format"] == "gmsh" else 2]
    path = written(tmp_path / name, mesh, **options)
    capfd.readouterr()
    found = read_unstructured(path, "s")
    assert capfd.readouterr() == ("", "")
    assert found.scalar == "s"
    assert not found.constant
    assert found.name == name
    assert found.source_sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert volume_of(found) == pytest.approx(min(len(mesh.cells), 2))
    assert np.array_equal(split(found).scalars, linear(split(found).vertices))
    expected = {"hexahedron": 1} if len(mesh.cells) == 1 else {"hexahedron": 1, "wedge": 2}
    assert split(found).report["cells"] == expected
    built(found)


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk"])
def test_formats_with_scalars_at_cells(name: str, tmp_path: Path) -> None:
    found = read_unstructured(written(tmp_path / name, mixed()), "c")
    assert found.constant
    volume = built(found)
    assert volume.scalar_range == (1, 3)
    assert len(volume.cells) == 12
    share = np.bincount((volume.gradients[:, 3] * 2).astype(int))
    assert share.tolist() == [6, 3, 3]


def test_gmsh_medit_and_abaqus(tmp_path: Path) -> None:
    mesh = mixed()
    mesh.cells, mesh.cell_data = mesh.cells[:1], {"c": [np.array([7.0])]}
    found = read_unstructured(written(tmp_path / "a.msh", mesh, file_format="gmsh"), "c")
    assert (found.constant, volume_of(found)) == (True, pytest.approx(1))
    assert built(found).scalar_range == (7, 7)
    mesh.point_data = {}
    mesh.cell_data = {"medit:ref": [np.array([4])]}
    found = read_unstructured(written(tmp_path / "a.mesh", mesh), "medit:ref")
    assert volume_of(found) == pytest.approx(1)
    assert not found.constant  # meshio makes a reference for every point, too
    mesh.cell_data = {}
    path = written(tmp_path / "a.inp", mesh)
    with pytest.raises(FileError, match=r"a\.inp: holds no arrays, only cells: export it with its"):
        read_unstructured(path)


def test_numbers_in_comments_are_no_counts(tmp_path: Path) -> None:
    mesh = mixed()
    mesh.cells, mesh.cell_data = mesh.cells[:1], {}
    path = written(tmp_path / "a.msh", mesh, file_format="gmsh")
    path.write_bytes(b"$Comments\n20260101 by hand\n$EndComments\n" + path.read_bytes())
    assert volume_of(read_unstructured(path, "s")) == pytest.approx(1)


def test_a_warning_of_meshio_is_short(tmp_path: Path) -> None:
    mesh = mixed()
    mesh.cells, mesh.cell_data = mesh.cells[:1], {}
    path = written(tmp_path / "a.msh", mesh, file_format="gmsh")
    path.write_bytes(path.read_bytes() + b"$Unknown" * 200 + b"\n")
    with pytest.warns(UserWarning, match="not closed|Unknown") as caught:
        read_unstructured(path, "s")
    assert all(len(str(warning.message)) < 300 for warning in caught)


def test_a_warning_of_another_thread_is_not_the_files(tmp_path: Path, monkeypatch, capsys) -> None:
    """Another thread, such as one that opens the device, warns and prints while meshio reads."""
    path = written(tmp_path / "a.vtk", mixed())

    def warn() -> None:
        warnings.warn("the folder cannot be written", DeviceWarning, stacklevel=1)
        print("a line", file=sys.stderr)

    def read(path: str, kind: str) -> Any:
        other = threading.Thread(target=warn)
        other.start()
        other.join()
        return meshio.read(path, kind)

    monkeypatch.setattr(through_meshio, "_read", read)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        read_unstructured(path, "s")
    assert [str(w.message) for w in found] == ["the folder cannot be written"]
    assert capsys.readouterr().err == "a line\n"


def test_an_array_at_points_goes_before_one_at_cells_and_the_only_one_needs_no_name(
    tmp_path: Path,
) -> None:
    mesh = mixed()
    del mesh.point_data["v"]
    mesh.cell_data["s"] = mesh.cell_data.pop("c")
    found = read_unstructured(written(tmp_path / "a.vtu", mesh))
    assert (found.scalar, found.constant) == ("s", False)


@pytest.mark.parametrize(
    ("component", "expected"),
    [
        ("x", lambda p: p[:, 0]),
        ("z", lambda p: p[:, 2] * 4),
        ("1", lambda p: p[:, 1] - 3),
        (1, lambda p: p[:, 1] - 3),
        ("magnitude", lambda p: np.sqrt(p[:, 0] ** 2 + (p[:, 1] - 3) ** 2 + 16 * p[:, 2] ** 2)),
    ],
)
def test_components(component, expected, tmp_path: Path) -> None:
    found = read_unstructured(written(tmp_path / "a.vtu", mixed()), "v", component)
    assert found.scalar == f"v {component}"
    assert np.allclose(found.scalars, expected(found.points), rtol=1e-15)


@pytest.mark.parametrize("kind", ["i1", "u2", "i8", "f4", "f8"])
def test_numbers_of_every_type(kind: str, tmp_path: Path) -> None:
    mesh = mixed()
    mesh.point_data["s"] = np.arange(len(mesh.points)).astype(kind)
    mesh.points = mesh.points.astype("f4")
    found = read_unstructured(written(tmp_path / "a.vtu", mesh), "s")
    assert isinstance(found.scalars, np.ndarray)
    assert found.scalars.dtype == found.points.dtype == np.float64
    assert np.array_equal(found.scalars, np.arange(len(mesh.points)))


@pytest.mark.parametrize(
    ("scalar", "component", "message"),
    [
        (None, None, r"a.vtu: which array\? Name one of c, s, v \(--scalar\)"),
        ("t", None, r"a.vtu: has no array 't': name one of c, s, v \(--scalar\)"),
        (
            "v",
            None,
            r"3 components, which component: --component x\|y\|z\|0\|1\|2\|magnitude",
        ),
        ("v", "w", r"v has 3 components, no component 'w': --component x\|y\|z"),
        ("v", "3", "no component '3'"),
        ("s", "x", "a.vtu: s is a scalar: leave --component out"),
    ],
)
def test_no_such_array(scalar, component, message: str, tmp_path: Path) -> None:
    path = written(tmp_path / "a.vtu", mixed())
    refusal(lambda path: read_unstructured(path, scalar, component), path, message)


def test_a_message_lists_a_few_of_many_components(tmp_path: Path) -> None:
    mesh = mixed()
    mesh.point_data["many"] = np.zeros((len(mesh.points), 100))
    path = written(tmp_path / "a.vtu", mesh)
    message = r"many has 100 components, which .* --component 0\|1\|.*\|17\|...\|magnitude$"
    refusal(lambda path: read_unstructured(path, "many", None), path, message)
    mesh.point_data["n" * 5000] = mesh.point_data.pop("many")
    path = written(tmp_path / "a.vtu", mesh)
    refusal(lambda path: read_unstructured(path, "x", None), path, f"name one of c, {'n' * 60}, s")


def changed(path: Path, *changes: tuple[bytes, bytes]) -> Path:
    data = path.read_bytes()
    for old, new in changes:
        assert old in data
        data = data.replace(old, new, 1)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"<VTKFile", b'<!DOCTYPE a [<!ENTITY b "c">]><VTKFile', "declares a document type"),
        (b"<VTKFile", b'<!DOCTYPE a SYSTEM "file:///etc/passwd"><VTKFile', "declares a document"),
        (b'NumberOfPoints="12"', b'NumberOfPoints="99999999"', "NumberOfPoints='99999999' is no"),
        (b'NumberOfPoints="12"', b'NumberOfPoints="-12"', "NumberOfPoints='-12' is no number"),
        (b'NumberOfCells="4"', b'NumberOfCells="5"', "meshio cannot read it as vtu"),
        (b'NumberOfPoints="12"', b'NumberOfPoints="13"', "meshio cannot read it as vtu"),
        (b"</Piece>", b"</Piece><Piece></Piece>", "has 2 pieces, of which meshio would read"),
        (b"</Points>", b"</Point>", "damaged XML: mismatched tag"),
        (b"UnstructuredGrid", b"PolyData", "meshio cannot read it as vtu: Expected type Unstruct"),
    ],
)
def test_hostile_xml(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    path = written(tmp_path / "a.vtu", mixed(), compression=None)
    refusal(lambda path: read_unstructured(path, "s"), changed(path, (old, new)), message)


def test_an_entity_bomb_is_refused_at_once(tmp_path: Path) -> None:
    bomb = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 30))
    path = tmp_path / "a.vtu"
    path.write_text(f'<?xml version="1.0"?><!DOCTYPE v [<!ENTITY e0 "x">{bomb}]><v>&e29;</v>')
    refusal(lambda path: read_unstructured(path), path, "declares a document type")


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk", "a.msh", "a.mesh", "a.inp"])
def test_damaged_meshes_are_one_line(name: str, tmp_path: Path, capfd) -> None:
    """Truncated anywhere, or bytes changed: read, or refused, and never anything else."""
    mesh = mixed()
    mesh.cells, mesh.cell_data = mesh.cells[:1], {}
    if name == "a.mesh":
        mesh.point_data, mesh.cell_data = {}, {"medit:ref": [np.array([4])]}
    options = {"file_format": "avsucd"} if name == "a.inp" else {}
    path = written(tmp_path / name, mesh, **options)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    messages = []
    capfd.readouterr()
    for step in range(40):
        mutant = bytearray(data)
        if step % 2:
            del mutant[int(rng.integers(len(data))) :]
        else:
            for place in rng.integers(len(data), size=3):
                mutant[place] = int(rng.integers(256))
        path.write_bytes(mutant)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                split(read_unstructured(path, "medit:ref" if name == "a.mesh" else "s"))
        except VoxtoolError as error:
            messages.append(str(error))
    assert len(messages) > 5
    assert not any("\n" in message or name not in message for message in messages)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.vtu", b"", "a.vtu is empty"),
        ("a.vtu", b"hello", "damaged XML"),
        ("a.vtk", b"hello", "meshio cannot read it as vtk"),
        ("a.msh", b"hello", "meshio cannot read it as gmsh"),
        ("a.mesh", b"hello", "meshio cannot read it as medit"),
        ("a.inp", b"hello", "meshio cannot read it as avsucd"),
        ("a.inp", b"8 6 1 0 0", "meshio cannot read it as avsucd"),
        ("a.obj", b"v 0 0 0", "no mesh of volume cells has this ending: give one of .vtu, .vtk"),
        ("a", b"v 0 0 0", "no mesh of volume cells has this ending"),
        ("a.pvtu", b"<VTKFile/>", "no mesh of volume cells has this ending"),
        ("a.tet.h5", b"hello", "is no mesh: name the file that it was made from"),
    ],
)
def test_no_mesh(name: str, data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with warnings.catch_warnings(action="error"):
        refusal(read_unstructured, tmp_path / name, message)


def test_no_file_no_stdin() -> None:
    with pytest.raises(FileError, match="there is no such file"):
        read_unstructured("none.vtu")
    with pytest.raises(FileError, match="a volume cannot be read from stdin: name a file"):
        read_unstructured("-")


def test_a_packed_bomb_is_bounded_by_the_file(tmp_path: Path) -> None:
    path = written(tmp_path / "a.vtu", mixed())
    count = 2000 * len(path.read_bytes())
    changed(path, (b'NumberOfPoints="12"', b'NumberOfPoints="%d"' % count))
    refusal(lambda path: read_unstructured(path, "s"), path, "is no number that")
    assert len(zlib.compress(bytes(1 << 24), 9)) * 1032 > 1 << 24  # so is what zlib can do


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux bounds the memory of a process")
def test_memory_is_limited(tmp_path: Path) -> None:
    points = np.zeros((1 << 21, 3))  # 50 MB: beyond 32 MB, free memory of the process is not taken
    mesh = meshio.Mesh(points, [("tetra", [[0, 1, 2, 3]])], {"s": points[:, 0]})
    path = written(tmp_path / "a.vtu", mesh)
    message = (
        r"a\.vtu: meshio needs more than the 1 MB that are free or allowed: raise --max-memory"
    )
    with pytest.raises(MemoryLimitError, match=message):
        read_unstructured(path, max_memory=1_000_000)
    assert len(read_unstructured(path).points) == 1 << 21


def test_meshio_is_an_extra(tmp_path: Path) -> None:
    path = written(tmp_path / "a.vtu", mixed())
    done = run_python("sys.modules['meshio'] = None\nvoxtool.read_unstructured(sys.argv[1])", path)
    message = b"a.vtu: meshio reads it, which is not installed: pip install 'voxtool[tets]'\n"
    assert done.stderr == message


def test_cubes_of_tetrahedra_survive_a_file(tmp_path: Path) -> None:
    mesh = cube(24)
    written(
        tmp_path / "a.vtu",
        meshio.Mesh(mesh.points, [("tetra", mesh.cells[0][1])], point_data={"s": mesh.scalars}),
    )
    assert built(read_unstructured(tmp_path / "a.vtu")).digest() == built(mesh).digest()
