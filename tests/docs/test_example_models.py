"""The example mesh and volume: well formed, and the same on every machine."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest
from helpers.cli import ROOT

import voxtool
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import check_surface, volume

pytestmark = pytest.mark.slow
BUNNY = "4ed00535ee5ae830ed83661f190ad5295ec88743e14226235b5b1a763512a256"
VOLUME = "43c856b8cf73067465170349de0302729a83fb844594e05024ce3e7e6e3b0f3a"
COUNTS = {"hexahedron": 5_376, "tetra": 33_792, "wedge": 10_752}
PIECES = {"hexahedron": 6, "tetra": 1, "wedge": 3}


def make(script: str, path: Path, *options: str, status: int = 0) -> Path:
    words = [sys.executable, ROOT / "examples" / script, "-o", path, *options]
    assert subprocess.run(words, capture_output=True).returncode == status
    return path


# ---- make_bunny.py


def closed(path: Path) -> Mesh:
    """Return the mesh of a file, which is closed, in one piece, of genus 0 and oriented."""
    mesh = voxtool.load_mesh(path)
    found = check_surface(mesh, weld=False)
    assert found.watertight
    assert found.manifold
    assert (found.shells, found.genus, found.degenerate_faces) == (1, 0, 0)
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    assert volume(mesh) == pytest.approx(1.05, abs=0.05)
    return mesh


def test_bunny(tmp_path: Path) -> None:
    path = make("make_bunny.py", tmp_path / "bunny.obj")
    assert hashlib.sha256(path.read_bytes()).hexdigest() == BUNNY
    mesh = closed(path)
    assert 65_000 <= len(mesh.faces) <= 75_000
    assert np.ptp(mesh.vertices[:, 1]) == pytest.approx(2.32, abs=0.02)


@pytest.mark.parametrize("triangles", [2_000, 9_000, 200_000])
def test_bunnies_of_other_sizes(triangles: int, tmp_path: Path) -> None:
    path = make("make_bunny.py", tmp_path / "other.obj", "--triangles", str(triangles))
    assert len(closed(path).faces) == pytest.approx(triangles, rel=0.1)


@pytest.mark.parametrize(
    ("script", "option"), [("make_bunny.py", "--triangles"), ("make_volume.py", "--cells")]
)
def test_too_few_are_refused(script: str, option: str, tmp_path: Path) -> None:
    make(script, tmp_path / "none", option, "10", status=2)
    assert not list(tmp_path.iterdir())


# ---- make_volume.py


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    return make("make_volume.py", tmp_path_factory.mktemp("volume") / "volume.vtu")


def test_volume(file: Path) -> None:
    mesh = meshio.read(file)
    sha = hashlib.sha256()  # of the arrays: the bytes depend on the versions of meshio and zlib
    for array in (mesh.points, *mesh.point_data.values()):
        sha.update(np.ascontiguousarray(array, "<f8"))
    for array in (*(block.data for block in mesh.cells), *mesh.cell_data["leg"]):
        sha.update(np.ascontiguousarray(array, "<i8"))
    assert sha.hexdigest() == VOLUME
    assert {block.type: len(block.data) for block in mesh.cells} == COUNTS
    assert file.stat().st_size < 5_000_000
    assert mesh.points.min(axis=0) == pytest.approx([-1.4, 0, -0.4], abs=1e-12)
    assert mesh.points.max(axis=0) == pytest.approx([1.4, 1.4, 0.4], abs=1e-12)
    density = mesh.point_data["density"]
    assert 0 < density.min() < 0.01 < 0.9 < density.max() < 1.1
    assert mesh.point_data["momentum"].shape == (len(mesh.points), 3)


def test_the_volume_is_conforming(file: Path) -> None:
    """Each face inside has two cells; together they fill the arch."""
    built = voxtool.build_tet(voxtool.read_unstructured(file, "density"))
    assert len(built.cells) == sum(PIECES[kind] * count for kind, count in COUNTS.items())
    for change in ("turned", "zero_volume", "flat", "duplicates", "collapsed", "merged_points"):
        assert built.report[change] == 0, change
    # two triangles on each outer face of 16 x 16 x 64 cells
    assert built.report["boundary_faces"] == 2 * (2 * 16 * 16 + 4 * 16 * 64)
    corners = built.vertices[built.cells, :3].astype(np.float64) * built.scale
    a, b, c = np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 0)
    # half a turn of a square of 0.8, its centroid at radius 1
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(0.8**2 * np.pi, rel=2e-3)


@pytest.mark.parametrize("cells", [1_000, 9_000, 200_000])
def test_volumes_of_other_sizes(cells: int, tmp_path: Path) -> None:
    mesh = meshio.read(make("make_volume.py", tmp_path / "other.vtu", "--cells", str(cells)))
    assert 0.5 * cells < sum(len(block.data) for block in mesh.cells) <= cells
