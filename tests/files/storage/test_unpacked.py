"""Zip archives and packed streams that are damaged, or packed in ways that are not read: one line
each, whatever the decompressor raises."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import struct
import zipfile
import zlib
from collections.abc import Callable
from math import prod
from pathlib import Path

import numpy as np
import pytest
from helpers.octree import ball, octree_from_dense

import voxtool
from voxtool.errors import FileError, MemoryLimitError, VoxtoolError
from voxtool.files.meshes import threemf
from voxtool.files.storage import unpacked
from voxtool.files.tables.points import read_points
from voxtool.memory import at_most, available_memory

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
MODEL = (
    f'<model xmlns="{threemf.CORE}"><resources><object id="1"><mesh><vertices>'
    '<vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/></vertices>'
    '<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh></object></resources><build>'
    '<item objectid="1"/></build></model>'
)
RELATION = (
    f'<Relationships xmlns="{threemf.RELATION.split()[0]}"><Relationship Target="/a.model" '
    f'Id="a" Type="{threemf.ROOT_MODEL}"/></Relationships>'
)


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


ENTRIES = {  # of archives of each kind that is read, by the name of the file
    "points.npz": {"points.npy": npy(np.arange(300.0).reshape(-1, 3))},
    "image.npz": {"a.npy": npy(ball((12, 13, 14)).astype(np.uint8))},
    "a.3mf": {threemf.RELATIONS: RELATION.encode(), "a.model": MODEL.encode()},
}


def read(path: Path) -> int:
    """Return the number of points, voxels or faces of a file."""
    if path.name == "points.npz":
        return sum(map(len, read_points(path)))
    if path.name.endswith("3mf"):
        return len(voxtool.load_mesh(path).faces)
    return voxtool.read_voxels(path).count


def refused(path: Path, message: str) -> None:
    with pytest.raises(VoxtoolError, match=message) as caught:
        read(path)
    assert path.name in str(caught.value)
    assert str(caught.value).isprintable()


def outcome(path: Path) -> str:
    """Return the refusal of a file, or "" if it is read; anything else fails the test."""
    try:
        read(path)
    except VoxtoolError as error:
        return str(error)
    return ""


def archive(name: str, method: int) -> bytearray:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as packed:
        for entry, content in ENTRIES[name].items():
            packed.writestr(zipfile.ZipInfo(entry), content, method)
    return bytearray(file.getvalue())


def heads(data: bytearray) -> list[tuple[int, int]]:
    """Return where the flags and the method of the last entry stand, here and in the list."""
    local, central = data.rfind(b"PK\3\4"), data.rfind(b"PK\1\2")
    return [(local + 6, local + 8), (central + 8, central + 10)]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ENTRIES)
def test_every_method_of_python_is_read(name: str, method: int, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(archive(name, method))
    counts = {"points.npz": 100, "a.3mf": 1, "image.npz": int(ball((12, 13, 14)).sum())}
    assert read(tmp_path / name) == counts[name]


@pytest.mark.parametrize(
    ("flag", "message"),
    [(0x1, "is encrypted"), (0x20, "as a patch"), (0x40, "is encrypted"), (0x2000, "is encrypted")],
)
@pytest.mark.parametrize("name", ENTRIES)
def test_flags_that_are_not_read(name: str, flag: int, message: str, tmp_path: Path) -> None:
    data = archive(name, zipfile.ZIP_DEFLATED)
    for place, _ in heads(data):
        struct.pack_into("<H", data, place, flag)
    (tmp_path / name).write_bytes(data)
    refused(tmp_path / name, message)


@pytest.mark.parametrize("method", [1, 6, 9, 93, 95, 97, 98, 99, 65535])
@pytest.mark.parametrize("name", ENTRIES)
def test_methods_that_are_not_read(name: str, method: int, tmp_path: Path) -> None:
    data = archive(name, zipfile.ZIP_STORED)
    for _, place in heads(data):
        struct.pack_into("<H", data, place, method)
    (tmp_path / name).write_bytes(data)
    refused(tmp_path / name, f"packed by method {method}")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ENTRIES)
def test_damage_of_an_archive_is_one_line(name: str, method: int, tmp_path: Path) -> None:
    """Each byte in turn is changed, or the end missing: a result, or one line."""
    data = archive(name, method)
    rng = np.random.default_rng(method)
    places = rng.integers(0, len(data), 40).tolist()
    last = data.rfind(b"PK\3\4") + 40  # of the compressed data
    for place in [*places, *range(last, last + 20)]:
        changed = data.copy()
        changed[place] ^= 0xFF
        (tmp_path / name).write_bytes(changed if place % 3 else changed[:place])
        assert outcome(tmp_path / name).isprintable()


def test_a_long_list_of_entries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its bytes are counted before zipfile makes an object of each."""
    for name in ENTRIES:
        (tmp_path / name).write_bytes(archive(name, zipfile.ZIP_STORED))
    monkeypatch.setattr(unpacked, "MOST_DIRECTORY", 40)
    for name in ENTRIES:
        refused(tmp_path / name, "list of entries")


# ---- streams

