"""Meshes of volume cells are read through meshio; volumes are read as they were written; what is
damaged or hostile is refused in one line.

The golden files tests/data/v1.0*.tet.h5 hold golden_volume() in each layout. They stay for good;
they were made once, at format version 1.0, by

    write_tet(golden_volume("raycast"), "tests/data/v1.0.tet.h5")
    write_tet(golden_volume("projection"), "tests/data/v1.0-projection.tet.h5")
    write_tet(golden_volume("hexahedra"), "tests/data/v1.0-hexahedra.tet.h5")
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import subprocess
import sys
import warnings
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import helpers_files
import meshio
import numpy as np
import pytest
from helpers_files import (
    attribute,
    changed_h5,
    check_mutants,
    check_truncated,
    edited,
    memory_below,
    newer_minor_version,
    stored,
    text,
)
from helpers_tets import CUBE, assembly, built, cube, lattice, linear, split, tet_mesh, unstructured

import voxtool
from voxtool import files, read_unstructured
from voxtool.choices import LAYOUTS
from voxtool.errors import FileError, VoxtoolError
from voxtool.files import tet_hdf5
from voxtool.tets.mesh import UnstructuredMesh
from voxtool.tets.volume import TetVolume

ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parents[1] / "data"
DOCUMENT = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
GOLDEN = {
    "raycast": "v1.0.tet.h5",
    "projection": "v1.0-projection.tet.h5",
    "hexahedra": "v1.0-hexahedra.tet.h5",
}
GOLDEN_DIGESTS = {
    "raycast": "7b3bb672fec2c1312ad7608768ad69b709e5d252bb51cf81e5b4f69c98346a3a",
    "projection": "4fe50048e0c28e981f24674a346bd4602f3395c5e3631361ea2ea8ec7e63f943",
    "hexahedra": "b7e7a040a23af2235668cfd795794f8146ae950a1c1aefd06f1e7bffb79fd7ca",
}


def golden_volume(layout: str = "raycast") -> TetVolume:
    """Three boxes in a row; a pyramid too, except for hexahedra, and scalars that differ."""
    points, cells = lattice((3, 1, 1))
    points = points * (0.7, 1.3, 2) + np.array([10, 0, -3])
    head = {"source_sha256": "0f" * 32, "name": "golden.vtu", "units": "mm"}
    said = {"plan": {"left_out": {"anchors": "none"}}, "report": {"merged_points": 7}}
    if layout == "hexahedra":
        values = [np.array([2.0, -1, 0.5])]
        mesh = unstructured(points, [("hexahedron", cells)], values, **head)
        return replace(built(mesh, layout), **said)
    points = np.concatenate([points, [(9, 0.5, -2)]])
    scalars = linear(points) + (np.arange(len(points)) % 3) ** 2
    blocks = [("pyramid", [(0, 8, 12, 4, 16)]), ("hexahedron", cells)]
    return replace(built(unstructured(points, blocks, scalars, **head), layout), **said)


def constant_volume() -> TetVolume:
    mesh = assembly((2, 2, 2), 0)
    values = [np.arange(len(block), dtype=float) for _, block in mesh.cells]
    return built(unstructured(mesh.points, mesh.cells, values))


VOLUMES: dict[str, Callable[[], TetVolume]] = {
    **{layout: lambda layout=layout: golden_volume(layout) for layout in LAYOUTS},
    "constant": constant_volume,
    "one": lambda: built(tet_mesh(CUBE[[0, 1, 3, 4]], [(0, 1, 2, 3)])),
    "many": lambda: built(assembly((4, 4, 3), 1)),
}


def to_bytes(volume: TetVolume) -> bytes:
    file = io.BytesIO()
    tet_hdf5.write(volume, file)
    return file.getvalue()


def from_bytes(data: bytes) -> TetVolume:
    return tet_hdf5.read(io.BytesIO(data), len(data))


def assert_same(a: TetVolume, b: TetVolume) -> None:
    assert a.digest() == b.digest()
    assert (a.units, a.source_sha256) == (b.units, b.source_sha256)
    for name in ("report", "plan"):
        assert json.dumps(getattr(a, name)) == json.dumps(getattr(b, name))  # the order, too
    assert a.arrays().keys() == b.arrays().keys()
    for name, array in a.arrays().items():
        assert array.dtype == b.arrays()[name].dtype
        assert np.array_equal(array, b.arrays()[name])


# ---- round trips


@pytest.mark.parametrize("layout", LAYOUTS)
def test_golden_files_of_version_1_0_read_for_good(layout: str) -> None:
    golden = files.read_tet(DATA / GOLDEN[layout])
    assert golden.digest() == GOLDEN_DIGESTS[layout]
    assert_same(golden, golden_volume(layout))


@pytest.mark.parametrize("name", VOLUMES)
def test_what_is_written_is_read(name: str, tmp_path: Path) -> None:
    volume = VOLUMES[name]()
    voxtool.write_tet(volume, tmp_path / "a.tet.h5")
    found = voxtool.read_tet(tmp_path / "a.tet.h5")
    assert isinstance(found, voxtool.TetVolume)
    assert_same(found, volume)
    assert_same(files.read_scene(tmp_path / "a.tet.h5"), volume)  # pyright: ignore


def test_bytes_depend_on_the_content_alone() -> None:
    assert to_bytes(golden_volume()) == to_bytes(from_bytes(to_bytes(golden_volume())))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_datasets_can_be_uploaded_as_they_lie(layout: str, tmp_path: Path) -> None:
    volume, path = golden_volume(layout), tmp_path / "a.tet.h5"
    files.write_tet(volume, path)
    with h5py.File(path) as h5:
        assert sorted(h5) == sorted(volume.arrays())
        for name, array in volume.arrays().items():
            dataset = h5[name]
            assert isinstance(dataset, h5py.Dataset)
            assert dataset.chunks is None
            start = dataset.id.get_offset()
            assert path.read_bytes()[start : start + array.nbytes] == array.tobytes()


def test_newer_minor_version_reads(tmp_path: Path) -> None:
    assert_same(files.read_tet(hostile(tmp_path, newer_minor_version)), golden_volume())


def test_what_differs_shows_in_the_digest() -> None:
    volume = golden_volume()
    moved = np.roll(volume.vertices, 1, axis=0)
    changes: list[dict[str, Any]] = [
        {"scale": 2 * volume.scale},
        {"origin": (0.0, 0.0, 1.0)},
        {"scalar_range": (0.0, 1.0)},
        {"scalar": "t"},
        {"vertices": moved},
    ]
    digests = {replace(volume, **change).digest() for change in changes}
    assert len({volume.digest(), *digests}) == len(changes) + 1
    same = replace(volume, units="m", plan={}, report={}, source_sha256="")
    assert same.digest() == volume.digest()


# ---- the recipe of docs/formats.md, in plain Python


def test_recipe_of_the_documents(tmp_path: Path) -> None:
    """The scalar at a point of the mesh, found cell by cell."""
    path = tmp_path / "a.tet.h5"
    mesh = assembly((2, 2, 2), 3)
    for layout in ("raycast", "projection"):
        files.write_tet(built(mesh, layout), path)
        with h5py.File(path) as h5:
            origin, scale = h5.attrs["origin"].tolist(), h5.attrs["scale"].item()  # pyright: ignore
            low, high = h5.attrs["scalar_range"].tolist()  # pyright: ignore
            arrays = {name: h5[name][()].tolist() for name in h5}  # pyright: ignore
        random = np.random.default_rng(0)
        for world in random.uniform(0, 2, (30, 3)).tolist():
            x = [(w - o) / scale for w, o in zip(world, origin, strict=True)]
            cell = next(t for t in range(len(arrays["cells"])) if inside(arrays, layout, t, x))
            g = arrays["gradients"][cell]
            if layout == "raycast":
                s = sum(a * b for a, b in zip(g, x, strict=False)) + g[3]
            else:
                *anchor, s = arrays["vertices"][arrays["anchors"][cell][0]]
                s += sum(a * (b - c) for a, b, c in zip(g, x, anchor, strict=True))
            exact = linear(np.array([world]))[0]
            assert low + (high - low) * s == pytest.approx(exact, abs=1e-5)


def inside(arrays: dict[str, Any], layout: str, cell: int, x: list[float]) -> bool:
    for face in range(4):
        n = arrays["normals"][face][cell]
        height = sum(a * b for a, b in zip(n, x, strict=False))
        if layout == "raycast":
            height += n[3]
        else:
            anchor = arrays["vertices"][arrays["anchors"][cell][face == 0]]
            height -= sum(a * b for a, b in zip(n, anchor, strict=False))
        if height > 1e-6:
            return False
    return True


def test_digest_of_the_documents() -> None:
    (line,) = re.findall(r"^\{\"constant\".*\}$", DOCUMENT, re.MULTILINE)
    sha = hashlib.sha256(line.encode())
    with h5py.File(DATA / GOLDEN["raycast"]) as h5:
        for name in ("vertices", "cells", "neighbours", "normals", "gradients", "ranges"):
            sha.update(h5[name][()].tobytes())  # pyright: ignore
    assert sha.hexdigest() == GOLDEN_DIGESTS["raycast"]


# ---- names, streams, files of another kind


def test_format_is_chosen_by_extension_and_read_by_content(tmp_path: Path) -> None:
    for name in ("a.tet.h5", "a.h5", "A.TET.H5"):
        files.write_tet(golden_volume(), tmp_path / name)
        moved = (tmp_path / name).rename(tmp_path / "no-extension")
        assert_same(files.read_tet(moved), golden_volume())
    for name in ("a.dat", "a.svo.h5", "a.adf.h5"):
        with pytest.raises(FileError, match=r"says no format: end it in one of \.tet\.h5$"):
            files.write_tet(golden_volume(), tmp_path / name)
    with pytest.raises(FileError, match=r"format 'obj' is unknown: choose one of tet\.h5, h5"):
        files.write_tet(golden_volume(), tmp_path / "a.obj", format="obj")


def test_stdin_and_stdout() -> None:
    code = "import voxtool; voxtool.write_tet(voxtool.read_tet('-'), '-')"
    data = to_bytes(golden_volume())
    done = subprocess.run([sys.executable, "-c", code], input=data, cwd=ROOT, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert_same(from_bytes(done.stdout), golden_volume())


def test_no_clobber(tmp_path: Path) -> None:
    path = tmp_path / "a.tet.h5"
    files.write_tet(golden_volume(), path, clobber=False)
    with pytest.raises(FileError, match="exists"):
        files.write_tet(constant_volume(), path, clobber=False)
    assert_same(files.read_tet(path), golden_volume())


def refusal(path: Path, message: str, read: Callable = files.read_tet) -> None:
    helpers_files.refusal(read, path, message)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("bunny.obj", b"v 0 0 0\n", "is a mesh of triangles: .*: voxtool tet-build MESH.vtu"),
        ("bunny", b"ply\nformat ascii 1.0\n", "is a mesh of triangles"),
        ("a.vtu", b"<?xml?>", r"build its textures first: voxtool tet-build \S+a\.vtu$"),
        ("a.ex2", b"\x89HDF\r\n\x1a\n", "is a mesh of volume cells: build its textures first"),
        ("a.tet.h5", b"", "is empty"),
        ("a.tet.h5", b"hello", r"is no tetrahedral volume: expected HDF5 \(\.tet\.h5\)"),
        ("a.tet.h5", b"\x89HDF\r\n\x1a\n", "damaged HDF5 file"),
    ],
)
def test_file_of_another_kind(tmp_path: Path, name: str, data: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(data)
    refusal(tmp_path / name, message)


def test_the_others_name_the_missing_step(tmp_path: Path) -> None:
    golden = DATA / GOLDEN["raycast"]
    message = "holds 'voxtool-tet', not an octree .*: voxelize a mesh first"
    refusal(golden, message, files.read_svo)
    message = "holds 'voxtool-tet', not a distance field .*: build a field first"
    refusal(golden, message, files.read_adf)
    (tmp_path / "a.vtu").write_bytes(b"<?xml?>")
    for read in (files.read_svo, files.read_adf):
        refusal(tmp_path / "a.vtu", "is a mesh of volume cells: build its textures first", read)
    message = "holds 'voxtool-adf', not a tetrahedral volume .*: build its textures first"
    refusal(DATA / "v1.0.adf.h5", message)
    refusal(tmp_path / "none.tet.h5", "there is no such file")
    refusal(tmp_path, "is a folder")


# ---- hostile files


def hostile(folder: Path, change: Callable[[h5py.File], None], layout: str = "raycast") -> Path:
    path = folder / "a.tet.h5"
    files.write_tet(golden_volume(layout), path)
    return changed_h5(path, change)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("format", None, "an HDF5 file, but no tetrahedral volume: attribute format=voxtool-tet"),
        ("layout", text("table 6"), "attribute layout is 'table 6' where raycast or projection or"),
        (
            "layout",
            text("projection"),
            r"dataset normals has shape \(4, 20, 4\) where \(4, 20, 3",
        ),
        ("layout", text("hexahedra"), r"dataset cells has shape \(\d+, 4\) where \(None, 8\)"),
        ("origin", [np.nan, 0, 0], "attribute origin .* is not finite"),
        ("origin", [1.7e308, 0, 0], None),
        ("scale", 0.0, "attribute scale is 0.0: a positive number"),
        ("scale", np.inf, "attribute scale is inf: a positive number"),
        ("scale", 3.0, "volume scale 3: a power of two is expected"),
        ("scale", 2.0**1023, None),
        ("scalar_range", [1.0, np.inf], "attribute scalar_range .* is not finite"),
        ("scalar_range", [2.0, 1.0], "volume scalar_range 2 to 1: no finite range"),
        ("scalar_range", [-1e308, 1e308], "volume scalar_range -1e.308 to 1e.308: no finite range"),
        ("constant", 2, "attribute constant is '2' where 0 or 1"),
        ("constant", 1, "volume ranges: they are not those of the cells"),
        ("scalar", text("m" * 257), "attribute scalar has 257 bytes: at most 256"),
        ("report", text("{"), "attribute report is not JSON"),
    ],
)
def test_attributes(tmp_path: Path, name: str, value: Any, message: str | None) -> None:
    path = hostile(tmp_path, attribute(name, value))
    if message is not None:
        refusal(path, message)
    else:  # far away or large, and sound
        assert np.isfinite(files.read_tet(path).bounds()).all()


def swap_neighbours(h5: h5py.File) -> None:
    """Each cell's neighbours are those of its faces in another order."""
    h5["neighbours"][...] = np.roll(h5["neighbours"][()], 1, axis=1)  # pyright: ignore


