"""Octree files: what is written is read, what is damaged or hostile is refused in one line.

The golden files tests/data/v1.0.svo.* hold helpers_octree.golden_octree(). They stay for good;
they were made once, at format version 1.0, by

    write_svo(golden_octree(), "tests/data/v1.0.svo.h5")
    write_svo(golden_octree(), "tests/data/v1.0.svo.xml")
"""

from __future__ import annotations

import gzip
import io
import json
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import helpers_files
import numpy as np
import pytest
from helpers_files import (
    attribute,
    changed_h5,
    check_mutants,
    check_truncated,
    memory_below,
    newer_minor_version,
    stored,
    text,
)
from helpers_octree import ball, golden_octree, octree_from_dense
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool import files, memory
from voxtool.errors import FileError, MemoryLimitError, VoxtoolError
from voxtool.files import skeleton, svo_hdf5, svo_xml
from voxtool.grid import Grid
from voxtool.svo import layers
from voxtool.svo.layout import INSIDE, VALID
from voxtool.svo.octree import Octree

ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parents[1] / "data"
GOLDEN_DIGEST = "7c2efdb1b391a600c595306787826bf25a4f5b5e1210126d331c654aa2352fe3"
EXTENSIONS = ("svo.h5", "svo.xml", "svo.xml.gz")


class Codec(NamedTuple):
    write: Callable[[Octree, Any], None]
    read: Callable[[Any, int], Octree]


CODECS = {
    "svo.h5": Codec(svo_hdf5.write, svo_hdf5.read),
    "svo.xml": Codec(svo_xml.write, svo_xml.read),
    "svo.xml.gz": Codec(svo_xml.write_gz, svo_xml.read_gz),
}


def to_bytes(octree: Octree, extension: str) -> bytes:
    file = io.BytesIO()
    CODECS[extension].write(octree, file)
    return file.getvalue()


def from_bytes(data: bytes, extension: str) -> Octree:
    return CODECS[extension].read(io.BytesIO(data), len(data))


def assert_same(a: Octree, b: Octree) -> None:
    assert a.digest() == b.digest()
    assert a.grid == b.grid
    assert (a.mode, a.fill, a.units, a.source_sha256) == (b.mode, b.fill, b.units, b.source_sha256)
    assert json.dumps(a.plan) == json.dumps(b.plan)  # the order of keys, too
    for name in ("offsets", "nodes", "bricks"):
        one, two = getattr(a, name), getattr(b, name)
        assert one.dtype == two.dtype
        assert np.array_equal(one, two)


@st.composite
def dense_arrays(draw) -> np.ndarray:
    """Blocks of all sizes, set and unset, in shapes that are no powers of two."""
    shape = draw(st.tuples(*[st.integers(1, 40)] * 3).filter(lambda s: max(s) >= 8))
    dense = np.full(shape, draw(st.booleans()))
    for value in draw(st.lists(st.booleans(), max_size=6)):
        low = [draw(st.integers(0, n - 1)) for n in shape]
        high = [draw(st.integers(a + 1, n)) for a, n in zip(low, shape, strict=True)]
        dense[tuple(map(slice, low, high))] = value
    return dense


@pytest.fixture(scope="module")
def octree() -> Octree:
    return golden_octree()


# The octree itself


@given(dense=dense_arrays())
@settings(max_examples=80)
def test_octree_holds_the_dense_array(dense: np.ndarray) -> None:
    for mode, fill in (("solid", "parity"), ("surface26", "none")):
        octree = octree_from_dense(dense, mode, fill)
        octree.validate()
        assert np.array_equal(octree.to_dense(), dense)
        assert np.array_equal(octree.occupied(), np.argwhere(dense))
        assert octree.count == np.count_nonzero(dense)


def test_empty_octree_is_the_root_alone() -> None:
    octree = octree_from_dense(np.zeros((9, 8, 8), bool))
    octree.validate()
    assert octree.offsets.tolist() == [0, 1, 1, 1]
    assert octree.count == 0
    assert octree.occupied().shape == (0, 3)


def test_full_octree_is_the_root_alone() -> None:
    octree = octree_from_dense(np.ones((16, 16, 16), bool))
    octree.validate()
    assert octree.nodes.tolist() == [(0, int(INSIDE))]
    assert octree.count == 16**3


def corrupt(name: str, index: Any, value: Any) -> Callable[[Octree], Octree]:
    def change(octree: Octree) -> Octree:
        array = getattr(octree, name).copy()
        if isinstance(index, tuple):
            array[index[0]][index[1]] = value
        else:
            array[index] = value
        return replace(octree, **{name: array})

    return change


