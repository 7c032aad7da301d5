"""Points from files and answers to files, block by block, in memory that their number does not
change; what is damaged or hostile is refused in one line that says where."""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.files import LIMITED, memory_below, run_python
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.errors import DeviceWarning, FileError, VoxtoolError
from voxtool.files.tables.answers import open_answers
from voxtool.files.tables.points import read_points

POINTS = np.array([[0.1, -2.5, 3e-300], [1e300, np.nan, np.inf], [-0.0, 7.0, 1 / 3]])
SMALL = np.array([[1, -2, 3], [4, 5, -6], [7, 8, 9], [10, 11, 12], [13, 14, 15]])


def npy(array: Any, **options: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def npz(compressed: bool = False, **arrays: Any) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(file, **arrays)
    return file.getvalue()


def csv(points: np.ndarray, header: str = "") -> bytes:
    return (header + "".join(f"{x!r},{y!r},{z!r}\n" for x, y, z in points.tolist())).encode()


def xyz(points: np.ndarray) -> bytes:
    return "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist()).encode()


PLY = """ply
format {format} 1.0
comment a cube, once
{before}element vertex {count}
property {kind} nx
property {kind} x
property uchar red
property {kind} y
property {kind} z
element face 1
property list uchar int vertex_indices
end_header
"""


def ply(points: np.ndarray, format: str, kind: str = "double", before: str = "") -> bytes:
    """Vertices, a face after them, and before them what `before` declares: 2 of 3 bytes."""
    head = PLY.format(format=format, count=len(points), kind=kind, before=before).encode()
    if format == "ascii":
        lines = "".join(f"9 {x!r} 255 {y!r} {z!r}\n" for x, y, z in points.tolist())
        return head + b"".join([b"1 2 3\n"] * 2 if before else []) + lines.encode() + b"3 0 1 2\n"
    order = "<" if "little" in format else ">"
    code = {"double": "d", "float": "f", "short": "h"}[kind]
    rows = [struct.pack(f"{order}{code * 2}B{code * 2}", 9, x, 255, y, z) for x, y, z in points]
    face = struct.pack(f"{order}B3i", 3, 0, 1, 2)
    return head + b"\1\2\3" * (2 if before else 0) + b"".join(rows) + face


PLAIN = "element colour 2\n" + "".join(f"property uchar {name}\n" for name in "rgb")

CONTENTS: dict[str, tuple[bytes, np.ndarray]] = {
    "npy": (npy(POINTS), POINTS),
    "npy fortran": (npy(np.asfortranarray(POINTS)), POINTS),
    "npy float32": (npy((SMALL / 3).astype("f4")), (SMALL / 3).astype("f4")),
    "npy big-endian": (npy(POINTS.astype(">f8")), POINTS),
    "npy int64": (npy(SMALL), SMALL),
    "npy uint8 fortran": (npy(np.asfortranarray(abs(SMALL).astype("u1"))), abs(SMALL)),
    "npz": (npz(points=POINTS, other=np.zeros(3)), POINTS),
    "npz of one array": (npz(a=SMALL), SMALL),
    "npz deflated": (npz(compressed=True, a=SMALL), SMALL),
    "npz fortran": (npz(compressed=True, points=np.asfortranarray(SMALL)), SMALL),
    "csv": (csv(POINTS), POINTS),
    "csv with a header": (csv(POINTS, "x,y,z\n"), POINTS),
    "csv with another header": (csv(POINTS, "east, north, up\r\n"), POINTS),
    "csv in another order": (csv(POINTS[:, [2, 0, 1]], '"Z", X ,y\n'), POINTS),
    "csv with more columns": (
        b"id,x,y,z\na,1,2,3\nb,4,5,6\n",
        SMALL[:2] * [[1, -1, 1], [1, 1, -1]],
    ),
    "csv of Windows": (b"\xef\xbb\xbf" + csv(SMALL).replace(b"\n", b"\r\n"), SMALL),
    "csv with comments": (b"# points\n\n 1, -2 ,3 # one\n  \n4,5,-6", SMALL[:2]),
    "xyz": (xyz(POINTS), POINTS),
    "xyz with more columns": (b"1 -2 3 a b\n\t4  5 -6\n# end\n", SMALL[:2]),
    "xyz of old Macs": (xyz(SMALL).replace(b"\n", b"\r"), SMALL),
    "ply ascii": (ply(POINTS, "ascii"), POINTS),
    "ply ascii after others": (ply(POINTS, "ascii", before=PLAIN), POINTS),
    "ply little-endian": (ply(POINTS, "binary_little_endian"), POINTS),
    "ply big-endian": (ply(POINTS, "binary_big_endian"), POINTS),
    "ply float": (ply(SMALL, "binary_little_endian", "float"), SMALL),
    "ply short": (ply(SMALL, "binary_big_endian", "short"), SMALL),
    "ply after others": (ply(SMALL, "binary_big_endian", before=PLAIN), SMALL),
    "ply of Windows": (ply(SMALL, "ascii").replace(b"\n", b"\r\n"), SMALL),
}


def same(found: np.ndarray, expected: np.ndarray) -> bool:
    return found.dtype == np.float64 and np.array_equal(found, expected, equal_nan=True)


@pytest.mark.parametrize("block", [2, 1000])
@pytest.mark.parametrize("name", CONTENTS)
def test_points_are_recognised_by_content(name: str, block: int, tmp_path: Path) -> None:
    data, expected = CONTENTS[name]
    (tmp_path / "points").write_bytes(data)
    blocks = list(read_points(tmp_path / "points", block=block))
    assert [len(b) for b in blocks[:-1]] == [block] * (len(blocks) - 1)
    assert 1 <= len(blocks[-1]) <= block
    assert same(np.concatenate(blocks), expected)


def test_a_header_of_python_2_hides_no_other_warning(tmp_path: Path, monkeypatch) -> None:
    """Another thread warns while the header is read: that warning is shown."""
    (tmp_path / "points").write_bytes(npy(SMALL).replace(b"(5, 3), }  ", b"(5L, 3L), }"))
    header = np.lib.format.read_array_header_1_0

    def read(stream: Any) -> Any:
        warnings.warn("the folder cannot be written", DeviceWarning, stacklevel=1)
        return header(stream)

    monkeypatch.setattr(np.lib.format, "read_array_header_1_0", read)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        assert same(np.concatenate(list(read_points(tmp_path / "points"))), SMALL)
    assert [str(w.message) for w in found] == ["the folder cannot be written"]


@pytest.mark.parametrize("name", [name for name in CONTENTS if "npz" not in name])
def test_points_from_a_pipe(name: str, monkeypatch) -> None:
    data, expected = CONTENTS[name]
    reader, writer = os.pipe()
    os.write(writer, data)
    os.close(writer)
    with open(reader, "rb") as pipe:
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(pipe))
        assert same(np.concatenate(list(read_points("-", block=2))), expected)


