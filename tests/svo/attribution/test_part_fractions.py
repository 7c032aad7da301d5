"""Labels and fractions in one octree, against the fractions of each part by itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from helpers import meshes
from helpers.attributes import label_array
from helpers.cli import fail, run, told, write_obj

import voxtool
from voxtool.bench.fractions import dense_of
from voxtool.errors import MeshError, VoxtoolError
from voxtool.mesh.appearance import Parts
from voxtool.svo.attribution.part_fractions import plan_part_fractions
from voxtool.svo.octree.stored_volume import stored_volume

N = 40


def grid(n: int = N) -> voxtool.Grid:
    return voxtool.Grid((n, n, n), (0, 0, 0), (1, 1, 1))


def joined(shapes: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[voxtool.Mesh, Parts]:
    """The shapes as one mesh, and each as a part of it."""
    mesh = meshes.mesh_of(*meshes.join(*shapes))
    of = np.repeat(np.arange(len(shapes), dtype=np.int32), [len(faces) for _, faces in shapes])
    return mesh, Parts(of, tuple(f"p{i}" for i in range(len(shapes))))


def check(
    shapes: Sequence[tuple[np.ndarray, np.ndarray]], device: Any, kind: str = "f4", **more: Any
) -> voxtool.Octree:
    """Compare the octree of parts with those of each."""
    mesh, parts = joined(shapes)
    job = plan_part_fractions(mesh, grid(), labels=parts, kind=kind, device=device, **more)
    octree = job.run()
    octree.validate()
    own = np.stack([
        dense_of(voxtool.voxelize(meshes.mesh_of(*shape), grid(), "fraction", device=device))
        for shape in shapes
    ])  # fmt: skip
    order = np.argsort(job.ranks)
    found, best = label_array(octree), order[own[order].argmax(axis=0)]
    assert np.array_equal(found >= 0, (own > 0).any(axis=0))
    assert np.array_equal(found[found >= 0], best[found >= 0])
    most = 1 << 24 if kind == "f4" else np.iinfo(kind).max
    assert np.abs(dense_of(octree) - np.minimum(own.sum(axis=0), 1)).max() <= 0.5 / most
    return octree


def balls(*places: tuple[float, float]) -> list[tuple[np.ndarray, np.ndarray]]:
    return [meshes.icosphere(3, place, radius) for place, radius in places]


@pytest.mark.parametrize("kind", ["f4", "u2", "u1"])
def test_parts_that_overlap(device, kind: str) -> None:
    """One ball holds another, and leaves of the one are refined by a third."""
    shapes = balls((20.3, 17.5), (20.6, 3.1), (30.2, 6.4))
    octree = check(shapes, device, kind)
    assert any(level.inside.any() for level in octree.levels() if level.number)
    last = check(shapes, device, kind, priority="last")
    assert not (label_array(octree) == 1).any()
    assert (label_array(last) == 1).any()


def test_parts_that_share_a_face_are_one(device) -> None:
    """Wherever the face lies, nothing is lost or doubled, and the greater share counts."""
    for at in (20, 20.25, 20.75, 20 + 1 / 256):
        shapes = [meshes.box(3, (at, 30.25, 31)), meshes.box((at, 3, 3), (33, 30.25, 31))]
        octree = check(shapes, device)
        one = voxtool.voxelize(meshes.mesh_of(*meshes.box(3, (33, 30.25, 31))), grid(), "fraction")
        assert np.array_equal(dense_of(octree), dense_of(one)), at
        assert stored_volume(octree) == 30 * 27.25 * 28
        labels = label_array(octree)
        assert (labels[20, 3:31, 3:31] == (at < 20.5)).all()
        halves = check([meshes.box(3, (20.5, 9, 9)), meshes.box((20.5, 3, 3), (33, 9, 9))], device)
        assert (label_array(halves)[20, 3:9, 3:9] == 0).all()


def test_parts_have_one_lattice(device) -> None:
    """A part that reaches far beyond the grid has a coarser lattice, and so has its neighbour."""
    at, end = 20 + 2**-20, (700, 30.25, 31)
    mesh, parts = joined([meshes.box(3, (at, 30.25, 31)), meshes.box((at, 3, 3), end)])
    octree = plan_part_fractions(mesh, grid(), labels=parts, device=device).run()
    one = voxtool.voxelize(meshes.mesh_of(*meshes.box(3, end)), grid(), "fraction", device=device)
    assert np.array_equal(dense_of(octree), dense_of(one))


def test_open_parts_and_warnings(device) -> None:
    """Each part is closed by its own caps; a part that bounds nothing is a warning of its own."""
    shapes = [meshes.open_box((2.5, 2.25, 2), (9.5, 11.125, 12)), meshes.box(20.5, 30)]
    mesh, parts = joined(shapes)
    job = plan_part_fractions(mesh, grid(), labels=parts, device=device)
    octree = job.run()
    assert stored_volume(octree) == 7 * 8.875 * 10 + 9.5**3
    assert octree.fill == "mixed"
    assert list(job.notes(octree)) == ["mesh: 1 hole of parts closed by 2 cap triangles"]
    mesh, parts = joined([meshes.open_box(2.5, 12.5, 0), shapes[1]])
    wrong = plan_part_fractions(mesh, grid(), labels=parts, fill="parity", device=device)
    with pytest.warns(voxtool.MeshWarning, match="part 0: at .* do not bound what parity fills"):
        wrong.run()


def test_command(here, device) -> None:
    """The command, its plan, what svo-info says of labels, and what does not go together."""
    write_obj(here / "a.obj", *meshes.box(1.25, (8, 9, 9)))
    write_obj(here / "b.obj", *meshes.box((8, 1.25, 1.25), (14.5, 9, 9)))
    line = "voxelize a.obj b.obj --labels file --mode fraction --bbox 0 0 0 16 16 16 --pitch 1"
    made = told(f"{line} -o both.svo.h5 --json")
    volumes = [6.75 * 7.75**2, 6.5 * 7.75**2]
    assert made["volume"] == sum(volumes)
    assert "mesh_volume" not in made
    printed = run(f"{line} -o both.svo.h5 -v").stderr
    assert f"; volume {sum(volumes):.12g}," in printed
    assert "vertices rounded to 2^-20 of a voxel\n" in printed
    assert set(made["attributes"]) == {"label", "fraction"}
    info = told("svo-info both.svo.h5 --json")
    assert [row["volume"] for row in info["attributes"]["label"]["labels"]] == volumes
    plan = told(f"{line} --fraction-type u2 --plan --json")
    assert plan["fraction_type"] == "u2"
    assert [part["reason"] for part in plan["alone"]] == ["each part has fractions of its own"] * 2
    assert "fractions  of type f4" in run(f"{line} --plan").stdout
    meshes_ = voxtool.join([voxtool.load_mesh("a.obj"), voxtool.load_mesh("b.obj")])
    place = voxtool.Grid((16,) * 3, (0, 0, 0), (1, 1, 1))
    request: dict[str, Any] = {"mode": "fraction", "labels": "file", "device": device}
    assert voxtool.voxelize(meshes_, place, **request).digest() == made["digest"]
    assert "are of a solid without --labels" in fail(f"{line} --face-fractions", 2)
    with pytest.raises(VoxtoolError, match="drop face_fractions and the window"):
        voxtool.voxelize(meshes_, place, **request, face_fractions=True)
    with pytest.raises(MeshError, match="part 0: a flood fills whole voxels"):
        voxtool.voxelize(meshes_, place, **request, fill="flood")
    with pytest.raises(VoxtoolError, match="fraction type 'f8' is unknown"):
        voxtool.voxelize(meshes_, place, **request, fraction_type="f8")
