"""Round trips of real models through every format, and long series of layers."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import MODELS
from helpers.cli import ENVIRONMENT
from helpers.formats import READERS, WRITERS
from helpers.octree import WORLD, ball

import voxtool
from voxtool.files import formats

pytestmark = [
    pytest.mark.soak,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]
UNEVEN = {"origin": (-1.5, 0.1, 1e-3), "pitch": (0.1, 0.25, 0.5)}
SHAPES = {  # a grid that is no cube with voxels that are none, nothing, one voxel, all
    "uneven": (ball((90, 31, 50)), UNEVEN),
    "nothing": (np.zeros((9, 9, 9), bool), WORLD),
    "one voxel": (np.arange(9**3).reshape(9, 9, 9) == 123, WORLD),
    "all": (np.ones((9, 9, 9), bool), WORLD),
}
MODEL_NAMES = [f"{path.stem} {dim}" for dim in (64, 200) for path in sorted(MODELS.glob("*.obj"))]


def octree_of(name: str) -> voxtool.Octree:
    if name in SHAPES:
        dense, place = SHAPES[name]
        return voxtool.Octree.from_dense(dense, **place)  # pyright: ignore[reportArgumentType]
    model, dim = name.rsplit(" ", 1)
    return voxtool.voxelize(voxtool.load_mesh(MODELS / f"{model}.obj"), dim=int(dim))


@pytest.mark.parametrize(
    "name",
    [
        *SHAPES,
        *MODEL_NAMES[:1],
        *(pytest.param(name, marks=pytest.mark.long) for name in MODEL_NAMES[1:]),
    ],
)
def test_round_trips(name: str, tmp_path: Path) -> None:
    """Another project reads every voxel and the world's positions of three corners, and the import
    gives the octree back; what another project writes is imported."""
    octree = octree_of(name)
    grid, dense = octree.grid, octree.to_dense()
    shape = np.array(grid.shape)
    near = 1e-6 * max(np.abs(grid.origin).max(), (shape * grid.pitch).max())  # NIfTI has float32
    for format, reader in READERS.items():
        if (format, name) in (("binvox", "uneven"), ("vox", "nothing")):
            continue  # voxels of .binvox are cubes; midvoxio cannot read an empty model
        path = tmp_path / "layers" / "%04d.png" if "%" in format else tmp_path / f"a.{format}"
        voxtool.export(octree, path)
        found, place = reader(path, grid)
        assert np.array_equal(found, dense), format
        if place:
            for corner in (0 * shape, (shape - 1) * (1, 0, 0), shape - 1):
                wanted = grid.to_world(corner[None] + 0.5)[0]
                assert np.allclose(place[0] + place[1] * corner, wanted, rtol=0, atol=near), format
        if format in formats.IMPORTS:
            again = voxtool.read_voxels(path, origin=grid.origin, pitch=grid.pitch)
            assert np.array_equal(again.to_dense(), dense), format
    for format, (writer, keeps) in WRITERS.items():
        path = tmp_path / f"other.{format}"
        writer(path, dense, grid)
        again = voxtool.read_voxels(path)
        assert np.array_equal(again.to_dense(), dense), format
        if keeps:
            for field in ("origin", "pitch"):
                assert np.allclose(getattr(again.grid, field), getattr(grid, field), atol=near)


LAYERS = """
import sys, numpy as np, voxtool
from voxtool.svo.octree.from_pieces import Collector
count, path = int(sys.argv[1]), sys.argv[2]
grid = voxtool.Grid((3840, 2160, count), (0, 0, 0), (1, 1, 1))
collector = Collector(grid)
places = [[i * 8 % 3000, i * 5 % 2000, i % count] for i in range(9 * count)]
collector.add_cubes(np.array(places) // 8 * 8, 8)
voxtool.export(collector.octree(), path)
status = open("/proc/self/status").read()  # rusage has the peak of the process that began it
print(status.partition("VmHWM:")[2].split()[0])
"""


@pytest.mark.parametrize("name", ["layers/%04d.png", "a.tif"])
def test_layers_of_4k_keep_their_memory(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """Layers of 3,840 x 2,160 voxels, 10,000 in a run of 2,000 s and more, take little more memory
    than a tenth of them."""
    most = int(min(max(5 * (request.config.getoption("soak") or 0), 200), 10_000)) // 80 * 80
    peaks = []
    for count in (most // 10, most):
        start = time.monotonic()
        path = tmp_path / str(count) / name
        path.parent.mkdir(parents=True)
        words = [sys.executable, "-c", LAYERS, str(count), str(path)]
        done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, check=True)
        peaks.append(int(done.stdout) << 10)
        print(
            f"soak: {count} layers as {name}: {time.monotonic() - start:.0f} s, {peaks[-1]:,} bytes"
        )
    assert peaks[1] < peaks[0] + (200 << 20)