def test_points_from_a_named_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    code = f"import pathlib; pathlib.Path({str(tmp_path / 'pipe')!r}).write_bytes({npy(SMALL)!r})"
    with subprocess.Popen([sys.executable, "-c", code]):
        assert same(np.concatenate(list(read_points(tmp_path / "pipe"))), SMALL)


def test_a_stream_is_read_while_it_comes(monkeypatch) -> None:
    reader, writer = os.pipe()
    with open(reader, "rb") as pipe:
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(pipe))
        os.write(writer, npy(np.zeros((10_000, 3)))[: 128 + 24 * 1000])
        blocks = read_points("-", block=500)
        assert len(next(blocks)) == 500  # though the other end is open
        os.close(writer)
        with pytest.raises(
            FileError, match="stdin: is cut short: 1,000 of 10,000 points are there"
        ):
            list(blocks)


def test_extension_and_format_decide_what_text_is(tmp_path: Path) -> None:
    for name in ("a.csv", "a.CSV"):
        (tmp_path / name).write_bytes(b"1 2 3\n")
        with pytest.raises(FileError, match=r"line 1: a header of other columns than x, y and z"):
            list(read_points(tmp_path / name))
        assert same(next(read_points(tmp_path / name, "xyz")), np.array([[1, 2, 3]]))
    (tmp_path / "a.xyz").write_bytes(b"1,2,3\n")
    with pytest.raises(FileError, match="line 1: 1 column, too few for x, y and z"):
        list(read_points(tmp_path / "a.xyz"))
    with pytest.raises(FileError, match=r"format 'obj' is unknown: choose one of npy, npz, csv"):
        list(read_points(tmp_path / "a.xyz", "obj"))