# golden_octree: offsets 0 1 9 25 121; the root and its first two children are refined
CORRUPTIONS = {
    "levels, but a grid": lambda o: replace(o, offsets=o.offsets[:-1]),
    "and ascend": corrupt("offsets", 0, 1),
    "not a multiple of 8": corrupt("offsets", 2, 10),
    "more nodes than the level above": corrupt("offsets", 2, 17),
    "they end at": lambda o: replace(o, nodes=o.nodes[:-8]),
    "octree bricks: 95 for 96": lambda o: replace(o, bricks=o.bricks[:-1]),
    "octree children: 1 refined nodes": corrupt("nodes", (1, "child"), 0),
    "inside flag of a refined node": corrupt("nodes", (0, "child"), VALID | INSIDE),
    "brick link": corrupt("nodes", (30, "child"), VALID | np.uint32(6)),
    "child link": corrupt("nodes", (2, "child"), VALID | np.uint32(16)),
    r"leaf \(link bits": corrupt("nodes", (3, "child"), 8),
    "inside flag of a surface": lambda o: replace(
        corrupt("nodes", (3, "child"), INSIDE)(o), mode="surface26"
    ),
    "parent link of the root": corrupt("nodes", (0, "parent"), VALID),
    r"parent link \(the parent": corrupt("nodes", (100, "parent"), VALID),
    "octree padding: level 2, node 5": corrupt("nodes", (6, "child"), INSIDE),
    "octree padding: level 0": corrupt("bricks", slice(None), np.uint64(2**64 - 1)),
}


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_validate_names_the_broken_invariant(octree: Octree, name: str) -> None:
    with pytest.raises(FileError, match=name):
        CORRUPTIONS[name](octree).validate()


@given(shape=st.tuples(*[st.integers(1, 20)] * 3).filter(lambda s: max(s) >= 8), data=st.data())
@settings(max_examples=60)
def test_validate_finds_any_voxel_beyond_the_shape(shape, data) -> None:
    wide = (32, 32, 32) if max(shape) > 16 else (16, 16, 16) if max(shape) > 8 else (8, 8, 8)
    voxel = tuple(data.draw(st.integers(0, n - 1)) for n in wide)
    dense = np.zeros(wide, bool)
    dense[voxel] = True
    big = octree_from_dense(dense)
    small = replace(big, grid=Grid(shape, big.grid.origin, big.grid.pitch))
    if all(v < n for v, n in zip(voxel, shape, strict=True)):
        small.validate()
    else:
        with pytest.raises(FileError, match="padding"):
            small.validate()


def test_digest_is_stable_and_sensitive(octree: Octree) -> None:
    grid = octree.grid
    nodes, bricks = octree.nodes.copy(), octree.bricks.copy()
    nodes["parent"][7] ^= 1
    bricks[3] ^= np.uint64(1)
    changed = [
        octree,
        replace(octree, mode="surface26"),
        replace(octree, fill="none"),
        replace(octree, grid=replace(grid, shape=(19, 16, 12))),
        replace(octree, grid=replace(grid, origin=(-1.5, 0.1, np.nextafter(1e-3, 1)))),
        replace(octree, grid=replace(grid, pitch=(0.1, 0.1, 0.2))),
        replace(octree, nodes=nodes),
        replace(octree, bricks=bricks),
    ]
    assert len({o.digest() for o in changed}) == len(changed)
    unrelated = replace(octree, plan={}, source_sha256="", units="")
    assert unrelated.digest() == octree.digest() == GOLDEN_DIGEST


# Round trips


@pytest.mark.parametrize("name", ["v1.0.svo.h5", "v1.0.svo.xml"])
def test_golden_files_of_version_1_0_read_for_good(name: str) -> None:
    golden = files.read_svo(DATA / name)
    assert golden.digest() == GOLDEN_DIGEST
    assert_same(golden, golden_octree())


@given(dense=dense_arrays())
@settings(max_examples=40)
def test_hdf5_to_xml_to_hdf5_changes_nothing(dense: np.ndarray) -> None:
    plan = {"b": [1, 2.5, None, True, "ř\n<&\"'"], "a": {"nested": 1e-300}}
    octree = octree_from_dense(dense, plan=plan, units="µm", source_sha256="0f" * 32)
    first = to_bytes(octree, "svo.h5")
    for extension in ("svo.xml", "svo.xml.gz"):
        one = from_bytes(first, "svo.h5")
        two = from_bytes(to_bytes(one, extension), extension)
        assert_same(two, octree)
        assert to_bytes(two, "svo.h5") == first