def no_cells(h5: h5py.File) -> None:
    for name in ("cells", "neighbours", "gradients", "ranges"):
        stored(name, lambda d: d[:0])(h5)
    stored("normals", lambda d: d[:, :0])(h5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            stored("normals", lambda d: d.astype("f8")),
            "normals is not of type float32, little-endian",
        ),
        (
            stored("cells", lambda d: d.astype("u4")),
            "cells is not of type int32, little-endian",
        ),
        (
            stored("cells", lambda d: d[:-1]),
            "dataset neighbours has shape",
        ),
        (no_cells, "volume: 0 cells"),
        (edited("vertices", (3, 0), np.nan), "volume vertices: positions in"),
        (edited("vertices", (3, 0), 1.5), "volume vertices: positions in"),
        (edited("vertices", (3, 3), -0.5), "volume vertices: .* scalars in"),
        (edited("normals", (1, 2, 3), np.inf), "volume normals: unit normals and offsets"),
        (edited("normals", (1, 2, 0), -1.5), "volume normals"),
        (edited("normals", (0, 0), (0, 0, 0, 0)), "volume normals"),
        (edited("gradients", (1, 0), np.nan), "volume gradients: numbers up to"),
        (edited("gradients", (1, 0), -1e38), "volume gradients: numbers up to"),
        (edited("gradients", (1, 0), 7), "volume gradients: they do not give the scalars"),
        (edited("gradients", (1, 3), 1e-3), "volume gradients: they do not give the scalars"),
        (edited("ranges", (0, 0), 0.25), "volume ranges: they are not those of the cells"),
        (edited("ranges", (0, 1), np.nan), "volume ranges: pairs in"),
        (edited("cells", (2, 1), 17), "volume cells: a vertex is not one of the 17"),
        (edited("cells", (2, 1), -1), "volume cells: a vertex is not one of the 17"),
        (edited("cells", 0, (0, 1, 2, 1)), "volume cells: a cell names a vertex twice"),
        (edited("neighbours", (1, 0), 2**31 - 1), "volume neighbours: one is not one of the"),
        (edited("neighbours", (1, 0), -2), "volume neighbours: one is not one of the"),
        (edited("neighbours", 1, (1, 1, 1, 1)), "volume neighbours: a cell is not the neighbour"),
        (edited("neighbours", 0, (-1, -1, -1, -1)), "volume neighbours: a cell is not the neigh"),
        (swap_neighbours, "volume neighbours: two cells share a face whose vertices differ"),
    ],
)
def test_datasets(tmp_path: Path, change: Callable, message: str) -> None:
    path = hostile(tmp_path, change)
    with memory_below(8 << 20):
        refusal(path, message)