@pytest.mark.parametrize(
    "data", [npy(np.zeros((0, 3))), b"# none\n", b"x,y,z\n", ply(SMALL[:0], "ascii")]
)
def test_no_points(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "points").write_bytes(data)
    assert list(read_points(tmp_path / "points")) == []


@given(data=st.data())
@settings(max_examples=100)
def test_text_and_arrays_hold_the_same(data, tmp_path_factory) -> None:
    points = data.draw(
        st.lists(st.tuples(*[st.floats()] * 3), min_size=1, max_size=20).map(np.array)
    )
    path = tmp_path_factory.getbasetemp() / "points"
    block = data.draw(st.integers(1, 30))
    for content in (npy(points), npy(points.T.copy().T), csv(points), xyz(points)):
        path.write_bytes(content)
        assert same(np.concatenate(list(read_points(path, block=block))), points)


# Faults


def header(text: str, version: bytes = b"\1\0", size: int = 1000) -> bytes:
    return b"\x93NUMPY" + version + struct.pack("<H", len(text)) + text.encode() + b"\0" * size


def described(descr: str = "'<f8'", shape: str = "(2, 3)", fortran: str = "False") -> bytes:
    return header(f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}}}\n")


def packed(method: int = zipfile.ZIP_STORED, **members: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return file.getvalue()


def flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :]


TEXT = ply(SMALL, "ascii")
BINARY = ply(SMALL, "binary_little_endian")
LISTS = b"element face 9\nproperty list uchar int a\nelement vertex"