@given(
    origin=st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3),
    pitch=st.tuples(*[st.floats(min_value=5e-324, allow_infinity=False)] * 3),
)
@settings(max_examples=50)
def test_every_float_survives(origin, pitch) -> None:
    octree = replace(golden_octree(), grid=Grid((19, 16, 11), origin, pitch))
    for extension in ("svo.h5", "svo.xml"):
        back = from_bytes(to_bytes(octree, extension), extension).grid
        assert [v.hex() for v in back.origin] == [v.hex() for v in octree.grid.origin]
        assert [v.hex() for v in back.pitch] == [v.hex() for v in octree.grid.pitch]


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_bytes_depend_on_the_content_alone(octree, extension, tmp_path) -> None:
    for name in ("a", "b"):
        files.write_svo(octree, tmp_path / f"{name}.{extension}")
    one, two = ((tmp_path / f"{n}.{extension}").read_bytes() for n in "ab")
    assert one == two


@pytest.mark.parametrize("extension", [*EXTENSIONS, "h5", "xml", "XML.GZ"])
def test_format_is_chosen_by_extension_and_read_by_content(octree, extension, tmp_path) -> None:
    path = tmp_path / f"a.{extension}"
    files.write_svo(octree, path)
    opening = {"h5": b"\x89HDF", "xml": b"<?xml", "gz": b"\x1f\x8b"}
    assert path.read_bytes().startswith(opening[extension.lower().split(".")[-1]])
    moved = path.rename(tmp_path / "no-extension")
    assert_same(files.read_svo(moved), octree)


def test_format_overrides_the_extension(octree: Octree, tmp_path: Path) -> None:
    files.write_svo(octree, tmp_path / "a.dat", format="svo.xml")
    assert_same(files.read_svo(str(tmp_path / "a.dat")), octree)
    with pytest.raises(FileError, match=r"format 'obj' is unknown: choose one of svo\.h5"):
        files.write_svo(octree, tmp_path / "b.dat", format="obj")
    with pytest.raises(FileError, match=r"b\.dat: the name says no format: end it in one of"):
        files.write_svo(octree, tmp_path / "b.dat")
    assert [p.name for p in tmp_path.iterdir()] == ["a.dat"]


def test_datasets_can_be_uploaded_as_they_lie(octree: Octree, tmp_path: Path) -> None:
    path = tmp_path / "a.svo.h5"
    files.write_svo(octree, path)
    with h5py.File(path) as h5:
        assert list(h5) == ["bricks", "nodes", "offsets"]
        for name, array in (("nodes", octree.nodes), ("bricks", octree.bricks)):
            assert h5[name].chunks is None
            start = h5[name].id.get_offset()
            raw = path.read_bytes()[start : start + array.nbytes]
            assert raw == array.tobytes()


def test_xml_is_valid_by_the_packaged_dtd(octree: Octree) -> None:
    from lxml import etree

    with skeleton.DTD.open("rb") as file:
        dtd = etree.DTD(file)
    for o in (octree, octree_from_dense(np.zeros((9, 8, 8), bool))):
        assert dtd.validate(etree.fromstring(to_bytes(o, "svo.xml"))), dtd.error_log


def test_plain_xml_needs_dim_alone() -> None:
    text = b"""<octree dim='8'><offset> 0 1\n9 </offset><levels><level>
      <node child="1073741824" parent="0"/></level><level>%s</level></levels>
      <subgrid size="16">%s<bitmask> 7 </bitmask></subgrid></octree>""" % (
        b"".join(b'<node parent="1073741824" child="%d"/>' % (VALID + n) for n in range(8)),
        b"<!-- low half first --><bitmask>0</bitmask>" * 15,
    )
    octree = from_bytes(text, "svo.xml")
    assert octree.grid == Grid((8, 8, 8), (0, 0, 0), (1, 1, 1))  # pyright: ignore
    assert octree.bricks.tolist() == [0] * 7 + [7 << 32]


# Streams


def cli(code: str, data: bytes = b"", **options) -> subprocess.CompletedProcess:
    program = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "from helpers_octree import golden_octree; from voxtool import files\n"
        "from voxtool.errors import VoxtoolError\n"
        f"try:\n    {code}\n"
        "except VoxtoolError as error:\n    print(error, file=sys.stderr); sys.exit(1)\n"
    )
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "timeout": 60} | options
    return subprocess.run([sys.executable, "-c", program], input=data, cwd=ROOT, **options)


