"""Octrees, fields and volumes as files: what is written is read, and what is damaged, hostile or of
another kind is refused in one line.

The golden files in tests/data stay for good. They were made once, at the format version in their
names, by write_svo, write_adf and write_tet of the contents that GOLDEN names.
"""

from __future__ import annotations

import gzip
import io
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
from helpers import files as helpers_files
from helpers.files import (
    DATA,
    FIELDS,
    LIMITED,
    assert_same,
    attribute,
    changed_h5,
    check_damaged,
    constant_volume,
    edited,
    flat_volume,
    golden_field,
    golden_volume,
    memory_below,
    newer_minor_version,
    replaced,
    run_python,
    stored,
    text,
)
from helpers.octree import golden_octree, octree_from_dense
from helpers.tets import CUBE, assembly, built, tet_mesh
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool import files
from voxtool.arrays import Blocks
from voxtool.choices import LAYOUTS
from voxtool.errors import FileError
from voxtool.files.cells import tet_hdf5
from voxtool.files.fields import adf_hdf5
from voxtool.files.octrees import svo_hdf5
from voxtool.files.storage import hdf5
from voxtool.files.storage.schema import Schema
from voxtool.svo.octree.octree import Octree


class Kind(NamedTuple):
    write: Callable[..., None]
    read: Callable[..., Any]
    schema: Schema
    golden: Callable[[], Any]
    other: Callable[[], Any]


def empty_octree() -> Octree:
    return octree_from_dense(np.zeros((9, 8, 8), bool))


KINDS = {
    "svo": Kind(files.write_svo, files.read_svo, svo_hdf5.SCHEMA, golden_octree, empty_octree),
    "adf": Kind(files.write_adf, files.read_adf, adf_hdf5.SCHEMA, golden_field, FIELDS["root"]),
    "tet": Kind(files.write_tet, files.read_tet, tet_hdf5.SCHEMA, golden_volume, constant_volume),
}
every_kind = pytest.mark.parametrize("kind", KINDS)

SVO_DIGEST = "7c2efdb1b391a600c595306787826bf25a4f5b5e1210126d331c654aa2352fe3"
ADF_DIGEST = "67e856b7cee1f03fcf2f83c91803bb797da8325a3b50f5ceadf5909685063b49"
TET_DIGESTS = {
    "raycast": "7b3bb672fec2c1312ad7608768ad69b709e5d252bb51cf81e5b4f69c98346a3a",
    "projection": "4fe50048e0c28e981f24674a346bd4602f3395c5e3631361ea2ea8ec7e63f943",
    "hexahedra": "b7e7a040a23af2235668cfd795794f8146ae950a1c1aefd06f1e7bffb79fd7ca",
}
GOLDEN: dict[str, tuple[Callable[[], Any], str]] = {
    "v1.0.svo.h5": (golden_octree, SVO_DIGEST),
    "v1.0.svo.xml": (golden_octree, SVO_DIGEST),
    "v2.0.svo.h5": (golden_octree, SVO_DIGEST),
    "v1.0.adf.h5": (golden_field, ADF_DIGEST),
    "v2.0.adf.h5": (golden_field, ADF_DIGEST),
    "v1.0.tet.h5": (golden_volume, TET_DIGESTS["raycast"]),
    "v1.0-projection.tet.h5": (lambda: golden_volume("projection"), TET_DIGESTS["projection"]),
    "v1.0-hexahedra.tet.h5": (lambda: golden_volume("hexahedra"), TET_DIGESTS["hexahedra"]),
    "v2.0.tet.h5": (golden_volume, TET_DIGESTS["raycast"]),
    "v2.0-projection.tet.h5": (lambda: golden_volume("projection"), TET_DIGESTS["projection"]),
    "v2.0-hexahedra.tet.h5": (lambda: golden_volume("hexahedra"), TET_DIGESTS["hexahedra"]),
}

CONTENTS: dict[str, Callable[[], Any]] = {
    "svo": golden_octree,
    "svo empty": empty_octree,
    **{f"adf {name}": make for name, make in FIELDS.items()},
    "adf of large texts": lambda: replace(
        golden_field(), plan={"a": "x" * 59_000}, reached={"a": "y" * 59_000}
    ),
    **{f"tet {layout}": lambda layout=layout: golden_volume(layout) for layout in LAYOUTS},
    "tet constant": constant_volume,
    "tet flat": flat_volume,
    "tet one": lambda: built(tet_mesh(CUBE[[0, 1, 3, 4]], [(0, 1, 2, 3)])),
    "tet many": lambda: built(assembly((4, 4, 3), 1)),
}