FAULTS: list[tuple[str, bytes, str]] = [
    ("a.npy", b"", "is empty"),
    ("a.npy", b"\x93NUMPY\3\0", "is no .npy array, or its header is damaged"),
    ("a.npy", described("'|O'"), r"type \|O: points are integers, float32 or float64"),
    ("a.npy", described("[('x', '<f8')]"), "points are integers, float32 or float64"),
    ("a.npy", described("'|b1'"), r"an array of type \|b1"),
    ("a.npy", described(shape="(3,)"), r"an array of shape \(3,\): points are \(N, 3\)"),
    ("a.npy", described(shape="(-1, 3)"), r"shape \(-1, 3\)"),
    ("a.npy", described(shape="'\x1b[2J'"), "is no .npy array, or its header is damaged"),
    ("a.npy", described(shape="(10**3, 3)"), "is no .npy array, or its header is damaged"),
    ("a.npy", described(fortran="1"), "is no .npy array, or its header is damaged"),
    ("a.npy", header("[1]"), "is no .npy array, or its header is damaged"),
    ("a.npy", header("(" * 9000), "is no .npy array, or its header is damaged"),
    ("a.npy", header("'" + "a" * 20_000 + "'"), "is no .npy array, or its header is damaged"),
    ("a.npy", described(shape="(999999999999, 3)"), "cut short: 41 of 999,999,999,999 points are"),
    ("a.npy", npy(SMALL)[:-1], "is cut short: 4 of 5 points are there: copy it anew"),
    ("a.npy", npy(np.asfortranarray(SMALL))[:-1], "is cut short: 4 of 5 points"),
    ("a.npz", b"PK\3\4", "damaged zip archive: File is not a zip file"),
    ("a.npz", packed(), "holds nothing: call the array of points `points`"),
    ("a.npz", npz(a=SMALL, b=SMALL), "holds a, b: call the array of points `points`"),
    ("a.npz", packed(a=npy(np.asfortranarray(SMALL))[:-9]), "is cut short: 3 of 5"),
    ("a.npz", packed(a=b"hello"), "is no .npy array, or its header is damaged"),
    ("a.npz", flipped(packed(a=npy(SMALL)), 200), "damaged entry a.npy: Bad CRC-32"),
    ("a.csv", b"1,2,3\n1,2,3\n1,O.2,3\n", "line 3: 'O.2' is no number"),
    ("a.csv", b"1,2,O.3\n4,5,6\n", "line 1: 'O.3' is no number"),
    ("a.csv", b"x,y,z\n1,2,3\n\n# so\n1,,3\n", "line 5: '' is no number"),
    ("a.csv", b"1,2,3\n1,2,3,4\n", "line 2: 4 columns where x,y,z are expected: name them in"),
    ("a.csv", b"1,2\n", "line 1: 2 columns where x,y,z are expected$"),
    ("a.csv", b"1,2,3\n1_0,2,3\n", "line 2: '1_0' is no number"),
    ("a.csv", "1,2,3\n1,٣,3\n".encode(), "line 2: '٣' is no number"),
    ("a.csv", b"1,2,3\n1,\xff,3\n", "line 2: '.' is no number"),
    ("a.csv", b"1,2,3\n1,\x1b[2J,3\n", r"line 2: '\\x1b\[2J' is no number"),
    ("a.csv", b"a,x,y\n1,2,3\n", "line 1: a header of other columns than x, y and z"),
    ("a.csv", b"id,x,y,z\n7,1,2\n", "line 2: 3 columns, too few for x, y and z"),
    ("a.csv", b"1,2,3\n" * 9 + b"4," * 40_000, "line 10: longer than 65536 letters"),
    ("a", b"1 2 3\n1 2\n", "line 2: 2 columns, too few for x, y and z"),
    ("a", b"1 2 3\n1, 2, 3\n", "line 2: '1,' is no number: columns with commas between them"),
    ("a.obj", b"v 0 0 0\n", "is a mesh: expected points, .npy, .npz, .csv, .xyz or .ply"),
    ("a.xyz", b"\x89HDF\r\n\x1a\n", "holds no points: expected .npy"),
    ("a.csv", "1,2,3\n".encode("utf-16"), "holds no points: expected .npy"),
    ("a.ply", TEXT.replace(b"ascii 1.0", b"ascii 2.0"), "line 2: 'format ascii 2.0' does not bel"),
    ("a.ply", TEXT.replace(b"format", b"comment"), "line 12: 'end_header' does not belong"),
    ("a.ply", TEXT.replace(b"vertex 5", b"vertex -5"), "line 4: 'element vertex -5' does not bel"),
    ("a.ply", TEXT.replace(b"uchar red", b"string red"), "line 7: 'property string red'"),
    ("a.ply", TEXT.replace(b"vertex 5", b"point 5"), "has no element vertex"),
    ("a.ply", TEXT.replace(b"double z", b"double w"), "its vertices have 0 properties z, not one"),
    ("a.ply", TEXT.replace(b"double nx", b"double x"), "its vertices have 2 properties x, not one"),
    ("a.ply", TEXT.replace(b"uchar red", b"list uchar int red"), "a list among their properties"),
    ("a.ply", TEXT.replace(b"9 7 255", b"9 oops 255"), "line 15: 'oops' is no number"),
    ("a.ply", TEXT.replace(b"vertex 5", b"vertex 900"), "line 18: 4 columns, too few"),
    ("a.ply", TEXT[: TEXT.index(b"9 7")], "is cut short: 2 of 5 points are there"),
    ("a.ply", BINARY[:-40], "is cut short: 4 of 5 points are there"),
    (
        "a.ply",
        BINARY.replace(b"vertex 5", b"vertex 9999999999"),
        "short: 5 of 9,999,999,999 points",
    ),
    (
        "a.ply",
        BINARY.replace(b"element vertex", LISTS),
        "a list comes before its vertices: write",
    ),
    ("a.ply", b"ply\nformat ascii 1.0\n" + b"comment\n" * 2000, "no end within 1000 lines"),
    ("a.ply", b"ply\n", "line 2: '' does not belong in a PLY header"),
]