def test_stdin_and_stdout(octree: Octree) -> None:
    done = cli("files.write_svo(files.read_svo('-'), '-')", to_bytes(octree, "svo.xml.gz"))
    assert done.returncode == 0, done.stderr
    assert_same(from_bytes(done.stdout, "svo.h5"), octree)
    done = cli("files.write_svo(files.read_svo('-'), '-', format='xml')", done.stdout)
    assert_same(from_bytes(done.stdout, "svo.xml"), octree)


def test_broken_pipe_is_no_traceback() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = cli("files.write_svo(golden_octree(), '-')", stdout=writer)
    os.close(writer)
    assert done.returncode == 1
    assert done.stderr == b"standard output was closed before all was written\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_full_stdout_is_no_traceback() -> None:
    with open("/dev/full", "wb") as full:
        done = cli("files.write_svo(golden_octree(), '-')", stdout=full)
    assert done.returncode == 1
    assert done.stderr.startswith(b"cannot write standard output: the disk is full: ")


def test_empty_stdin() -> None:
    assert cli("files.read_svo('-')").stderr == b"stdin is empty\n"


@pytest.mark.skipif(os.name != "posix", reason="POSIX only")
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_disk_full_leaves_the_old_file(octree, extension, tmp_path) -> None:
    path = tmp_path / f"a.{extension}"
    path.write_bytes(b"old")
    limit = "__import__('resource').setrlimit(__import__('resource').RLIMIT_FSIZE, (900, 900))"
    done = cli(f"{limit}; files.write_svo(golden_octree(), {str(path)!r})")
    assert done.returncode == 1
    assert re.fullmatch(rb"cannot write .*: the file would be larger than .*\n", done.stderr)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


# Files of the wrong kind


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("bunny.obj", b"v 0 0 0\n", r"bunny\.obj is a mesh: voxelize it first \(voxtool voxel"),
        ("bunny", b"ply\nformat ascii 1.0\n", "is a mesh: voxelize it first"),
        ("bunny.stl", b"\0" * 84, "is a mesh: voxelize it first"),
        ("a.svo.h5", b"", "is empty"),
        ("a.svo.h5", b"hello", "is no octree: expected HDF5"),
        ("a.npy", b"\x93NUMPY", "is an export: read the .svo.h5"),
        ("a.xml", b'<?xml version="1.0"?><VTKFile/>', "not an octree: its root is VTKFile"),
        ("a.gz", gzip.compress(b"hello", mtime=0), "no well-formed XML"),
        ("a.svo.h5", b"\x89HDF\r\n\x1a\n", "damaged HDF5 file"),
    ],
)
def test_file_of_another_kind(tmp_path, name, data, message) -> None:
    (tmp_path / name).write_bytes(data)
    refusal(tmp_path / name, message)


def refusal(path: Path, message: str) -> None:
    helpers_files.refusal(files.read_svo, path, message)


def test_no_such_file_and_a_folder(tmp_path: Path) -> None:
    refusal(tmp_path / "none.svo.h5", "there is no such file")
    refusal(tmp_path, "is a folder")


# Hostile HDF5


def hostile(folder: Path, change: Callable[[h5py.File], None]) -> Path:
    files.write_svo(golden_octree(), folder / "a.svo.h5")
    return changed_h5(folder / "a.svo.h5", change)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("format", text("voxtool-adf"), "holds 'voxtool-adf', not an octree"),
        ("format", None, "attribute format=voxtool-svo is missing"),
        ("format_version", text("2.0"), "written in format 2.0, newer .*: update voxtool"),
        ("format_version", text("0.9"), "written in format 0.9, older"),
        ("format_version", text("1"), "no version"),
        ("format_version", 1.0, "attribute format_version is not text"),
        ("creator", "variable", "text of variable length"),
        ("creator", text("\x1b[2J"), "cannot be printed"),
        ("creator", np.bytes_(b"\xff\xfe"), "not UTF-8"),
        ("dim", None, "attribute dim is missing"),
        ("dim", 20, "attribute dim is '20' where 19"),
        ("dim", 19.0, "attribute dim is not of type int"),
        ("dim", [19, 19], "attribute dim is not one value"),
        ("dim", h5py.Empty("i8"), "attribute dim is not one value"),
        ("dim", h5py.Reference, "attribute dim is not"),
        ("depth", 3, "attribute depth is '3' where 4"),
        ("depth", 2**62, "attribute depth is"),
        ("shape", [19, 16], "attribute shape has shape"),
        ("shape", [2**40, 16, 11], "the longest side must have"),
        ("shape", [-1, 16, 11], "the longest side must have"),
        ("mode", text("smoke"), "attribute mode is 'smoke' where surface26 or"),
        ("fill", text("../x"), "attribute fill"),
        ("origin", [np.nan, 0, 0], "origin .* is not finite"),
        ("origin", [np.inf, 0, 0], "origin .* is not finite"),
        ("origin", [1, 2, 3], "attribute origin is not of type float"),
        ("pitch", [0.1, 0.1, -0.1], "voxel size .* is not positive"),
        ("pitch", [0.1, 0.1, np.nan], "voxel size .* is not positive"),
        ("units", text("m" * 65), "attribute units has 65 bytes: at most 64"),
        ("source_sha256", text("zz"), "source_sha256 is not 64 hexadecimal digits"),
        ("plan", text("{"), "plan is not JSON"),
        ("plan", text("[]"), "plan is not a JSON object"),
        ("plan", text('{"a": NaN}'), "plan is not JSON"),
        ("plan", text('{"a": 1e999}'), "plan is not JSON"),
        ("plan", text('{"a": ' + "9" * 5000 + "}"), "plan is not JSON"),
        ("plan", text('{"a": "\\ud800"}'), "plan is not JSON"),
        ("plan", text("[" * 50_000), "plan is not JSON"),
    ],
)
def test_hdf5_attributes(tmp_path, name, value, message) -> None:
    if value is h5py.Reference:
        value = np.zeros((), [("a", "<i8"), ("b", "<i8")])  # a compound
    refusal(hostile(tmp_path, attribute(name, value)), message)


