"""voxtool diagnose: what it says of meshes whose faults are known, in words, JSON and tubes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import model, usable_devices
from helpers import meshes
from helpers.cli import fail, invoke, run, write_obj

from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.mesh.topology import check_surface
from voxtool.svo.voxelization.voxelize import voxelize

RULES = ["parity", "nonzero", "winding", "flood"]
OPEN = """\
mesh         10 faces, 8 vertices, 1 shell; not closed
box          4 x 3 x 2, from (0, 0, 0) to (4, 3, 2)
voxel        0.166667 at dim 32
loops        1, of 4 edges of one face
              length    voxels   edges   centre; size in voxels
                  14      84.0       4   (2, 1.5, 2); 24 x 18 x 0
edges        0 of more than two faces; 0 whose two faces disagree
vertices     0 of more than one fan of faces
patches      1, 0 flipped
duplicate    0 faces
degenerate   0 faces
intersecting 0 faces
shells       1, 1 open
     0 open                             10 faces, volume 24, 1 loop capped
rows         0 of 1,024 along x leak by parity
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def turned(pair):
    vertices, faces = pair
    return vertices, faces[:, ::-1]


def report(pair, options: str = "--dim 32") -> dict[str, Any]:
    """Return the JSON of a mesh; check that the text agrees and is shorter than a screen."""
    write_obj(Path("mesh.obj"), *pair)
    result = run(f"diagnose mesh.obj {options} --json")
    assert result.stderr == ""
    found = json.loads(result.stdout)
    text = run(f"diagnose mesh.obj {options}").stdout
    assert text.count("\n") < 60
    for fault in found["faults"]:
        assert fault["what"] in text
        assert fault["mend"] in text
    assert f"voxelize --fill {found['recommended']['fill']}" in text
    assert list(found["fills"]) == RULES + ["auto"] * (found["choice"] != "")
    best = found["fills"][found["recommended"]["fill"]]
    assert best["missing"] == best["extra"] == 0
    for row in found["fills"].values():
        assert row["voxels"] - row["extra"] == best["voxels"] - row["missing"]
    return found


def faults(found: dict[str, Any]) -> list[str]:
    return [fault["what"] for fault in found["faults"]]


def recommended(found: dict[str, Any]) -> str:
    return found["recommended"]["fill"]


def test_a_good_mesh(here: Path) -> None:
    found = report(meshes.icosphere(2, 0, 10.0))
    assert faults(found) == []
    assert recommended(found) == "parity"
    assert found["auto"] == "parity"
    assert found["diagnosis"]["watertight"]
    assert [shell["is"] for shell in found["shells"]] == ["solid"]
    voxels = {rule: row["voxels"] for rule, row in found["fills"].items()}
    assert voxels["parity"] == voxels["nonzero"] == voxels["winding"] < voxels["flood"]
    assert "\nwrong        nothing\n" in run("diagnose mesh.obj --dim 32").stdout
    assert run("diagnose mesh.obj --dim 32 --strict").exit_code == 0


def test_an_open_box(here: Path) -> None:
    found = report(meshes.open_box(0, (4, 3, 2)))
    assert faults(found) == ["1 boundary loop"]
    assert recommended(found) == "winding"
    (loop,) = found["loops"]
    assert loop == {
        "edges": 4, "length": 14.0, "centre": [2.0, 1.5, 2.0], "size": [4.0, 3.0, 0.0],
        "closed": True,
    }  # fmt: skip
    assert found["shells"][0]["volume"] == 24
    assert not found["t_junctions"]
    assert "close the holes" in found["faults"][0]["mend"]
    assert run("diagnose mesh.obj --dim 32").stdout.startswith(OPEN)


def test_rows_that_leak(here: Path) -> None:
    """Without its side at high x a box of 24 x 24 x 24 voxels leaks along all rows."""
    found = report(meshes.open_box(0, 1, missing=1))
    rows = found["leaking_rows"]
    assert (rows["count"], rows["of"]) == (24 * 24, 32 * 32)
    assert (rows["low"], rows["high"]) == ([4, 4], [27, 27])
    assert rows["rows"][:2] == [[4, 4], [4, 5]]
    parity = found["fills"]["parity"]
    assert parity["voxels"] == 24 * 24 * (32 - 4)
    assert parity["extra"] >= 24 * 24 * 4


def test_flipped_faces(here: Path) -> None:
    vertices, faces = meshes.box(0, 2)
    faces[[4, 5]] = faces[[4, 5], ::-1]
    found = report((vertices, faces))
    assert faults(found) == ["2 faces flipped"]
    (patch,) = found["patches"]["flipped"]
    assert (patch["faces"], patch["first"], patch["area"]) == (2, 4, 4.0)
    assert (patch["centre"], patch["size"]) == ([1, 0, 1], [2, 0, 2])
    assert found["shells"][0]["is"] == "mixed"
    assert found["shells"][0]["volume"] is None


