"""Hexahedra of the largest cubes: they hold the cells, their faces are whole, and nodes that hang
are interpolated where they lie."""

from __future__ import annotations

import io
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.attributes import attributed
from helpers.cli import fail, run, told
from helpers.octree import WORLD, ball

import voxtool
from voxtool.files.cells import inp, msh, vtu
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.images.image_parts import SHARE, ImageInParts
from voxtool.svo.solvers import leaf_hexahedra
from voxtool.svo.solvers.hexahedra import CORNERS, SIDES
from voxtool.svo.solvers.leaf_hexahedra import LeafHexahedra

MANY = 1 << 30
DENSE = ball((40, 33, 21)) | (np.random.default_rng(1).random((40, 33, 21)) < 0.002)
MESHES: dict[str, tuple[voxtool.Octree, dict[str, Any]]] = {
    "ball": (voxtool.Octree.from_dense(DENSE, **WORLD), {}),
    "part": (voxtool.Octree.from_dense(DENSE, **WORLD), {"bbox": (-1, 0.5, 0.3, 1.8, 2.9, 1.9)}),
    "outside": (voxtool.Octree.from_dense(DENSE, **WORLD), {"invert": True}),
    "coarse": (voxtool.Octree.from_dense(DENSE, **WORLD), {"level": 1}),
    "labels": (attributed(), {}),
    "step": (voxtool.Octree.from_dense(np.ones((16, 16, 24), bool), **WORLD), {}),
}


def mesh_of(name: str) -> LeafHexahedra:
    octree, part = MESHES[name]
    return LeafHexahedra.of(VoxelImage.of(octree, **part), limit=MANY)


def values_of(mesh: LeafHexahedra) -> np.ndarray:
    """The materials of all cells, 0 where there is none."""
    image = AttributeImage(mesh.image, "label") if mesh.labels else mesh.image
    return np.concatenate(list(image.slabs())).astype(int)


def cubes_of(mesh: LeafHexahedra) -> list[tuple[tuple[slice, ...], int]]:
    cubes = mesh.cubes
    return [
        (tuple(slice(n, n + (1 << p)) for n in low), value)
        for low, p, value in zip(
            mesh.lows.tolist(), cubes.powers.tolist(), cubes.values.tolist(), strict=True
        )
    ]


@pytest.mark.parametrize("name", MESHES)
def test_cubes_hold_the_cells(name: str) -> None:
    """Each cell once; what a face touches is alike; eight cubes stay apart only if their union has
    a face that touches different cells."""
    mesh = mesh_of(name)
    values, found = values_of(mesh), np.zeros(mesh.image.shape, int)
    padded = np.pad(values, 1)

    def alike(box: tuple[slice, ...]) -> bool:
        for axis in range(3):
            for at in (box[axis].start, box[axis].stop + 1):
                beside = [slice(s.start + 1, s.stop + 1) for s in box]
                beside[axis] = slice(at, at + 1)
                if len(np.unique(padded[tuple(beside)])) > 1:
                    return False
        return True

    for box, value in cubes_of(mesh):
        assert not found[box].any()
        found[box] = value
        assert alike(box)
        side = box[0].stop - box[0].start
        low = [(s.start + n) // (2 * side) * 2 * side - n
               for s, n in zip(box, mesh.image.low, strict=True)]  # fmt: skip
        union = tuple(slice(n, n + 2 * side) for n in low)
        if min(low) >= 0 and all(s.stop <= n for s, n in zip(union, values.shape, strict=True)):
            assert (values[union] != value).any() or not alike(union)
    assert np.array_equal(found, values)


@pytest.mark.parametrize("name", MESHES)
def test_nodes_that_hang(name: str) -> None:
    """They are those that are no corner of a cube that they touch; weights give their places."""
    mesh = mesh_of(name)
    places = mesh.node_places
    sides = 1 << mesh.cubes.powers.astype(int)
    hangs = np.zeros(len(places), bool)
    numbers = {tuple(place): n for n, place in enumerate(places.tolist())}
    for low, side in zip(mesh.lows, sides.tolist(), strict=True):
        if side > 1:
            steps = np.indices((side + 1,) * 3).reshape(3, -1).T
            inner = ((steps > 0) & (steps < side)).any(axis=1)
            near = map(tuple, (low + steps[inner]).tolist())
            hangs[[numbers[place] for place in near if place in numbers]] = True
    nodes, masters, weights = mesh.hanging
    assert np.array_equal(nodes, np.flatnonzero(hangs))
    assert len(nodes) > 0
    held = masters >= 0
    assert (held.sum(axis=1) % 2 == 0).all()
    assert (weights[held] > 0).all()
    assert not weights[~held].any()
    assert (weights.sum(axis=1) == 1).all()
    where = (places[masters] * weights[:, :, None]).sum(axis=1)
    assert np.array_equal(where, places[nodes])