def test_newer_minor_version_reads(tmp_path: Path) -> None:
    assert_same(files.read_svo(hostile(tmp_path, newer_minor_version)), golden_octree())


def instead_of_nodes(make: Callable[[h5py.File, np.ndarray], object]) -> Callable:
    """A change: something else is called nodes."""

    def change(h5: h5py.File) -> None:
        data = h5["nodes"][()]  # pyright: ignore
        del h5["nodes"]
        make(h5, data)  # pyright: ignore

    return change


def virtual(h5: h5py.File, data: np.ndarray) -> None:
    h5["real"] = data
    layout = h5py.VirtualLayout(data.shape, data.dtype)
    layout[:] = h5py.VirtualSource(".", "real", data.shape)
    h5.create_virtual_dataset("nodes", layout)


def link_to(link: object) -> Callable[[h5py.File, np.ndarray], None]:
    return lambda h5, data: h5.__setitem__("nodes", link)


def external_storage(h5: h5py.File, data: np.ndarray) -> None:
    spec = [("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
    h5.create_dataset("nodes", data.shape, data.dtype, external=spec)


def huge(h5: h5py.File, data: np.ndarray) -> None:
    h5.create_dataset("nodes", (1 << 40, 2), data.dtype)  # never written: no storage


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (stored("nodes", lambda d: None), "dataset nodes is missing"),
        (instead_of_nodes(lambda h5, d: h5.create_group("nodes")), "is not a dataset"),
        (instead_of_nodes(virtual), "nodes is not contiguous"),
        (
            instead_of_nodes(link_to(h5py.ExternalLink("/etc/passwd", "/nodes"))),
            "nodes is a link",
        ),
        (instead_of_nodes(link_to(h5py.SoftLink("/bricks"))), "nodes is a link"),
        (instead_of_nodes(external_storage), "nodes lies in another file"),
        (instead_of_nodes(huge), "bytes that the file does not have"),
        (
            stored("nodes", lambda d: d, compression=9),
            "nodes is not contiguous",
        ),
        (
            stored("nodes", lambda d: d, chunks=(8, 2)),
            "nodes is not contiguous",
        ),
        (stored("nodes", lambda d: d.astype("f4")), "type"),
        (stored("nodes", lambda d: d.astype(">u4")), "type"),
        (stored("nodes", lambda d: d.astype("i4")), "type"),
        (stored("nodes", lambda d: d[:, 0]), "has shape"),
        (
            stored("nodes", lambda d: d[:-1]),
            "they end at",
        ),
        (stored("bricks", lambda d: d[1:]), "95 for 96"),
        (
            stored("bricks", lambda d: d.astype("u4")),
            "bricks is not of type uint64",
        ),
        (
            stored("offsets", lambda d: d * 0),
            "and ascend",
        ),
        (
            stored("offsets", lambda d: d[1:]),
            "has shape",
        ),
        (stored("offsets", lambda d: "x"), "not of type"),
        (lambda h5: h5["nodes"].write_direct(h5["nodes"][()] ^ 1), "octree"),
    ],
)
def test_hdf5_datasets(tmp_path: Path, change: Callable, message: str) -> None:
    with memory_below(8 << 20):
        refusal(hostile(tmp_path, change), message)


# Hostile XML


