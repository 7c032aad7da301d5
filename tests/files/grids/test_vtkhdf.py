"""HyperTreeGrids of VTKHDF against VTK's own reader and writer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers import vtk as helpers_vtk
from helpers.octree import WORLD, ball

import voxtool
from voxtool.errors import FileError, VoxtoolError
from voxtool.svo.images.image import VoxelImage

vtk: Any = helpers_vtk.vtk()
RANDOM = np.random.default_rng(0)
SHAPES = {
    "ball": ball((40, 33, 21)),
    "noise": RANDOM.random((17, 30, 9)) < 0.3,
    "one voxel": np.arange(8 * 9 * 10).reshape(8, 9, 10) == 123,
    "all": np.ones((8, 16, 9), bool),
    "full": np.ones((8, 8, 8), bool),
    "nothing": np.zeros((8, 9, 10), bool),
}
OPTIONS: list[dict[str, Any]] = [
    {},
    {"level": 1},
    {"level": 2},
    {"level": 3},
    {"invert": True},
]
PART = {"bbox": (-1.2, 0.6, 0.2, 1.2, 2.1, 1.7)}


def leaves(path: Path) -> list[tuple[np.ndarray, float, int, int]]:
    """The boxes of leaves that VTK's reader finds, their coverage, inside and depth."""
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.Update()
    grid = reader.GetOutputDataObject(0)
    arrays = [grid.GetCellData().GetArray(name) for name in ("coverage", "inside")]
    cursor = vtk.vtkHyperTreeGridNonOrientedGeometryCursor()
    found: list[Any] = []

    def walk() -> None:
        if cursor.IsLeaf() or cursor.IsMasked():
            box, cell = [0.0] * 6, cursor.GetGlobalNodeIndex()
            cursor.GetBounds(box)
            values = [array.GetTuple1(cell) for array in arrays]
            if not cursor.IsMasked():
                found.append((np.array(box), *values, cursor.GetLevel()))
            return
        for child in range(8):
            cursor.ToChild(child)
            walk()
            cursor.ToParent()

    grid.InitializeNonOrientedGeometryCursor(cursor, 0)
    walk()
    return found


def dense_of(path: Path, image: VoxelImage, full: float) -> np.ndarray:
    """The coverage of each cell of an image, by VTK."""
    found = np.zeros(image.shape)
    for box, coverage, inside, _ in leaves(path):
        ends = (box.reshape(3, 2).T - image.origin) / image.pitch
        assert np.abs(ends - np.rint(ends)).max() < 1e-9  # where it belongs
        low, high = np.rint(ends).astype(int)
        assert inside == (coverage == full)
        found[tuple(map(slice, low, high))] = coverage / full
    return found


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("shape", SHAPES)
def test_vtk_reads_the_same(shape: str, options: dict[str, Any], tmp_path: Path) -> None:
    world = {**WORLD, "pitch": (0.1, 0.25, 0.5)} if shape == "noise" else WORLD
    octree = voxtool.Octree.from_dense(SHAPES[shape], **world)  # pyright: ignore
    image = VoxelImage.of(octree, **options)
    job = voxtool.plan_export(octree, tmp_path / "a.vtkhdf", **options)
    assert job.run() <= job.plan.size
    wanted = np.concatenate(list(image.slabs()))
    full = 255 if image.dtype == bool else 1
    assert np.array_equal(dense_of(tmp_path / "a.vtkhdf", image, full), wanted)


def test_levels_are_kept(tmp_path: Path) -> None:
    """Uniform nodes of the octree are leaves of the tree, at the same level."""
    octree = voxtool.Octree.from_dense(ball((64, 64, 64)), **WORLD)
    voxtool.export(octree, tmp_path / "a.vtkhdf")
    sides = {64 >> depth: 0 for depth in range(7)}
    for _, coverage, _, depth in leaves(tmp_path / "a.vtkhdf"):
        assert coverage == 255
        sides[64 >> depth] += (64 >> depth) ** 3
    counts = octree.count_by_level()
    assert [sides[8], sides[16]] == [counts[1], counts[2]]
    assert sides[1] + sides[2] + sides[4] == counts[0]