@pytest.mark.slow
def test_shells_in_shells(here: Path) -> None:
    hollow = meshes.join(meshes.box(0, 9), turned(meshes.box(1, 8)), meshes.box(3, 5))
    found = report(hollow)
    assert [shell["is"] for shell in found["shells"]] == ["solid", "cavity", "solid"]
    assert [shell["parent"] for shell in found["shells"]] == [None, 0, 1]
    assert faults(found) == []
    assert recommended(found) == "parity"

    alike = report(meshes.join(meshes.box(0, 9), meshes.box(1, 8)))
    assert [shell["is"] for shell in alike["shells"]] == ["solid", "nested alike"]
    assert faults(alike) == ["1 shell wound like the one around it"]
    assert recommended(alike) == "auto"
    assert alike["fills"]["parity"]["missing"] > 0

    inward = report(turned(hollow))
    assert [shell["is"] for shell in inward["shells"]] == ["inside out", "solid", "cavity"]
    assert faults(inward) == ["1 shell inside out"]


def test_overlapping_cubes(here: Path) -> None:
    found = report(meshes.join(meshes.box(0, 4), meshes.box(2, 6)))
    assert found["crossed_faces"]["count"] == 12
    assert found["crossed_faces"]["faces"][0] == 2
    assert found["crossed_faces"]["centre"] == pytest.approx([4, 8 / 3, 4 / 3])
    assert faults(found) == ["12 self-intersecting faces"]
    assert recommended(found) == "auto"
    assert found["fills"]["parity"]["missing"] == 8 * 4**3  # the common cube, of 8 voxels a side


def test_faces_twice_and_flat_ones(here: Path) -> None:
    vertices, faces = meshes.box(0, 2)
    faces = np.concatenate([faces, faces[[7]][:, [1, 0, 2]], [[0, 0, 1]]])
    found = report((vertices, faces))
    assert found["duplicate_faces"]["faces"] == [12]
    assert found["degenerate_faces"]["faces"] == [13]
    assert found["crossed_faces"]["count"] == 0  # a copy does not intersect
    assert found["diagnosis"]["nonmanifold_edges"] == len(found["crowded_edges"]) == 3
    for edge in found["crowded_edges"]:
        assert edge["faces"] == 3
        assert set(map(tuple, edge["ends"])) <= set(map(tuple, vertices[faces[7]].tolist()))
    assert faults(found)[0] == "3 edges of more than two faces"
    assert {"1 duplicate face", "1 degenerate face"} <= set(faults(found))


