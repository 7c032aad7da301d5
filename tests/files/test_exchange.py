"""Export and import by the table of formats; the formats have tests of their own."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from helpers.octree import WORLD, ball, octree_from_dense

import voxtool
from voxtool.errors import FileError, MemoryLimitError, VoxtoolError
from voxtool.files import formats, imports
from voxtool.files.grids import npy
from voxtool.files.grids.voxels import frame_of
from voxtool.files.lattices import read_lattice
from voxtool.files.storage.atomic import MARK, atomic_folder
from voxtool.svo.octree.from_pieces import Collector

BALL = ball((40, 33, 21))
SHAPES = {
    "ball": BALL,
    "nothing": np.zeros((8, 9, 10), bool),
    "one voxel": np.arange(8 * 9 * 10).reshape(8, 9, 10) == 123,
    "all": np.ones((8, 16, 9), bool),
}
PLACED = (
    "npz",
    "ome.zarr",
    "vti",
    "nii",
    "nii.gz",
    "nrrd",
    "vox",
    "vdb",
    "vtkhdf",
    "tif",
    "tiff",
)  # formats that keep the grid


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", formats.IMPORTS)
def test_round_trip(name: str, shape: str, tmp_path: Path) -> None:
    """An export comes back by import, bit for bit, and where it was."""
    octree = voxtool.Octree.from_dense(SHAPES[shape], **WORLD)
    if name == "binvox":  # a cube
        cube = [(0, octree.grid.dim - n) for n in octree.grid.shape]
        octree = voxtool.Octree.from_dense(np.pad(SHAPES[shape], cube), **WORLD)
    path = tmp_path / f"a.{name}"
    voxtool.export(octree, path)
    more = {} if name in PLACED else WORLD
    assert voxtool.read_voxels(path, **more).digest() == octree.digest()
    if name in PLACED:
        assert read_lattice(path).grid == octree.grid


@pytest.mark.parametrize("name", sorted({*formats.IMPORTS} - {"binvox", "vox"}))
def test_coverage(name: str, tmp_path: Path) -> None:
    """Coverages come back, and a threshold says what is set."""
    octree = voxtool.Octree.from_dense(BALL, **WORLD)
    path = tmp_path / f"a.{name}"
    voxtool.export(octree, path, level=1, dtype="float32")
    cells = np.pad(BALL, [(0, n % 2) for n in BALL.shape]).reshape(20, 2, 17, 2, 11, 2)
    coverage = cells.mean(axis=(1, 3, 5))
    assert np.array_equal(voxtool.read_voxels(path).to_dense(), coverage > 0)
    assert np.array_equal(voxtool.read_voxels(path, threshold=0.5).to_dense(), coverage >= 0.5)
    assert np.array_equal(voxtool.read_voxels(path, label=0.25).to_dense(), coverage == 0.25)


def test_axes_of_frames() -> None:
    """Permuted and mirrored axes become those of the world, exactly."""
    matrix = np.array([[0, 0, -2], [0.5, 0, 0], [0, 3, 0]], float)
    frame = frame_of((8, 9, 10), matrix, np.array([7.0, 1, 2]))
    assert (frame.axes, frame.flips) == ((1, 2, 0), (False, False, True))
    assert frame.grid.shape == (10, 8, 9)
    assert frame.grid.pitch == (2, 0.5, 3)
    assert frame.grid.origin == (7 - 18 - 1, 1 - 0.25, 2 - 1.5)
    assert frame.shape == (8, 9, 10)
    with pytest.raises(FileError, match="oblique: resample it"):
        frame_of((8, 9, 10), matrix + 0.01, np.zeros(3))
    with pytest.raises(FileError, match="no three directions"):
        frame_of((8, 9, 10), np.ones((3, 3)), np.zeros(3))


def test_pieces_are_turned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An array with other axes is read in pieces, which come to their places."""
    from voxtool.files.grids import voxels

    rng = np.random.default_rng(1)
    values = rng.random((8, 9, 10)) < 0.3
    np.save(tmp_path / "a.npy", values)
    monkeypatch.setattr(voxels, "PIECE", 400)
    matrix = np.array([[0, 0, -1], [1, 0, 0], [0, 1, 0]], float)
    frame = frame_of((8, 9, 10), matrix, np.zeros(3))
    with imports.Source.of(tmp_path / "a.npy").stored() as stored:
        found = voxels.octree_of(
            stored._replace(frame=frame), voxels.Rule(), lambda share: None
        ).to_dense()
    assert np.array_equal(found, values[:, :, ::-1].transpose(2, 0, 1))


# ---- refusals


def test_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line = formats.EXCHANGE["npy"]._replace(needs="no_such_package")
    monkeypatch.setitem(formats.EXCHANGE, "npy", line)
    with pytest.raises(FileError) as error:
        voxtool.export(octree_from_dense(BALL), tmp_path / "a.npy")
    assert str(error.value) == (
        ".npy needs no_such_package, which is not installed: pip install 'voxtool[formats]'"
    )


