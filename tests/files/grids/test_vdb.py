"""OpenVDB's trees against OpenVDB's own library and against tinyvdb."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers.octree import WORLD, ball
from helpers.openvdb import openvdb

import voxtool
from voxtool.errors import FileError, VoxtoolError
from voxtool.svo.images.image import VoxelImage

tinyvdb: Any = pytest.importorskip("tinyvdb")
RANDOM = np.random.default_rng(0)
FLAT = {"origin": (-1.5, 0.1, 1e-3), "pitch": (0.1, 0.25, 0.5)}
SHAPES = {
    "ball": ball((40, 33, 21)),
    "large": ball((140, 136, 21), 0.6),  # with tiles, in two lower nodes along an axis
    "noise": RANDOM.random((17, 30, 9)) < 0.3,
    "one voxel": np.arange(8 * 9 * 10).reshape(8, 9, 10) == 123,
    "all": np.ones((8, 16, 9), bool),
    "cube": np.ones((136, 136, 136), bool),  # a tile of a lower node
    "nothing": np.zeros((8, 9, 10), bool),
}
OPTIONS: dict[str, dict[str, Any]] = {
    "voxels": {},
    "coverage": {"dtype": "float32"},
    "coarse": {"level": 1},
    "halves": {"level": 1, "dtype": "bool"},
    "unset": {"invert": True},
    "part": {"bbox": (-1.2, 0.6, 0.2, 1.2, 2.1, 1.7), "dtype": "float32"},
}


class Case(NamedTuple):
    octree: voxtool.Octree
    image: VoxelImage
    path: Path


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], Case]:
    folder, found = tmp_path_factory.mktemp("vdb"), {}
    for shape, dense in SHAPES.items():
        octree = voxtool.Octree.from_dense(dense, **(FLAT if shape == "noise" else WORLD))
        for name, options in OPTIONS.items():
            few = ("voxels", "coverage") if shape in ("large", "cube") else tuple(OPTIONS)
            if name not in few or (name == "part" and shape not in ("ball", "noise")):
                continue
            path = folder / f"{shape} {name}.vdb"
            voxtool.export(octree, path, **options)
            found[shape, name] = Case(octree, VoxelImage.of(octree, **options), path)
    return found


def dense_of(image: VoxelImage) -> np.ndarray:
    """The values of an image from the low corner of its grid on."""
    found = np.zeros(np.add(image.low, image.shape), image.dtype)
    part = tuple(slice(n, None) for n in image.low)
    found[part] = np.concatenate(list(image.slabs()))
    return found


def test_openvdb_reads_the_same(cases: dict[tuple[str, str], Case], tmp_path: Path) -> None:
    """Every cell, the world's positions of three corners, the class and the statistics."""
    wanted = {key: dense_of(case.image) for key, case in cases.items()}
    outs = {key: tmp_path / f"{' '.join(key)}.npz" for key in cases}
    openvdb([("read", cases[key].path, outs[key], *wanted[key].shape) for key in cases])
    for key, (_, image, path) in cases.items():
        read = np.load(outs[key])
        facts, dense = json.loads(str(read["facts"])), wanted[key]
        assert np.array_equal(read["values"], dense), key
        assert facts["type"] == ("BoolGrid" if image.dtype == bool else "FloatGrid")
        assert (facts["name"], facts["class"], facts["background"]) == ("voxels", "fog volume", 0)
        assert facts["active"] == np.count_nonzero(dense)
        assert facts["metadata"]["file_voxel_count"] == facts["active"]
        assert facts["leaves"] == facts["pruned"], key
        if dense.any():
            cells = np.argwhere(dense)
            assert facts["box"] == [cells.min(0).tolist(), cells.max(0).tolist()]
        corner, pitch = np.array(image.corner), np.array(image.pitch)
        for k, found in zip((0, 1, 3), facts["corners"], strict=True):
            index = np.array(dense.shape) * (np.arange(3) < k)
            assert np.allclose(found, corner + pitch * (index + 0.5), rtol=0, atol=1e-14)
        assert (
            path.stat().st_size
            <= voxtool.plan_export(*cases[key][:1], path, **OPTIONS[key[1]]).plan.size
        )


def test_tinyvdb_reads_the_same(cases: dict[tuple[str, str], Case]) -> None:
    """Cells that are in leaves; it does not list tiles."""
    for shape in ("ball", "noise", "one voxel"):
        _, image, path = cases[shape, "coarse"]
        with tinyvdb.open(str(path)) as file:
            file.read_grids()
            sparse = file.grid(0).to_sparse()
        dense = dense_of(image)
        cells = np.frombuffer(sparse["coords"], "<i4").reshape(-1, 3)
        found = np.zeros_like(dense)
        found[tuple(cells.T)] = np.frombuffer(sparse["values"], "<f4")
        for cubes in image.cubes():
            for corner in cubes.corners:
                found[tuple(slice(n, n + cubes.side) for n in corner)] = 1
        assert np.array_equal(found, dense)


def test_equal_content_makes_equal_bytes(
    cases: dict[tuple[str, str], Case], tmp_path: Path
) -> None:
    octree, _, path = cases["ball", "coarse"]
    voxtool.export(octree, tmp_path / "a.vdb", level=1)
    assert (tmp_path / "a.vdb").read_bytes() == path.read_bytes()


# ---- files of OpenVDB's library