def edited(old: str, new: str, count: int = 1) -> bytes:
    whole = to_bytes(golden_octree(), "svo.xml").decode()
    assert old in whole
    return whole.replace(old, new, count).encode()


LAUGHS = "".join(f'<!ENTITY l{n} "{f"&l{n - 1};" * 10}">' for n in range(1, 10))
BOMB = f'<!DOCTYPE octree [<!ENTITY l0 "lol">{LAUGHS}]>'
OPENING = '<?xml version="1.0" encoding="UTF-8"?>'
DOCTYPE = OPENING + '<!DOCTYPE octree SYSTEM "octree.dtd">'
FIRST_NODE = '<node parent="0" child="1073741824"/>'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (OPENING, BOMB, "internal subset is refused"),
        (OPENING, "<!DOCTYPE octree [<!ELEMENT octree ANY>]>", "internal subset"),
        (OPENING, '<!DOCTYPE o [<!ENTITY x SYSTEM "file:///etc/passwd">]>', "internal subset"),
        (OPENING, '<!DOCTYPE o [<!ENTITY % x SYSTEM "http://a/">%x;]>', "internal subset"),
        ('units="mm"', 'units="&l9;"', "undefined entity"),
        ("<offset>", "<offset>&l9;", "undefined entity"),
        ("<offset>", "<?php 1?><offset>", "processing instructions are refused"),
        ("<bitmask>", "<bitmask><bitmask>", "element bitmask inside bitmask"),
        (FIRST_NODE, FIRST_NODE[:-2] + "> 1</node>", "text inside a node"),
        (FIRST_NODE, FIRST_NODE[:-2] + ' x="1"/>', "two attributes parent and child"),
        (FIRST_NODE, FIRST_NODE.replace("child", "kid"), "two attributes parent and child"),
        (FIRST_NODE, "", r"level element 1 has 0 nodes, not 1"),
        (FIRST_NODE, FIRST_NODE * 2, "more than the 242 node words|level element 1 has 2"),
        (FIRST_NODE, FIRST_NODE.replace("1073741824", "4294967296"), "no unsigned 32-bit"),
        (FIRST_NODE, FIRST_NODE.replace("1073741824", "-1"), "'-1' is no unsigned 32-bit"),
        (FIRST_NODE, FIRST_NODE.replace("1073741824", "1 2"), "two numbers where one goes"),
        (FIRST_NODE, FIRST_NODE.replace("1073741824", "٣"), "no unsigned 32-bit"),
        (FIRST_NODE, FIRST_NODE.replace("1073741824", "9" * 9000), "no unsigned 32-bit"),
        ("<bitmask>0</bitmask>", "<bitmask/>", "'' is no unsigned 32-bit number"),
        ("<bitmask>0</bitmask>", "", "191 bitmasks where 192 are declared"),
        ("<bitmask>0", "<bitmask>0x10", "no unsigned 32-bit"),
        ('<subgrid size="192">', "<subgrid>", "not by octree.dtd: .*size"),
        ('<subgrid size="192">', '<subgrid size="9">', "size '9' where the offsets say 192"),
        ('  size="121"', '  size="1000"', "size '1000' where the offsets say 121"),
        ("0 1 9 25 121<", "0 1 9 25<", "levels, but a grid of dim 19 has 4"),
        ("0 1 9 25 121<", "0 1 9 25 28<", "not a multiple of 8"),
        ("0 1 9 25 121<", "0 1 9 73 585<", "declared, which the file cannot hold|size '121'"),
        ("<levels>", "<other/><levels>", "element other inside octree"),
        ("<levels>", "<levels>" + "<level></level>" * 100, "more elements than an octree has"),
        ("</octree>", "<offset>0 1</offset></octree>", "not the first thing"),
        ("</octree>", '<subgrid size="192"/></octree>', "not by octree.dtd"),
        ("<levels>", "<levels>text", "text 'text' inside levels"),
        ("<octree", "<tree><octree", "not an octree: its root is tree"),
        ("<octree", '<octree foo="1"', "not by octree.dtd: .*foo"),
        ("<octree", '<octree a:b="1"', "namespaces are refused"),
        ('"1.0"\n', '"2.0"\n', "written in format 2.0, newer"),
        ('dim="19"', "", "attribute dim is missing"),
        ('dim="19"', 'dim="999999999999999999999"', "attribute dim is"),
        ('dim="19"', 'dim="1_9"', "attribute dim is"),
        ('shape="19 16 11"', 'shape="19 16"', "attribute shape is"),
        ('origin="-1.5', 'origin="nan', "attribute origin is"),
        ('origin="-1.5', 'origin="1e999', "origin .* is not finite"),
        ('pitch="0.1', 'pitch="-0.1', "is not positive"),
        ('mode="solid"', 'mode="x"', "attribute mode"),
        ("plan='{", "plan='[{", "plan is not JSON"),
        ("<offset>", f"<!--{'x' * 400_000}--><offset>", "a tag or comment of more than"),
        ("<offset>", f"{' ' * 1_500_000}<offset>", "more text than its declared sizes"),
        ("<levels>", f"<levels>{'<!---->' * 300_000}", "more text than its declared sizes"),
        ('units="mm"', 'units="' + "m" * 65 + '"', "attribute units has 65 bytes"),
    ],
)
def test_xml(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "a.svo.xml").write_bytes(edited(old, new))
    with pytest.raises(VoxtoolError, match=message) as caught:
        files.read_svo(tmp_path / "a.svo.xml")
    assert "\n" not in str(caught.value)


