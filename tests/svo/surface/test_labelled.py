"""Meshes of labels: against faces of a dense array, exact volumes, and surfaces without labels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import meshes
from helpers.attributes import attributed, label_array, labelled
from helpers.octree import ball, octree_from_dense

import voxtool
from voxtool.choices import LABEL_STYLES, SURFACE_NETS, VOXEL_FACES
from voxtool.errors import FileError, MemoryLimitError, MeshWarning, VoxtoolError
from voxtool.mesh.topology import check_surface
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.isosurface import LATTICE, NEAREST
from voxtool.svo.surface.labelled import LabelledSurface, plan_labelled
from voxtool.svo.surface.plan import RELAXATIONS

NAMES = ("a", "b b", "größe")
RNG = np.random.default_rng(4)
RANDOM = np.where(RNG.random((9, 13, 10)) < 0.4, RNG.integers(0, 3, (9, 13, 10)), -1)
BLOCKS = np.kron(RNG.integers(-1, 3, (3, 4, 3)), np.ones((4, 4, 4), int))
HALVES = np.where(ball((17, 16, 15)), np.arange(15) // 8, -1)  # a ball of two labels


def whole(side: int) -> Octree:
    """A cube that is one inside leaf, or eight."""
    octree = Octree.from_dense(np.ones((side,) * 3, bool))
    leaves = sum(int(level.inside.sum()) for level in octree.levels())
    none = np.empty(0, np.uint8)
    label = Attribute("label", none, np.full(leaves, 1, np.uint8), names=("no", "yes"))
    return replace(octree, attributes=(label,))


OCTREES = {
    "random": lambda: labelled(RANDOM, NAMES),
    "blocks": lambda: labelled(BLOCKS, NAMES),
    "halves": lambda: labelled(HALVES, NAMES[:2]),
    "leaves": attributed,
    "cube": lambda: whole(16),
}


def extracted(octree: Octree, style: str) -> LabelledSurface:
    return plan_labelled(octree, style=style).run()


def count_of(octree: Octree, label: int) -> int:
    return int(np.count_nonzero(label_array(octree) == label))


@pytest.mark.parametrize("name", OCTREES)
def test_faces_are_those_between_labels(name: str) -> None:
    """Each face between two labels, or a label and nothing, is there once, with both labels."""
    octree = OCTREES[name]()
    padded = np.pad(label_array(octree), 1, constant_values=-1)
    expected = set()
    for axis in range(3):
        n = padded.shape[axis] - 1
        low, high = np.take(padded, range(n), axis), np.take(padded, range(1, n + 1), axis)
        for at in np.argwhere(low != high):
            corner = at - 1
            corner[axis] += 1
            expected.add((axis, *corner.tolist(), int(low[tuple(at)]), int(high[tuple(at)])))
    surface = extracted(octree, VOXEL_FACES)
    corners = surface.points[surface.faces].reshape(-1, 6, 3) // LATTICE
    p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    up = np.cross(p, q)
    found = []
    for face, normal, sides in zip(corners, up, surface.sides[::2].tolist(), strict=True):
        axis = int(np.argmax(np.abs(normal)))
        behind, before = sides if normal[axis] > 0 else sides[::-1]
        assert sides[0] != -1
        assert sides[1] == -1 or sides[0] < sides[1]
        found.append((axis, *face.min(axis=0).tolist(), behind, before))
    assert len(set(found)) == len(found)
    assert set(found) == expected
    assert np.array_equal(surface.sides[::2], surface.sides[1::2])


@pytest.mark.parametrize("style", LABEL_STYLES)
@pytest.mark.parametrize("name", OCTREES)
def test_each_mesh_is_closed(name: str, style: str) -> None:
    """At each edge of a label as many triangles go one way as the other; of voxel faces the volume
    is that of the voxels; no triangle is without area, and vertices of nets stay in their cells."""
    octree = OCTREES[name]()
    surface = extracted(octree, style)
    assert np.array_equal(np.unique(surface.faces), np.arange(len(surface.points)))
    corners = extracted(octree, VOXEL_FACES).points
    room = 0 if style == VOXEL_FACES else LATTICE // 2 - NEAREST
    assert np.abs(surface.points - corners).max() <= room
    for label in surface.labels:
        faces = surface.faces_of(label)
        ways = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        there, back = (np.sort(pair @ [1 << 32, 1]) for pair in (ways, ways[:, ::-1]))
        assert np.array_equal(there, back)
        a, b, c = surface.points[faces].astype(np.int64).transpose(1, 0, 2)
        assert np.cross(b - a, c - a).any(axis=1).all()
        if style == VOXEL_FACES:
            a, b, c = (p // LATTICE for p in (a, b, c))
            assert (a * np.cross(b, c)).sum() == 6 * count_of(octree, label)


@pytest.mark.parametrize("style", LABEL_STYLES)
def test_borders_are_the_same_and_reversed(style: str, tmp_path: Path) -> None:
    """Triangles between two labels are in both meshes, in opposite order, bit for bit, also when
    they are read from a file."""
    surface = extracted(labelled(HALVES, NAMES[:2]), style)
    pairs = [tuple(surface.meshes())]
    for format in ("obj", "glb"):
        path = tmp_path / f"two.{format}"
        voxtool.write_mesh(surface, path)
        read = voxtool.load_mesh(path, keep=("parts",))
        assert read.parts["object"].names == NAMES[:2]
        of = read.parts["object"].labels
        pairs.append(tuple(replace(read, faces=read.faces[of == n], parts={}) for n in (0, 1)))
    for low, high in pairs:
        own = {face.tobytes() for face in low.vertices[low.faces]}
        other = {face.tobytes() for face in high.vertices[high.faces][:, [0, 2, 1]]}
        shared = int((surface.sides[:, 1] == 1).sum())
        assert shared > 100
        assert len(own & other) == shared
        for mesh in (low, high):
            found = check_surface(mesh)
            assert found.watertight
            assert found.manifold
    facts = surface.facts(check=True)
    assert [one["shared_triangles"] for one in facts] == [shared, shared]
    assert [one["triangles"] for one in facts] == [len(mesh.faces) for mesh in pairs[0]]
    assert all(one["closed"] for one in facts)


def triangles_of(points: np.ndarray, faces: np.ndarray) -> set[tuple[tuple[int, ...], ...]]:
    """The triangles by their points, the least point first."""
    found = set()
    for face in points[faces].tolist():
        corners = [tuple(corner) for corner in face]
        first = corners.index(min(corners))
        found.add(tuple(corners[first:] + corners[:first]))
    return found


@pytest.mark.parametrize("style", LABEL_STYLES)
def test_one_label_is_the_surface_without_labels(style: str, device) -> None:
    """The vertices and triangles are those of `extract` without labels, which computes them on the
    device, as no two voxels touch only in an edge or a corner."""
    dense = ball((23, 20, 21))
    found = extracted(labelled(dense.astype(int) - 1, ("one",)), style)
    expected = voxtool.extract(octree_from_dense(dense), style=style, level="voxel", device=device)
    assert triangles_of(found.points, found.faces) == triangles_of(expected.points, expected.faces)


def test_borders_leave_no_groove() -> None:
    """The upper side of a plate of two labels side by side stays flat. The plate's rim is
    farther away than the relaxation reaches."""
    half = RELAXATIONS + 4
    plate = np.full((2 * half, 2 * half, 12), -1)
    plate[:half, :, :6], plate[half:, :, :6] = 0, 1
    surface = extracted(labelled(plate, NAMES[:2]), SURFACE_NETS)
    corners = extracted(labelled(plate, NAMES[:2]), VOXEL_FACES).points // LATTICE
    middle = (np.abs(corners[:, :2] - half) <= 3).all(axis=1) & (corners[:, 2] == 6)
    assert set(surface.points[middle, 2].tolist()) == {6 * LATTICE}
    wall = (corners[:, 0] == half) & middle
    assert set(surface.points[wall, 0].tolist()) == {half * LATTICE}


def test_real_parts(device) -> None:
    """Parts of a mesh, voxelized, extracted and voxelized again, are the same labels."""
    parts = [meshes.box((0.1, 0.2, 0.3), (5.2, 6.1, 4.9)), meshes.box((5.2, 0.2, 0.3), (9, 6, 8))]
    mesh = voxtool.join([voxtool.mesh_from_arrays(*part) for part in parts])
    octree = voxtool.voxelize(mesh, dim=24, labels="file", device=device)
    surface = voxtool.extract(octree, by="label", style="voxel-faces")
    again = voxtool.join(surface.meshes())
    found = voxtool.voxelize(again, octree.grid, labels="file", device=device)
    assert np.array_equal(label_array(found), label_array(octree))


def test_labels_without_voxels() -> None:
    octree = labelled(HALVES, (*NAMES[:2], "none"))
    with pytest.warns(MeshWarning, match="no voxel is labelled none: no mesh has that name"):
        surface = extracted(octree, VOXEL_FACES)
    assert surface.labels == [0, 1]
    assert [mesh.name for mesh in surface.meshes()] == list(NAMES[:2])
    assert surface.mesh("b b") == surface.mesh(1)
    with pytest.raises(VoxtoolError, match="no label is named 'c': it has a, b b, none"):
        surface.mesh("c")


def test_digests_cover_names_and_sides() -> None:
    surface = extracted(labelled(HALVES, NAMES[:2]), VOXEL_FACES)
    others = [
        replace(surface, names=("a", "c")),
        replace(surface, sides=surface.sides[:, ::-1].copy()),
        replace(surface, points=surface.points + np.int32(1)),
    ]
    assert len({one.digest() for one in (surface, *others)}) == 4


def test_what_is_refused(tmp_path: Path) -> None:
    octree = labelled(HALVES, NAMES[:2])
    for request, message in (
        ({"by": "colour"}, "by 'colour' is unknown: choose label"),
        ({"style": "sharp"}, "common borders: choose one of surface-nets, voxel-faces"),
        ({"isovalue": 0.4}, "samples are voxels: leave out level, isovalue"),
        ({"level": 0}, "samples are voxels: leave out level, isovalue"),
        ({"max_memory": 1000}, "would need .* of memory, of .* allowed: voxelize with"),
    ):
        with pytest.raises(VoxtoolError, match=message):
            voxtool.extract(octree, **{"by": "label", **request})
    with pytest.raises(VoxtoolError, match="has no labels: voxelize with --labels"):
        voxtool.extract(replace(octree, attributes=()), by="label")
    with pytest.raises(VoxtoolError, match=r"mode surface26 has no inside .* voxel-faces"):
        voxtool.extract(replace(octree, mode="surface26"), by="label")
    surface = voxtool.extract(octree, by="label")
    with pytest.raises(FileError, match=r"\.stl holds one mesh without a name: write \.obj, \.glb"):
        voxtool.write_mesh(surface, tmp_path / "a.stl")
    assert not list(tmp_path.iterdir())


def test_counted_faces_are_refused() -> None:
    """A plan that predicts too few faces is held to what it counts."""
    job = plan_labelled(labelled(RANDOM, NAMES)).with_(faces=0)
    job.max_memory = job.cost.host
    with pytest.raises(MemoryLimitError, match="faces between labels would need"):
        job.run()
