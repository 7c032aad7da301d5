"""Hexahedra of voxels: against plain lists of corners, and whatever way they are found."""

from __future__ import annotations

import io
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from helpers.octree import WORLD, ball

import voxtool
from voxtool.errors import VoxtoolError
from voxtool.files.cells import vtu
from voxtool.files.storage.digits import text_of, width_of
from voxtool.svo.images import neighbour_layers
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.images.image_parts import SHARE, ImageInParts
from voxtool.svo.solvers.hexahedra import BOUNDARY, CORNERS, SIDES, Hexahedra, Key

RANDOM = np.random.default_rng(3).random((13, 9, 17)) < 0.3
SHAPES = {
    "ball": ball((20, 17, 11)),
    "random": RANDOM,
    "apart": np.isin(np.arange(13), (0, 5, 6, 12))[:, None, None] & RANDOM,
    "one": np.arange(8 * 9 * 10).reshape(8, 9, 10) == 719,
    "all": np.ones((8, 8, 9), bool),
}
AXES = np.eye(3, dtype=int)
OUTWARDS = dict(zip((s.name for s in SIDES), np.kron(AXES, [[-1], [1]]), strict=True))


def faces_of(dense: np.ndarray) -> dict[str, set[tuple[int, ...]]]:
    """The cells with a face in each surface."""
    padded = np.pad(dense, 1)
    found = {}
    for name, step in OUTWARDS.items():
        beside = tuple(
            slice(1 + d, 1 + d + n) for d, n in zip(step.tolist(), dense.shape, strict=True)
        )
        found[name] = set(map(tuple, np.argwhere(dense & ~padded[beside]).tolist()))
    return found


def mesh_of(dense: np.ndarray, **part) -> Hexahedra:
    return Hexahedra.of(VoxelImage.of(voxtool.Octree.from_dense(dense, **WORLD), **part))


@pytest.mark.parametrize("table", [neighbour_layers.TABLE, 0])
@pytest.mark.parametrize("name", SHAPES)
def test_nodes_cells_and_faces(name: str, table: int, monkeypatch) -> None:
    """Nodes are numbered in lexicographic order, each once; cells and faces have their corners."""
    monkeypatch.setattr(neighbour_layers, "TABLE", table)
    dense = SHAPES[name]
    cells = np.argwhere(dense)
    corners = (cells[:, None] + CORNERS).reshape(-1, 3)
    nodes, numbers = np.unique(corners, axis=0, return_inverse=True)
    mesh = mesh_of(dense)
    layers = list(mesh.layers())
    found = [(x, *yz) for e in layers for x, _, y, z in e.nodes() for yz in zip(y, z, strict=True)]
    assert np.array_equal(found, nodes)
    found = np.concatenate([layer.corners(np.int64) for layer in layers])
    assert np.array_equal(found, numbers.reshape(-1, 8))
    expected, none = faces_of(dense), np.empty(0, int)
    for n, side in enumerate(SIDES):
        firsts = np.cumsum([0, *(layer.count for layer in layers)])
        parts = [
            first + dict(layer.faces).get(Key(0, 0, n), none)
            for first, layer in zip(firsts, layers, strict=False)
        ]
        own = np.concatenate(parts)
        assert set(map(tuple, cells[own].tolist())) == expected[side.name]
        assert len(own) == mesh.facts["surfaces"][side.name] == len(expected[side.name])
    assert mesh.sizes.nodes == len(nodes)
    assert mesh.facts["surfaces"][BOUNDARY] == sum(map(len, expected.values()))


@pytest.mark.parametrize("name", [*SHAPES, "none"])
def test_layers_with_their_neighbours(name: str) -> None:
    dense = SHAPES.get(name, np.zeros((8, 8, 8), bool))
    image = VoxelImage.of(voxtool.Octree.from_dense(dense))
    padded = np.pad(dense, ((2, 2), (1, 1), (1, 1)))
    found = [
        (x, *(near.keys.tolist() for near in three))
        for x, *three in neighbour_layers.layers_of(image)
    ]
    keys = [np.flatnonzero(layer).tolist() for layer in padded]
    expected = [(x, *keys[x + 1 : x + 4]) for x in range(-1, len(dense) + 1)]
    assert found == [row for row in expected if any(row[1:])]


def test_faces_look_outwards() -> None:
    for side in SIDES:
        a, b, _, d = np.array(CORNERS)[list(side.corners)]
        assert np.array_equal(np.cross(b - a, d - a), OUTWARDS[side.name])


@pytest.mark.parametrize(
    "part", [{"level": 1}, {"invert": True}, {"bbox": (-0.9, 0.3, 0.2, 0.1, 1.5, 0.9)}]
)
def test_parts_of_images(part: dict) -> None:
    """The cells are those of the image; coordinates are in world units."""
    dense = SHAPES["ball"]
    mesh = mesh_of(dense, **part)
    cells = [
        np.stack([np.full(len(e.cells), e.x), *(np.divmod(e.cells.keys, e.width))], axis=1)
        for e in mesh.layers()
    ]
    expected = np.concatenate(list(mesh.image.coordinates()))
    assert np.array_equal(np.concatenate(cells) - (0, 1, 1), expected)
    for axis, values in enumerate(mesh.coordinates()):
        assert values[0] == mesh.image.origin[axis]
        assert len(values) == mesh.image.shape[axis] + 1


def test_parts_make_the_same_file(tmp_path: Path) -> None:
    """Numbers do not depend on how an octree is read."""
    dense = np.kron(np.random.default_rng(1).random((12, 10, 7)) < 0.4, np.ones((5, 5, 5), bool))
    image = VoxelImage.of(voxtool.Octree.from_dense(dense, **WORLD))
    shared = {item.name: getattr(image, item.name) for item in fields(VoxelImage)}
    parts = ImageInParts(**shared, limit=image.layer_bytes + SHARE * 10_000)
    assert len(list(parts.parts())) > 3
    written = []
    for own in (image, parts):
        written.append(io.BytesIO())
        vtu.write(Hexahedra.of(own), written[-1])
    assert written[0].getvalue() == written[1].getvalue()


def test_nothing_is_refused(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(np.zeros((8, 8, 8), bool))
    with pytest.raises(VoxtoolError, match="no cell is set, so there is no hexahedron"):
        voxtool.export(octree, tmp_path / "a.vtu")
    assert not list(tmp_path.iterdir())


def test_digits() -> None:
    numbers = [0, 1, 9, 10, 999, 1000, 9999, 10_000, 10_001, 12_345_678, 99_999_999]
    assert text_of(np.array(numbers), 8).tolist() == [b"%8d" % n for n in numbers]
    numbers += [100_000_000, 4_300_000_001, 999_999_999_999]
    assert text_of(np.array(numbers), 12).tolist() == [b"%12d" % n for n in numbers]
    assert [width_of(n) for n in (1, 9999, 10_000, 10**8 - 1, 10**8)] == [4, 4, 8, 8, 12]