NRRD = b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 8 8 32\nencoding: %s\n\n"
ARRAY = np.random.default_rng(1).integers(0, 9, 2048).astype(np.uint8).tobytes()


def vti(compressor: str, packed: bytes, shape: tuple[int, ...] = (8, 8, 32)) -> bytes:
    head = struct.pack("<4I", 1, prod(shape), 0, len(packed))
    extent = " ".join(f"0 {n}" for n in shape)
    return (
        f'<VTKFile type="ImageData" byte_order="LittleEndian" compressor="{compressor}">'
        f'<ImageData WholeExtent="{extent}"><Piece Extent="{extent}"><CellData><DataArray '
        'type="UInt8" Name="a" format="appended" offset="0"/></CellData></Piece></ImageData>'
        f'<AppendedData encoding="raw">_'
    ).encode() + head + packed + b"</AppendedData></VTKFile>"  # fmt: skip


def zipped(content: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("a.npy", content)
    return file.getvalue()


def lz4(data: bytes) -> bytes:
    from numcodecs.lz4 import compress

    return bytes(compress(data))[4:]


STREAMS: dict[str, Callable[[], bytes]] = {
    "gzip.nrrd": lambda: NRRD % b"gzip" + gzip.compress(ARRAY),
    "bzip2.nrrd": lambda: NRRD % b"bzip2" + bz2.compress(ARRAY),
    "zlib.vti": lambda: vti("vtkZLibDataCompressor", zlib.compress(ARRAY)),
    "lzma.vti": lambda: vti("vtkLZMADataCompressor", lzma.compress(ARRAY)),
    "lz4.vti": lambda: vti("vtkLZ4DataCompressor", lz4(ARRAY)),
}


@pytest.mark.parametrize("name", STREAMS)
def test_damage_of_a_stream_is_one_line(name: str, tmp_path: Path) -> None:
    data = STREAMS[name]()
    (tmp_path / name).write_bytes(data)
    assert read(tmp_path / name) == np.count_nonzero(np.frombuffer(ARRAY, np.uint8))
    start = len(data) - len(data.rpartition(b"\n\n" if name.endswith("nrrd") else b">_")[2])
    refusals = []
    for place in range(start, len(data) - 26, 23):
        changed = bytearray(data)
        changed[place] ^= 0xFF
        (tmp_path / name).write_bytes(changed if place % 2 else changed[:place])
        refusals.append(outcome(tmp_path / name))
    assert all(map(str.isprintable, refusals))
    assert sum(map(bool, refusals)) > 20


def test_packed_nifti_and_vdb_that_are_damaged(tmp_path: Path) -> None:
    octree = octree_from_dense(ball((21, 16, 9)))
    for name in ("a.nii.gz", "a.vdb"):
        voxtool.export(octree, tmp_path / name)
        data = (tmp_path / name).read_bytes()
        for place in range(len(data) // 2, len(data), len(data) // 60):
            changed = bytearray(data)
            changed[place] ^= 0xFF
            (tmp_path / name).write_bytes(changed if place % 2 else changed[:place])
            assert outcome(tmp_path / name).isprintable()


@pytest.mark.parametrize("name", ["gzip.nrrd", "bzip2.nrrd", "zlib.vti", "lzma.vti", "image.npz"])
def test_little_that_unpacks_to_much(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An array of more than 100 times the file is refused, or read if --max-memory allows it."""
    array = bytes(1 << 20)
    nrrd = NRRD.replace(b"8 8 32", b"64 64 256")
    made = {
        "gzip.nrrd": lambda: nrrd % b"gzip" + gzip.compress(array),
        "bzip2.nrrd": lambda: nrrd % b"bzip2" + bz2.compress(array),
        "zlib.vti": lambda: vti("vtkZLibDataCompressor", zlib.compress(array, 9), (64, 64, 256)),
        "lzma.vti": lambda: vti("vtkLZMADataCompressor", lzma.compress(array), (64, 64, 256)),
        "image.npz": lambda: zipped(npy(np.zeros((64, 64, 256), np.uint8))),
    }
    (tmp_path / name).write_bytes(made[name]())
    monkeypatch.setattr(unpacked, "ANY_SIZE", 1 << 19)
    with pytest.raises(MemoryLimitError, match=r"unpacks to 1\.05 MB, .* times the file's"):
        voxtool.read_voxels(tmp_path / name)
    assert voxtool.read_voxels(tmp_path / name, max_memory=1 << 30).count == 0


def test_memory_that_is_allowed() -> None:
    with at_most(1000):
        assert available_memory() == 1000
        with at_most(None):
            assert available_memory() > 1000
    with pytest.raises(FileError, match="damaged thing: EOFError"), unpacked.unpacking("thing"):
        raise EOFError
    with pytest.raises(OSError, match="disk"), unpacked.unpacking("thing"):
        raise OSError(5, "of the disk")


def test_points_that_unpack_to_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "points.npz").write_bytes(zipped(npy(np.zeros((99_999, 3)))))
    monkeypatch.setattr(unpacked, "ANY_SIZE", 1 << 19)
    refused(tmp_path / "points.npz", "unpacks to 2.4 MB")