DIAGONAL = np.diag([0.5, 0.5, 0.25, 1])
DIAGONAL[3, :3] = 1, 2, 3  # world = index @ matrix
TURNED = DIAGONAL[[1, 2, 0, 3]] * np.array([[-1], [1], [1], [1]])
CENTERED = ball((21, 17, 19))
KINDS = {  # type, values, whether half floats
    "blosc": ("FloatGrid", np.where(CENTERED, RANDOM.random(CENTERED.shape), 0), ""),
    "half": ("FloatGrid", np.where(CENTERED, RANDOM.random(CENTERED.shape), 0), "half"),
    "bool": ("BoolGrid", CENTERED, ""),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of files that OpenVDB's library wrote."""
    folder, lines = tmp_path_factory.mktemp("openvdb"), []
    for name, (kind, values, half) in KINDS.items():
        values = values.astype(bool if kind == "BoolGrid" else np.float32)
        np.save(folder / f"{name}.npy", values)
        for matrix, place in {"plain": DIAGONAL, "turned": TURNED}.items():
            path = folder / f"{name} {matrix}.vdb"
            words = (folder / f"{name}.npy", kind, half, json.dumps(place.tolist()))
            lines.append(("write", path, *words))
    oblique = DIAGONAL.copy()
    oblique[0, 1] = 0.1
    words = (folder / "bool.npy", "BoolGrid", "", json.dumps(oblique.tolist()))
    lines += [("write", folder / "oblique.vdb", *words), ("several", folder / "several.vdb")]
    openvdb(lines)
    return folder


@pytest.mark.parametrize("matrix", ["plain", "turned"])
@pytest.mark.parametrize("name", KINDS)
def test_openvdb_writes_what_is_read(name: str, matrix: str, written: Path) -> None:
    """Leaves and tiles, at negative indices, and with turned and mirrored axes."""
    octree = voxtool.read_voxels(written / f"{name} {matrix}.vdb")
    cells = np.argwhere(np.load(written / f"{name}.npy")) + np.array([-3, 5, 130])
    place = DIAGONAL if matrix == "plain" else TURNED
    wanted = cells @ place[:3, :3] + place[3, :3]
    in_tile = np.sort(
        np.array([[127.5, -0.5, -0.5], [135.5, 7.5, 7.5]]) @ place[:3, :3] + place[3, :3], 0
    )
    found = (octree.occupied() + 0.5) * octree.grid.pitch + octree.grid.origin
    is_tile = ((found > in_tile[0]) & (found < in_tile[1])).all(axis=1)
    assert np.count_nonzero(is_tile) == 8**3
    assert np.array_equal(found[~is_tile], wanted[np.lexsort(wanted.T[::-1])])


def test_values_of_openvdb(written: Path) -> None:
    values = np.load(written / "half.npy").astype(np.float16)
    octree = voxtool.read_voxels(written / "half plain.vdb", threshold=0.5)
    assert octree.count - 8**3 == np.count_nonzero(values >= 0.5)
    values = np.load(written / "blosc.npy")
    octree = voxtool.read_voxels(written / "blosc plain.vdb", label=float(values.max()))
    assert octree.count == np.count_nonzero(values == values.max())


def test_several_grids(written: Path) -> None:
    """A level set is set inside, where it is inactive, too; grids are chosen by name."""
    path = written / "several.vdb"
    octree = voxtool.read_voxels(path, grid="sphere")
    centers = (octree.occupied() + 0.5) * octree.grid.pitch + octree.grid.origin
    assert (np.linalg.norm(centers - (1, 2, 3), axis=1) < 9).all()
    steps = np.indices((76, 76, 76)).reshape(3, -1).T - 38
    inside = np.linalg.norm(0.25 * steps + (0, 0, 0), axis=1) < 9 - 1e-6
    assert octree.count >= np.count_nonzero(inside)
    for name, message in {
        None: "holds 3 grids: choose one of sphere, nothing, velocity",
        "nothing": "grid nothing has no active voxel",
        "velocity": "grid velocity is a Tree_vec3s_5_4_3: voxels are bool",
        "smoke": "holds no grid smoke",
    }.items():
        with pytest.raises(FileError, match=message):
            voxtool.read_voxels(path, grid=name)
    with pytest.raises(VoxtoolError, match=r"\.npy holds one grid"):
        voxtool.read_voxels("a.npy", grid="a")


def test_oblique_grids_are_refused(written: Path) -> None:
    with pytest.raises(FileError, match="its axes are oblique"):
        voxtool.read_voxels(written / "oblique.vdb")


def test_bombs_are_refused(cases: dict[tuple[str, str], Case], tmp_path: Path) -> None:
    """Counts beyond the file, and values that unpack to more than their node holds."""
    whole = cases["ball", "coarse"].path.read_bytes()
    tree = whole.index(b"ScaleTranslateMap") + len("ScaleTranslateMap") + 18 * 8
    counts = tree + 4 + 4
    packed = zlib.compress(bytes(1 << 20))
    leaf = whole.rindex(bytes([0x78, 0x9C])) - 8
    for lie, message in {
        whole[:counts] + b"\xff" * 8 + whole[counts + 8 :]: "beyond its end",
        whole[:leaf] + struct.pack("<q", len(packed)) + packed + whole: "bytes of values where",
        whole[:leaf] + struct.pack("<q", 1 << 60) + whole: "beyond its end",
        whole.replace(b"Tree_float", b"Tree_fl0at"): "is a Tree_fl0at_5_4_3",
        whole[:8] + struct.pack("<I", 213) + whole[12:]: "of version 213",
    }.items():
        (tmp_path / "a.vdb").write_bytes(lie)
        with pytest.raises(FileError, match=message):
            voxtool.read_voxels(tmp_path / "a.vdb")


def test_types_are_refused(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(SHAPES["ball"])
    with pytest.raises(VoxtoolError, match=r"\.vdb holds bool or float32, not uint8"):
        voxtool.export(octree, tmp_path / "a.vdb", dtype="uint8")