@pytest.mark.parametrize("name", MESHES)
def test_faces_and_volume(name: str) -> None:
    """Faces of the boundary have the area of the cells'; corners are those of the cubes."""
    mesh = mesh_of(name)
    (part,) = mesh.layers()
    places, corners = mesh.node_places, part.corners(np.int64)
    sides = places[corners[:, 6]] - places[corners[:, 0]]
    assert np.array_equal(places[corners], places[corners[:, :1]] + sides[:, None] * CORNERS)
    values = np.pad(values_of(mesh), 1)
    areas = dict.fromkeys(range(len(SIDES)), 0)
    for key, cells in part.faces:
        if not key.low:
            areas[key.side] += int((sides[cells, 0] ** 2).sum())
    for side in range(len(SIDES)):
        beside = np.roll(values, 1 if side % 2 == 0 else -1, side // 2)
        assert areas[side] == np.count_nonzero((values > 0) & (beside == 0))


def test_parts_make_the_same_file() -> None:
    image = VoxelImage.of(MESHES["ball"][0])
    shared = {item.name: getattr(image, item.name) for item in fields(VoxelImage)}
    parts = ImageInParts(**shared, limit=image.layer_bytes + SHARE * 3_000)
    assert len(list(parts.parts())) > 1
    for module in (vtu, msh, inp):
        written = []
        for own in (image, parts):
            written.append(io.BytesIO())
            module.write(LeafHexahedra.of(own, limit=MANY), written[-1])
        assert written[0].getvalue() == written[1].getvalue()


def test_pieces_make_the_same_file(monkeypatch: pytest.MonkeyPatch) -> None:
    written = []
    for piece in (leaf_hexahedra.PIECE, 100):
        monkeypatch.setattr(leaf_hexahedra, "PIECE", piece)
        for module in (vtu, msh, inp):
            file, mesh = io.BytesIO(), mesh_of("labels")
            module.write(mesh, file)
            assert file.getbuffer().nbytes == module.size(mesh)
            written.append(file.getvalue())
    assert written[:3] == written[3:]


def test_files_list_them(here: Path) -> None:
    """.vtu as arrays, .inp as a set and equations, .msh as lines: the same nodes and weights."""
    meshio: Any = pytest.importorskip("meshio")
    for name in ("vtu", "msh", "inp"):
        report = told(f"export bunny.svo.h5 --leaves -o a.{name} --json")
    mesh = meshio.read("a.vtu")
    count, masters, weights = (mesh.point_data[name] for name in ("hanging", "masters", "weights"))
    nodes = np.flatnonzero(count)
    assert len(nodes) == report["hanging"] > 0
    where = (mesh.points[masters[nodes]] * weights[nodes, :, None]).sum(axis=1)
    assert np.allclose(where, mesh.points[nodes], atol=1e-12)
    assert meshio.read("a.inp").point_sets["hanging"].tolist() == nodes.tolist()
    assert len(meshio.read("a.msh").cells[0].data) == report["hexahedra"]
    text = Path("a.msh").read_bytes().partition(b"$HangingNodes\n")[2].decode()
    lines = text.partition("$End")[0].splitlines()
    assert int(lines[0]) == len(nodes) == len(lines) - 1
    found = np.array([line.split() for line in lines[1:]], float)
    assert np.array_equal(found[:, 0], nodes + 1)
    assert np.array_equal(found[:, 1::2], masters[nodes] + 1)
    assert np.array_equal(found[:, 2::2], weights[nodes])
    words = Path("a.inp").read_text().partition("*EQUATION\n")[2].replace("\n", ",").split(",")
    numbers = iter([float(word) for word in words if word.strip()])
    equations = {}
    for terms in numbers:
        row = [next(numbers) for _ in range(3 * int(terms))]
        assert row[2] == 1
        assert len(set(row[1::3])) == 1
        own = dict(zip(row[3::3], row[5::3], strict=True))
        assert (row[0], row[1]) not in equations
        equations[row[0], row[1]] = own
    assert len(equations) == 3 * len(nodes)
    for node in nodes.tolist():
        used = masters[node] >= 0
        wanted = dict(zip(masters[node][used] + 1.0, -weights[node][used], strict=True))
        assert all(equations[node + 1, along] == wanted for along in (1, 2, 3))


def test_refusals(here: Path) -> None:
    assert "a.npz holds" not in fail("export bunny.svo.h5 --leaves -o a.npz")
    assert "leave out --leaves" in fail("export bunny.svo.h5 --leaves -o a.vtu --max-memory 300000")
    run("export bunny.svo.h5 --leaves -o a.vtu")