def to_bytes(schema: Schema, content: Any) -> bytes:
    file = io.BytesIO()
    hdf5.write(schema, content, file)
    return file.getvalue()


def from_bytes(schema: Schema, data: bytes) -> Any:
    return hdf5.read([schema], io.BytesIO(data), len(data))


# Round trips


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_files_of_every_version_read_for_good(name: str) -> None:
    make, digest = GOLDEN[name]
    golden = files.read_scene(DATA / name)
    assert golden.digest() == digest
    assert_same(golden, make())


@pytest.mark.parametrize("name", CONTENTS)
def test_what_is_written_is_read(name: str, tmp_path: Path) -> None:
    """The datasets can be uploaded as they lie, and the bytes depend on the content alone."""
    content, kind = CONTENTS[name](), KINDS[name[:3]]
    path = tmp_path / f"a.{name[:3]}.h5"
    kind.write(content, path)
    found = kind.read(path)
    assert_same(found, content)
    assert_same(files.read_scene(path), content)
    assert path.read_bytes() == to_bytes(kind.schema, found)
    with h5py.File(path) as h5:
        for dataset in kind.schema.datasets:
            array = dataset.encode(content, dict(h5.attrs))
            if isinstance(array, Blocks):
                array = np.concatenate(list(array.blocks))
            assert (dataset.name in h5) == (array is not None)
            if array is not None and array.size:
                written = h5[dataset.name]
                assert isinstance(written, h5py.Dataset)
                start = written.id.get_offset()
                assert written.chunks is None
                assert path.read_bytes()[start : start + array.nbytes] == array.tobytes()


@given(
    origin=st.tuples(*[st.floats(-1.0, 1.0)] * 3),  # a cube has to be one
    side=st.floats(1e-9, 1e250),
    tolerance=st.floats(min_value=0, allow_infinity=False),
    band=st.floats(min_value=0),
    lipschitz=st.floats(min_value=0, allow_infinity=False),
)
@settings(max_examples=50)
def test_every_float_survives(**head) -> None:
    field = replace(golden_field(), **head)
    assert_same(from_bytes(adf_hdf5.SCHEMA, to_bytes(adf_hdf5.SCHEMA, field)), field)


def test_what_differs_shows_in_the_digest() -> None:
    octree, volume = golden_octree(), golden_volume()
    nodes, bricks = octree.nodes.copy(), octree.bricks.copy()
    nodes["parent"][7] ^= 1
    bricks[3] ^= np.uint64(1)
    moved = replace(octree.grid, origin=(-1.5, 0.1, np.nextafter(1e-3, 1)))
    octrees = [{"mode": "surface26"}, {"fill": "none"}, {"nodes": nodes}, {"bricks": bricks}]
    octrees += [{"grid": replace(octree.grid, pitch=(0.1, 0.1, 0.2))}, {"grid": moved}]
    octrees += [{"grid": replace(octree.grid, shape=(19, 16, 12))}]
    volumes = [{"scale": 2 * volume.scale}, {"origin": (0.0, 0.0, 1.0)}, {"scalar": "t"}]
    volumes += [{"scalar_range": (0.0, 1.0)}, {"vertices": np.roll(volume.vertices, 1, axis=0)}]
    for content, changes in ((octree, octrees), (volume, volumes)):
        digests = {replace(content, **change).digest() for change in changes}
        assert len({content.digest(), *digests}) == len(changes) + 1
        same = replace(content, units="m", plan={}, source_sha256="")
        assert same.digest() == content.digest()


# Names and streams