def test_a_shared_face_has_one_plane(tmp_path: Path) -> None:
    volume = golden_volume()
    cell, face = np.argwhere(volume.neighbours >= 0)[0]
    nudged = np.nextafter(volume.normals[face, cell, 3], np.float32(2))
    path = hostile(tmp_path, edited("normals", (face, cell, 3), nudged))
    refusal(path, "volume normals: those of a shared face are not each other's negation")


@pytest.mark.parametrize(
    ("layout", "change", "message"),
    [
        (
            "projection",
            edited("anchors", (1, 1), 0),
            "volume anchors: they are not vertices",
        ),
        ("projection", edited("gradients", (1, 1), 0.7), "they do not give the scalars"),
        ("projection", edited("normals", (2, 3), (0.6, 0.8, 0)), "volume normals"),
        ("projection", attribute("constant", 1), "volume: table 4 holds no constant cells"),
        ("hexahedra", attribute("constant", 0), "volume: hexahedra have constant scalars"),
        ("hexahedra", edited("gradients", (1, 1), 1), "those of constant cells are 0"),
        ("hexahedra", edited("vertices", (1, 3), 1), "those of constant cells are 0"),
        ("hexahedra", edited("gradients", (1, 3), 2), "volume ranges: they are not those"),
        ("hexahedra", edited("vertices", (5, 1), 0.9), "volume normals: one is not that of its"),
    ],
)
def test_datasets_of_other_layouts(
    tmp_path: Path, layout: str, change: Callable, message: str
) -> None:
    refusal(hostile(tmp_path, change, layout), message)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_damage_of_any_kind(layout: str) -> None:
    data = to_bytes(golden_volume(layout))
    check_truncated(data, from_bytes)
    check_mutants(data, from_bytes, LAYOUTS.index(layout), least=60)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"plan": {"a": "x" * 70_000}}, "attribute plan has .* bytes: at most 60000 fit"),
        ({"report": {"a": float("inf")}}, "attribute report cannot be JSON"),
        ({"units": "a\nb"}, "attribute units has characters that cannot be printed"),
        ({"layout": "table 5"}, "attribute layout is 'table 5'"),
        ({"scale": float("nan")}, "attribute scale is nan"),
    ],
)
def test_what_would_not_read_is_not_written(change: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=message):
        files.write_tet(replace(golden_volume(), **change), tmp_path / "a.tet.h5")
    assert list(tmp_path.iterdir()) == []


