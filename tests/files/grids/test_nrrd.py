"""NRRD: pynrrd and SimpleITK read what is exported; what they write is imported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.octree import ball

import voxtool
from voxtool.errors import FileError

nrrd = pytest.importorskip("nrrd")
DENSE = ball((21, 16, 9))
PLACE = {"origin": (-1.5, 0.1, 1e-3), "pitch": (0.1, 0.3, 0.7)}
CORNERS = ((0, 0, 0), (20, 15, 8), (3, 15, 1))


@pytest.mark.parametrize(("level", "dtype"), [(0, "bool"), (1, "uint16"), (1, "float32")])
def test_pynrrd_reads_exports(level: int, dtype: str, tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(DENSE, **PLACE, units="mm")
    voxtool.export(octree, tmp_path / "a.nrrd", level=level, dtype=dtype)
    values, header = nrrd.read(str(tmp_path / "a.nrrd"))
    assert np.array_equal(header["space directions"], np.diag(PLACE["pitch"]) * 2**level)
    assert header["space units"] == ["mm"] * 3
    if level == 0:
        assert np.array_equal(values, DENSE)
    assert np.array_equal(voxtool.read_voxels(tmp_path / "a.nrrd").to_dense(), values > 0)
    assert voxtool.read_voxels(tmp_path / "a.nrrd").units == "mm"


def test_itk_reads_exports(tmp_path: Path) -> None:
    """ITK's world has x to the left and y to the back."""
    itk = pytest.importorskip("SimpleITK")
    octree = voxtool.Octree.from_dense(DENSE, **PLACE)
    voxtool.export(octree, tmp_path / "a.nrrd")
    image = itk.ReadImage(str(tmp_path / "a.nrrd"))
    assert np.array_equal(itk.GetArrayFromImage(image).transpose(2, 1, 0), DENSE)
    for cell in CORNERS:
        center = octree.grid.to_world(np.array([cell]) + 0.5)[0]
        found = np.array(image.TransformIndexToPhysicalPoint(cell)) * (-1, -1, 1)
        assert np.allclose(found, center, rtol=0, atol=1e-12)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("dtype", ["u1", "i2", "f8"])
def test_itk_files_are_imported(dtype: str, packed: bool, tmp_path: Path) -> None:
    """The direction is kept, and the world turned from ITK's."""
    itk = pytest.importorskip("SimpleITK")
    image = itk.GetImageFromArray(DENSE.astype(dtype).transpose(2, 1, 0))
    image.SetSpacing((0.5, 4.0, 2.0))
    image.SetOrigin((7.0, 1.0, 2.0))
    image.SetDirection((0, 0, -1, 1, 0, 0, 0, 1, 0))
    itk.WriteImage(image, str(tmp_path / "a.nrrd"), useCompression=packed)
    octree = voxtool.read_voxels(tmp_path / "a.nrrd")
    assert octree.grid.shape == (9, 21, 16)
    assert octree.grid.pitch == (2.0, 0.5, 4.0)
    assert octree.count == np.count_nonzero(DENSE)
    for cell in np.argwhere(DENSE)[::97]:
        point = np.array(image.TransformIndexToPhysicalPoint(cell.tolist())) * (-1, -1, 1)
        index = (point - octree.grid.origin) / octree.grid.pitch - 0.5
        assert np.array_equal(index, np.rint(index))
        assert octree.to_dense()[tuple(index.astype(int))]


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2", "ascii"])
@pytest.mark.parametrize("endian", ["little", "big"])
def test_pynrrd_files_are_imported(encoding: str, endian: str, tmp_path: Path) -> None:
    header = {"encoding": encoding, "endian": endian, "spacings": [1, 2, 3]}
    values = DENSE.astype(">i2" if endian == "big" else "<i2")
    nrrd.write(str(tmp_path / "a.nrrd"), values, header)
    octree = voxtool.read_voxels(tmp_path / "a.nrrd")
    assert np.array_equal(octree.to_dense(), DENSE)
    assert octree.grid.pitch == (1, 2, 3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"NRRD0005", b"NRRX0005", "is no NRRD image"),
        (b"sizes: 21 16 9", b"sizes: 21 16", "an array of 21 x 16"),
        (b"sizes: 21 16 9", b"sizes: 60000 60000 9", "its array needs 32.4 GB"),
        (b"type: uint8", b"type: block", "values of type 'block'"),
        (b"encoding: gzip", b"encoding: hex", "encoding 'hex' is not read"),
        (b"encoding: gzip", b"encoding: gzip\ndata file: b.raw", "lies in another file"),
        (b"encoding: gzip", b"encoding: gzip\nline skip: 2", "save it without"),
        (b"encoding: gzip", b"encoding", "a header line that is no field"),
        (b"(1.0,0.0,0.0)", b"(1.0,0.5,0.0)", "oblique"),
        (b"(1.0,0.0,0.0)", b"(1.0,0.5", "is no number"),
    ],
)
def test_damaged_files(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.nrrd"
    voxtool.export(voxtool.Octree.from_dense(DENSE), path)
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(FileError, match=message):
        voxtool.read_voxels(path)
