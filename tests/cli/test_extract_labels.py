"""voxtool extract --by label: files, reports, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.attributes import attributed, labelled
from helpers.cli import fail, run
from helpers.octree import ball

import voxtool
from voxtool.mesh import srgb
from voxtool.mesh.topology import volume
from voxtool.palette import palette
from voxtool.svo.surface.labelled import LabelledSurface

HALVES = np.where(ball((17, 16, 15)), np.arange(15) // 8, -1)
NAMES = ("low", "über b")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    voxtool.write_svo(labelled(HALVES, NAMES), "two.svo.h5")
    return tmp_path


def expected(style: str) -> LabelledSurface:
    return voxtool.extract("two.svo.h5", by="label", style=style)


def test_formats(folder: Path) -> None:
    """OBJ has an object a label and one list of vertices, GLB a node a label."""
    run("extract two.svo.h5 --by label")
    assert [p.name for p in folder.iterdir() if p.suffix == ".obj"] == ["two.surface-nets.obj"]
    surface = expected("surface-nets")
    lines = Path("two.surface-nets.obj").read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if line[0] == "o"] == [f"o {name}" for name in NAMES]
    assert sum(line[0] == "v" for line in lines) == len(surface.points)
    read = voxtool.load_mesh("two.surface-nets.obj")
    assert np.array_equal(read.faces, np.concatenate([surface.faces_of(n) for n in (0, 1)]))
    assert np.allclose(read.vertices, surface.vertices, rtol=0, atol=1e-12)
    run("extract two.svo.h5 --by label --style voxel-faces -o two.glb")
    read = voxtool.load_mesh("two.glb", keep=("parts",))
    assert read.parts["part"].names == NAMES
    assert np.array_equal(
        read.parts["part"].labels, np.repeat([0, 1], expected("blocks").triangles)
    )


def test_3mf(folder: Path) -> None:
    """lib3mf and voxtool read a component for each label, with its name and colour."""
    lib3mf = pytest.importorskip("lib3mf")
    surface = replace(expected("surface-nets"), units="in", names=('<low> & "so"', "über b"))
    voxtool.write_mesh(surface, "two.3mf")
    model = lib3mf.get_wrapper().CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile("two.3mf")
    assert reader.GetWarningCount() == 0
    assert model.GetUnit() == lib3mf.ModelUnit.Inch
    items, objects = model.GetBuildItems(), model.GetMeshObjects()
    assert items.Count() == 1
    assert model.GetComponentsObjects().Count() == 1
    for label in surface.labels:
        assert objects.MoveNext()
        found, mesh = objects.GetCurrentMeshObject(), surface.mesh(label)
        assert found.GetName() == surface.names[label]
        assert found.IsManifoldAndOriented()
        points = [list(vertex.Coordinates) for vertex in found.GetVertices()]
        assert np.array_equal(points, mesh.vertices.astype(np.float32))
        faces = [list(face.Indices) for face in found.GetTriangleIndices()]
        assert np.array_equal(faces, mesh.faces)
    assert not objects.MoveNext()
    read = voxtool.load_mesh("two.3mf", keep=("parts", "appearance"))
    assert read.units == "in"
    assert read.parts["part"].names == read.parts["material"].names == surface.names
    assert np.array_equal(read.parts["part"].labels, np.repeat([0, 1], surface.triangles))
    assert read.appearance is not None
    wanted = srgb.to_linear(palette(2)).tolist()
    assert [list(one.colour[:3]) for one in read.appearance.materials] == wanted
    first = Path("two.3mf").read_bytes()
    voxtool.write_mesh(surface, "two.3mf")
    assert Path("two.3mf").read_bytes() == first
    run("extract two.svo.h5 --by label -o c.3mf")
    assert "end it in one of .obj" in fail("extract two.svo.h5 -o d.3mf", 3)


def test_report(folder: Path) -> None:
    found = json.loads(run("extract two.svo.h5 --by label --check --json -o a.obj").stdout)
    surface = expected("nets")
    octree = voxtool.read_svo("two.svo.h5")
    for one, facts in zip(found["labels"], surface.facts(check=True), strict=True):
        count = np.count_nonzero(one["label"] == HALVES)
        assert {name: one[name] for name in facts} == facts
        assert one["volume"] == pytest.approx(volume(surface.mesh(one["label"])), rel=1e-12)
        assert one["octree_volume"] == pytest.approx(count * octree.grid.voxel_volume)
        assert one["volume_ratio"] == one["volume"] / one["octree_volume"]
    assert found["octree_volume"] == pytest.approx(octree.volume)
    assert found["volume"] == pytest.approx(sum(one["volume"] for one in found["labels"]))
    assert [one["name"] for one in found["labels"]] == list(NAMES)
    assert all(one["closed"] for one in found["labels"])
    assert found["digest"] == surface.digest()
    assert found["triangles"] == len(surface.faces)
    text = run("extract two.svo.h5 --by label -o a.obj -v").stderr
    assert f"  low: {surface.triangles[0]:,} triangles, volume " in text
    line = run("extract two.svo.h5 --by label -o a.obj").stderr.splitlines()[0]
    assert f"volume {found['volume']:.6g}, of the voxels {found['octree_volume']:.6g} (" in line
    worst = max(found["labels"], key=lambda one: abs(one["volume_ratio"] - 1))
    assert f", at worst {worst['name']} {100 * (worst['volume_ratio'] - 1):+.2f} %, " in line


def test_colours(folder: Path) -> None:
    voxtool.write_svo(attributed(), "a.svo.h5")
    said = run("extract a.svo.h5 --by label -o a.obj").stderr
    assert "voxtool: colours are left out: meshes of labels have them in .glb\n" in said
    found = run("extract a.svo.h5 --by label -o a.glb --json").stdout
    assert json.loads(found)["coloured"]
    assert voxtool.load_mesh("a.glb", keep=("appearance",)).colours is not None
    assert "colours" not in run("extract two.svo.h5 --by label -o a.obj").stderr


def test_plan(folder: Path) -> None:
    plan = json.loads(run("extract two.svo.h5 --by label --plan --json").stdout)
    assert plan["labels"] == 2
    assert plan["stages"] == ["labels", "borders", "vertices", "relax", "triangles"]
    faces = json.loads(
        run("extract two.svo.h5 --by label --style voxel-faces --plan --json").stdout
    )
    assert faces["stages"] == ["labels", "borders", "vertices", "triangles"]
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        ("--style sharp", 3, "choose one of surface-nets, voxel-faces"),
        ("--style marching-cubes", 3, "choose one of surface-nets, voxel-faces"),
        ("-o a.ply", 3, ".ply holds one mesh without a name: write .obj, .glb, .3mf"),
        ("--merge", 2, "--merge is of a single surface: drop it, or --by label"),
        ("--level 0", 2, "--level is of a single surface"),
        ("--isovalue 0.4", 2, "--isovalue is of a single surface"),
        ("--against b.obj", 2, "--against is of a single surface"),
        ("--normals", 2, "--normals is of a single surface"),
        ("--scale 2", 2, "--scale is of a single surface"),
        ("--offset 0", 2, "--offset is of a single surface"),
        ("--max-memory 1000", 4, "with its attribute label need"),
    ],
)
def test_refusals(folder: Path, options: str, code: int, message: str) -> None:
    assert message in fail(f"extract two.svo.h5 --by label {options}", code)
    assert len(list(folder.iterdir())) == 1


def test_other_inputs_are_refused(folder: Path) -> None:
    voxtool.write_svo(voxtool.Octree.from_dense(HALVES >= 0), "plain.svo.h5")
    message = fail("extract plain.svo.h5 --by label", 3)
    assert "plain.svo.h5: the octree has no labels: voxelize with --labels part" in message