def test_too_many_bytes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"would take up to 27.8 kB, of 10 kB allowed: choose"):
        voxtool.export(octree_from_dense(BALL), tmp_path / "a.npy", max_bytes=10_000)
    assert list(tmp_path.iterdir()) == []


def test_parts_of_slices_are_refused(tmp_path: Path) -> None:
    with pytest.raises(VoxtoolError, match=r"\.png takes no level"):
        voxtool.export(octree_from_dense(BALL), tmp_path / "a.png", level=1)


@pytest.mark.parametrize("name", [n for n in formats.IMPORTS if not formats.is_folder(n)])
def test_cut_files_are_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{name}"
    voxtool.export(octree_from_dense(BALL), path)
    whole = path.read_bytes()
    for size in (0, 7, len(whole) // 2, len(whole) - 100):  # the end may be markup
        path.write_bytes(whole[:size])
        with pytest.raises(FileError, match=f"a.{name}: "):
            voxtool.read_voxels(path)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((8, 8)), "an array of 8 x 8: voxels have three axes"),
        (np.zeros((8, 8, 8), "c8"), "values of type <c8: voxels are bool"),
        (np.zeros((8, 0, 8)), "an array of 8 x 0 x 8"),
        (np.zeros((4, 4, 4)), "the longest side must have 8 to 65536 voxels"),
    ],
)
def test_arrays_that_are_no_voxels(array: np.ndarray, message: str, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(VoxtoolError) as error:
        voxtool.read_voxels(tmp_path / "a.npy")
    assert message in str(error.value)


def test_declared_arrays_are_compared_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((8, 8, 8)))
    path.write_bytes(path.read_bytes().replace(b"(8, 8, 8), }", b"(8000, 8000, 8000)}", 1))
    with pytest.raises(FileError, match=r"its array needs|its header is damaged"):
        voxtool.read_voxels(path)


@pytest.mark.parametrize(
    ("name", "content"), [("a.nii.gz", gzip.compress(b"scan", mtime=0)), ("a.vti", b"<VTKFile/>")]
)
def test_readers_of_octrees_name_the_import(name: str, content: bytes, tmp_path: Path) -> None:
    """Also of files that are gzip or XML, as octrees may be."""
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FileError, match=f"import it first: voxtool import {path}"):
        voxtool.read_svo(path)


# ---- folders


def test_folders_appear_whole(tmp_path: Path) -> None:
    target = tmp_path / "layers"
    for text in ("old", "new"):
        with atomic_folder(target) as folder:
            (folder / text).write_text(text)
            assert not (target / text).exists()
        assert sorted(p.name for p in target.iterdir()) == sorted([MARK, text])
    with pytest.raises(FileError, match="layers exists"), atomic_folder(target, clobber=False):
        pass
    with pytest.raises(RuntimeError), atomic_folder(target) as folder:
        raise RuntimeError
    assert (target / "new").exists()
    (target / MARK).unlink()
    with pytest.raises(FileError, match="files that no export wrote"), atomic_folder(target):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["layers"]


def test_exports_can_be_planned() -> None:
    octree = octree_from_dense(BALL)
    job = voxtool.plan_export(octree, "-", format="npy", level=1, dtype="uint8")
    assert job.plan.size == npy.HEADER + 20 * 17 * 11
    assert job.describe()["shape"] == [20, 17, 11]


def test_import_is_planned_and_limited(tmp_path: Path) -> None:
    """The plan is that of the header; bricks that do not fit are refused, and cubes are small."""
    grid = np.indices((64, 64, 64)).sum(axis=0)
    np.save(tmp_path / "checks.npy", grid % 2 == 0)
    np.save(tmp_path / "solid.npy", grid >= 0)
    plan = voxtool.plan_import(tmp_path / "checks.npy", pitch=0.5).plan
    assert (plan.grid.shape, plan.grid.pitch, plan.as_dict()["becomes"]) == (
        (64, 64, 64), (0.5, 0.5, 0.5), "octree",
    )  # fmt: skip
    with pytest.raises(MemoryLimitError, match=r"import would need 50\.3 MB of memory, of 50 MB"):
        voxtool.read_voxels(tmp_path / "solid.npy", max_memory=50_000_000)
    low, cube = np.zeros((1, 3), int), voxtool.Grid((64, 64, 64), (0, 0, 0), (1, 1, 1))
    collector = Collector(cube, max_memory=10_000)
    collector.add_boxes(low, (grid >= 0)[None])  # cubes, once they are united
    assert collector.octree().count == 64**3
    assert voxtool.read_voxels(tmp_path / "checks.npy", max_memory=51_000_000).count == 64**3 // 2
    with pytest.raises(MemoryLimitError, match=r"4,096 bricks of 4\^3 voxels .* choose fewer"):
        Collector(cube, max_memory=10_000).add_boxes(low, (grid % 2 == 0)[None])