# ---- meshes, through meshio


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
        ("a.ex2", {}),
        ("A.EXO", {"file_format": "exodus"}),
        ("a.e", {}),
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


def test_gmsh_with_scalars_at_cells(tmp_path: Path) -> None:
    mesh = mixed()
    mesh.cells, mesh.cell_data = mesh.cells[:1], {"c": [np.array([7.0])]}
    found = read_unstructured(written(tmp_path / "a.msh", mesh, file_format="gmsh"), "c")
    assert (found.constant, volume_of(found)) == (True, pytest.approx(1))
    assert built(found).scalar_range == (7, 7)


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk"])
def test_formats_with_scalars_at_cells(name: str, tmp_path: Path) -> None:
    found = read_unstructured(written(tmp_path / name, mixed()), "c")
    assert found.constant
    volume = built(found)
    assert volume.scalar_range == (1, 3)
    assert len(volume.cells) == 12
    share = np.bincount((volume.gradients[:, 3] * 2).astype(int))
    assert share.tolist() == [6, 3, 3]


def test_medit_and_abaqus(tmp_path: Path) -> None:
    mesh = mixed()
    mesh.cells = mesh.cells[:1]
    mesh.point_data = {}
    mesh.cell_data = {"medit:ref": [np.array([4])]}
    found = read_unstructured(written(tmp_path / "a.mesh", mesh), "medit:ref")
    assert volume_of(found) == pytest.approx(1)
    assert not found.constant  # meshio makes a reference for every point, too
    mesh.cell_data = {}
    path = written(tmp_path / "a.inp", mesh)
    with pytest.raises(FileError, match=r"a\.inp: holds no arrays, only cells: export it with its"):
        read_unstructured(path)