@pytest.mark.parametrize(("name", "data", "message"), FAULTS)
def test_faults_are_one_line(name: str, data: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(FileError, match=message) as caught:
        list(read_points(path, block=4))
    assert str(caught.value).startswith(str(path))
    assert str(caught.value).isprintable()


def test_faults_of_formats_that_were_named(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"1 2 3\n")
    for format, message in (("npy", "is no .npy array"), ("ply", "is no PLY file")):
        with pytest.raises(FileError, match=message):
            list(read_points(path, format))


@pytest.mark.parametrize(
    ("data", "message"),
    [(npz(a=SMALL), "stdin: the contents of a .npz are .*: save it to"), (b"", "stdin is empty")],
)
def test_zip_and_nothing_on_stdin(data: bytes, message: str, monkeypatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))
    with pytest.raises(FileError, match=message):
        list(read_points("-"))


def test_no_such_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="none: there is no such file"):
        list(read_points(tmp_path / "none"))
    with pytest.raises(FileError, match="is a folder"):
        list(read_points(tmp_path))


# Memory


MANY = 150_000  # points: 3.6 MB as float64


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("a.npy", lambda: npy(np.zeros((MANY, 3)))),
        ("f.npy", lambda: npy(np.zeros((3, MANY)).T)),
        ("a.npz", lambda: npz(compressed=True, points=np.zeros((MANY, 3)))),
        ("f.npz", lambda: npz(compressed=True, points=np.zeros((3, MANY)).T)),
        ("a.csv", lambda: b"1.5,2.5,3.5\n" * MANY),
        ("a.xyz", lambda: b"1.5 2.5 3.5\n" * MANY),
        ("a.ply", lambda: ply(np.zeros((MANY, 3)), "binary_big_endian")),
    ],
)
def test_memory_does_not_grow_with_the_points(name: str, make: Callable, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(make())
    next(read_points(tmp_path / name))  # imports what it needs
    with memory_below(2 << 20):
        assert sum(map(len, read_points(tmp_path / name, block=1000))) == MANY


@pytest.mark.parametrize("order", "CF")
def test_a_bomb_is_read_no_faster_than_it_is_asked_for(order: str, tmp_path: Path) -> None:
    n = 5_000_000  # 120 MB, in an eighth of a megabyte
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f8", "fortran_order": order == "F", "shape": (n, 3)}
    )
    with (
        zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("points.npy", "w", force_zip64=True) as member,
    ):
        member.write(head.getvalue())
        for _ in range(24):
            member.write(bytes(n))
    assert (tmp_path / "a.npz").stat().st_size < 1 << 20

    with memory_below(4 << 20):
        blocks = read_points(tmp_path / "a.npz", block=1000)
        assert len(next(blocks)) == 1000
        blocks.close()


# Answers


TABLE = [("distance", np.float64), ("slope", np.float32), ("level", np.uint8), ("outside", bool)]


def blocks_of(n: int, size: int) -> list[dict[str, np.ndarray]]:
    rng = np.random.default_rng(0)
    return [
        {
            "distance": rng.normal(size=size),
            "slope": rng.normal(size=size).astype(np.float32),
            "level": rng.integers(0, 22, size).astype(np.uint8),
            "outside": rng.random(size) < 0.5,
        }
        for _ in range(n)
    ]


def joined(blocks: list[dict[str, np.ndarray]]) -> np.ndarray:
    return np.concatenate([np.stack([*b.values()], axis=1).astype(np.float64) for b in blocks])


