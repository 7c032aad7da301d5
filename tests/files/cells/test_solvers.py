"""Exports for solvers: other programs read the hexahedra, materials and surfaces of .vtu, .msh and
.inp."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.attributes import attributed
from helpers.cli import fail, run, told
from helpers.octree import WORLD, ball

import voxtool
from voxtool.files import open_svo
from voxtool.files.cells import inp
from voxtool.files.exchange import plan_export
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.images.image_parts import ImageInParts
from voxtool.svo.solvers.hexahedra import CORNERS, SIDES, name_of

meshio: Any = pytest.importorskip("meshio")
FORMATS = ("vtu", "msh", "inp")
DENSE = ball((20, 17, 11)) & (np.random.default_rng(1).random((20, 17, 11)) < 0.9)
# Faces of Abaqus's C3D8, by its manual, in nodes counted from 1.
C3D8 = {
    "S1": (1, 2, 3, 4), "S2": (5, 8, 7, 6), "S3": (1, 5, 6, 2),
    "S4": (2, 6, 7, 3), "S5": (3, 7, 8, 4), "S6": (4, 8, 5, 1),
}  # fmt: skip


def exported(name: str, folder: Path, dense: np.ndarray = DENSE, **more) -> Path:
    """The path of an export of the size that its plan says."""
    job = plan_export(voxtool.Octree.from_dense(dense, **WORLD), folder / f"a.{name}", **more)
    assert job.run() == job.plan.size
    return folder / f"a.{name}"


def quads_of(dense: np.ndarray) -> dict[str, np.ndarray]:
    """The corners of the faces of each surface in world units, (n, 4, 3) sorted."""
    padded, found = np.pad(dense, 1), {}
    for n, side in enumerate(SIDES):
        beside = np.roll(padded, 1 if n % 2 == 0 else -1, n // 2)
        cells = np.argwhere(padded & ~beside) - 1
        found[side.name] = rows(place(cells[:, None] + np.array(CORNERS)[list(side.corners)]))
    return found


def place(nodes: np.ndarray) -> np.ndarray:
    return np.array(WORLD["origin"]) + np.array(WORLD["pitch"]) * nodes


def rows(corners: np.ndarray) -> np.ndarray:
    """Faces, each with its corners in their cyclic order, sorted."""
    first = np.array([min(range(4), key=lambda k: tuple(face[k])) for face in corners])
    turned = corners[np.arange(len(corners))[:, None], (first[:, None] + range(4)) % 4]
    return turned[np.lexsort(turned.reshape(len(turned), -1).T[::-1])]


def unturned(faces: np.ndarray) -> np.ndarray:
    """Faces without the order of their corners, in which Abaqus lists some from inside."""
    return np.array(sorted(sorted(map(tuple, face)) for face in faces.tolist()))


@pytest.mark.parametrize("name", FORMATS)
def test_meshio_reads_the_hexahedra(name: str, tmp_path: Path) -> None:
    mesh = meshio.read(exported(name, tmp_path))
    cells = np.argwhere(DENSE)
    assert len(np.unique(mesh.points, axis=0)) == len(mesh.points)
    assert [block.type for block in mesh.cells if block.dim == 3] == ["hexahedron"]
    found = mesh.points[mesh.cells[0].data]
    assert np.array_equal(found, place(cells[:, None] + CORNERS))


@pytest.mark.parametrize("name", ["vtu", "msh"])
def test_meshio_reads_the_surfaces(name: str, tmp_path: Path) -> None:
    mesh, expected = meshio.read(exported(name, tmp_path)), quads_of(DENSE)
    total = sum(map(len, expected.values()))
    if name == "vtu":
        number = {key: int(value[0, 0]) for key, value in mesh.field_data.items()}
        assert mesh.cell_data["label"][0].tolist() == [1] * np.count_nonzero(DENSE)
        assert {int(value[0, 1]) for key, value in mesh.field_data.items()} == {2, 3}
        assert len(mesh.cells[1].data) == total
        for key, faces in expected.items():
            own = mesh.cells[1].data[mesh.cell_data["surface"][1] == number[key]]
            assert np.array_equal(rows(mesh.points[own]), faces)
        return
    for key, faces in expected.items():
        own = [b.data[s] for b, s in zip(mesh.cells, mesh.cell_sets[key], strict=True) if len(s)]
        assert np.array_equal(rows(mesh.points[own[0]]), faces)
    assert sum(map(len, mesh.cell_sets["boundary"])) == total
    assert len(mesh.cell_sets["solid"][0]) == np.count_nonzero(DENSE)


def test_surfaces_of_abaqus(tmp_path: Path) -> None:
    """Each surface names element sets and the numbers of their faces, whose nodes are those."""
    path = exported("inp", tmp_path)
    mesh, expected = meshio.read(path), quads_of(DENSE)
    assert len(mesh.cell_sets["solid"][0]) == np.count_nonzero(DENSE)
    surfaces: dict[str, list[list[str]]] = {}
    name = None
    for line in path.read_text().splitlines():
        assert len(line) < 256
        if line.startswith("*"):
            name = line.partition("NAME=")[2]
        elif name:
            surfaces.setdefault(name, []).append(line.split(", "))
    assert surfaces.keys() == {*expected, "boundary"}
    for name, parts in surfaces.items():
        found = []
        for own, face in parts:
            cells = mesh.cells[0].data[mesh.cell_sets[own][0]]
            found.append(cells[:, np.array(C3D8[face]) - 1])
        wanted = expected.values() if name == "boundary" else [expected[name]]
        faces = mesh.points[np.concatenate(found)]
        assert np.array_equal(unturned(faces), unturned(np.concatenate(list(wanted))))


def labelled(level: int) -> tuple[voxtool.Octree, np.ndarray]:
    """An octree of labels, and the labels of its cells, from 1, as a dense array."""
    octree = attributed()
    image = AttributeImage(VoxelImage.of(octree, level=level, dtype=bool), "label")
    return octree, np.concatenate(list(image.slabs()))


def faces_between(labels: np.ndarray, low: int, high: int) -> np.ndarray:
    """The faces of cells of one label that cells of another touch, in cells."""
    padded, found = np.pad(labels, 1), []
    for n, side in enumerate(SIDES):
        beside = np.roll(padded, 1 if n % 2 == 0 else -1, n // 2)
        cells = np.argwhere((padded == low) & (beside == high)) - 1
        found.append(cells[:, None] + np.array(CORNERS)[list(side.corners)])
    return np.concatenate(found)


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("name", FORMATS)
def test_labels_are_materials(name: str, level: int, tmp_path: Path) -> None:
    """Their cells, and the faces between them, have the names that solvers take."""
    octree, labels = labelled(level)
    job = plan_export(octree, tmp_path / f"a.{name}", level=level)
    assert job.run() == job.plan.size
    mesh, names = meshio.read(tmp_path / f"a.{name}"), ("head", "gr__e", "a_b")
    cells = (mesh.points - octree.grid.origin) / (np.array(octree.grid.pitch) * 2**level)
    assert np.allclose(cells, np.rint(cells))
    points = np.rint(cells)
    blocks = [(b.type, b.data) for b in mesh.cells]
    quads: dict[str, np.ndarray] = {}
    if name == "vtu":
        numbers = {key: int(value[0, 0]) for key, value in mesh.field_data.items()}
        of = {own: blocks[0][1][mesh.cell_data["label"][0] == numbers[own]] for own in names}
        quads = {
            own: blocks[1][1][mesh.cell_data["surface"][1] == number]
            for own, number in numbers.items()
        }
        assert not mesh.cell_data["label"][1].any()
        assert not mesh.cell_data["surface"][0].any()
    else:
        sets = {
            own: np.concatenate(
                [data[part] for (_, data), part in zip(blocks, parts, strict=True) if len(part)]
            )
            for own, parts in mesh.cell_sets.items()
            if own != "gmsh:bounding_entities"
        }
        of = {own: sets[own] for own in names}
        quads = sets
    for number, own in enumerate(names, 1):
        assert np.array_equal(points[of[own]], np.argwhere(labels == number)[:, None] + CORNERS)
    inner = 0
    for low, high in ((1, 2), (1, 3), (2, 3)):
        expected = faces_between(labels, low, high)
        own = f"{names[low - 1]}-{names[high - 1]}"
        assert job.plan.about["surfaces"][own] == len(expected)
        inner += len(expected)
        if name == "inp":
            text = (tmp_path / "a.inp").read_text()
            parts = [f"{own}_{face}" for face in inp.FACES if f"ELSET={own}_{face}\n" in text]
            rows_of = text.partition(f"NAME={own}\n")[2].partition("*")[0].splitlines()
            assert rows_of == [f"{part}, {part[-2:]}" for part in parts]
            found = []
            for part in parts:
                elements = np.concatenate(
                    [b[1][s] for b, s in zip(blocks, mesh.cell_sets[part], strict=True)]
                )
                found.append(elements[:, np.array(C3D8[part[-2:]]) - 1])
            assert np.array_equal(unturned(points[np.concatenate(found)]), unturned(expected))
        else:
            assert np.array_equal(rows(points[quads[own]]), rows(expected.astype(float)))
    assert inner > 100


def test_names() -> None:
    used = {"boundary"}
    texts = ["a b", "a_b", "A_B", "Boundary", "7up", "x_S6", "ä" * 99]
    found = [name_of(text, used, 32) for text in texts]
    assert found == ["a_b", "a_b-2", "A_B-3", "Boundary-2", "m_7up", "x-S6", "m_" + "_" * 32]


def test_vtk_reads_it(tmp_path: Path) -> None:
    """Hexahedra and faces look outwards: the volume, and that within the boundary, are right."""
    vtk = pytest.importorskip("vtkmodules.vtkIOXML")
    support = pytest.importorskip("vtkmodules.util.numpy_support")
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(exported("vtu", tmp_path)))
    reader.Update()
    grid = reader.GetOutput()
    count, faces = np.count_nonzero(DENSE), sum(map(len, quads_of(DENSE).values()))
    kinds = support.vtk_to_numpy(grid.GetCellTypes())
    assert kinds.tolist() == [12] * count + [9] * faces
    points = support.vtk_to_numpy(grid.GetPoints().GetData())
    assert points.dtype == np.float64
    ends = support.vtk_to_numpy(grid.GetCells().GetOffsetsArray())
    nodes = support.vtk_to_numpy(grid.GetCells().GetConnectivityArray())
    assert ends[count] == 8 * count
    a, b, _, d = points[nodes[8 * count :].reshape(-1, 4)].transpose(1, 0, 2)
    inside = (a * np.cross(b - a, d - a)).sum() / 3
    assert inside == pytest.approx(count * 1e-3, rel=1e-9)


def test_coordinates_of_abaqus_have_twenty_letters() -> None:
    """They read back exactly, or differ by less than the last of the digits that fit."""
    for value in (0.1, -1.2345678901234567e-300, -0.12345678901234567, 1e22, 2 / 3 * 1e5, -0.0):
        text = inp._text(value)
        assert len(text) <= 20
        assert float(text) == pytest.approx(value, rel=1e-12, abs=0)
    assert float(inp._text(0.1)) == 0.1


@pytest.mark.parametrize("name", FORMATS)
def test_wide_numbers(name: str, tmp_path: Path, monkeypatch) -> None:
    """Numbers of more digits than the small test has make the same mesh."""
    expected = meshio.read(exported(name, tmp_path))
    monkeypatch.setattr("voxtool.files.cells.vtu._index", lambda mesh: np.dtype("<i8"))
    monkeypatch.setattr("voxtool.files.cells.inp._width", lambda mesh: 12)
    found = meshio.read(exported(name, tmp_path))
    assert np.array_equal(found.points, expected.points)
    for one, other in zip(found.cells, expected.cells, strict=True):
        assert np.array_equal(one.data, other.data)


@pytest.mark.parametrize("name", ["vtu", "msh"])
def test_a_volume_can_be_built(name: str, here: Path) -> None:
    """Faces without a neighbour are those of the boundary."""
    report = told(f"export bunny.svo.h5 -o a.{name} --json")
    scalar = "label" if name == "vtu" else "gmsh:physical"
    built = told(f"tet-build a.{name} --scalar {scalar} --layout hexahedra --json")
    assert (built["hexahedra"], built["vertices"]) == (report["hexahedra"], report["nodes"])
    assert built["boundary_faces"] == report["surfaces"]["boundary"]


def test_plans_and_refusals(here: Path) -> None:
    plan = told("export bunny.svo.h5 -o a.inp --plan --json")
    run("export bunny.svo.h5 -o a.inp")
    assert plan["bytes"] == Path("a.inp").stat().st_size
    assert plan["surfaces"]["x_low"] == plan["surfaces"]["x_high"] > 0
    assert "of 1 kB allowed" in fail("export bunny.svo.h5 -o b.inp --max-bytes 1000")
    assert ".msh holds bool, not float32" in fail("export bunny.svo.h5 -o b.msh --dtype float32")
    assert "is a mesh of volume cells: build its textures" in fail("svo-info a.inp")
    assert not Path("b.inp").exists()


def test_octrees_larger_than_memory(tmp_path: Path) -> None:
    """They are read in windows, within the memory that is allowed, for the same bytes."""
    voxels = np.random.default_rng(1).integers(0, 512, (60_000, 3))
    octree = voxtool.Octree.from_voxels(voxels, voxtool.Grid((512,) * 3, (0, 0, 0), (1, 1, 1)))
    voxtool.write_svo(octree, tmp_path / "a.svo.h5")
    voxtool.export(octree, tmp_path / "a.vtu")
    with open_svo(tmp_path / "a.svo.h5") as content:
        job = plan_export(content, tmp_path / "b.vtu", max_memory=20_000_000)
        assert isinstance(job.plan.image.image, ImageInParts)
        assert len(list(job.plan.image.image.parts())) > 1
        assert job.cost.host <= 20_000_000
        job.run()
    assert (tmp_path / "a.vtu").read_bytes() == (tmp_path / "b.vtu").read_bytes()