def test_the_only_array_needs_no_name(tmp_path: Path) -> None:
    mesh = mixed()
    del mesh.point_data["v"]
    mesh.cell_data = {}
    assert read_unstructured(written(tmp_path / "a.vtu", mesh)).scalar == "s"


def test_an_array_at_points_goes_before_one_at_cells(tmp_path: Path) -> None:
    mesh = mixed()
    mesh.cell_data["s"] = mesh.cell_data.pop("c")
    assert not read_unstructured(written(tmp_path / "a.vtu", mesh), "s").constant


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
    refusal(path, message, lambda path: read_unstructured(path, scalar, component))


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
    refusal(changed(path, (old, new)), message, lambda path: read_unstructured(path, "s"))


def test_an_entity_bomb_is_refused_at_once(tmp_path: Path) -> None:
    bomb = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 30))
    path = tmp_path / "a.vtu"
    path.write_text(f'<?xml version="1.0"?><!DOCTYPE v [<!ENTITY e0 "x">{bomb}]><v>&e29;</v>')
    refusal(path, "declares a document type", lambda path: read_unstructured(path))


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk", "a.msh", "a.mesh", "a.ex2", "a.inp"])
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
        ("a.ex2", b"hello", "meshio cannot read it as exodus"),
        ("a.obj", b"v 0 0 0", "no mesh of volume cells has this ending: give one of .vtu, .vtk"),
        ("a", b"v 0 0 0", "no mesh of volume cells has this ending"),
        ("a.tet.h5", b"hello", "is no mesh: name the file that it was made from"),
    ],
)
def test_no_mesh(name: str, data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    refusal(tmp_path / name, message, read_unstructured)


def test_no_file_no_stdin() -> None:
    with pytest.raises(FileError, match="there is no such file"):
        read_unstructured("none.vtu")
    with pytest.raises(FileError, match="a volume cannot be read from stdin: name a file"):
        read_unstructured("-")


def test_a_packed_bomb_is_bounded_by_the_file(tmp_path: Path) -> None:
    path = written(tmp_path / "a.vtu", mixed())
    count = 2000 * len(path.read_bytes())
    changed(path, (b'NumberOfPoints="12"', b'NumberOfPoints="%d"' % count))
    refusal(path, "is no number that", lambda path: read_unstructured(path, "s"))
    assert len(zlib.compress(bytes(1 << 24), 9)) * 1032 > 1 << 24  # so is what zlib can do


def test_meshio_is_an_extra(tmp_path: Path) -> None:
    path = written(tmp_path / "a.vtu", mixed())
    code = (
        "import sys; sys.modules['meshio'] = None\n"
        "import voxtool\n"
        "try: voxtool.read_unstructured(sys.argv[1])\n"
        "except voxtool.FileError as error: print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, path], cwd=ROOT, capture_output=True, text=True
    )
    assert done.stdout == (
        "a.vtu: meshio reads it, which is not installed: pip install 'voxtool[tets]'\n"
    )


def test_what_meshio_warns_of_is_told(tmp_path: Path) -> None:
    """Exodus: of several steps in time one is read."""
    path = written(tmp_path / "a.ex2", mixed())
    from netCDF4 import Dataset

    with Dataset(path, "r+") as data:
        variable = next(name for name in data.variables if name.startswith("vals_nod_var"))
        data.variables["time_whole"][1] = 1.0
        data.variables[variable][1] = 0.0
    with pytest.warns(UserWarning, match="a.ex2: .*[Ss]kipping some time data"):
        read_unstructured(path, "s")


def test_cubes_of_tetrahedra_survive_a_file(tmp_path: Path) -> None:
    mesh = cube(24)
    written(
        tmp_path / "a.vtu",
        meshio.Mesh(mesh.points, [("tetra", mesh.cells[0][1])], point_data={"s": mesh.scalars}),
    )
    assert built(read_unstructured(tmp_path / "a.vtu")).digest() == built(mesh).digest()
