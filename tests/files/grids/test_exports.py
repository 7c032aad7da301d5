"""Exports of octrees: other programs read the same voxels."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.octree import ball, octree_from_dense

from voxtool import files, memory
from voxtool.errors import FileError, MemoryLimitError
from voxtool.files.grids import npy
from voxtool.files.pictures import slice_png
from voxtool.grid import Grid
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.octree import Octree


@pytest.fixture
def dense() -> np.ndarray:
    return ball((40, 33, 21))


def exported(dense: np.ndarray, path: Path) -> Path:
    """The path of an export, whose bytes depend on the content alone."""
    files.export(octree_from_dense(dense), path)
    first = path.read_bytes()
    files.export(octree_from_dense(dense), path)
    assert path.read_bytes() == first
    return path


def test_npy(dense: np.ndarray, tmp_path: Path) -> None:
    found = np.load(exported(dense, tmp_path / "a.npy"))
    assert found.dtype == bool
    assert found.flags.c_contiguous
    assert np.array_equal(found, dense)


def test_npz(dense: np.ndarray, tmp_path: Path) -> None:
    path = exported(dense, tmp_path / "a.npz")
    with np.load(path) as found:
        assert found["voxels"].dtype == np.int32
        assert np.array_equal(found["voxels"], np.argwhere(dense))
        assert found["shape"].tolist() == [40, 33, 21]
        assert found["origin"].tolist() == [-1.5, 0.1, 1e-3]
        assert found["pitch"].tolist() == [0.1] * 3
    with zipfile.ZipFile(path) as packed:
        assert {i.date_time for i in packed.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_npz_of_nothing(tmp_path: Path) -> None:
    with np.load(exported(np.zeros((8, 8, 8), bool), tmp_path / "a.npz")) as found:
        assert found["voxels"].shape == (0, 3)


def test_vti(dense: np.ndarray, tmp_path: Path) -> None:
    """The header and the bytes are those that VTK's reader looks for."""
    head, _, body = exported(dense, tmp_path / "a.vti").read_bytes().partition(b"\n   _")
    grid = b'WholeExtent="0 40 0 33 0 21" Origin="-1.5 0.1 0.001" Spacing="0.1 0.1 0.1"'
    assert grid in head
    assert b'type="UInt8" Name="occupancy" format="appended" offset="0"' in head
    assert int.from_bytes(body[:8], "little") == dense.size
    found = np.frombuffer(body, np.uint8, dense.size, 8).reshape(21, 33, 40)
    assert np.array_equal(found, dense.transpose(2, 1, 0))


def test_vtk_reads_vti(dense: np.ndarray, tmp_path: Path) -> None:
    vtk = pytest.importorskip("vtkmodules.vtkIOXML")
    support = pytest.importorskip("vtkmodules.util.numpy_support")
    reader = vtk.vtkXMLImageDataReader()
    reader.SetFileName(str(exported(dense, tmp_path / "a.vti")))
    reader.Update()
    image = reader.GetOutput()
    assert image.GetDimensions() == (41, 34, 22)  # corners of voxels
    assert (image.GetOrigin(), image.GetSpacing()) == ((-1.5, 0.1, 1e-3), (0.1,) * 3)
    found = support.vtk_to_numpy(image.GetCellData().GetArray("occupancy"))
    assert np.array_equal(found.reshape(21, 33, 40), dense.transpose(2, 1, 0))


def huge_octree() -> Octree:
    """One inside leaf in a grid of 65,536**3: its dense array has 281 TB."""
    grid = Grid((65536,) * 3, (0, 0, 0), (1, 1, 1))  # pyright: ignore[reportArgumentType]
    full = octree_from_dense(np.ones((8, 8, 8), bool))
    return replace(full, grid=grid, offsets=np.array([0] + [1] * 15, np.uint32))


@pytest.mark.parametrize("extension", ["npy", "vti", "npz"])
def test_export_larger_than_the_disk_is_refused(tmp_path: Path, extension: str) -> None:
    with pytest.raises(FileError, match=r"would take .* TB .* free: choose"):
        files.export(huge_octree(), tmp_path / f"a.{extension}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("write", [npy.write, slice_png.write])
def test_export_larger_than_memory_is_refused(write: Callable, monkeypatch) -> None:
    monkeypatch.setattr(memory, "available_memory", lambda: 1 << 30)  # a smaller machine
    with pytest.raises(MemoryLimitError, match=r"1\.07 GB are free: choose a smaller dim"):
        write(VoxelImage.of(huge_octree()), io.BytesIO())


def test_export_by_an_unknown_name(dense: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"end it in one of \.npy, "):
        files.export(octree_from_dense(dense), tmp_path / "a.zzz")


def test_large_empty_space_costs_nothing(tmp_path: Path) -> None:
    for extension in ("svo.h5", "svo.xml"):
        files.write_svo(huge_octree(), tmp_path / f"a.{extension}")
        assert files.read_svo(tmp_path / f"a.{extension}").count == 65536**3
