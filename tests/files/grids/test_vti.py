"""VTK images: VTK reads what is exported, and what VTK writes is imported."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.octree import ball

import voxtool
from voxtool.errors import FileError
from voxtool.files.imports import Source

DENSE = ball((21, 16, 9))
PLACE = {"origin": (-1.5, 0.1, 1e-3), "pitch": (0.1, 0.3, 0.7)}


def vtk_image(values: np.ndarray, at_points: bool = False) -> Any:
    """A VTK image of values [x, y, z], from point 3 on along x."""
    data = pytest.importorskip("vtkmodules.vtkCommonDataModel")
    support = pytest.importorskip("vtkmodules.util.numpy_support")
    image = data.vtkImageData()
    a, b, c = (n - at_points for n in values.shape)
    image.SetExtent(3, a + 3, 0, b, 0, c)
    image.SetOrigin(-1.0, 0.25, 2.0)
    image.SetSpacing(0.5, 0.25, 2.0)
    array = support.numpy_to_vtk(values.ravel(order="F"), deep=True)
    array.SetName("mask")
    (image.GetPointData() if at_points else image.GetCellData()).SetScalars(array)
    return image


def written(image: Any, path: Path, mode: str, packed: bool, header: int, raw: bool) -> Path:
    xml = pytest.importorskip("vtkmodules.vtkIOXML")
    writer = xml.vtkXMLImageDataWriter()
    writer.SetInputData(image)
    writer.SetFileName(str(path))
    {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary,
     "appended": writer.SetDataModeToAppended}[mode]()  # fmt: skip
    writer.SetEncodeAppendedData(not raw)
    if not packed:
        writer.SetCompressorTypeToNone()
    (writer.SetHeaderTypeToUInt32 if header == 32 else writer.SetHeaderTypeToUInt64)()
    writer.SetBlockSize(1 << 10)
    writer.Write()
    return path


@pytest.mark.parametrize("header", [32, 64])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("mode", "raw"), [("ascii", False), ("binary", False), ("appended", False), ("appended", True)]
)
@pytest.mark.parametrize("dtype", ["u1", "f4", "i8"])
def test_vtk_files_are_imported(
    dtype: str, mode: str, raw: bool, packed: bool, header: int, tmp_path: Path
) -> None:
    image = vtk_image(DENSE.astype(dtype))
    path = written(image, tmp_path / "a.vti", mode, packed, header, raw)
    octree = voxtool.read_voxels(path)
    assert np.array_equal(octree.to_dense(), DENSE)
    assert octree.grid == voxtool.Grid(DENSE.shape, (0.5, 0.25, 2), (0.5, 0.25, 2))


def stored_values(path: Path) -> np.ndarray:
    """Return the values of a row of voxels as they are stored."""
    with Source.of(path).stored() as stored:
        parts = [piece.values.ravel() for piece in stored.pieces]
        return np.concatenate(parts)


@pytest.mark.parametrize("compressor", ["None", "ZLib", "LZ4", "LZMA"])
@pytest.mark.parametrize(
    ("mode", "raw"), [("ascii", False), ("binary", False), ("appended", False), ("appended", True)]
)
@pytest.mark.parametrize("dtype", ["u1", "f8", "i8"])
def test_every_file_of_vtk_is_read_exactly(
    dtype: str, mode: str, raw: bool, compressor: str, tmp_path: Path
) -> None:
    """Sizes about one and two blocks, headers of both types, both orders of bytes; the default
    block of 32 kB is larger than these arrays."""
    xml, rng = pytest.importorskip("vtkmodules.vtkIOXML"), np.random.default_rng(3)
    block = 1024 // np.dtype(dtype).itemsize
    for count in (8, block - 1, block, block + 1, 2 * block, 2 * block + 1):
        values = rng.integers(0, 200, count).astype(dtype)
        if dtype == "i8":
            values = rng.integers(-(2**62), 2**62, count) | 1
        image = vtk_image(values.reshape(-1, 1, 1))
        for header, order, size in product((32, 64), (0, 1), (1024, 1 << 15)):
            writer = xml.vtkXMLImageDataWriter()
            writer.SetInputData(image)
            writer.SetFileName(str(tmp_path / "a.vti"))
            getattr(writer, f"SetDataModeTo{mode.capitalize()}")()
            getattr(writer, f"SetCompressorTypeTo{compressor}")()
            getattr(writer, f"SetHeaderTypeToUInt{header}")()
            writer.SetEncodeAppendedData(not raw)
            writer.SetByteOrder(order)
            writer.SetBlockSize(size)
            writer.Write()
            assert np.array_equal(stored_values(tmp_path / "a.vti"), values)


def test_points_are_centres_of_voxels(tmp_path: Path) -> None:
    image = vtk_image(DENSE.astype("u1"), at_points=True)
    octree = voxtool.read_voxels(written(image, tmp_path / "a.vti", "binary", True, 32, False))
    assert np.array_equal(octree.to_dense(), DENSE)
    assert octree.grid.origin == (0.25, 0.125, 1.0)


def test_directions_are_kept(tmp_path: Path) -> None:
    image = vtk_image(DENSE.astype("u1"))
    image.SetDirectionMatrix(0, -1, 0, 0, 0, 1, 1, 0, 0)  # x runs along z, y against x, z along y
    octree = voxtool.read_voxels(written(image, tmp_path / "a.vti", "appended", True, 64, True))
    assert np.array_equal(octree.to_dense(), DENSE[:, ::-1].transpose(1, 2, 0))
    for cell in ((0, 0, 0), (20, 0, 8), (3, 15, 1)):
        point = np.zeros(3)
        index = [n + 0.5 + low for n, low in zip(cell, (3, 0, 0), strict=True)]
        image.TransformContinuousIndexToPhysicalPoint(*index, point)
        i, j, k = cell
        center = octree.grid.to_world(np.array([15 - j, k, i]) + 0.5)
        assert np.allclose(center, point, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("level", "dtype"), [(0, "bool"), (1, "uint16"), (2, "float32")])
def test_vtk_reads_exports(level: int, dtype: str, tmp_path: Path) -> None:
    xml = pytest.importorskip("vtkmodules.vtkIOXML")
    support = pytest.importorskip("vtkmodules.util.numpy_support")
    octree = voxtool.Octree.from_dense(DENSE, **PLACE)
    path = tmp_path / "a.vti"
    voxtool.export(octree, path, level=level, dtype=dtype)
    reader = xml.vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    image = reader.GetOutput()
    s = 1 << level
    padded = np.pad(DENSE, [(0, -n % s) for n in DENSE.shape])
    a, b, c = (n // s for n in padded.shape)
    wanted = padded.reshape(a, s, b, s, c, s).sum(axis=(1, 3, 5))
    wanted = wanted / s**3 if dtype == "float32" else wanted
    found = support.vtk_to_numpy(image.GetCellData().GetScalars())
    assert np.array_equal(found.reshape(c, b, a).transpose(2, 1, 0), wanted)
    assert image.GetOrigin() == octree.grid.origin
    assert image.GetSpacing() == tuple(p * s for p in octree.grid.pitch)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ImageData", b"ImageDate", "is no VTK image"),
        (b'type="UInt8"', b'type="String"', "values of type"),
        (b"</Piece>", b"</Piece><Piece/>", "expected 6 numbers"),
        (b'0 21 0 16 0 9" Or', b'0 60000 0 60000 0 9" Or', "not the whole image"),
        (b"0 21 0 16 0 9", b"0 60000 0 60000 0 9", "its array needs 32.4 GB"),
        (b"LittleEndian", b'LittleEndian" compressor="vtkLZ5', "is packed by vtkLZ5"),
        (b'offset="0"', b'offset="99"', "it ends before its array"),
        (b"<VTKFile", b"<<VTKFile", "is no XML"),
        (b"<CellData", b"<x>" * 99 + b"<CellData", "elements inside more than 64"),
        (b"<CellData", b'<x a="' + b"1" * 2_000_000 + b'"/><CellData', "a tag of more than 1 MiB"),
    ],
)
def test_damaged_files(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.vti"
    voxtool.export(voxtool.Octree.from_dense(DENSE), path)
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(FileError, match=message):
        voxtool.read_voxels(path)
