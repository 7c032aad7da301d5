"""Images of distances that become fields: their bounds, against the image's own interpolation."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from helpers.field import plain_field
from helpers.octree import ball

import voxtool
from voxtool.adf.construction import from_image
from voxtool.adf.construction.from_image import field_of_image
from voxtool.cli.main import cli
from voxtool.errors import FileError, MemoryLimitError, VoxtoolError
from voxtool.files.formats import IMAGES, ending
from voxtool.grid import Grid

ORIGIN = (5.0, -3.0, 1000.1)
# Shapes and spacings: a cube of the natural level and others, multiples and none, a plane.
GRIDS = {
    "cube": Grid((17, 17, 17), ORIGIN, (0.1, 0.1, 0.1)),
    "box": Grid((23, 14, 9), ORIGIN, (0.1, 0.1, 0.1)),
    "multiples": Grid((23, 14, 9), ORIGIN, (0.25, 0.5, 1.0)),
    "none": Grid((13, 9, 5), ORIGIN, (0.1, 0.13, 0.37)),
    "plane": Grid((20, 1, 11), ORIGIN, (0.1, 7.0, 0.1)),
}


def image_of(grid: Grid, noise: float) -> np.ndarray:
    """Return distances to a sphere at the centres of the voxels, and noise."""
    centers = grid.to_world(np.indices(grid.shape).reshape(3, -1).T + 0.5)
    middle = grid.to_world(np.array([grid.shape]) / 2)
    values = np.sqrt(((centers - middle) ** 2).sum(axis=1)) - 0.3 * max(grid.pitch) * grid.dim / 2
    values += noise * np.random.default_rng(3).normal(size=len(values))
    return values.astype(np.float32).reshape(grid.shape)


def interpolation(values: np.ndarray, grid: Grid, points: np.ndarray) -> np.ndarray:
    """Return an image's interpolation at points; SciPy's algorithm is another one."""
    ndimage = pytest.importorskip("scipy.ndimage")
    at = (points - grid.origin) / grid.pitch - 0.5
    return ndimage.map_coordinates(values.astype(np.float64), at.T, order=1, mode="nearest")


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("name", GRIDS)
def test_bounds_hold(name: str, noise: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """No answer in the cube is further from the image than its bound, which is no looser than the
    tolerance; samples at corners of leaves come back."""
    monkeypatch.setattr(from_image, "AT_ONCE", 9000)  # parts of cells, too
    monkeypatch.setattr(from_image, "CELLS_AT_ONCE", 700)
    grid = GRIDS[name]
    values = image_of(grid, noise)
    level = 5 if name == "none" else None
    field = field_of_image(values, grid, tolerance=4e-3, max_level=level, units="mm")
    field.validate()
    assert (field.sign, field.units, field.continuous) == ("given", "mm", False)
    samples = grid.to_world(np.indices(grid.shape).reshape(3, -1).T + 0.5)
    unit = np.random.default_rng(1).random((9000, 3))
    points = np.concatenate([field.origin + field.side * unit, samples])
    found = voxtool.query_adf(field, points, bounds=True)
    assert not found.outside.any()
    errors = abs(found.distance - interpolation(values, grid, points))
    assert (errors <= found.bound).all()
    if name != "none":
        assert field.reached["missed"] == 0
        assert found.bound.max() <= 4.5e-3 * field.side  # a code rounds up by 9 %
    else:
        assert field.reached["missed"]
    if name in ("cube", "box"):
        lossless = field_of_image(values, grid, tolerance=0)
        back = voxtool.query_adf(lossless, samples).distance
        assert np.allclose(back, values.ravel(), rtol=2**-20, atol=2**-22 * field.side)


def test_cells_are_refined_where_the_image_bends() -> None:
    """A linear image needs no cells below the root's, and a bend between two planes of samples is
    found, however few samples a first look takes."""
    grid = Grid((65, 65, 65), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    x = np.arange(65.0)[:, None, None] + np.zeros((65, 65, 65))
    flat = field_of_image(x - 20, grid)
    middle = np.random.default_rng(4).uniform(1, 64, (99, 3))
    assert set(voxtool.query_adf(flat, middle, cell=True).level) == {2}  # cubes of 32 samples
    assert flat.sign == "given"
    assert field_of_image(x, grid).sign == "none"
    assert 1 - 1e-6 < flat.lipschitz < 1.01
    bent = x - 20
    bent[37, 41, 22] += 1
    field = field_of_image(bent, grid, tolerance=1e-3)
    assert field.depth == 7
    assert abs(voxtool.query_adf(field, [37.5, 41.5, 22.5]).distance - 18) < 1e-5


@pytest.mark.parametrize("name", IMAGES)
def test_export_and_import(name: str, tmp_path: Path) -> None:
    """A field goes out and comes back, at its place."""
    field = plain_field(origin=(-3.7, 0.1, 12.0), side=2.3, units="mm")
    path = tmp_path / f"a{ending(name)}"
    voxtool.export(field, path, shape=17)
    pitch = 2.3 / 17
    place = {"origin": field.origin, "pitch": pitch} if name == "npy" else {}
    back = voxtool.read_field(path, tolerance=0, **place)
    points = np.array(field.origin) + pitch * (
        np.random.default_rng(2).integers(0, 17, (99, 3)) + 0.5
    )
    expected = voxtool.query_adf(field, points).distance
    assert np.allclose(voxtool.query_adf(back, points).distance, expected, rtol=0, atol=1e-6)
    assert back.source_sha256
    assert back.units == ("mm" if name in ("nii", "nii.gz", "nrrd", "tif", "tiff") else "")


def test_axes_are_turned(tmp_path: Path) -> None:
    """An image whose axes are permuted and mirrored becomes the same field."""
    nibabel = pytest.importorskip("nibabel")
    grid = GRIDS["box"]
    values = image_of(grid, 0.05)
    expected = field_of_image(values, grid, tolerance=1e-3)
    turned = values.transpose(2, 0, 1)[:, ::-1]
    affine = np.zeros((4, 4))
    affine[2, 0] = affine[1, 2] = 0.1
    affine[0, 1] = -0.1
    first = grid.to_world(np.array([[22.5, 0.5, 0.5]]))[0]
    affine[:, 3] = *first, 1
    nibabel.save(nibabel.Nifti1Image(turned, affine), tmp_path / "a.nii")
    exact = {"origin": grid.origin, "pitch": grid.pitch}  # the affine is float32
    assert voxtool.read_field(tmp_path / "a.nii", **exact).digest() == expected.digest()
    affine[0, 0] = 0.05
    nibabel.save(nibabel.Nifti1Image(turned, affine), tmp_path / "b.nii")
    with pytest.raises(FileError, match="axes are oblique"):
        voxtool.read_field(tmp_path / "b.nii")


def test_commands_take_the_field(tmp_path: Path) -> None:
    """import, its plan, and the commands that read fields."""
    grid = Grid((16, 16, 16), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    np.save(tmp_path / "a.npy", image_of(grid, 0.0))

    def called(*words: Any) -> str:
        result = CliRunner().invoke(cli, list(map(str, words)))
        assert result.exit_code == 0, result.output
        return result.output

    image, field = tmp_path / "a.npy", tmp_path / "a.adf.h5"
    plan = called("import", image, "--as-field", "--plan", "-o", field)
    assert "samples at level 4; tolerance 0.001 sides, levels to 4" in plan
    assert not field.exists()
    assert "sign given" in called("import", image, "--as-field", "-o", field)
    assert re.search("sign +given", called("adf-info", field, "--check"))
    called("render", field, "-o", tmp_path / "a.png", "--size", "32x32")
    called("view", field, "-o", tmp_path / "a.html")
    called("export", field, "-o", tmp_path / "a.vdb")
    called("export", field, "-o", tmp_path / "b.npy", "--shape", "16")
    called("import", image, "--threshold", "1", "--plan", "-o", tmp_path / "a.svo.h5")
    assert CliRunner().invoke(cli, ["import", str(image), "--tolerance", "1"]).exit_code == 2
    wrong = CliRunner().invoke(cli, ["import", str(image), "--as-field", "--label", "1"])
    assert wrong.exit_code == 2
    hint = CliRunner().invoke(cli, ["adf-info", str(image)])
    assert f"voxtool import --as-field {image}" in hint.output


@pytest.mark.parametrize(
    ("change", "options", "error", "message"),
    [
        (np.nan, {}, VoxtoolError, r"a\.npy: values from nan to nan: distances are finite"),
        (1e9, {}, VoxtoolError, "values from .* to 1e"),
        (0, {"tolerance": -1}, VoxtoolError, "tolerance -1"),
        (0, {"max_level": 22}, VoxtoolError, "max level 22"),
        (0, {"max_memory": 10_000}, MemoryLimitError, "import a part of the image"),
    ],
)
def test_refusals(
    change: float, options: dict[str, Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    values = np.ones((9, 8, 8), np.float32)
    values[3, 4, 5] += change
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(error, match=message):
        voxtool.read_field(tmp_path / "a.npy", **options)


def test_what_is_no_image_of_distances_is_refused(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(ball((9, 8, 8)))
    voxtool.export(octree, tmp_path / "a.npz")
    with pytest.raises(FileError, match="does not hold a value for each voxel"):
        voxtool.read_field(tmp_path / "a.npz")
    voxtool.export(octree, tmp_path / "a.vdb")
    with pytest.raises(FileError, match=r"\.vdb does not become a field: choose one of \.npy"):
        voxtool.read_field(tmp_path / "a.vdb")
    with pytest.raises(VoxtoolError, match="are of octrees"):
        voxtool.plan_import(tmp_path / "a.npz", as_field=True, threshold=1)
    with pytest.raises(VoxtoolError, match="are of fields"):
        voxtool.plan_import(tmp_path / "a.npz", tolerance=1)


def test_blocks_beyond_the_memory_are_refused() -> None:
    grid = GRIDS["cube"]
    values = image_of(grid, 0.05)
    with pytest.raises(MemoryLimitError, match=r"down to level 3 .*--max-level 3 fits, or choose"):
        field_of_image(values, grid, tolerance=0, max_memory=from_image.WORK_BYTES + 100_000)
