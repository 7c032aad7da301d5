"""TIFF stacks and PNG layers: read by tifffile and Pillow, and stacks of other programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner
from helpers.octree import WORLD, ball, octree_from_dense
from PIL import Image

import voxtool
from voxtool.cli.main import cli
from voxtool.errors import FileError, GridError, MemoryLimitError, VoxtoolError
from voxtool.files.grids import tiff

BALL = ball((40, 33, 21))
BALL[:9, :4, :2] = True  # no symmetry
OCTREE = voxtool.Octree.from_dense(BALL, **WORLD, units="mm")
UNEVEN = {"origin": (1.0, -2.0, 3.0), "pitch": (0.5, 0.25, 2.0)}


@pytest.mark.parametrize("axis", "xyz")
def test_tifffile_reads_the_stack(axis: str, tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(BALL, **UNEVEN, units="mm")
    voxtool.export(octree, tmp_path / "a.tif", axis=axis, dpi=300)
    order = {"x": (0, 2, 1), "y": (1, 2, 0), "z": (2, 1, 0)}[axis]
    with tifffile.TiffFile(tmp_path / "a.tif") as tif:
        assert np.array_equal(tif.asarray(), BALL.transpose(order))
        assert tif.pages[0].bitspersample == 1  # pyright: ignore[reportAttributeAccessIssue]
        assert not tif.is_bigtiff
        pixels = tifffile.xml2dict(tif.ome_metadata or "")["OME"]["Image"]["Pixels"]
        spacing = [pixels[f"PhysicalSize{name}"] for name in "ZYX"]
        assert spacing == [UNEVEN["pitch"][a] for a in order]
        assert pixels["PhysicalSizeXUnit"] == "mm"
    with Image.open(tmp_path / "a.tif") as picture:
        assert picture.info["dpi"] == (300, 300)
        picture.seek(3)
        assert np.array_equal(picture, BALL.transpose(order)[3])
    again = voxtool.read_voxels(tmp_path / "a.tif")
    assert (again, again.units) == (octree, "mm")


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_stacks_of_coverages(dtype: str, tmp_path: Path) -> None:
    voxtool.export(OCTREE, tmp_path / "a.tif", level=1, dtype=dtype)
    cells = np.pad(BALL, [(0, n % 2) for n in BALL.shape]).reshape(20, 2, 17, 2, 11, 2)
    counts = cells.sum(axis=(1, 3, 5)).T
    found = tifffile.imread(tmp_path / "a.tif")
    assert found.dtype == dtype
    assert np.array_equal(found, counts / 8 if dtype == "float32" else counts)


def test_large_stacks_are_bigtiff(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiff, "CLASSIC_BYTES", 1000)
    voxtool.export(OCTREE, tmp_path / "a.tif")
    with tifffile.TiffFile(tmp_path / "a.tif") as tif:
        assert tif.is_bigtiff
    assert voxtool.read_voxels(tmp_path / "a.tif") == OCTREE


def write_imagej(path: Path, values: np.ndarray) -> None:
    about = {"axes": "ZYX", "spacing": 3.0, "unit": "mm"}
    tifffile.imwrite(path, values, imagej=True, resolution=(2, 4), metadata=about)


def write_ome(path: Path, values: np.ndarray) -> None:
    sizes = {"PhysicalSizeX": 0.5, "PhysicalSizeY": 0.25, "PhysicalSizeZ": 3.0}
    about = {"axes": "ZYX", "PhysicalSizeXUnit": "mm", **sizes}
    tifffile.imwrite(path, values, ome=True, metadata=about, compression="zlib")


def write_pages(path: Path, values: np.ndarray) -> None:
    with tifffile.TiffWriter(path, byteorder=">") as tif:
        for page in values:
            tif.write(page, photometric="minisblack", contiguous=False, metadata=None)


@pytest.mark.parametrize("write", [write_imagej, write_ome, write_pages])
def test_stacks_of_other_programs(write: Any, tmp_path: Path) -> None:
    values = np.random.default_rng(1).integers(0, 3, (9, 10, 11)).astype(np.uint16)
    write(tmp_path / "a.tif", values)
    octree = voxtool.read_voxels(tmp_path / "a.tif", label=2)
    assert np.array_equal(octree.to_dense(), (values == 2).T)
    known = write is not write_pages
    assert octree.grid.pitch == ((0.5, 0.25, 3.0) if known else (1, 1, 1))
    assert octree.units == ("mm" if known else "")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((9, 10, 11, 3), np.uint8), "three axes|one channel"),
        (np.zeros((9, 10, 11), np.complex64), "values of type"),
        (np.zeros((4, 5), np.uint8), "8 to 65536"),
    ],
)
def test_stacks_that_are_no_voxels(values: np.ndarray, message: str, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb" if values.ndim == 4 else None)
    with pytest.raises(VoxtoolError, match=message):
        voxtool.read_voxels(tmp_path / "a.tif")


def test_damaged_stacks_are_refused(tmp_path: Path) -> None:
    voxtool.export(OCTREE, tmp_path / "a.tif")
    data = (tmp_path / "a.tif").read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(60):
        changed = np.frombuffer(data, np.uint8).copy()
        changed[rng.integers(0, len(data), 9)] = rng.integers(0, 256, 9)
        (tmp_path / "b.tif").write_bytes(changed.tobytes())
        message = ""
        try:
            voxtool.read_voxels(tmp_path / "b.tif").validate()
        except (FileError, GridError, MemoryLimitError) as error:
            message = str(error)
        assert message.isprintable()
        assert len(message) < 400


def test_pages_that_lie_about_their_size_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((1, 8, 8), np.uint8), compression="zlib")
    data = bytearray((tmp_path / "a.tif").read_bytes())
    with tifffile.TiffFile(tmp_path / "a.tif") as tif:
        for name in ("ImageWidth", "ImageLength"):
            tag = tif.pages[0].tags[name]  # pyright: ignore[reportAttributeAccessIssue]
            size = 2 if tag.dtype == 3 else 4
            data[tag.valueoffset : tag.valueoffset + size] = (60000).to_bytes(size, "little")
    (tmp_path / "a.tif").write_bytes(data)
    with pytest.raises(FileError, match="its array needs"):
        voxtool.read_voxels(tmp_path / "a.tif")


@pytest.mark.parametrize("axis", "xyz")
def test_layers_are_pictures_of_one_bit(axis: str, tmp_path: Path) -> None:
    voxtool.export(OCTREE, tmp_path / "layers" / "l%03d.png", axis=axis, dpi=600)
    order = {"x": (0, 2, 1), "y": (1, 2, 0), "z": (2, 1, 0)}[axis]
    expected = BALL.transpose(order)[:, ::-1]  # top row first
    names = sorted(path.name for path in (tmp_path / "layers").glob("*.png"))
    assert names == [f"l{n:03}.png" for n in range(len(expected))]
    for name, layer in zip(names, expected, strict=True):
        with Image.open(tmp_path / "layers" / name) as picture:
            assert picture.mode == "1"
            assert np.array_equal(picture, layer)
            assert np.allclose(picture.info["dpi"], 600, atol=0.01)  # of whole pixels a metre


def test_layers_by_commands(tmp_path: Path) -> None:
    voxtool.write_svo(octree_from_dense(BALL), tmp_path / "a.svo.h5")

    def export(words: str) -> Any:
        return CliRunner().invoke(cli, f"export {tmp_path}/a.svo.h5 {words}".split())

    found = export(f"-o {tmp_path}/layers/%04d.png --slice x=all --dpi 100 --level 1 --json")
    assert found.exit_code == 0, found.output
    assert len(list((tmp_path / "layers").glob("*.png"))) == 20
    assert export(f"-o {tmp_path}/a.tif --axis y").exit_code == 0
    assert tifffile.imread(tmp_path / "a.tif").shape == (33, 21, 40)
    assert export(f"-o {tmp_path}/a.png --slice z=3").exit_code == 0
    for words in (
        "a.png --slice z=all", "a.npy --axis y", "a.npy --dpi 3", "a.tif --slice z=3",
        "a.npy --slice z=all", "a.tif --axis y --slice z=all", "a.tif --dpi 0",
    ):  # fmt: skip
        assert export(f"-o {tmp_path}/{words}").exit_code == 2, words


def test_an_unknown_axis_is_refused(tmp_path: Path) -> None:
    for name in ("a.tif", "layers/%d.png"):
        with pytest.raises(GridError, match="axis 'w' is unknown: choose x, y or z"):
            voxtool.export(voxtool.Octree.from_dense(BALL, **WORLD), tmp_path / name, axis="w")


def test_directories_that_repeat_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(b"II*\0" + bytes([8, 0, 0, 0, 0, 0, 8, 0, 0, 0]))
    with pytest.raises(FileError, match="the directories of its pages overlap"):
        voxtool.read_voxels(tmp_path / "a.tif")
