"""OME-Zarr: ome-zarr reads the pyramid and its places, and what it writes is read."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from helpers.octree import WORLD, ball

import voxtool
from voxtool.errors import VoxtoolError

BALL = ball((150, 33, 21))
BALL[:9, :4, :2] = True  # no symmetry
UNEVEN = {"origin": (1.0, -2.0, 3.0), "pitch": (0.5, 0.25, 2.0)}


def coverage(dense: np.ndarray, side: int) -> np.ndarray:
    """The share of set voxels in cubes of a side."""
    padded = np.pad(dense, [(0, -n % side) for n in dense.shape])
    a, b, c = (n // side for n in padded.shape)
    return padded.reshape(a, side, b, side, c, side).mean(axis=(1, 3, 5))


def test_ome_zarr_reads_the_pyramid(tmp_path: Path) -> None:
    from ome_zarr.io import parse_url
    from ome_zarr.reader import Reader

    octree = voxtool.Octree.from_dense(BALL, **UNEVEN, units="mm")
    voxtool.export(octree, tmp_path / "a.ome.zarr")
    location = parse_url(tmp_path / "a.ome.zarr")
    (node,) = list(Reader(location)())  # pyright: ignore[reportArgumentType]
    steps = node.metadata["coordinateTransformations"]
    assert [axis["name"] for axis in node.metadata["axes"]] == ["z", "y", "x"]
    assert {axis["unit"] for axis in node.metadata["axes"]} == {"millimeter"}
    for level, data in enumerate(node.data):
        expected = coverage(BALL, 1 << level)
        found = np.asarray(data).T
        assert np.array_equal(found, expected)
        scale, move = (np.array(step[step["type"]])[::-1] for step in steps[level])
        cells = np.argwhere(expected > 0)[[0, 7, -1]]  # world positions of three centres
        pitch = np.array(UNEVEN["pitch"]) * (1 << level)
        assert np.allclose(cells * scale + move, UNEVEN["origin"] + (cells + 0.5) * pitch, atol=0)
    assert len(node.data) == 3
    again = voxtool.read_voxels(tmp_path / "a.ome.zarr")
    assert (again, again.units) == (octree, "mm")


def test_full_and_empty_chunks(tmp_path: Path) -> None:
    dense = np.zeros((200, 70, 64), bool)
    dense[:128, :64] = True
    octree = voxtool.Octree.from_dense(dense, **WORLD)
    voxtool.export(octree, tmp_path / "a.ome.zarr")
    chunks = [path for path in (tmp_path / "a.ome.zarr" / "0").glob("*/*/*") if path.is_file()]
    assert len(chunks) == 2
    assert voxtool.read_voxels(tmp_path / "a.ome.zarr").digest() == octree.digest()


def test_parts_of_coarser_cells(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(BALL, (0, 0, 0), (1, 1, 1))
    box = (3, 5, 0, 141, 33, 21)
    voxtool.export(octree, tmp_path / "a.ome.zarr", level=1, bbox=box)
    expected = coverage(BALL, 2)[1:71, 2:17]
    group: Any = zarr.open_group(tmp_path / "a.ome.zarr", mode="r")
    assert np.array_equal(np.asarray(group["0"]).T, expected)
    grid = voxtool.read_voxels(tmp_path / "a.ome.zarr").grid
    assert grid == voxtool.Grid((70, 15, 11), (2, 4, 0), (2, 2, 2))


@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_what_ome_zarr_writes_is_read(version: str, tmp_path: Path) -> None:
    from ome_zarr.format import FormatV04, FormatV05
    from ome_zarr.writer import write_image

    values = np.random.default_rng(1).integers(0, 3, (1, 9, 10, 11)).astype(np.uint16)
    format = FormatV04() if version == "0.4" else FormatV05()
    kind = 2 if version == "0.4" else 3
    group = zarr.open_group(str(tmp_path / "a.ome.zarr"), mode="w", zarr_format=kind)
    axes = [{"name": "c", "type": "channel"},
            *({"name": n, "type": "space", "unit": "micrometer"} for n in "zyx")]  # fmt: skip
    scale = {"c": 1.0, "z": 2.0, "y": 0.5, "x": 0.25}
    write_image(
        values,
        group,
        axes=axes,
        scale=scale,
        axes_units=dict.fromkeys("zyx", "micrometer"),
        scale_factors=(),
        fmt=format,
    )  # pyright: ignore
    octree = voxtool.read_voxels(tmp_path / "a.ome.zarr", label=2)
    assert np.array_equal(octree.to_dense(), (values[0] == 2).T)
    assert octree.grid == voxtool.Grid((11, 10, 9), (-0.125, -0.25, -1.0), (0.25, 0.5, 2.0))
    assert octree.units == "um"


def changed(folder: Path, name: str, change: Any) -> None:
    about = json.loads((folder / name).read_text())
    change(about)
    (folder / name).write_text(json.dumps(about))


def first(about: Any) -> Any:
    return about["multiscales"][0]["datasets"][0]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (".zattrs", lambda a: a.clear(), "is no OME-Zarr, or damaged: 'multiscales'"),
        (".zattrs", lambda a: first(a).update(path="../b"), "is no OME-Zarr, or damaged"),
        (".zattrs", lambda a: first(a).update(path="9"), "is no OME-Zarr, or damaged"),
        (".zattrs", lambda a: a["multiscales"][0]["axes"].pop(), "voxels have x, y and z"),
        (".zattrs", lambda a: first(a)["coordinateTransformations"][0].update(type="affine"),
         "a transformation that is no scale or translation"),
        (".zattrs", lambda a: first(a)["coordinateTransformations"][0].update(scale=[1, 0, 1]),
         "pitch|directions"),
        ("0/.zarray", lambda a: a.update(shape=[1 << 16] * 3, chunks=[8] * 3, fill_value=1),
         "more than 4,194"),
        ("0/.zarray", lambda a: a.update(chunks=[1 << 20] * 3), "a chunk of"),
        ("0/.zarray", lambda a: a.update(compressor={"id": "base64"}), "coded as 'base64'"),
        ("0/.zarray", lambda a: a.update(dtype="<c8"), "values of type|is no OME-Zarr"),
        ("0/.zarray", lambda a: a.update(dtype="|O", filters=[{"id": "pickle"}]), "OME-Zarr|type"),
        ("0/.zarray", lambda a: a.update(shape=[8, 8]), "is no OME-Zarr|voxels have"),
        ("0/.zarray", lambda a: a.clear(), "is no OME-Zarr, or damaged"),
    ],
)  # fmt: skip
def test_refusals(name: str, change: Any, message: str, tmp_path: Path) -> None:
    folder = tmp_path / "a.ome.zarr"
    voxtool.export(voxtool.Octree.from_dense(ball((9, 9, 9)), **WORLD), folder)
    changed(folder, name, change)
    with pytest.raises(VoxtoolError, match=message):
        voxtool.read_voxels(folder)


def test_missing_chunks(tmp_path: Path) -> None:
    """They are not looked for, unless they mean something else than 0."""
    folder, octree = tmp_path / "a.ome.zarr", voxtool.Octree.from_dense(ball((9, 9, 9)), **WORLD)
    voxtool.export(octree, folder)
    changed(folder, "0/.zarray", lambda about: about.update(shape=[1 << 16] * 3))
    assert np.array_equal(voxtool.read_voxels(folder).occupied(), octree.occupied())
    changed(folder, "0/.zarray", lambda about: about.update(shape=[64, 64, 128], fill_value=1))
    dense = voxtool.read_voxels(folder).to_dense()
    assert np.array_equal(dense[:9, :9, :9], octree.to_dense())
    assert np.count_nonzero(dense[:64]) == octree.count
    assert dense[64:].all()
    changed(folder, "0/.zarray", lambda about: about.update(dtype="<f4", fill_value="1e+308"))
    with warnings.catch_warnings(action="error"):  # of the overflow
        assert voxtool.read_voxels(folder).to_dense()[64:].all()


def test_damaged_chunks_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "a.ome.zarr"
    voxtool.export(voxtool.Octree.from_dense(ball((9, 9, 9)), **WORLD), folder)
    chunk = folder / "0" / "0" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:9])
    with pytest.raises(VoxtoolError, match=r"a.ome.zarr: is no OME-Zarr, or damaged"):
        voxtool.read_voxels(folder)
    (tmp_path / "b.ome.zarr").mkdir()
    with pytest.raises(VoxtoolError, match=r"b.ome.zarr: "):
        voxtool.read_voxels(tmp_path / "b.ome.zarr")
