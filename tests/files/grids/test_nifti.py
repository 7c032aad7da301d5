"""NIfTI: nibabel and SimpleITK read what is exported; what they write is imported."""

from __future__ import annotations

import gzip
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers.octree import ball

import voxtool
from voxtool.errors import FileError
from voxtool.files.lattices import read_lattice

nibabel = pytest.importorskip("nibabel")
DENSE = ball((21, 16, 9))
PLACE = {"origin": (-1.5, 0.1, 1e-3), "pitch": (0.1, 0.3, 0.7)}
CORNERS = ((0, 0, 0), (20, 15, 8), (3, 15, 1))


@pytest.mark.parametrize("name", ["nii", "nii.gz"])
@pytest.mark.parametrize(("level", "dtype"), [(0, "bool"), (1, "uint16"), (1, "float32")])
def test_nibabel_reads_exports(level: int, dtype: str, name: str, tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(DENSE, **PLACE)
    path = tmp_path / f"a.{name}"
    voxtool.export(octree, path, level=level, dtype=dtype)
    image = nibabel.load(path)
    cells = voxtool.read_voxels(path, threshold=1e-9)
    assert np.array_equal(cells.to_dense(), np.asarray(image.dataobj) > 0)
    if level == 0:
        assert np.array_equal(np.asarray(image.dataobj), DENSE)
    for cell in CORNERS if level == 0 else ():
        center = octree.grid.to_world(np.array([cell]) + 0.5)[0]
        found = image.affine @ (*cell, 1)
        assert np.allclose(found[:3], center, rtol=1e-6, atol=1e-6)  # float32


@pytest.mark.parametrize("name", ["nii", "nii.gz"])
def test_itk_reads_exports(name: str, tmp_path: Path) -> None:
    """ITK's world has x to the left and y to the back."""
    itk = pytest.importorskip("SimpleITK")
    octree = voxtool.Octree.from_dense(DENSE, **PLACE)
    voxtool.export(octree, tmp_path / f"a.{name}")
    image = itk.ReadImage(str(tmp_path / f"a.{name}"))
    assert np.array_equal(itk.GetArrayFromImage(image).transpose(2, 1, 0), DENSE)
    for cell in CORNERS:
        center = octree.grid.to_world(np.array([cell]) + 0.5)[0]
        found = np.array(image.TransformIndexToPhysicalPoint(cell)) * (-1, -1, 1)
        assert np.allclose(found, center, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("dtype", ["u1", "i2", "f4", "f8"])
@pytest.mark.parametrize("form", ["sform", "qform"])
def test_nibabel_files_are_imported(form: str, dtype: str, tmp_path: Path) -> None:
    """Permuted, mirrored axes come to their places."""
    affine = np.array([[0, 0, -2, 7], [0.5, 0, 0, 1], [0, 4, 0, 2], [0, 0, 0, 1.0]])
    image = nibabel.Nifti1Image(DENSE.astype(dtype), affine if form == "sform" else None)
    if form == "qform":
        image.set_qform(affine, 1)
    nibabel.save(image, tmp_path / "a.nii.gz")
    octree = voxtool.read_voxels(tmp_path / "a.nii.gz")
    assert np.array_equal(octree.to_dense(), DENSE.transpose(2, 0, 1)[::-1])
    assert octree.grid.shape == (9, 21, 16)
    assert np.allclose(octree.grid.pitch, (2, 0.5, 4), rtol=1e-6)
    for cell in CORNERS:
        i, j, k = cell
        center = octree.grid.to_world(np.array([[8 - k, i, j]]) + 0.5)[0]
        assert np.allclose(center, (affine @ (*cell, 1))[:3], rtol=1e-6, atol=1e-5)


def test_scaled_values(tmp_path: Path) -> None:
    """A slope and an intercept come before the threshold."""
    values = np.arange(512, dtype=np.int16).reshape(8, 8, 8)
    image = nibabel.Nifti1Image(values, np.eye(4))
    image.header.set_slope_inter(0.5, -10)
    nibabel.save(image, tmp_path / "a.nii")
    octree = voxtool.read_voxels(tmp_path / "a.nii", threshold=100)
    stored = np.asarray(nibabel.load(tmp_path / "a.nii").dataobj)
    assert np.array_equal(octree.to_dense(), stored >= 100)


def test_mask_lies_on_its_image(tmp_path: Path) -> None:
    """A mesh voxelized on the grid of an image gives a mask with the image's own affine."""
    itk = pytest.importorskip("SimpleITK")
    affine = np.diag([0.7, 0.8, 1.3, 1])
    affine[:3, 3] = (-7.1, 3.3, 0.2)
    nibabel.save(nibabel.Nifti1Image(np.zeros((20, 30, 10), "i2"), affine), tmp_path / "scan.nii")
    grid = read_lattice(tmp_path / "scan.nii").grid
    assert grid.shape == (20, 30, 10)
    mask = voxtool.Octree.from_voxels([[3, 4, 5]], grid)
    voxtool.export(mask, tmp_path / "mask.nii")
    scan, found = (itk.ReadImage(str(tmp_path / f"{n}.nii")) for n in ("scan", "mask"))
    assert scan.GetSize() == found.GetSize()
    for name in ("GetOrigin", "GetSpacing", "GetDirection"):
        assert getattr(scan, name)() == getattr(found, name)()


def test_changed_affine_counts(tmp_path: Path) -> None:
    """A program that moves the image and keeps its comments is believed."""
    voxtool.export(voxtool.Octree.from_dense(DENSE, **PLACE), tmp_path / "a.nii")
    image = nibabel.load(tmp_path / "a.nii")
    affine = image.affine.copy()
    affine[0, 3] += 5
    image.set_sform(affine)
    nibabel.save(image, tmp_path / "b.nii")
    assert read_lattice(tmp_path / "a.nii").grid.origin == PLACE["origin"]
    assert abs(read_lattice(tmp_path / "b.nii").grid.origin[0] - 3.5) < 1e-5


def damaged(head: bytes) -> dict[str, tuple[bytes, str]]:
    return {
        "size": (b"\x00" * 4 + head[4:], "is no NIfTI image"),
        "offset": (head[:108] + np.float32(1e9).tobytes() + head[112:], "begins at byte 1e"),
        "nan": (head[:108] + np.float32("nan").tobytes() + head[112:], "begins at byte nan"),
        "shape": (head[:42] + np.int16([30000] * 3).tobytes() + head[48:], "its array needs 27 TB"),
        "negative": (head[:42] + np.int16([-5] * 3).tobytes() + head[48:], "an array of -5"),
        "dtype": (head[:70] + np.int16([32, 64]).tobytes() + head[74:], "values of type <c8"),
        "affine": (head[:280] + np.float32([1.0, 0.5]).tobytes() + head[288:], "oblique"),
    }


@pytest.mark.parametrize("name", damaged(bytes(400)))
@pytest.mark.parametrize("packed", [False, True])
def test_damaged_files(name: str, packed: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.nii"
    voxtool.export(voxtool.Octree.from_dense(DENSE), path)
    content, message = damaged(path.read_bytes())[name]
    path = tmp_path / ("a.nii.gz" if packed else "a.nii")
    path.write_bytes(gzip.compress(content) if packed else content)
    with pytest.raises(FileError, match=message):
        voxtool.read_voxels(path)


def test_an_extension_of_an_odd_size(tmp_path: Path) -> None:
    path = tmp_path / "a.nii"
    octree = voxtool.Octree.from_dense(DENSE)
    voxtool.export(octree, path)
    content = bytearray(path.read_bytes())
    (size,) = struct.unpack_from("<i", content, 352)
    struct.pack_into("<i", content, 352, size - 1)
    path.write_bytes(content)
    with warnings.catch_warnings(action="error"):
        assert voxtool.read_voxels(path) == octree


def test_long_sides_are_refused(tmp_path: Path) -> None:
    grid = voxtool.Grid((40000, 8, 8), (0, 0, 0), (1, 1, 1))
    with pytest.raises(FileError, match="a side of 40000 cells is more than"):
        voxtool.export(voxtool.Octree.from_voxels([[1, 2, 3]], grid), tmp_path / "a.nii.gz")
