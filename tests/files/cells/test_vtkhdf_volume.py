"""Volumes as UnstructuredGrids: VTK reads the points, cells and scalars that are exported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import vtk as helpers_vtk
from helpers.cli import fail, run, told
from helpers.tets import assembly, boxes, built, grid_points, linear

import voxtool
from voxtool.errors import VoxtoolError

vtk: Any = helpers_vtk.vtk()
SHAPE = (3, 2, 4)
LAYOUTS = ("raycast", "projection", "hexahedra", "constant")


def volume_of(layout: str) -> voxtool.TetVolume:
    """A volume of 24 unit cubes."""
    if layout in ("hexahedra", "constant"):
        hexahedra, cut = boxes(grid_points(SHAPE), SHAPE, np.arange(24.0) - 7)
        return built(hexahedra, "hexahedra") if layout == "hexahedra" else built(cut)
    return built(assembly(SHAPE, 3), layout)


def grid_of(path: Path | str) -> Any:
    """The grid that VTK's reader finds."""
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutputDataObject(0)


def array(found: Any) -> np.ndarray:
    return vtk.vtk_to_numpy(found)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_vtk_reads_the_cells(layout: str, tmp_path: Path) -> None:
    volume = volume_of(layout)
    voxtool.export(volume, tmp_path / "a.vtkhdf")
    grid = grid_of(tmp_path / "a.vtkhdf")
    points = array(grid.GetPoints().GetData())
    assert points.dtype == np.float64
    assert np.array_equal(points, volume.points())
    assert np.array_equal(array(grid.GetCells().GetConnectivityArray()), volume.cells.ravel())
    kind = vtk.VTK_HEXAHEDRON if layout == "hexahedra" else vtk.VTK_TETRA
    assert {grid.GetCellType(cell) for cell in range(grid.GetNumberOfCells())} == {kind}
    data = grid.GetCellData() if volume.constant else grid.GetPointData()
    assert np.array_equal(array(data.GetArray("s")), volume.scalars())


@pytest.mark.parametrize("layout", LAYOUTS)
def test_they_are_the_cells_of_the_mesh(layout: str, tmp_path: Path) -> None:
    """The volumes by VTK's order of corners are positive and fill the box; the scalars are those
    of the mesh in single precision."""
    volume = volume_of(layout)
    voxtool.export(volume, tmp_path / "a.vtkhdf")
    sizes = vtk.vtkCellSizeFilter()
    sizes.SetInputData(grid_of(tmp_path / "a.vtkhdf"))
    sizes.Update()
    found = sizes.GetOutput()
    volumes = array(found.GetCellData().GetArray("Volume"))
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(24, rel=1e-6)
    if volume.constant:
        values = array(found.GetCellData().GetArray("s"))
        totals = np.bincount(np.rint(values + 7).astype(int), volumes)
        assert np.allclose(totals, np.ones(24), rtol=1e-6)
        assert np.abs(values - np.rint(values)).max() < 1e-5
    else:
        values = array(found.GetPointData().GetArray("s"))
        assert np.abs(values - linear(volume.points())).max() < 1e-5


def test_names_that_hdf5_has_no_place_for(tmp_path: Path) -> None:
    for name, stored in (("a/b", "a_b"), (".", "scalar"), ("Dichte °C", "Dichte °C")):
        voxtool.export(replace(volume_of("raycast"), scalar=name), tmp_path / "a.vtkhdf")
        assert grid_of(tmp_path / "a.vtkhdf").GetPointData().GetArrayName(0) == stored


def test_on_the_command_line(here: Path) -> None:
    plan = told("export volume.tet.h5 -o a.vtkhdf --plan --json")
    facts = told("export volume.tet.h5 -o a.vtkhdf --json")
    volume = voxtool.read_tet("volume.tet.h5")
    assert facts["tetrahedra"] == plan["tetrahedra"] == len(volume.cells)
    assert facts["digest"] == volume.digest()
    assert facts["bytes"] == Path("a.vtkhdf").stat().st_size <= plan["bytes"]
    text = run("export volume.tet.h5 -o a.vtkhdf --plan").stdout
    assert f"image      {len(volume.cells):,} tetrahedra, {len(volume.vertices):,} points" in text
    assert fail("export volume.tet.h5 -o a.vdb").startswith(".vdb holds no tetrahedral volume: cho")
    assert "go with a distance field" in fail("export volume.tet.h5 -o a.vtkhdf --band 3")
    with pytest.raises(VoxtoolError, match="take no level"):
        voxtool.export(volume, "a.vtkhdf", level=1)
