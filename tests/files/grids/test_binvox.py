"""binvox, and centres of cells: trimesh reads what is exported, and writes what is imported."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.octree import ball

import voxtool
from voxtool.errors import FileError

DENSE = {
    "ball": ball((21, 16, 9)),
    "noise": np.random.default_rng(0).random((17, 17, 17)) < 0.4,
    "nothing": np.zeros((8, 8, 8), bool),
    "one voxel": np.arange(729).reshape(9, 9, 9) == 123,
    "all": np.ones((12, 12, 12), bool),
}
PLACE = {"origin": (-1.5, 0.1, 1e-3), "pitch": 0.3}


@pytest.mark.parametrize("name", DENSE)
def test_trimesh_reads_exports(name: str, tmp_path: Path) -> None:
    """trimesh takes the scale as that between the outer centres: the cells are compared, and the
    world by the format's own rule."""
    dense = DENSE[name]
    octree = voxtool.Octree.from_dense(dense, **PLACE)
    voxtool.export(octree, tmp_path / "a.binvox")
    found = trimesh.exchange.binvox.load_binvox(io.BytesIO((tmp_path / "a.binvox").read_bytes()))
    side = max(dense.shape)
    assert np.array_equal(found.matrix, np.pad(dense, [(0, side - n) for n in dense.shape]))
    head = dict(
        line.split(b" ", 1)
        for line in (tmp_path / "a.binvox").read_bytes().split(b"data\n")[0].splitlines()
    )
    translate, scale = np.array(head[b"translate"].split(), float), float(head[b"scale"])
    for cell in ((0, 0, 0), (7, 1, 2), (3, 4, 5)):
        center = octree.grid.to_world(np.array(cell) + 0.5)
        assert np.allclose(scale * (np.array(cell) + 0.5) / side + translate, center, atol=1e-15)


@pytest.mark.parametrize("name", ["noise", "nothing", "one voxel", "all"])
def test_trimesh_files_are_imported(name: str, tmp_path: Path) -> None:
    grid = trimesh.voxel.VoxelGrid(trimesh.voxel.encoding.DenseEncoding(DENSE[name]))
    (tmp_path / "a.binvox").write_bytes(trimesh.exchange.binvox.export_binvox(grid))
    assert np.array_equal(voxtool.read_voxels(tmp_path / "a.binvox").to_dense(), DENSE[name])


def test_voxels_that_are_no_cubes(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(DENSE["ball"], pitch=(1, 1, 2))
    with pytest.raises(FileError, match="voxels of equal sides"):
        voxtool.export(octree, tmp_path / "a.binvox")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"#binvox", b"#bimbox", "is no .binvox file"),
        (b"dim 12 12 12", b"dim 12 12 13", "a .binvox is a cube"),
        (b"dim 12 12 12", b"dim 6000 6000 6000", "its array needs 1.69 GB"),
        (b"dim 12 12 12", b"dim 13 13 13", "its array needs 18 bytes"),
        (b"dim 12 12 12", b"dim 11 11 11", "longer than its cube"),
        (b"dim 12", b"dam 12", "a header line that is unknown"),
        (b"dim 12 12 12", b"dim 12 12 x", "is no number"),
        (b"dim 12 12 12", b"dim 1e400 12 12", "'1e400' is beyond float64"),
    ],
)
def test_damaged_files(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.binvox"
    voxtool.export(voxtool.Octree.from_dense(DENSE["all"]), path)
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(FileError, match=message):
        voxtool.read_voxels(path)


@pytest.mark.parametrize("name", ["ball", "nothing"])
@pytest.mark.parametrize("extension", ["ply", "xyz"])
def test_trimesh_reads_centres(extension: str, name: str, tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(DENSE[name], origin=(-1.5, 0.1, 1e-3), pitch=(0.1, 0.3, 0.7))
    path = tmp_path / f"a.{extension}"
    voxtool.export(octree, path)
    wanted = octree.grid.to_world(np.argwhere(DENSE[name]) + 0.5)
    if name == "nothing":
        assert path.stat().st_size < 256
        return
    cloud = trimesh.load(path)
    assert np.allclose(cloud.vertices, wanted, rtol=0, atol=1e-15)


def test_values_of_points(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(DENSE["ball"])
    voxtool.export(octree, tmp_path / "a.ply", level=1, dtype="uint8")
    body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")[2]
    records = np.frombuffer(body, [("place", "<f8", 3), ("value", "u1")])
    assert records["value"].sum() == octree.count
    assert (records["place"] % 2 == 1).all()