def test_npy_of_one_column_is_what_numpy_saves(tmp_path: Path) -> None:
    pieces = np.split(np.random.default_rng(0).normal(size=1000), [1, 1, 400])
    with open_answers(tmp_path / "a.npy", [("distance", np.float64)]) as answers:
        for i, piece in enumerate(pieces):
            answers.write([piece] if i % 2 else {"distance": piece})
        assert answers.count == 1000
    assert (tmp_path / "a.npy").read_bytes() == npy(np.concatenate(pieces))


@pytest.mark.parametrize("n", [0, 12])
def test_npy_of_more_columns(n: int, tmp_path: Path) -> None:
    blocks = blocks_of(n, 100)
    with open_answers(tmp_path / "a.npy", TABLE) as answers:
        for block in blocks:
            answers.write(block)
    found = np.load(tmp_path / "a.npy")
    assert found.dtype == np.float64
    assert np.array_equal(found, joined(blocks) if n else np.zeros((0, 4)))


def test_arrays_of_several_columns(tmp_path: Path) -> None:
    columns = [("distance", "f8"), *((f"g{axis}", "f4") for axis in "xyz")]
    distance, gradient = np.arange(5.0), np.arange(15, dtype="f4").reshape(5, 3)
    for name in ("a.npy", "a.csv"):
        with open_answers(tmp_path / name, columns) as answers:
            answers.write([distance, gradient])
    expected = np.column_stack([distance, gradient])
    assert np.array_equal(np.load(tmp_path / "a.npy"), expected)
    found = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    assert np.array_equal(found, expected)


@given(values=st.lists(st.floats(), max_size=30), narrow=st.lists(st.floats(width=32), max_size=30))
@settings(max_examples=40)
def test_csv_is_the_shortest_that_reads_back(values, narrow, tmp_path_factory) -> None:
    path = tmp_path_factory.getbasetemp() / "answers.csv"
    size = min(len(values), len(narrow))
    wide, slim = np.array(values[:size], "f8"), np.array(narrow[:size], "f4")
    with open_answers(path, [("a", "f8"), ("b", "f4"), ("c", "i4"), ("d", bool)]) as answers:
        answers.write([wide, slim, np.arange(size), np.arange(size) % 2 == 0])
    head, *lines = path.read_text().splitlines()
    assert head == "a,b,c,d"
    rows = [line.split(",") for line in lines]
    assert [row[0] for row in rows] == list(map(repr, wide.tolist()))
    found = np.array([row[1] for row in rows], "f4")
    assert np.array_equal(found, slim, equal_nan=True)
    assert [digits(row[1]) for row in rows] == [digits(shortest(v)) for v in slim]
    assert [row[2:] for row in rows] == [[str(i), str(1 - i % 2)] for i in range(size)]


def digits(text: str) -> str:
    """Without sign, point, exponent and zeros on either side."""
    return text.partition("e")[0].replace(".", "").strip("-0")


def shortest(value: np.float32) -> str:
    """The fewest decimals that are this number in float32."""
    texts = (f"{float(value):.{n}e}" for n in range(10))
    with np.errstate(over="ignore"):
        return next(text for text in texts if np.float32(text) == value or np.isnan(value))


def test_csv_of_a_large_block(tmp_path: Path) -> None:
    with open_answers(tmp_path / "a.csv", [("a", "i4")]) as answers:
        answers.write([np.arange(150_000)])
    assert (tmp_path / "a.csv").read_text().split() == ["a", *map(str, range(150_000))]


@pytest.mark.slow
@pytest.mark.parametrize("extension", ["npy", "csv"])
def test_memory_does_not_grow_with_the_answers(extension: str, tmp_path: Path) -> None:
    def write(n: int) -> None:
        block = blocks_of(1, 1000)[0]
        with open_answers(tmp_path / f"a.{extension}", TABLE) as answers:
            for _ in range(n):
                answers.write(block)

    write(1)
    with memory_below(1 << 20):
        write(300)  # 10 MB in the file
    assert (tmp_path / f"a.{extension}").stat().st_size > 9_000_000


