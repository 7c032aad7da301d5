"""Numbers of text, held against Python's whole numbers and fractions; and in every format of text:
a number beyond its type is refused, and none becomes another one."""

from __future__ import annotations

import warnings
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import voxtool
from voxtool.errors import FileError, VoxtoolError
from voxtool.files.storage.text_numbers import array_of_text, real, whole
from voxtool.files.tables.points import read_points

KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("kind", KINDS)
def test_whole_numbers_are_exact(kind: str, order: str) -> None:
    """Around each end of the type, and everywhere in it."""
    dtype = np.dtype(order + kind)
    ends, rng = np.iinfo(dtype), np.random.default_rng(5)
    numbers = [*rng.integers(ends.min, ends.max, 50, kind, endpoint=True).tolist()]
    numbers += [ends.min, ends.max, ends.max - 1, 0]
    found = array_of_text(" \n".join(map(str, numbers)).encode(), dtype)
    assert found.dtype == dtype
    assert found.tolist() == numbers
    for wrong in (ends.max + 1, ends.min - 1, 10**30, -(10**30), f"{ends.max}.5", "1e30", "nan"):
        with pytest.raises(FileError, match=r"is beyond|is no whole number"):
            array_of_text(f"1 2 {wrong} 3".encode(), dtype)


def test_whole_numbers_that_are_written_as_reals() -> None:
    assert array_of_text(b"1.0 2e3 -0.0", np.dtype("i4")).tolist() == [1, 2000, 0]
    for wrong in (b"9007199254740993.0", b"1e19", b"0.5", b"1e-3"):
        with pytest.raises(FileError, match="is no whole number"):
            array_of_text(wrong, np.dtype("i8"))


@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_reals_are_the_nearest(kind: str) -> None:
    dtype, rng = np.dtype(kind), np.random.default_rng(6)
    numbers = (rng.uniform(-1, 1, 300) * 10.0 ** rng.integers(-30, 30, 300)).astype(dtype)
    words = [repr(x) for x in numbers.tolist()]
    found = array_of_text(" ".join(words).encode(), dtype)
    for word, number in zip(words, found.tolist(), strict=True):
        nearest = (
            Fraction(float(np.nextafter(dtype.type(number), dtype.type(to))))
            for to in (-1e38, 1e38)
        )
        assert all(
            abs(Fraction(word) - Fraction(number)) <= abs(Fraction(word) - n) for n in nearest
        )
    assert str(array_of_text(b"nan -inf Infinity", dtype).tolist()) == "[nan, -inf, inf]"
    for wrong in (b"1e400", b"-1e400", *([b"3.5e38"] if kind == "f4" else [])):
        with pytest.raises(FileError, match="is beyond float"):
            array_of_text(wrong, dtype)


@pytest.mark.parametrize("word", ["1_0", "0x10", "1,5", "--1", "1.2.3", "", "\u0661", "1e", "a"])
def test_words_that_are_no_numbers(word: str) -> None:
    for read in (real, whole):
        with pytest.raises(FileError, match="is no"):
            read(word)
    for dtype in ("i4", "f8"):
        if word:
            with pytest.raises(FileError, match="is no"):
                array_of_text(f"1 {word} 2".encode(), np.dtype(dtype))


def test_long_texts_are_read_in_blocks() -> None:
    numbers = np.arange(200_000)
    text = "\t".join(map(str, numbers.tolist())).encode()
    assert np.array_equal(array_of_text(text, np.dtype("u4")), numbers)
    with pytest.raises(FileError, match="'199999' is beyond uint16"):
        array_of_text(text[-6:] + b" 1", np.dtype("u2"))


# ---- in files