@every_kind
def test_format_is_chosen_by_extension_and_read_by_content(kind: str, tmp_path: Path) -> None:
    write, read, _, golden, _ = KINDS[kind]
    for name in (f"a.{kind}.h5", "a.h5", f"A.{kind}.H5".upper()):
        write(golden(), tmp_path / name)
        assert_same(read((tmp_path / name).rename(tmp_path / "no-extension")), golden())
    write(golden(), tmp_path / "a.dat", format=f"{kind}.h5")
    assert_same(read(str(tmp_path / "a.dat")), golden())
    others = [f"a.{other}.h5" for other in KINDS if other != kind]
    for name in ("b.dat", "a.npy", *others):
        message = rf"{name}: the name says no format: end it in one of \.{kind}\.h5"
        with pytest.raises(FileError, match=message):
            write(golden(), tmp_path / name)
    with pytest.raises(FileError, match=rf"format 'obj' is unknown: choose one of {kind}\.h5"):
        write(golden(), tmp_path / "a.obj", format="obj")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.dat", "no-extension"]


@every_kind
def test_no_clobber(kind: str, tmp_path: Path) -> None:
    write, read, _, golden, other = KINDS[kind]
    path = tmp_path / f"a.{kind}.h5"
    write(golden(), path, clobber=False)
    with pytest.raises(FileError, match="exists"):
        write(other(), path, clobber=False)
    assert_same(read(path), golden())


@every_kind
def test_stdin_and_stdout(kind: str) -> None:
    _, _, schema, golden, _ = KINDS[kind]
    code = f"voxtool.write_{kind}(voxtool.read_{kind}('-'), '-')"
    done = run_python(code, input=to_bytes(schema, golden()))
    assert done.returncode == 0, done.stderr
    assert_same(from_bytes(schema, done.stdout), golden())


WRITE = "from helpers.octree import golden_octree\nvoxtool.write_svo(golden_octree(), sys.argv[1])"


def test_a_stdout_that_cannot_be_written_is_one_line() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = run_python(WRITE, "-", stdout=writer)
    os.close(writer)
    assert done.returncode == 1
    assert done.stderr == b"standard output was closed before all was written\n"
    if Path("/dev/full").exists():
        with open("/dev/full", "wb") as full:
            done = run_python(WRITE, "-", stdout=full)
        assert done.returncode == 1
        assert done.stderr.startswith(b"cannot write standard output: the disk is full: ")


def test_empty_stdin() -> None:
    assert run_python("voxtool.read_svo('-')", input=b"").stderr == b"stdin is empty\n"


@pytest.mark.skipif(os.name != "posix", reason="POSIX only")
@pytest.mark.parametrize("extension", ["svo.h5", "svo.xml", "svo.xml.gz"])
def test_disk_full_leaves_the_old_file(extension: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{extension}"
    path.write_bytes(b"old")
    done = run_python(LIMITED + WRITE, path)
    assert done.returncode == 1
    assert re.fullmatch(rb"cannot write .*: the file would be larger than .*\n", done.stderr)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


# Files of the wrong kind


def refusal(kind: str, path: Path, message: str) -> None:
    helpers_files.refusal(KINDS[kind].read, path, message)


@pytest.mark.parametrize(
    ("kind", "name", "data", "message"),
    [
        ("svo", "bunny.obj", b"v 0 0 0\n", r"bunny\.obj is a mesh: voxelize it first \(voxtool vo"),
        ("svo", "bunny", b"ply\nformat ascii 1.0\n", "is a mesh: voxelize it first"),
        ("svo", "bunny.stl", b"\0" * 84, "is a mesh: voxelize it first"),
        ("svo", "a.svo.h5", b"", "is empty"),
        ("svo", "a.svo.h5", b"hello", "is no octree: expected HDF5"),
        ("svo", "a.npy", b"\x93NUMPY", "voxels: import it first: voxtool import .*a.npy"),
        ("svo", "a.xml", b'<?xml version="1.0"?><VTKFile/>', "not an octree: its root is VTKFile"),
        ("svo", "a.gz", gzip.compress(b"hello", mtime=0), "no well-formed XML"),
        ("svo", "a.svo.h5", b"\x89HDF\r\n\x1a\n", "damaged HDF5 file"),
        ("svo", "a.vtu", b"<?xml?>", "is a mesh of volume cells: build its textures first"),
        ("adf", "b.obj", b"v 0 0 0\n", r"mesh: build a field first: voxtool adf-build \S+b\.obj$"),
        ("adf", "a.vtu", b"<?xml?>", "is a mesh of volume cells: build its textures first"),
        ("adf", "a.svo.xml", b"<?xml?>", "is an octree: build a field first: voxtool adf-build M"),
        ("adf", "a.adf.h5", b"hello", r"is no distance field: expected HDF5 \(\.adf\.h5\)"),
        ("tet", "b.obj", b"v 0 0 0\n", "is a mesh of triangles: .*: voxtool tet-build MESH.vtu"),
        ("tet", "a.vtu", b"<?xml?>", r"build its textures first: voxtool tet-build \S+a\.vtu$"),
        ("tet", "a.ex2", b"\x89HDF\r\n\x1a\n", "is a mesh of volume cells: build its textures"),
        ("tet", "a.tet.h5", b"hello", r"is no tetrahedral volume: expected HDF5 \(\.tet\.h5\)"),
    ],
)
def test_file_of_another_kind(kind: str, name: str, data: bytes, message: str, tmp_path) -> None:
    (tmp_path / name).write_bytes(data)
    refusal(kind, tmp_path / name, message)


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("svo", "v1.0.adf.h5", "holds 'voxtool-adf', not an octree .*: voxelize a mesh first: vo"),
        ("adf", "v1.0.svo.h5", "holds 'voxtool-svo', not a distance field .*: build a field first"),
        ("tet", "v1.0.adf.h5", "not a tetrahedral volume .*: build its textures first"),
        ("svo", "none.svo.h5", "there is no such file"),
        ("svo", "../data", "is a folder"),
    ],
)
def test_the_missing_step_is_named(kind: str, name: str, message: str) -> None:
    refusal(kind, DATA / name, message)


