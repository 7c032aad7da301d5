"""The example volume: conforming, no cell inverted, and the same arrays on every machine."""

import hashlib
import subprocess
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

import voxtool

pytestmark = pytest.mark.slow
SCRIPT = Path(__file__).parents[2] / "examples" / "make_volume.py"
GOLDEN = "43c856b8cf73067465170349de0302729a83fb844594e05024ce3e7e6e3b0f3a"
COUNTS = {"hexahedron": 5_376, "tetra": 33_792, "wedge": 10_752}
PIECES = {"hexahedron": 6, "tetra": 1, "wedge": 3}


def make(path, *options):
    subprocess.run([sys.executable, SCRIPT, "-o", path, *options], check=True, capture_output=True)
    return path


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return make(tmp_path_factory.mktemp("volume") / "volume.vtu")


@pytest.fixture(scope="module")
def mesh(file):
    return meshio.read(file)


def digest(mesh):
    """Of the arrays: the file's bytes depend on the versions of meshio and zlib."""
    sha = hashlib.sha256()
    for array in (mesh.points, *mesh.point_data.values()):
        sha.update(np.ascontiguousarray(array, "<f8"))
    for array in (*(block.data for block in mesh.cells), *mesh.cell_data["leg"]):
        sha.update(np.ascontiguousarray(array, "<i8"))
    return sha.hexdigest()


def test_same_arrays_everywhere(mesh):
    assert digest(mesh) == GOLDEN


def test_size(file, mesh):
    assert {block.type: len(block.data) for block in mesh.cells} == COUNTS
    assert file.stat().st_size < 5_000_000
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    assert low == pytest.approx([-1.4, 0, -0.4], abs=1e-12)
    assert high == pytest.approx([1.4, 1.4, 0.4], abs=1e-12)


def test_scalars(mesh):
    density, momentum = mesh.point_data["density"], mesh.point_data["momentum"]
    assert density.shape == (len(mesh.points),)
    assert momentum.shape == (len(mesh.points), 3)
    assert 0 < density.min() < 0.01 < 0.9 < density.max() < 1.1
    for number, array in enumerate(mesh.cell_data["leg"]):
        assert (array == number).all()


def test_conforming(file):
    """Each face inside has two cells; together they fill the arch."""
    volume = voxtool.build_tet(voxtool.read_unstructured(file, "density"))
    assert len(volume.cells) == sum(PIECES[kind] * count for kind, count in COUNTS.items())
    report = volume.report
    for change in ("turned", "zero_volume", "flat", "duplicates", "collapsed", "merged_points"):
        assert report[change] == 0, change
    # two triangles on each outer face of 16 x 16 x 64 cells
    assert report["boundary_faces"] == 2 * (2 * 16 * 16 + 4 * 16 * 64)
    corners = volume.vertices[volume.cells, :3].astype(np.float64) * volume.scale
    a, b, c = np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 0)
    # half a turn of a square of 0.8, its centroid at radius 1
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(0.8**2 * np.pi, rel=2e-3)


@pytest.mark.parametrize("cells", [1_000, 9_000, 200_000])
def test_other_sizes(cells, tmp_path):
    mesh = meshio.read(make(tmp_path / "other.vtu", "--cells", str(cells)))
    assert 0.5 * cells < sum(len(block.data) for block in mesh.cells) <= cells


def test_refuses_too_few_cells(tmp_path):
    command = [sys.executable, SCRIPT, "-o", tmp_path / "none.vtu", "--cells", "10"]
    assert subprocess.run(command, capture_output=True).returncode == 2
    assert not list(tmp_path.iterdir())