VTI = (
    '<VTKFile type="ImageData" byte_order="LittleEndian"><ImageData WholeExtent="0 8 0 1 0 1" '
    'Origin="0 0 0" Spacing="1 1 1"><Piece Extent="0 8 0 1 0 1"><CellData><DataArray '
    'type="{}" Name="a" format="ascii">{}</DataArray></CellData></Piece></ImageData></VTKFile>'
)
NRRD = "NRRD0004\ntype: {}\ndimension: 3\nsizes: 8 1 1\nencoding: ascii\n\n{}\n"
POINTS = "0 0 0 1 0 0 0 1 0 0 0 1"
VTU = (
    '<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian"><UnstructuredGrid>'
    '<Piece NumberOfPoints="4" NumberOfCells="1"><PointData><DataArray type="{}" Name="s" '
    'format="ascii">{}</DataArray></PointData><Points><DataArray type="Float32" '
    f'NumberOfComponents="3" format="ascii">{POINTS}</DataArray></Points><Cells><DataArray '
    'type="Int32" Name="connectivity" format="ascii">{}</DataArray><DataArray type="Int64" '
    'Name="offsets" format="ascii">4</DataArray><DataArray type="UInt8" Name="types" '
    'format="ascii">10</DataArray></Cells></Piece></UnstructuredGrid></VTKFile>'
)
VTK = (
    "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n"
    f"{POINTS}\nCELLS 1 5\n4 {{2}}\nCELL_TYPES 1\n10\nPOINT_DATA 4\n{{0}}\n{{1}}\n"
)
SCALARS, FIELD = "SCALARS s {} 1\nLOOKUP_TABLE default", "FIELD FieldData 1\ns 1 4 {}"
MSH = (
    "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n"
    "$EndNodes\n$Elements\n1\n1 4 2 0 0 1 2 3 {}\n$EndElements\n"
)
MESH = (
    "MeshVersionFormatted 2\nDimension 3\nVertices\n4\n0 0 0 0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n"
    "Tetrahedra\n1\n1 2 3 {} {}\n"
)
SEVEN = "1 " * 7
BEYOND = [
    ("a.vti", VTI.format("UInt8", SEVEN + "300"), "'300' is beyond uint8"),
    ("a.vti", VTI.format("UInt8", SEVEN + "-1"), "'-1' is beyond uint8"),
    ("a.vti", VTI.format("Int64", SEVEN + str(2**63)), "is beyond int64"),
    ("a.vti", VTI.format("Float32", SEVEN + "1e39"), "'1e39' is beyond float32"),
    ("a.nrrd", NRRD.format("short", SEVEN + "32768"), "'32768' is beyond int16"),
    ("a.nrrd", NRRD.format("uint64", SEVEN + str(2**64)), "is beyond uint64"),
    ("a.nrrd", NRRD.format("uchar", SEVEN + "1.5"), "'1.5' is no whole number"),
    ("a.nrrd", NRRD.format("double", SEVEN + "-1e400"), "'-1e400' is beyond float64"),
    ("a.vtu", VTU.format("UInt8", "1 2 3 256", "0 1 2 3"), "array s: '256' is beyond uint8"),
    ("a.vtu", VTU.format("Float32", "1 2 3 1e39", "0 1 2 3"), "array s: '1e39' is beyond"),
    ("a.vtu", VTU.format("UInt8", "1 2 3 4", f"0 1 2 {2**32 + 3}"), "connectivity: '4294967299'"),
    ("a.vtk", VTK.format(SCALARS.format("char"), "1 2 3 128", "0 1 2 3"), "'128' is beyond int8"),
    ("a.vtk", VTK.format(FIELD.format("int"), f"1 2 3 {2**32}", "0 1 2 3"), "is beyond int32"),
    ("a.vtk", VTK.format(SCALARS.format("int"), "1 2 3 4", f"0 1 2 {2**32}"), "is beyond int32"),
    ("a.msh", MSH.format(2**32 + 4), "'4294967300' is beyond int32"),
    ("a.mesh", MESH.format(4, 2**64 + 5), "is beyond int64"),
    ("a.csv", "x,y,z\n1,2,3\n1,-1e400,3\n", "line 3: '-1e400' is beyond float64"),
    ("a.xyz", "1 2 inf\n1 2 1e999\n", "line 2: '1e999' is beyond float64"),
]  # fmt: skip


def read(path: Path) -> object:
    if path.suffix in (".csv", ".xyz"):
        return np.concatenate(list(read_points(path)))
    if path.suffix in (".vti", ".nrrd"):
        return voxtool.read_voxels(path)
    return voxtool.read_unstructured(path, "medit:ref" if path.suffix == ".mesh" else None)


@pytest.mark.parametrize(("name", "text", "message"), BEYOND)
def test_numbers_beyond_their_types_are_refused(
    name: str, text: str, message: str, tmp_path: Path
) -> None:
    """Without a warning of numpy."""
    (tmp_path / name).write_text(text)
    with (
        warnings.catch_warnings(action="error"),
        pytest.raises(VoxtoolError, match=message) as caught,
    ):
        read(tmp_path / name)
    assert name in str(caught.value)


def test_the_same_files_with_numbers_of_their_types(tmp_path: Path) -> None:
    for name, text in {
        "a.vtu": VTU.format("UInt8", "1 2 3 255", "0 1 2 3"),
        "a.vtk": VTK.format(FIELD.format("char"), "1 2 3 -128", "0 1 2 3"),
        "b.vtk": VTK.format(SCALARS.format("float"), "1 2 nan 3e38", "0 1 2 3"),
        "a.mesh": MESH.format(4, 2**62),
        "a.xyz": "1 2 inf\n1 nan 1e99\n",
    }.items():
        (tmp_path / name).write_text(text)
        read(tmp_path / name)


@pytest.mark.parametrize("name", ["a.vti", "a.nrrd"])
def test_labels_of_64_bits_are_exact(name: str, tmp_path: Path) -> None:
    """2**53 and 2**53 + 1 are two labels, which float64 does not tell apart."""
    words = " ".join(str(2**53 + n % 2) for n in range(8))
    kinds = {"a.vti": VTI.format("Int64", words), "a.nrrd": NRRD.format("int64", words)}
    (tmp_path / name).write_text(kinds[name])
    odd = voxtool.read_voxels(tmp_path / name, label=2**53 + 1)
    assert odd.occupied()[:, 0].tolist() == [1, 3, 5, 7]
    assert voxtool.read_voxels(tmp_path / name, threshold=2**53 + 1) == odd
    assert voxtool.read_voxels(tmp_path / name, threshold=2.0**53).count == 8
    assert voxtool.read_voxels(tmp_path / name, label=0.5).count == 0
