"""Fields sampled on grids: other projects' readers against the field at every sample."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import meshes
from helpers.field import plain_field
from helpers.octree import ball

import voxtool
from voxtool.adf.queries import samples
from voxtool.errors import FileError, GridError, VoxtoolError
from voxtool.files.formats import EXCHANGE, ending
from voxtool.files.lattices import read_lattice

SIDE = 2.3
FIELD = plain_field(origin=(-3.7, 0.1, 12.0), side=SIDE, units="mm")
GRID = voxtool.Grid((5, 17, 9), (-4.0, 0.5, 12.1), (0.3, 0.11, 0.2))  # partly beyond the cube
FORMATS = tuple(name for name, format in EXCHANGE.items() if format.dense)


def expected(grid: voxtool.Grid) -> np.ndarray:
    """Return the distances at the centres of the cells of a grid, as a query returns them."""
    steps = np.indices(grid.shape).reshape(3, -1).T
    points = np.array(grid.origin) + np.array(grid.pitch) * (steps + 0.5)
    return voxtool.query_adf(FIELD, points).distance.astype(np.float32).reshape(grid.shape)


def values_in(path: Path, name: str) -> np.ndarray:
    """Return the values of a file as another project reads them, indexed [x, y, z]."""
    if name == "npy":
        return np.load(path)
    if name == "npz":
        return np.load(path)["distance"]
    if name in ("tif", "tiff"):
        return pytest.importorskip("tifffile").imread(path).transpose(2, 1, 0)
    if name == "vti":
        reader = pytest.importorskip("vtkmodules.vtkIOXML").vtkXMLImageDataReader()
        reader.SetFileName(str(path))
        reader.Update()
        cells = reader.GetOutput().GetCellData().GetArray("distance")
        shape = np.subtract(reader.GetOutput().GetDimensions(), 1)
        to_numpy = pytest.importorskip("vtkmodules.util.numpy_support").vtk_to_numpy
        return to_numpy(cells).reshape(shape[::-1]).transpose(2, 1, 0)
    itk = pytest.importorskip("SimpleITK")
    return itk.GetArrayFromImage(itk.ReadImage(str(path))).transpose(2, 1, 0)


@pytest.mark.parametrize("name", FORMATS)
def test_every_sample(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples are those of a query, bit for bit, also where slabs are parts of a layer."""
    monkeypatch.setattr(samples, "AT_ONCE", 40)
    path = tmp_path / f"a{ending(name)}"
    job = voxtool.plan_export(FIELD, path, grid=GRID)
    assert job.run() <= job.plan.size
    values = values_in(path, name)
    assert values.dtype == np.float32
    assert np.array_equal(values, expected(GRID))
    if name != "npy":
        assert read_lattice(path).grid == GRID


@pytest.mark.parametrize("name", ["nii", "nii.gz", "nrrd"])
def test_itk_places_the_samples(name: str, tmp_path: Path) -> None:
    """ITK's world has x to the left and y to the back."""
    itk = pytest.importorskip("SimpleITK")
    voxtool.export(FIELD, tmp_path / f"a.{name}", grid=GRID)
    image = itk.ReadImage(str(tmp_path / f"a.{name}"))
    for cell in ((0, 0, 0), (4, 16, 8), (3, 5, 1)):
        center = GRID.to_world(np.array([cell]) + 0.5)[0]
        found = np.array(image.TransformIndexToPhysicalPoint(cell)) * (-1, -1, 1)
        assert np.allclose(found, center, rtol=1e-6, atol=1e-6)