@pytest.mark.parametrize("extension", ["npy", "csv"])
def test_an_error_leaves_the_old_file(extension: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{extension}"
    path.write_bytes(b"old")
    with pytest.raises(KeyError), open_answers(path, TABLE) as answers:
        list(map(answers.write, [*blocks_of(1, 100_000), {}]))
    assert path.read_bytes() == b"old"
    with pytest.raises(FileError, match="exists"), open_answers(path, TABLE, clobber=False):
        pass
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.skipif(os.name != "posix", reason="POSIX only")
def test_disk_full_is_one_line(tmp_path: Path) -> None:
    code = (
        "import numpy; from voxtool.files.tables.answers import open_answers\n"
        "with open_answers(sys.argv[1], [('d', 'f8')]) as answers:\n"
        "    answers.write([numpy.zeros(100_000)])\n"
    )
    done = run_python(LIMITED + code, tmp_path / "a.npy")
    assert b"a.npy: the file would be larger than its disk" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_opened(tmp_path: Path) -> None:
    for path, format, message in (
        ("a.txt", None, r"a\.txt: the name says no format: end it in one of \.npy, \.csv"),
        ("a.npy", "xyz", "format 'xyz' is unknown: choose one of npy, csv"),
        ("none/a.npy", None, "there is no folder"),
    ):
        with pytest.raises(FileError, match=message), open_answers(tmp_path / path, TABLE, format):
            pass


@pytest.mark.parametrize(
    "block",
    [[np.zeros(3)], [np.zeros(3)] * 5, [np.zeros((3, 3)), np.zeros(2)], [np.zeros((4, 3))], []],
)
def test_blocks_of_other_columns_are_refused(block: list, tmp_path: Path) -> None:
    with (
        pytest.raises(VoxtoolError, match="4 columns of one length are expected"),
        open_answers(tmp_path / "a.npy", TABLE) as answers,
    ):
        answers.write(block)


def stdout_of(format: str, **options: Any) -> subprocess.CompletedProcess[bytes]:
    code = (
        "import numpy; from voxtool.files.tables.answers import open_answers\n"
        f"with open_answers('-', [('a', 'f8'), ('b', 'u1')], {format}) as answers:\n"
        "    for i in range(3): answers.write([numpy.full(2, i / 10), numpy.full(2, i)])\n"
    )
    return run_python(code, **options)


def test_stdout_is_csv_unless_the_format_says_npy() -> None:
    expected = np.repeat(np.array([[0.0, 0], [0.1, 1], [0.2, 2]]), 2, axis=0)
    done = stdout_of("'npy'")
    assert done.stdout == npy(expected), done.stderr
    for format in ("None", "'csv'"):
        done = stdout_of(format)
        assert done.stdout == b"a,b\n0.0,0\n0.0,0\n0.1,1\n0.1,1\n0.2,2\n0.2,2\n"


def test_a_terminal_gets_csv() -> None:
    pty = pytest.importorskip("pty")
    for format, expected in (("None", b"a,b\r\n0.0,0\r\n"), ("'npy'", b"")):
        master, slave = pty.openpty()
        done = stdout_of(format, stdout=slave)
        os.close(slave)
        sent = b""
        with suppress(OSError):  # the other end is closed
            while piece := os.read(master, 4096):
                sent += piece
        os.close(master)
        assert sent.startswith(expected)
        assert (b"is a terminal: redirect it" in done.stderr) == (expected == b"")


def test_answers_can_be_read_as_points(tmp_path: Path) -> None:
    for name in ("a.npy", "a.csv"):
        with open_answers(tmp_path / name, [(axis, "f8") for axis in "xyz"]) as answers:
            answers.write([POINTS])
        assert same(next(read_points(tmp_path / name)), POINTS)
