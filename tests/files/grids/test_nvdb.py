"""NanoVDB's grids against NanoVDB's own code, in Warp."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.field import level_sets
from helpers.octree import WORLD, ball
from helpers.warp import values_at, wp

import voxtool
from voxtool.errors import GridError, VoxtoolError
from voxtool.svo.images.image import VoxelImage

CASES = level_sets()
LARGE = np.zeros((264, 16, 16), bool)
LARGE[:, 3:] = ball((264, 13, 16), 0.03) | (np.arange(264) > 200)[:, None, None]
SHAPES = {
    "ball": ball((40, 33, 21)),
    "noise": np.random.default_rng(0).random((17, 30, 9)) < 0.3,
    "several nodes": LARGE,
    "one voxel": np.arange(8 * 9 * 10).reshape(8, 9, 10) == 123,
    "all": np.ones((8, 16, 9), bool),
    "nothing": np.zeros((8, 9, 10), bool),
}


@pytest.mark.parametrize("options", [{}, {"level": 1}], ids=str)
@pytest.mark.parametrize("shape", SHAPES)
def test_warp_reads_the_same(shape: str, options: dict[str, Any], tmp_path: Path) -> None:
    """Every cell and those around, and the map to the world."""
    octree = voxtool.Octree.from_dense(SHAPES[shape], **WORLD)
    image = VoxelImage.of(octree, **options)
    path = tmp_path / "a.nvdb"
    job = voxtool.plan_export(octree, path, **options)
    assert job.run() <= job.plan.size
    wanted = np.pad(np.concatenate(list(image.slabs())), 1)
    volume = wp.Volume.load_from_nvdb(path.read_bytes(), device="cpu")
    info = volume.get_grid_info()
    pitch, corner = np.array(image.pitch), np.array(image.origin)
    assert info.name == "voxels"
    assert np.array_equal(np.reshape(info.transform_matrix, (3, 3)), np.diag(pitch.astype("f4")))
    assert np.allclose(info.translation, corner + pitch / 2, rtol=1e-6, atol=0)
    cells = np.argwhere(np.ones_like(wanted)).astype(np.int32) - 1
    found = values_at(volume, cells)
    assert info.type_str == "float"
    assert np.array_equal(found.reshape(wanted.shape), wanted)


def test_types_are_refused(tmp_path: Path) -> None:
    with pytest.raises(VoxtoolError, match=r"\.nvdb holds float32, not bool"):
        voxtool.export(voxtool.Octree.from_dense(LARGE), tmp_path / "a.nvdb", level=1, dtype="bool")


def test_a_place_beyond_float32_is_refused(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(LARGE, origin=(0, 0, 0), pitch=(1e-39, 1, 1))
    with pytest.raises(GridError, match=r"\.nvdb holds float32"):
        voxtool.export(octree, tmp_path / "a.nvdb")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", CASES)
def test_warp_reads_level_sets(name: str, tmp_path: Path) -> None:
    """Every sample: the distance, and beyond the band the background with its sign."""
    field, options, shape = CASES[name]
    path = tmp_path / "a.nvdb"
    job = voxtool.plan_export(field, path, **options)
    assert job.run() <= job.plan.size
    spacing = options.get("spacing", field.side / 32)
    background = np.float32(options.get("band", 3) * spacing)
    steps = np.indices(shape).reshape(3, -1).T
    first = np.array(field.origin) + spacing / 2
    distances = voxtool.query_adf(field, first + spacing * steps).distance.astype(np.float32)
    volume = wp.Volume.load_from_nvdb(path.read_bytes(), device="cpu")
    info = volume.get_grid_info()
    assert np.allclose(info.translation, first, rtol=1e-6, atol=0)
    active, kind = struct.unpack_from("<Q4xI", path.read_bytes(), 40)
    assert kind == 1  # level set
    if name != "half":  # of which a part is looked at
        assert active == np.count_nonzero(abs(distances) < background)
    cells = np.concatenate([steps, [[-5, 0, 0], [5000, 7, 7]]]).astype(np.int32)
    found = values_at(volume, cells)
    wanted = distances.clip(-background, background)
    assert np.array_equal(found, [*wanted, background, background])
