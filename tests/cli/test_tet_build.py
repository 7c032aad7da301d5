"""voxtool tet-build: what it writes, says and refuses."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import meshio
import numpy as np
import pytest
from conftest import model
from helpers.cli import fail, process, run, told
from helpers.tets import CUBE, cube, lattice

from voxtool import build_tet, read_tet, read_unstructured


def counted() -> str:
    mesh = read_unstructured("volume.vtu", "density")
    return ", ".join(f"{len(block)} {kind}" for kind, block in mesh.cells)


def written(name: str, points, cells, **data) -> None:
    meshio.write(name, meshio.Mesh(np.asarray(points, float), cells, **data))


def test_what_it_writes_and_says(here: Path) -> None:
    os.remove("volume.tet.h5")
    result = run("tet-build volume.vtu --scalar density -v")
    assert result.stdout == ""
    volume = read_tet("volume.tet.h5")
    assert volume.digest() == build_tet(read_unstructured("volume.vtu", "density")).digest()
    lines = [line.removeprefix("voxtool: ") for line in result.stderr.splitlines()]
    count = len(volume.cells)
    assert lines[0].startswith(
        f"volume.vtu -> volume.tet.h5: {count:,} tetrahedra of density, "
        f"{len(volume.vertices)} vertices in "
    )
    assert [line.split()[0] for line in lines[1:8]] == [
        "cells", "points", "faces", "scalar", "rounding", "texels", "bytes",
    ]  # fmt: skip
    assert lines[1] == f"  cells     {counted()}; none turned or dropped"
    assert lines[2] == f"  points    0 of {len(volume.vertices)} merged into others"
    outside = np.count_nonzero(volume.neighbours < 0)
    assert lines[3].startswith(f"  faces     {outside} without a neighbour, of these 0 of more")
    assert lines[6].startswith("  texels    vertices 16 x 6, cells 32 x 9, neighbours 32 x 9, norm")
    assert lines[4].startswith("  scalar    density, linear in a cell, 1 to ")
    assert re.match(r"  bytes     96\.0 a cell of table 5; 144 before it .*, 119 and 912", lines[7])


def test_json(here: Path) -> None:
    result = run("tet-build volume.vtu --scalar region --json -o a.tet.h5")
    assert result.stderr == ""
    found = json.loads(result.stdout)
    volume = read_tet("a.tet.h5")
    assert found["output"] == "a.tet.h5"
    assert found["tetrahedra"] == len(volume.cells)
    assert found["textures"] == volume.sizes()
    assert found["bytes"] == os.path.getsize("a.tet.h5")
    assert found["bytes_a_cell"] == 96
    assert found["digest"] == volume.digest()
    assert found["scalar_range"] == [0, 2]
    assert found["constant"] is True
    assert found["merged_points"] == found["zero_volume"] == found["turned"] == 0
    assert list(found["stages"]) == [
        "read mesh", "plan", "tetrahedra", "order", "neighbours", "planes", "gradients",
        "write file", "other",
    ]  # fmt: skip
    assert sum(found["stages"].values()) <= found["seconds"] + 1e-3


def test_a_component(here: Path) -> None:
    run("tet-build volume.vtu --scalar momentum --component magnitude -o a.tet.h5")
    assert read_tet("a.tet.h5").scalar == "momentum magnitude"
    message = fail("tet-build volume.vtu --scalar momentum")
    assert message.endswith("momentum has 3 components, which component: --component "
                            "x|y|z|0|1|2|magnitude")  # fmt: skip


def test_layouts(here: Path) -> None:
    command = "tet-build volume.vtu --scalar density --layout projection"
    assert run(command).stderr.count("\n") == 1
    lines = run(f"{command} -v").stderr.splitlines()
    volume = read_tet("volume.tet.h5")
    assert volume.layout == "projection"
    share = len(volume.vertices) / len(volume.cells)
    assert f"bytes     {68 + 16 * share:.1f} a cell of table 4, 119 with OpenGL's" in lines[7]
    points, cells = lattice((2, 2, 2))
    written("boxes.vtu", points, [("hexahedron", cells)], cell_data={"c": [np.arange(8.0)]})
    lines = run("tet-build boxes.vtu --layout hexahedra -v").stderr.splitlines()
    assert "boxes.vtu -> boxes.tet.h5: 8 hexahedra of c, 27 vertices in" in lines[0]
    assert "136.0 a cell of table 5 with two more faces" in lines[7]
    assert read_tet("boxes.tet.h5").cells.shape == (8, 8)
    message = fail("tet-build volume.vtu --scalar region --layout hexahedra")
    assert "cells beside hexahedra: use --layout raycast" in message
    message = fail("tet-build volume.vtu --scalar region --layout projection")
    assert message.startswith("volume.vtu: region is one a cell, and the layout projection")


def test_what_was_done_to_the_mesh_is_said(here: Path) -> None:
    cells = cube(6).cells[0][1].copy()
    cells[:2] = cells[:2][:, [0, 2, 1, 3]]
    twin = np.concatenate([CUBE, CUBE[:1]])
    cells = np.concatenate([cells, [(0, 1, 2, 3), (8, 0, 1, 2)], cells[:1]])
    scalars = np.append(np.arange(8.0), 5)
    blocks = [("tetra", cells), ("triangle", cells[:3, :3])]
    written("odd.vtu", twin, blocks, point_data={"s": scalars})
    lines = run("tet-build odd.vtu -v").stderr.splitlines()
    assert lines[1] == (
        "voxtool:   cells     9 tetra; 3 are no volumes and left out, 2 turned, 1 dropped as "
        "there already, 2 of zero volume dropped (1 with coincident points)"
    )
    assert lines[2] == "voxtool:   points    1 of 9 merged into others, 1 of another scalar"
    assert "12 without a neighbour" in lines[3]
    points, hexes = lattice((2, 1, 1))
    apart = np.concatenate([points[hexes[0]], points[hexes[1]] + np.array([1e-7, 0, 0])])
    block = [("hexahedron", np.arange(16).reshape(2, 8))]
    written("seam.vtu", apart, block, point_data={"s": np.arange(16.0)})
    assert "24 without a neighbour" in run("tet-build seam.vtu -v").stderr
    merged = told("tet-build seam.vtu --merge-distance 1e-6 --json")
    found = [merged[name] for name in ("boundary_faces", "merged_points", "merged_scalars")]
    assert found == [20, 4, 4]


def test_the_stored_plan_is_the_one_that_is_printed(here: Path) -> None:
    assert counted() in run("tet-build volume.vtu --scalar density --plan").stdout
    plan = told("tet-build volume.vtu --scalar density --plan --json")
    stored = read_tet("volume.tet.h5").plan
    assert {name: plan[name] for name in stored} == stored
    message = fail("tet-build volume.vtu --scalar density --max-memory 1K")
    assert f"{plan['predicted_cells']:,} cells would need" in message


def test_streams(here: Path) -> None:
    result = run("tet-build volume.vtu --scalar density -o -")
    Path("b.tet.h5").write_bytes(result.stdout_bytes)
    assert read_tet("b.tet.h5").digest() == read_tet("volume.tet.h5").digest()
    assert "volume.vtu -> stdout: " in result.stderr
    message = fail("tet-build - --scalar density")
    assert message.startswith("a volume cannot be read from stdin: name a file")


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("tet-build volume.vtu --layout table", "'raycast', 'projection', 'hexahedra'"),
        ("tet-build volume.vtu --merge-distance far", "'far' is not a valid float"),
    ],
)
def test_usage(command: str, message: str, here: Path) -> None:
    assert message in fail(command, code=2)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("tet-build bunny.obj", "bunny.obj: no mesh of volume cells has this ending: give one of"),
        ("tet-build volume.tet.h5", "volume.tet.h5 is no mesh: name the file that it was made"),
        ("tet-build volume.vtu", "which array? Name one of density, momentum, region (--scalar)"),
        ("tet-build volume.vtu --scalar t", "has no array 't': name one of density, momentum"),
        ("tet-build volume.vtu --scalar density --merge-distance -1", "give a length from 0 on"),
        ("tet-build volume.vtu --scalar density -o a.svo.h5", "end it in one of .tet.h5"),
        ("svo-info volume.tet.h5", "holds 'voxtool-tet', not an octree"),
        ("adf-info volume.tet.h5", "holds 'voxtool-tet', not a distance field"),
        ("svo-info volume.vtu", "is a mesh of volume cells: build its textures first: voxtool"),
    ],
)
def test_failures_are_one_line(command: str, message: str, here: Path) -> None:
    assert message in fail(command)


def test_scalars_that_are_no_numbers(here: Path) -> None:
    scalars = np.arange(8.0)
    scalars[[2, 5]] = np.nan
    written("nan.vtu", CUBE, [("hexahedron", [list(range(8))])], point_data={"s": scalars})
    assert "s is not finite at 2 points, the first is point 2 (nan)" in fail("tet-build nan.vtu")
    written("flat.vtu", CUBE, [("quad", [[0, 1, 2, 3]])], point_data={"s": np.arange(8.0)})
    message = fail("tet-build flat.vtu")
    assert message.startswith("flat.vtu: no volume cells (it has 1 quad)")


def test_blunt_fin(here: Path) -> None:
    path = model("bluntfin.vtu")
    done = process(f"tet-build {path} --scalar density -v", cwd=here)
    assert done.returncode == 0
    said = done.stderr.decode()
    assert "bluntfin.tet.h5: 187,318 tetrahedra of density, 40,921 vertices in 22.4 MB" in said
    assert "187,395 tetra; 77 of zero volume dropped (77 with coincident points)" in said
    assert "39 of 40,960 merged" in said
    assert "96.0 a cell of table 5; 144 before it" in said