def test_xml_with_a_doctype_reads_and_fetches_nothing() -> None:
    assert_same(from_bytes(edited(OPENING, DOCTYPE), "svo.xml"), golden_octree())


@pytest.mark.parametrize("old", ['units="', "<offset>", '<node parent="', "<bitmask>"])
@pytest.mark.parametrize("padding", range(65_300, 65_540, 16))
def test_entities_after_a_doctype_are_refused(old: str, padding: int) -> None:
    doctype = f"{DOCTYPE}<!--{' ' * padding}-->"  # the reference meets the end of a chunk
    data = edited(OPENING, doctype).replace(old.encode(), f"{old}&x;".encode(), 1)
    with pytest.raises(FileError, match="entities are refused"):
        from_bytes(data, "svo.xml")
    data = edited(OPENING, doctype).replace(old.encode(), f"{old}&#x20;".encode(), 1)
    if "node" not in old:  # a number there is strict: no spaces
        assert_same(replace(from_bytes(data, "svo.xml"), units="mm"), golden_octree())


def test_xml_error_names_the_line(tmp_path: Path) -> None:
    (tmp_path / "a.svo.xml").write_bytes(edited("<levels>", "<levels><oops/>"))
    refusal(tmp_path / "a.svo.xml", r"a\.svo\.xml: line 17: element oops inside levels")


def test_xml_in_utf16_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.svo.xml").write_bytes(
        to_bytes(golden_octree(), "svo.xml").decode().encode("u16")
    )
    refusal(tmp_path / "a.svo.xml", "no octree")


def test_xml_newer_minor_version_reads() -> None:
    data = edited('format_version="1.0"', 'format_version="1.4" labels="none"')
    assert_same(from_bytes(data, "svo.xml"), golden_octree())


def test_gzip_bomb_takes_neither_memory_nor_time(tmp_path: Path) -> None:
    head = to_bytes(golden_octree(), "svo.xml").split(b"<levels>")[0]
    row = b'<node parent="0" child="0"/>\n'
    for bomb in (b" " * 200_000_000, b"<levels><level>" + row * 7_000_000):
        path = tmp_path / "a.svo.xml.gz"
        path.write_bytes(gzip.compress(head + bomb, 1, mtime=0))
        with memory_below(4 << 20):
            refusal(path, "more text than its declared|more than the 242 node words")


@pytest.mark.parametrize("extension", ["svo.xml", "svo.xml.gz"])
def test_declared_nodes_that_the_file_cannot_hold(tmp_path: Path, extension: str) -> None:
    text = b'<octree dim="65536"><offset>0 1 9 73 585 4681 37449 299593 2396745 19173961 '
    text += b"153391689 %d %d %d %d %d</offset><levels>" % (*[1000000009] * 4, 1000000009)
    path = tmp_path / f"a.{extension}"
    path.write_bytes(gzip.compress(text, mtime=0) if extension.endswith("gz") else text)
    with memory_below(4 << 20):
        refusal(path, "1000000009 nodes are declared, which the file cannot hold")


# Damage of any kind


@pytest.mark.slow
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_damage_of_any_kind(octree: Octree, extension: str) -> None:
    def read(data: bytes) -> Octree:
        found = from_bytes(data, extension)
        assert np.count_nonzero(found.to_dense()) == found.count
        return found

    data = to_bytes(octree, extension)
    check_truncated(data, read)
    for seed in range(2):
        check_mutants(data, read, seed, least=80)