def test_parts(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(SHAPES["ball"], **WORLD)
    image = VoxelImage.of(octree, **PART)
    voxtool.export(octree, tmp_path / "a.vtkhdf", **PART)
    wanted = np.concatenate(list(image.slabs()))
    assert np.array_equal(dense_of(tmp_path / "a.vtkhdf", image, 255), wanted)
    assert np.array_equal(voxtool.read_voxels(tmp_path / "a.vtkhdf").to_dense(), wanted)
    with pytest.raises(VoxtoolError, match="choose --dtype bool"):
        voxtool.export(octree, tmp_path / "a.vtkhdf", dtype="float32", **PART)


def test_equal_content_makes_equal_bytes(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(SHAPES["noise"])
    for name in ("a", "b"):
        voxtool.export(octree, tmp_path / f"{name}.vtkhdf")
    assert (tmp_path / "a.vtkhdf").read_bytes() == (tmp_path / "b.vtkhdf").read_bytes()


def test_several_trees_of_vtk(tmp_path: Path) -> None:
    """A grid of 3 x 2 x 1 trees of other depths, written by VTK, with a mask."""
    grid, cursor = vtk.vtkHyperTreeGrid(), vtk.vtkHyperTreeGridNonOrientedCursor()
    grid.SetDimensions([4, 3, 2])
    grid.SetBranchFactor(2)
    setters = (grid.SetXCoordinates, grid.SetYCoordinates, grid.SetZCoordinates)
    for n, start, put in zip((4, 3, 2), (5, 0, -1), setters, strict=True):
        line = vtk.vtkDoubleArray()
        for i in range(n):
            line.InsertNextValue(start + 2 * i)
        put(line)
    coverage, mask, first = vtk.vtkUnsignedCharArray(), vtk.vtkBitArray(), 0
    coverage.SetName("coverage")
    dense = np.zeros((12, 8, 4), bool)
    for tree in range(6):
        grid.InitializeNonOrientedCursor(cursor, tree, True)
        cursor.SetGlobalIndexStart(first)
        if tree != 2:
            cursor.SubdivideLeaf()
            cursor.ToChild(6)  # x low, y and z high
            if tree != 4:
                cursor.SubdivideLeaf()
        corner = np.array([tree % 3 * 4, tree // 3 * 4, 0])
        cells = 1 if tree == 2 else 9 if tree == 4 else 17
        for cell in range(cells):
            covered, masked = cell in (2, 10, 11), cell == 11
            coverage.InsertNextValue(9 * covered)
            mask.InsertNextValue(masked)
            if cell == 2:  # child 1: x high
                dense[tuple(slice(n, n + 2) for n in corner + np.array([2, 0, 0]))] = True
            if cell == 10:  # child 1 of child 6
                dense[tuple(corner + np.array([1, 2, 2]))] = True
        first += cells
    grid.GetCellData().AddArray(coverage)
    grid.SetMask(mask)
    writer = vtk.vtkHDFWriter()
    writer.SetInputData(grid)
    writer.SetFileName(str(tmp_path / "a.vtkhdf"))
    assert writer.Write()
    octree = voxtool.read_voxels(tmp_path / "a.vtkhdf")
    assert octree.grid.origin == (5, 0, -1)
    assert octree.grid.pitch == (0.5, 0.5, 0.5)
    assert np.array_equal(octree.to_dense(), dense)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("TreeIds", [7], "its trees are not in its grid"),
        ("DepthPerTree", [60], "its trees and their depths"),
        ("NumberOfCellsPerTreeDepth", [1, 8, 8, 8, 1 << 60], "more cells than the file can hold"),
        ("NumberOfCellsPerTreeDepth", [1, 8, 8, 0, 16], "has 0 cells where 8 are expected"),
        ("Descriptors", [0, 0, 0, 0], "has 8 cells where 0 are expected"),
        ("XCoordinates", [0.0, np.nan], "not equal in size"),
        ("Mask", [0], "mask holds too few bits"),
    ],
)
def test_lies_are_refused(name: str, values: list, message: str, tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(SHAPES["one voxel"])
    voxtool.export(octree, tmp_path / "a.vtkhdf")
    with h5py.File(tmp_path / "a.vtkhdf", "r+") as file:
        group: Any = file["VTKHDF"]
        dtype = group[name].dtype
        del group[name]
        group[name] = np.array(values, dtype)
    with pytest.raises(FileError, match=message):
        voxtool.read_voxels(tmp_path / "a.vtkhdf")