# Hostile files


def hostile(folder: Path, kind: str, change: Callable, layout: str = "") -> Path:
    write, _, _, golden, _ = KINDS[kind]
    path = folder / f"a.{kind}.h5"
    write(golden_volume(layout) if layout else golden(), path)
    return changed_h5(path, change)


@every_kind
def test_newer_minor_version_reads(kind: str, tmp_path: Path) -> None:
    found = KINDS[kind].read(hostile(tmp_path, kind, newer_minor_version))
    assert_same(found, KINDS[kind].golden())


COMPOUND = np.zeros((), [("a", "<i8"), ("b", "<i8")])


@pytest.mark.parametrize(
    ("kind", "name", "value", "message"),
    [
        ("svo", "format", text("voxtool-adf"), "holds 'voxtool-adf', not an octree"),
        ("svo", "format", None, "an HDF5 file, but no octree: attribute format=voxtool-svo is mis"),
        ("svo", "format_version", text("4.0"), "written in format 4.0, newer .*: update voxtool"),
        ("svo", "format_version", text("0.9"), "written in format 0.9, older"),
        ("svo", "format_version", text("1"), "no version"),
        ("svo", "format_version", 1.0, "attribute format_version is not text"),
        ("svo", "creator", "variable", "text of variable length"),
        ("svo", "creator", text("\x1b[2J"), "cannot be printed"),
        ("svo", "creator", np.bytes_(b"\xff\xfe"), "not UTF-8"),
        ("svo", "dim", None, "attribute dim is missing"),
        ("svo", "dim", 20, "attribute dim is '20' where 19"),
        ("svo", "dim", 19.0, "attribute dim is not of type int"),
        ("svo", "dim", [19, 19], "attribute dim is not one value"),
        ("svo", "dim", h5py.Empty("i8"), "attribute dim is not one value"),
        ("svo", "dim", COMPOUND, "attribute dim is not"),
        ("svo", "depth", 3, "attribute depth is '3' where 4"),
        ("svo", "depth", 2**62, "attribute depth is"),
        ("svo", "shape", [19, 16], "attribute shape has shape"),
        ("svo", "shape", [2**40, 16, 11], "the longest side must have"),
        ("svo", "shape", [-1, 16, 11], "the longest side must have"),
        ("svo", "mode", text("smoke"), "attribute mode is 'smoke' where surface26 or"),
        ("svo", "fill", text("../x"), "attribute fill"),
        ("svo", "origin", [np.nan, 0, 0], "origin .* is not finite"),
        ("svo", "origin", [np.inf, 0, 0], "origin .* is not finite"),
        ("svo", "origin", [1, 2, 3], "attribute origin is not of type float"),
        ("svo", "pitch", [0.1, 0.1, -0.1], "voxel size .* is not positive"),
        ("svo", "pitch", [0.1, 0.1, np.nan], "voxel size .* is not positive"),
        ("svo", "units", text("m" * 65), "attribute units has 65 bytes: at most 64"),
        ("svo", "source_sha256", text("zz"), "source_sha256 is not 64 hexadecimal digits"),
        ("svo", "plan", text("{"), "plan is not JSON"),
        ("svo", "plan", text("[]"), "plan is not a JSON object"),
        ("svo", "plan", text('{"a": NaN}'), "plan is not JSON"),
        ("svo", "plan", text('{"a": 1e999}'), "plan is not JSON"),
        ("svo", "plan", text('{"a": ' + "9" * 5000 + "}"), "plan is not JSON"),
        ("svo", "plan", text('{"a": "\\ud800"}'), "plan is not JSON"),
        ("svo", "plan", text("[" * 50_000), "plan is not JSON"),
        ("svo", "plan", text('{"a":' * 17 + "1" + "}" * 17), "plan is nested deeper than 16"),
        ("adf", "depth", 1, "attribute depth is '1' where 2 is expected"),
        ("adf", "depth", 22, "attribute depth is 22: leaves have levels 1 to 21"),
        ("adf", "max_level", 0, "attribute max_level is 0: leaves have levels 1 to 21"),
        ("adf", "m", 2**40, r"dataset cells has shape \(3, 3, 3, 2\) where \(1099511627776, "),
        ("adf", "m", -3, "dataset cells has shape"),
        ("adf", "r", 5, "dataset hash has shape"),
        ("adf", "origin", [np.nan, 0, 0], "attribute origin .* is not finite"),
        ("adf", "side", 0.0, "attribute side is 0.0: a positive number"),
        ("adf", "side", np.inf, "attribute side is inf: a positive number"),
        ("adf", "tolerance", -1.0, "attribute tolerance is -1.0: a finite number from 0"),
        ("adf", "tolerance", np.inf, "attribute tolerance is inf: a finite number from 0"),
        ("adf", "lipschitz", np.nan, "attribute lipschitz is nan: a finite number from 0"),
        ("adf", "band", np.nan, "attribute band is nan: a number from 0"),
        ("adf", "band", -0.5, "attribute band is -0.5: a number from 0"),
        ("adf", "continuous", 2, "attribute continuous is '2' where 0 or 1"),
        ("adf", "sign", text("parity"), "attribute sign is 'parity' where pseudonormal or winding"),
        ("tet", "layout", text("table 6"), "is 'table 6' where raycast or projection or"),
        ("tet", "layout", text("projection"), r"has shape \(4, 3, 8, 4\) where \(4, 3, 8, 3"),
        ("tet", "layout", text("hexahedra"), r"cells has shape \(1, 3, 8, 4\) where \(2, 3, 8"),
        ("tet", "cell_count", 0, "attribute cell_count is 0: a number from 1 is expected"),
        ("tet", "cell_count", 25, r"cells has shape \(1, 3, 8, 4\) where \(1, 4, 8, 4\)"),
        ("tet", "cell_count", 2**62, "attribute cell_count is 4611686018427387904"),
        ("tet", "cell_count", 19, "volume"),
        ("tet", "vertex_count", 16, r"vertices has shape \(3, 8, 4\) where \(4, 4, 4\)"),
        ("tet", "scale", 3.0, "volume scale 3: a power of two is expected"),
        ("tet", "scalar_range", [1.0, np.inf], "attribute scalar_range .* is not finite"),
        ("tet", "scalar_range", [2.0, 1.0], "volume scalar_range 2 to 1: no finite range"),
        ("tet", "scalar_range", [-1e308, 1e308], "volume scalar_range .*: no finite range"),
        ("tet", "constant", 1, "volume ranges: they are not those of the cells"),
    ],
)
def test_attributes(kind: str, name: str, value: Any, message: str, tmp_path: Path) -> None:
    refusal(kind, hostile(tmp_path, kind, attribute(name, value)), message)