# What cannot be written


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"plan": {"a": "x" * 70_000}}, "plan has .* bytes: at most 60000 fit"),
        ({"units": "m" * 100}, "units has 100 bytes"),
        ({"units": "a\nb"}, "cannot be printed"),
        ({"units": "\ud800"}, "not Unicode"),
    ],
)
def test_what_would_not_read_is_not_written(octree, extension, change, message, tmp_path) -> None:
    with pytest.raises(FileError, match=message):
        files.write_svo(replace(octree, **change), tmp_path / f"a.{extension}")
    assert list(tmp_path.iterdir()) == []


def test_no_clobber(octree: Octree, tmp_path: Path) -> None:
    path = tmp_path / "a.svo.h5"
    files.write_svo(octree, path, clobber=False)
    with pytest.raises(FileError, match="exists"):
        files.write_svo(octree, path, clobber=False)
    with pytest.raises(FileError, match="exists"):
        files.export(octree, path, clobber=False, format="npy")
    assert_same(files.read_svo(path), octree)


# Exports


@given(dense=dense_arrays())
@settings(max_examples=40)
def test_layers_are_the_dense_array(dense: np.ndarray) -> None:
    for mode in ("solid", "surface26"):
        octree = octree_from_dense(dense, mode, "none")
        for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
            found = np.concatenate(list(layers.layers(octree, order)))
            assert np.array_equal(found, dense.transpose(order))
        found = np.concatenate(list(layers.coordinates(octree)))
        assert np.array_equal(found, np.argwhere(dense))


@pytest.fixture
def dense() -> np.ndarray:
    return ball((40, 33, 21))


def exported(dense: np.ndarray, path: Path, **options) -> Path:
    files.export(octree_from_dense(dense), path, **options)
    first = path.read_bytes()
    files.export(octree_from_dense(dense), path, **options)
    assert path.read_bytes() == first  # no time, no chance
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


def test_vti_opens_in_vtk(dense: np.ndarray, tmp_path: Path) -> None:
    reader_module = pytest.importorskip("vtkmodules.vtkIOXML")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    reader = reader_module.vtkXMLImageDataReader()
    reader.SetFileName(str(exported(dense, tmp_path / "a.vti")))
    reader.Update()
    image = reader.GetOutput()
    assert image.GetDimensions() == (41, 34, 22)
    assert image.GetOrigin() == (-1.5, 0.1, 1e-3)
    assert image.GetSpacing() == (0.1, 0.1, 0.1)
    cells = image.GetCellData().GetScalars()
    assert cells.GetName() == "occupancy"
    assert np.array_equal(vtk_to_numpy(cells).reshape(21, 33, 40), dense.transpose(2, 1, 0))


def huge_octree() -> Octree:
    """One inside leaf in a grid of 65,536**3: its dense array has 281 TB."""
    nodes = golden_octree().nodes[:1].copy()
    nodes["child"] = INSIDE
    offsets = np.array([0] + [1] * 15, np.uint32)
    octree = Octree(
        Grid((65536,) * 3, (0, 0, 0), (1, 1, 1)),  # pyright: ignore[reportArgumentType]
        "solid",
        "parity",
        offsets,
        nodes,
        np.empty(0, np.uint64),
    )
    octree.validate()
    return octree


@pytest.mark.parametrize("extension", ["npy", "vti", "npz"])
def test_export_larger_than_the_disk_is_refused(tmp_path: Path, extension: str) -> None:
    with pytest.raises(FileError, match=r"would take .* TB .* free: choose"):
        files.export(huge_octree(), tmp_path / f"a.{extension}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("extension", ["npy", "png"])
def test_export_larger_than_memory_is_refused(tmp_path, extension, monkeypatch) -> None:
    monkeypatch.setattr(memory, "available_memory", lambda: 1 << 30)
    monkeypatch.setattr(memory, "check_disk", lambda *_: None)
    with pytest.raises(MemoryLimitError, match=r"1\.07 GB are free: choose a smaller dim"):
        files.export(huge_octree(), tmp_path / f"a.{extension}")
    assert list(tmp_path.iterdir()) == []


def test_export_by_an_unknown_name(dense: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"end it in one of \.npy, \.npz, \.vti, \.png"):
        files.export(octree_from_dense(dense), tmp_path / "a.vox")


def test_large_empty_space_costs_nothing(tmp_path: Path) -> None:
    for extension in EXTENSIONS:
        files.write_svo(huge_octree(), tmp_path / f"a.{extension}")
        assert files.read_svo(tmp_path / f"a.{extension}").count == 65536**3


def test_importing_files_is_light() -> None:
    code = "import sys, voxtool.files; print([m for m in ('h5py', 'lxml', 'PIL', 'numpy') "
    code += "if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, check=True)
    assert done.stdout == b"[]\n"