def test_what_has_no_inside(here: Path) -> None:
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    width = np.array([-1.0, 1.0])
    ring = 5 + np.cos(angle / 2)[:, None] * width
    band = np.stack(
        [np.cos(angle)[:, None] * ring, np.sin(angle)[:, None] * ring,
         np.sin(angle / 2)[:, None] * width], axis=-1,
    ).reshape(-1, 3)  # fmt: skip
    quads = [(2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2) for i in range(23)] + [(46, 47, 0, 1)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    found = report((band, faces))
    assert found["patches"]["one_sided"] == 1
    assert faults(found) == ["1 boundary loop", "1 patch with one side only"]
    assert found["recommended"]["fill"] == "auto"
    assert found["fills"]["auto"]["share"] >= 0.98 > found["fills"]["winding"]["share"]

    sheet = report(([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], [[0, 1, 2], [0, 2, 3]]))
    assert faults(sheet) == ["1 boundary loop"]
    assert (sheet["recommended"]["fill"], sheet["auto"]) == ("auto", "flood+gap1")
    assert sheet["recommended"]["why"] == sheet["choice"]


def test_an_open_mesh_that_faces_inwards(here: Path) -> None:
    vertices, faces = turned(meshes.icosphere(3, 0, 1.0))
    found = report((vertices, faces[1:]))
    assert found["fills"]["winding"]["voxels"] == 0
    assert (found["recommended"]["fill"], found["auto"]) == ("auto", "winding")
    assert "1,279 faces turned outward" in found["recommended"]["why"]
    assert found["fills"]["winding"]["share"] == 0 < found["fills"]["auto"]["share"]


def test_t_junctions_are_no_holes(here: Path) -> None:
    """A prism of eight sides beside a cube, as merged rectangles."""
    write_obj(Path("mesh.obj"), *meshes.join(meshes.box(0, 4), meshes.box([4, 1, 1], [6, 2, 3])))
    run("voxelize mesh.obj --dim 32 -q")
    run("extract mesh.svo.h5 --style voxel-faces --merge -q -o merged.obj")
    found = json.loads(run("diagnose merged.obj --dim 32 --json").stdout)
    assert found["t_junctions"]
    assert len(found["loops"]) > 0
    assert "no holes" in found["faults"][0]["mend"]


def test_only_faces_without_area(here: Path) -> None:
    found = report(([[0, 0, 0], [1, 2, 3], [2, 4, 6]], [[0, 1, 2]]))
    assert found["degenerate_faces"]["count"] == 1
    found = report(([[0, 0, 0], [1, 2, 3]], [[0, 0, 1]]))
    assert found["shells"] == []


# Output


def test_tubes(here: Path) -> None:
    write_obj(Path("mesh.obj"), *meshes.open_box(0, (4, 3, 2)))
    result = run("diagnose mesh.obj --dim 32 --obj leaks.obj")
    assert result.stdout == run("diagnose mesh.obj --dim 32").stdout
    assert result.stderr == "voxtool: mesh.obj -> leaks.obj: 1 boundary loop as tubes\n"
    drawn = load_mesh("leaks.obj")
    assert len(drawn.faces) == 4 * 8
    assert check_surface(drawn).watertight
    low, high = drawn.bounds
    assert low == pytest.approx([0, 0, 2], abs=0.002 * 4 + 1e-9)
    assert high == pytest.approx([4, 3, 2], abs=0.002 * 4 + 1e-9)
    assert fail("diagnose mesh.obj --obj leaks.obj --no-clobber").startswith("leaks.obj exists")


def test_tubes_of_no_loops(here: Path) -> None:
    """A file that was there shows no leaks that are closed."""
    write_obj(Path("mesh.obj"), *meshes.box(0, 2))
    Path("leaks.obj").write_text("v 0 0 0\n")
    result = run("diagnose mesh.obj --dim 32 --obj leaks.obj")
    assert result.stderr == "voxtool: mesh.obj -> leaks.obj: 0 boundary loops as tubes\n"
    assert all(line.startswith("#") for line in Path("leaks.obj").read_text().splitlines())


def test_strict(here: Path) -> None:
    vertices, faces = meshes.open_box(0, 2)
    faces[0] = faces[0, ::-1]
    write_obj(Path("mesh.obj"), vertices, faces)
    result = invoke("diagnose mesh.obj --dim 32 --strict --json")
    assert result.exit_code == 1
    assert len(json.loads(result.stdout)["faults"]) == 2
    assert result.stderr == (
        "voxtool: error: mesh.obj: 1 boundary loop; 1 face flipped (--strict)\n"
    )


def test_standard_input(here: Path) -> None:
    write_obj(Path("mesh.obj"), *meshes.open_box(0, 2))
    data = Path("mesh.obj").read_bytes()
    assert run("diagnose - --dim 32", data).stdout == run("diagnose mesh.obj --dim 32").stdout
    result = run("diagnose - --dim 32 --obj leaks.obj", data)
    assert result.stderr.startswith("voxtool: stdin -> leaks.obj: ")


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        ("--dim 7", 2, "7 is not in the range"),
        ("--obj -", 2, "stdout has the report: name a file for --obj"),
        ("--obj leaks.ply", 3, "leaks.ply: the name says no format: end it in one of .obj"),
        ("--obj ./mesh.obj", 2, "./mesh.obj is the input mesh.obj: name another"),
        ("--obj no/leaks.obj", 3, "no"),
    ],
)
def test_failures(here: Path, options: str, code: int, message: str) -> None:
    write_obj(Path("mesh.obj"), *meshes.open_box(0, 2))
    assert message in fail(f"diagnose mesh.obj {options}", code)


# Devices and real models


def test_every_device_says_the_same(here: Path) -> None:
    rng = np.random.default_rng(7)
    ball = meshes.icosphere(2, 0, 3.0)
    torn = ball[0], ball[1][rng.random(len(ball[1])) > 0.05]
    scene = meshes.join(torn, meshes.box(1, 5), turned(meshes.box(2, 3)), meshes.torus(-4))
    write_obj(Path("mesh.obj"), *scene)
    indices = [index for index, _ in usable_devices()]
    texts = {run(f"diagnose mesh.obj --dim 48 --json --device {i}").stdout for i in indices}
    assert len(texts) == 1


def test_the_bunny(device_index: int) -> None:
    path = model("stanford-bunny.obj")
    found = json.loads(run(f"diagnose {path} --dim 128 --json --device {device_index}").stdout)
    assert faults(found) == ["5 boundary loops"]
    assert [loop["edges"] for loop in found["loops"]] == [80, 42, 40, 39, 22]
    assert recommended(found) == "winding"
    mesh = load_mesh(path)
    octree = voxelize(mesh, Grid.fit(mesh, 128), fill="winding")
    assert found["fills"]["winding"]["voxels"] == octree.count
    volume = octree.count * octree.grid.voxel_volume
    assert volume == pytest.approx(found["shells"][0]["volume"], rel=0.01)


def test_the_dragon(device_index: int) -> None:
    """Closed, but with copies of faces and shells within."""
    found = json.loads(
        run(f"diagnose {model('dragon.obj')} --dim 64 --json --device {device_index}").stdout
    )
    assert found["loops"] == []
    assert found["leaking_rows"]["count"] == 0
    assert found["duplicate_faces"]["count"] == found["diagnosis"]["duplicate_faces"] == 1489
    assert len(found["shells"]) == found["diagnosis"]["shells"] == 12
    assert len(found["crowded_edges"]) == 1000  # of 2,534