@pytest.mark.parametrize(("name", "value"), [("origin", [1.7e308, 0, 0]), ("scale", 2.0**1023)])
def test_a_volume_may_be_far_away_or_large(name: str, value: Any, tmp_path: Path) -> None:
    found = files.read_tet(hostile(tmp_path, "tet", attribute(name, value)))
    assert np.isfinite(found.bounds()).all()


def virtual(h5: h5py.File, data: np.ndarray) -> None:
    h5["real"] = data
    layout = h5py.VirtualLayout(data.shape, data.dtype)
    layout[:] = h5py.VirtualSource(".", "real", data.shape)
    h5.create_virtual_dataset("nodes", layout)


def external_storage(h5: h5py.File, data: np.ndarray) -> None:
    spec = [("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
    h5.create_dataset("nodes", data.shape, data.dtype, external=spec)


def unwritten(h5: h5py.File, data: np.ndarray) -> None:
    h5.create_dataset("nodes", (1 << 40, 2), data.dtype)  # it has no storage


def link_to(link: object) -> Callable:
    return replaced("nodes", lambda h5, data: h5.__setitem__("nodes", link))


def swap_neighbours(h5: h5py.File) -> None:
    """Each cell's neighbours are those of its faces in another order."""
    h5["neighbours"][...] = np.roll(h5["neighbours"][()], 1, axis=-1)  # pyright: ignore


def item(name: str, place: int | tuple[int, ...], value: Any) -> Callable:
    """A change: an item of a volume's texture, or one number of it, has another value; of normals
    the face comes first."""

    def change(h5: h5py.File) -> None:
        data: Any = h5[name]
        places = [place] if isinstance(place, int) else [*place]
        layer = [places.pop(0)] if name == "normals" else [0] * (data.ndim - 3)
        row, column = divmod(places.pop(0), data.shape[-2])
        data[(*layer, row, column, *places)] = value

    return change


def nudged_plane(h5: h5py.File) -> None:
    """One of two cells at a face has another plane there."""
    _, row, column, face = np.argwhere(h5["neighbours"][()] >= 0)[0]  # pyright: ignore
    place = (face, row, column, 3)
    h5["normals"][place] = np.nextafter(h5["normals"][place], np.float32(2))  # pyright: ignore


def alone(make: Callable[[np.ndarray], np.ndarray]) -> Callable:
    """A change: other voxels, and no bounds."""

    def change(h5: h5py.File) -> None:
        del h5["bounds"]
        stored("voxels", make)(h5)

    return change


NOT_STORED = [
    (replaced("nodes", lambda h5, d: None), "dataset nodes is missing"),
    (replaced("nodes", lambda h5, d: h5.create_group("nodes")), "is not a dataset"),
    (replaced("nodes", virtual), "nodes lies in another file"),
    (link_to(h5py.ExternalLink("/etc/passwd", "/nodes")), "nodes is a link"),
    (link_to(h5py.SoftLink("/bricks")), "nodes is a link"),
    (replaced("nodes", external_storage), "nodes lies in another file"),
    (replaced("nodes", unwritten), "bytes that the file does not have"),
    (stored("nodes", lambda d: d, compression=9), "nodes is not contiguous"),
    (stored("nodes", lambda d: d, chunks=(8, 2)), "nodes is not contiguous"),
]
SVO = [
    (stored("nodes", lambda d: d.astype("f4")), "type"),
    (stored("nodes", lambda d: d.astype(">u4")), "type"),
    (stored("nodes", lambda d: d.astype("i4")), "type"),
    (stored("nodes", lambda d: d[:, 0]), "has shape"),
    (stored("nodes", lambda d: d[:-1]), "they end at"),
    (stored("bricks", lambda d: d[1:]), "95 for 96"),
    (stored("bricks", lambda d: d.astype("u4")), "bricks is not of type uint64"),
    (stored("offsets", lambda d: d * 0), "and ascend"),
    (stored("offsets", lambda d: d[1:]), "has shape"),
    (stored("offsets", lambda d: "x"), "not of type"),
    (lambda h5: h5["nodes"].write_direct(h5["nodes"][()] ^ 1), "octree"),
]
ADF = [
    (stored("voxels", lambda d: d.astype("f8")), "voxels is not of type float32, little-endian"),
    (stored("voxels", lambda d: d[:, :6]), r"bounds has shape \(2, 6, 6\) where \(2, 4, 6\)"),
    (stored("voxels", lambda d: d[:, 1:]), r"bounds has shape \(2, 6, 6\) where \(2, 4, 6\)"),
    (stored("voxels", lambda d: d[:, :, None]), r"dataset voxels has shape \(3, 9, 1, 9\)"),
    (stored("voxels", lambda d: d[:0]), "dataset bounds has shape"),
    (alone(lambda d: d[1:]), r"voxels has shape \(2, 9, 9\): blocks of 3 x 3 x 3 fill it"),
    (alone(lambda d: d[:0]), r"voxels has shape \(0, 9, 9\): blocks of 3 x 3 x 3 fill it"),
    (alone(lambda d: d[:, :6]), "field cells: a pointer leads beyond the voxels"),
    (stored("cells", lambda d: d[..., :1]), r"where \(3, 3, 3, \(2, 3\)\) is expected"),
    (stored("cells", lambda d: np.insert(d, 1, 0, 3)), "identifiers of 8 bytes for level 1"),
    (stored("hash", lambda d: d.astype("u2")), "hash is not of type uint8"),
    (stored("hash", lambda d: d[..., :2]), r"dataset hash has shape \(4, 4, 4, 2\)"),
    (edited("voxels", (0, 3, 0), np.nan), "field voxels: .* finite distances"),
    (edited("cells", (0, 0, 0), (0, 0)), "field cells: a cell has no parent|root first"),
    (edited("cells", (2, 2, 2), (0, 1)), "field cells: a free slot has a pointer"),
    (edited("cells", (0, 0, 1, 1), 0), "field cells: two pointers lead to one block"),
    (edited("cells", (0, 0, 1, 1), 1 << 29), "field cells: a pointer leads beyond the voxels"),
    (edited("hash", (1, 1, 1), (0, 0, 0, 2)), "field"),
    (edited("hash", (0, 0, 0), (0, 0, 0, 0)), "an offset is out of range"),
    (edited("hash", (0, 0, 0), (3, 0, 0, 2)), "an offset is out of range"),
    (edited("bounds", (0, 0, 0), 7), "field bounds: they are not those of the leaves"),
]
TET = [
    (stored("cells", lambda d: d[:, :-1]), r"cells has shape \(1, 2, 8, 4\) where \(1, 3, 8, 4\)"),
    (stored("neighbours", lambda d: d[0]), r"dataset neighbours has shape \(3, 8, 4\)"),
    (item("vertices", (3, 0), np.nan), "volume vertices: positions in"),
    (item("vertices", (3, 0), 1.5), "volume vertices: positions in"),
    (item("vertices", (3, 3), -0.5), "volume vertices: .* scalars in"),
    (item("normals", (1, 2, 3), np.inf), "volume normals: unit normals and offsets"),
    (item("normals", (1, 2, 0), -1.5), "volume normals"),
    (item("normals", (0, 0), (0, 0, 0, 0)), "volume normals"),
    (nudged_plane, "volume normals: those of a shared face are not each other's negation"),
    (item("gradients", (1, 0), np.nan), "volume gradients: numbers up to"),
    (item("gradients", (1, 0), -1e38), "volume gradients: numbers up to"),
    (item("gradients", (1, 0), 7), "volume gradients: they do not give the scalars"),
    (item("gradients", (1, 3), 1e-3), "volume gradients: they do not give the scalars"),
    (item("ranges", (0, 0), 0.25), "volume ranges: they are not those of the cells"),
    (item("ranges", (0, 1), np.nan), "volume ranges: pairs in"),
    (item("cells", (2, 1), 17), "volume cells: a vertex is not one of the 17"),
    (item("cells", (2, 1), -1), "volume cells: a vertex is not one of the 17"),
    (item("cells", 0, (0, 1, 2, 1)), "volume cells: a cell names a vertex twice"),
    (item("neighbours", (1, 0), 2**31 - 1), "volume neighbours: one is not one of the"),
    (item("neighbours", (1, 0), -2), "volume neighbours: one is not one of the"),
    (item("neighbours", 1, (1, 1, 1, 1)), "volume neighbours: a cell is not the neighbour"),
    (item("neighbours", 0, (-1, -1, -1, -1)), "volume neighbours: a cell is not the neigh"),
    (swap_neighbours, "volume neighbours: two cells share a face whose vertices differ"),
]
PROJECTION = [
    (item("anchors", (1, 1), 0), "volume anchors: they are not vertices"),
    (item("gradients", (1, 1), 0.7), "they do not give the scalars"),
    (item("normals", (2, 3), (0.6, 0.8, 0)), "volume normals"),
    (attribute("constant", 1), "volume: table 4 holds no constant cells"),
]
HEXAHEDRA = [
    (attribute("constant", 0), "volume: hexahedra have constant scalars"),
    (item("gradients", (1, 1), 1), "those of constant cells are 0"),
    (item("vertices", (1, 3), 1), "those of constant cells are 0"),
    (item("gradients", (1, 3), 2), "volume ranges: they are not those"),
    (item("vertices", (5, 1), 0.9), "volume normals: one is not that of its"),
]


@pytest.mark.parametrize(
    ("kind", "layout", "change", "message"),
    [
        (kind, layout, *row)
        for kind, layout, rows in (
            ("svo", "", NOT_STORED + SVO),
            ("adf", "", ADF),
            ("tet", "", TET),
            ("tet", "projection", PROJECTION),
            ("tet", "hexahedra", HEXAHEDRA),
        )
        for row in rows
    ],
)
def test_datasets(kind: str, layout: str, change: Callable, message: str, tmp_path: Path) -> None:
    path = hostile(tmp_path, kind, change, layout)
    with memory_below(8 << 20):
        refusal(kind, path, message)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["svo", "adf golden", *(f"tet {layout}" for layout in LAYOUTS)])
def test_damage_of_any_kind(name: str) -> None:
    schema = KINDS[name[:3]].schema

    def read(data: bytes) -> Any:
        found = from_bytes(schema, data)
        if schema.format == "voxtool-svo":
            assert np.count_nonzero(found.to_dense()) == found.count
        if schema.format == "voxtool-adf":
            assert np.isfinite(found.distance(np.full((1, 3), 0.4))).all()
        return found

    check_damaged(to_bytes(schema, CONTENTS[name]()), read, seeds=1, least=60)


# What cannot be written


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("svo", {"plan": {"a": "x" * 70_000}}, "plan has .* bytes: at most 60000 fit"),
        ("svo", {"units": "m" * 100}, "units has 100 bytes"),
        ("svo", {"units": "a\nb"}, "cannot be printed"),
        ("svo", {"units": "\ud800"}, "not Unicode"),
        ("adf", {"reached": {"a": float("inf")}}, "attribute reached cannot be JSON"),
        ("adf", {"reached": {"a": np.int64(1)}}, "attribute reached cannot be JSON"),
        ("adf", {"sign": "parity"}, "attribute sign is 'parity'"),
        ("adf", {"side": float("nan")}, "attribute side is nan"),
        ("adf", {"max_level": 30}, "attribute max_level is 30"),
        ("tet", {"layout": "table 5"}, "attribute layout is 'table 5'"),
    ],
)
def test_what_would_not_read_is_not_written(kind, change, message, tmp_path: Path) -> None:
    content = replace(KINDS[kind].golden(), **change)
    extensions = ("svo.h5", "svo.xml", "svo.xml.gz") if kind == "svo" else (f"{kind}.h5",)
    for extension in extensions:
        with pytest.raises(FileError, match=message):
            KINDS[kind].write(content, tmp_path / f"a.{extension}")
    assert list(tmp_path.iterdir()) == []


def test_importing_files_is_light() -> None:
    code = "import sys, voxtool.files\n"
    code += "print([m for m in ('h5py', 'lxml', 'PIL', 'numpy') if m in sys.modules])"
    assert run_python(code).stdout == b"[]\n"


def test_the_limit_of_memory_is_not_one_of_the_data(tmp_path: Path, monkeypatch) -> None:
    octree = Octree.from_dense(np.random.default_rng(0).random((256, 256, 256)) < 0.5)
    monkeypatch.setattr(hdf5, "METADATA", 1 << 22)
    assert octree.nbytes > hdf5.METADATA
    files.write_svo(octree, tmp_path / "a.svo.h5")
    assert files.read_svo(tmp_path / "a.svo.h5").digest() == octree.digest()