def test_grids(tmp_path: Path) -> None:
    """The grids that a shape, a spacing, a file and nothing give."""
    octree = voxtool.Octree.from_dense(ball((9, 8, 7)), origin=GRID.origin, pitch=GRID.pitch)
    voxtool.write_svo(octree, tmp_path / "a.svo.h5")
    cases: list[tuple[dict[str, Any], tuple[int, ...], tuple[float, ...]]] = [
        ({}, (32, 32, 32), (SIDE / 32,) * 3),  # leaves of level 5
        ({"shape": 12}, (12, 12, 12), (SIDE / 12,) * 3),
        ({"shape": (12, 3, 9)}, (12, 3, 9), (SIDE / 12, SIDE / 3, SIDE / 9)),
        ({"spacing": 0.19}, (12, 12, 12), (0.19, 0.19, 0.19)),
        ({"spacing": (0.1, 0.19, 9.0)}, (23, 12, 1), (0.1, 0.19, 9.0)),
        ({"grid": tmp_path / "a.svo.h5"}, octree.grid.shape, octree.grid.pitch),
    ]
    for options, shape, pitch in cases:
        plan = voxtool.plan_export(FIELD, tmp_path / "a.npy", **options).plan
        assert (plan.image.shape, plan.image.pitch) == (shape, pitch), options
        assert plan.image.origin == (GRID.origin if "grid" in options else FIELD.origin)
        assert plan.as_dict()["bytes"] == 128 + 4 * np.prod(shape)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"band": 3}, VoxtoolError, "a band goes with level sets"),
        ({"shape": 8, "spacing": 0.1}, VoxtoolError, "give one of them"),
        ({"grid": GRID, "shape": 8}, VoxtoolError, "has its own shape and spacing"),
        ({"level": 1}, VoxtoolError, "take no level"),
        ({"shape": (8, 0, 8)}, GridError, "at least 1 cell"),
        ({"spacing": -1.0}, GridError, "a spacing of -1.0"),
        ({"spacing": 1e-9}, GridError, "for this field choose one from"),
        ({"max_bytes": 1000}, FileError, "choose a larger --spacing, or a smaller --shape"),
        ({"format": "vdb", "shape": 8}, VoxtoolError, "a level set: choose it by a band"),
        ({"format": "vox"}, VoxtoolError, r"\.vox holds no distance field: choose \.npy, \.npz"),
    ],
)
def test_refusals(
    options: dict[str, Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        voxtool.export(FIELD, tmp_path / "a.npy", **options)
    assert not any(tmp_path.iterdir())
    if "shape" in options:
        octree = voxtool.Octree.from_dense(ball((9, 8, 7)))
        with pytest.raises(VoxtoolError, match="go with a distance field"):
            voxtool.export(octree, tmp_path / "a.npy", shape=8)


def test_command(tmp_path: Path) -> None:
    """The options of the command line that place the grid, and its plan."""
    from click.testing import CliRunner

    from voxtool.cli.main import cli

    voxtool.write_adf(FIELD, tmp_path / "a.adf.h5")
    np.save(tmp_path / "like.npy", np.zeros((8, 9, 10)))

    def called(*words: str) -> Any:
        base = ["export", str(tmp_path / "a.adf.h5"), "-o", str(tmp_path / "a.npy")]
        return CliRunner().invoke(cli, [*base, *words])

    for words, shape in (
        (["--shape", "9"], (9, 9, 9)),
        (["--like", str(tmp_path / "like.npy")], (8, 9, 10)),
        (["--origin", "0,0,0", "--shape", "8,2,3", "--spacing", "1"], (8, 2, 3)),
    ):
        assert called(*words).exit_code == 0
        assert np.load(tmp_path / "a.npy").shape == shape
    plan = called("--plan")
    assert "32 x 32 x 32 samples, float32; a cell is 0.071875 x" in plan.output
    assert called("--origin", "0,0,0", "--shape", "8").exit_code == 2
    assert called("--like", "a", "--shape", "8").exit_code == 2


@pytest.mark.parametrize("scale", [1e60, 1e-60])
def test_lengths_that_float32_does_not_hold(scale: float, tmp_path: Path) -> None:
    """Are refused, where others of the kind are written."""
    vertices, faces = meshes.icosphere(1)
    for size, refused in ((1.0, False), (scale, True)):
        mesh = voxtool.mesh_from_arrays(size * vertices, faces)
        field = voxtool.build_adf(mesh, max_level=3)
        octree = voxtool.voxelize(mesh, dim=16)
        calls = [
            (voxtool.export, (field, tmp_path / "a.npy"), {"shape": 8}),
            (voxtool.export, (field, tmp_path / "a.vdb"), {}),
            (voxtool.export, (octree, tmp_path / "a.nii.gz"), {}),
            (voxtool.export, (octree, tmp_path / "a.nvdb"), {}),
            (voxtool.distance_grid, (mesh, octree.grid), {"dtype": "float32"}),
        ]
        for call, given, more in calls:
            with pytest.raises(voxtool.VoxtoolError, match="float32") if refused else nullcontext():
                call(*given, **more)
    voxtool.export(octree, tmp_path / "a.vdb")
    voxtool.distance_grid(mesh, octree.grid)
