"""Distance field files: what is written is read, what is damaged or hostile is refused in one line,
and a reader in another language can be written from docs/formats.md.

The golden file tests/data/v1.0.adf.h5 holds golden_field(). It stays for good; it was made once, at
format version 1.0, by

    write_adf(golden_field(), "tests/data/v1.0.adf.h5")
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import math
import re
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import helpers_files
import numpy as np
import pytest
from helpers_field import plain_field, point
from helpers_files import (
    attribute,
    changed_h5,
    check_mutants,
    check_truncated,
    edited,
    memory_below,
    newer_minor_version,
    stored,
    text,
)
from helpers_octree import golden_octree
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
from voxtool import files
from voxtool.adf.cells import cell_of, key_of
from voxtool.adf.field import DistanceField, assemble
from voxtool.adf.spatial_hash import SpatialHash
from voxtool.errors import FileError
from voxtool.files import adf_hdf5

ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parents[1] / "data"
DOCUMENT = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
GOLDEN_DIGEST = "8d56f2cce91e898584e9e2a71eacd015ae767d7c9f013cf783a6d7a33e5bd423"
ARRAYS = ("voxels", "cells", "bounds")


def with_w(field: DistanceField, w: int) -> DistanceField:
    """The same field, its hash with another w than m; every key has an offset of its own."""
    identifiers = field.blocks
    keys = key_of(*cell_of(identifiers))
    m, r = field.hash.m, int(keys.max()) + 1
    slots = np.stack(np.unravel_index(np.arange(len(keys)), (m, m, m))[::-1], axis=1)
    offsets = np.zeros((r, r, r, 4), np.uint8)
    offsets[..., 3] = w
    x, y, z = keys.T
    offsets[z, y, x, :3] = (slots - keys % w) % m
    names = ("origin", "side", "sign", "tolerance", "max_level", "band", "continuous", "lipschitz")
    more = ("reached", "plan", "source_sha256", "units")
    head = {name: getattr(field, name) for name in (*names, *more)}
    return assemble(identifiers, field.voxels, field.bounds, SpatialHash(m, r, offsets), **head)


def golden_field() -> DistanceField:
    """A field of 9 blocks, one of its bounds a jump, whose hash does not depend on build_hash."""
    field = plain_field(
        tolerance=1e-3,
        max_level=2,
        origin=(-1.5, 0.1, 1e-3),
        side=2.5,
        sign="winding",
        units="mm",
        source_sha256="0f" * 32,
        reached={"error": {"max": 0.5, "rms": 0.25}, "samples": 7},
        plan={"left_out": {"64-bit identifiers": "levels 0 to 2"}},
    )
    assert field.bounds is not None
    bounds = field.bounds.copy()
    bounds[3, 1, 0, 1] = 255
    return with_w(replace(field, bounds=bounds), 2)


def deep_field(**head: Any) -> DistanceField:
    """A field of few cells to level 14, whose identifiers have 64 bits."""
    field = plain_field(lambda p: np.sqrt(point(p)), 3e-3, 14, **head)
    assert field.depth > 11
    return field


FIELDS: dict[str, Callable[[], DistanceField]] = {
    "golden": golden_field,
    "deep": deep_field,
    "without bounds": lambda: plain_field(bounds=False),
    "band": lambda: deep_field(bounds=False, band=0.25, continuous=True, sign="none"),
    "root": lambda: plain_field(max_level=1),
}


def to_bytes(field: DistanceField) -> bytes:
    file = io.BytesIO()
    adf_hdf5.write(field, file)
    return file.getvalue()


def from_bytes(data: bytes) -> DistanceField:
    return adf_hdf5.read(io.BytesIO(data), len(data))


def assert_same(a: DistanceField, b: DistanceField) -> None:
    assert a.digest() == b.digest()
    assert (a.units, a.source_sha256) == (b.units, b.source_sha256)
    for name in ("reached", "plan"):
        assert json.dumps(getattr(a, name)) == json.dumps(getattr(b, name))  # the order, too
    pairs = [(getattr(a, name), getattr(b, name)) for name in ARRAYS]
    for one, two in [*pairs, (a.hash.offsets, b.hash.offsets)]:
        assert (one is None) == (two is None)
        if one is not None:
            assert one.dtype == two.dtype
            assert np.array_equal(one, two)


# Round trips


def test_golden_file_of_version_1_0_reads_for_good() -> None:
    golden = files.read_adf(DATA / "v1.0.adf.h5")
    assert golden.digest() == GOLDEN_DIGEST
    assert_same(golden, golden_field())


@pytest.mark.parametrize("name", FIELDS)
def test_what_is_written_is_read(name: str, tmp_path: Path) -> None:
    field = FIELDS[name]()
    voxtool.write_adf(field, tmp_path / "a.adf.h5")
    found = voxtool.read_adf(tmp_path / "a.adf.h5")
    assert isinstance(found, voxtool.DistanceField)
    assert_same(found, field)
    points = np.random.default_rng(0).uniform(-0.2, 1.2, (200, 3)) * field.side + field.origin
    assert np.array_equal(found.distance(points), field.distance(points))


@given(
    origin=st.tuples(*[st.floats(-1.0, 1.0)] * 3),  # a cube has to be one
    side=st.floats(1e-9, 1e250),
    tolerance=st.floats(min_value=0, allow_infinity=False),
    band=st.floats(min_value=0),
    lipschitz=st.floats(min_value=0, allow_infinity=False),
)
@settings(max_examples=50)
def test_every_float_survives(**head) -> None:
    back = from_bytes(to_bytes(replace(golden_field(), **head)))
    for name, value in head.items():
        assert str(getattr(back, name)) == str(value)
    assert type(back.continuous) is bool


def test_bytes_depend_on_the_content_alone() -> None:
    assert to_bytes(golden_field()) == to_bytes(from_bytes(to_bytes(golden_field())))


def test_datasets_can_be_uploaded_as_they_lie(tmp_path: Path) -> None:
    field, path = deep_field(), tmp_path / "a.adf.h5"
    files.write_adf(field, path)
    with h5py.File(path) as h5:
        assert list(h5) == ["bounds", "cells", "hash", "voxels"]
        arrays = {name: getattr(field, name) for name in ARRAYS} | {"hash": field.hash.offsets}
        for name, array in arrays.items():
            assert h5[name].chunks is None
            start = h5[name].id.get_offset()
            assert path.read_bytes()[start : start + array.nbytes] == array.tobytes()


def test_large_texts_fit() -> None:
    field = replace(golden_field(), plan={"a": "x" * 59_000}, reached={"a": "y" * 59_000})
    assert_same(from_bytes(to_bytes(field)), field)


def test_newer_minor_version_reads(tmp_path: Path) -> None:
    assert_same(files.read_adf(hostile(tmp_path, newer_minor_version)), golden_field())


# The recipe of docs/formats.md, in plain Python


class Recipe:
    """A field as a program in another language reads it."""

    def __init__(self, path: Path) -> None:
        with h5py.File(path) as h5:
            for name in ("depth", "m", "r", "side"):
                setattr(self, name, h5.attrs[name].item())
            self.origin = h5.attrs["origin"].tolist()
            self.voxels, self.cells, self.hash, self.bounds = (
                h5[name][()].tolist() if name in h5 else None
                for name in ("voxels", "cells", "hash", "bounds")
            )

    def point(self, world: list[float]) -> list[int]:
        u = [(x - o) / self.side for x, o in zip(world, self.origin, strict=True)]
        return [min(int(x * 2.0**32), 2**32 - 1) for x in u]

    def identifier(self, level: int, c: list[int]) -> int:
        code = 0
        for q in range(level):
            for axis in range(3):
                code |= (c[axis] >> q & 1) << (3 * q + axis)
        return 1 << (3 * level) | code

    def block(self, level: int, c: list[int]) -> int | None:
        key = [2**level + a for a in c]
        x, y, z = (a % self.r for a in key)
        offset = self.hash[z][y][x]
        w = offset[3] if len(offset) == 4 else self.m
        hx, hy, hz = ((k % w + o) % self.m for k, o in zip(key, offset, strict=False))
        *words, block = self.cells[hz][hy][hx]
        stored = words[0] if len(words) == 1 else words[1] << 32 | words[0]
        return block if stored == self.identifier(level, c) else None

    def leaf(self, p: list[int]) -> tuple[int, list[int], int]:
        """The level and the cell of the leaf, and the block that it is in."""
        found = 0
        for level in range(self.depth):
            block = self.block(level, [a >> (32 - level) for a in p])
            if block is None:
                break
            found, last = block, level
        return last + 1, [a >> (31 - last) for a in p], found

    def distance(self, p: list[int]) -> float:
        level, leaf, block = self.leaf(p)
        x, y, z = (a & 1 for a in leaf)
        t = [((a << level) % 2**32 >> 8) * 2.0**-24 for a in p]
        v = [
            self.voxels[block][z + dz][y + dy][x + dx]
            for dz, dy, dx in itertools.product((0, 1), repeat=3)
        ]
        for axis in range(3):
            v = [
                rounded(a + rounded(t[axis] * rounded(b - a)))
                for a, b in zip(v[::2], v[1::2], strict=True)
            ]
        return v[0] * self.side

    def bound(self, p: list[int]) -> float:
        _, leaf, block = self.leaf(p)
        x, y, z = (a & 1 for a in leaf)
        code = self.bounds[block][z][y][x]
        assert code != 0
        return math.inf if code == 255 else 2 ** ((code - 254) / 8) * self.side


def rounded(value: float) -> float:
    """To float32; of a sum or product of two float32 in float64 that is rounded once."""
    return struct.unpack("<f", struct.pack("<f", value))[0]


@pytest.mark.parametrize("name", FIELDS)
def test_recipe_of_the_documents(name: str, tmp_path: Path) -> None:
    field, path = FIELDS[name](), tmp_path / "a.adf.h5"
    files.write_adf(field, path)
    recipe = Recipe(path)
    rng = np.random.default_rng(1)
    u = np.concatenate(
        [
            rng.uniform(0, 1, (150, 3)),
            (0.3, 0.6, 0.7) + rng.normal(0, 1, (150, 3)) * np.exp2(-rng.uniform(2, 16, (150, 1))),
            np.array(list(itertools.product((0.0, 0.5, 1.0), repeat=3))),
        ]
    )
    points = np.clip(u, 0, 1) * field.side + field.origin
    points = points[~field.query(points).outside]
    answer = field.query(points, bounds=field.bounds is not None, cell=True)
    assert answer.level is not None
    assert answer.cell is not None
    assert len(np.unique(answer.level)) > 2 or name in ("golden", "root")
    for i, world in enumerate(points.tolist()):
        p = recipe.point(world)
        level, cell, _ = recipe.leaf(p)
        assert (level, cell) == (answer.level[i], answer.cell[i].tolist())
        assert recipe.distance(p) == answer.distance[i]
        if answer.bound is not None:
            assert recipe.bound(p) == pytest.approx(answer.bound[i], rel=1e-12)


def test_recipe_of_the_order_of_blocks(tmp_path: Path) -> None:
    field, path = deep_field(), tmp_path / "a.adf.h5"
    files.write_adf(field, path)
    recipe = Recipe(path)
    identifiers = {}
    for texel in itertools.chain(*itertools.chain(*recipe.cells)):
        low, high, block = texel
        if low or high:
            identifiers[block] = high << 32 | low
    assert [*sorted(identifiers)] == [*range(len(field.voxels))]
    ordered = [identifiers[block] for block in range(len(identifiers))]
    assert ordered == sorted(ordered)
    assert ordered[0] == 1
    assert {code >> 3 for code in ordered[1:]} <= {*ordered}


def test_digest_of_the_documents() -> None:
    (line,) = re.findall(r"^\{\"band\".*\}$", DOCUMENT, re.MULTILINE)
    sha = hashlib.sha256(line.encode())
    with h5py.File(DATA / "v1.0.adf.h5") as h5:
        for name in ("voxels", "cells", "hash", "bounds"):
            sha.update(h5[name][()].tobytes())
    assert sha.hexdigest() == GOLDEN_DIGEST

    # Names, streams, files of another kind


def test_format_is_chosen_by_extension_and_read_by_content(tmp_path: Path) -> None:
    for name in ("a.adf.h5", "a.h5", "A.ADF.H5"):
        files.write_adf(golden_field(), tmp_path / name)
        moved = (tmp_path / name).rename(tmp_path / "no-extension")
        assert_same(files.read_adf(moved), golden_field())
    files.write_adf(golden_field(), tmp_path / "a.dat", format="adf.h5")
    with pytest.raises(FileError, match=r"format 'svo\.h5' is unknown: choose one of adf\.h5, h5"):
        files.write_adf(golden_field(), tmp_path / "b.dat", format="svo.h5")


def test_a_name_of_another_kind_is_refused(tmp_path: Path) -> None:
    for name in ("a.dat", "a.svo.h5", "a.npy"):
        with pytest.raises(
            FileError, match=r": the name says no format: end it in one of \.adf\.h5$"
        ):
            files.write_adf(golden_field(), tmp_path / name)
    with pytest.raises(FileError, match=r"end it in one of \.svo\.h5, \.svo\.xml, \.svo\.xml\.gz$"):
        files.write_svo(golden_octree(), tmp_path / "a.adf.h5")
    assert list(tmp_path.iterdir()) == []


def test_stdin_and_stdout() -> None:
    code = "import voxtool; voxtool.write_adf(voxtool.read_adf('-'), '-')"
    data = to_bytes(deep_field())
    done = subprocess.run([sys.executable, "-c", code], input=data, cwd=ROOT, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert_same(from_bytes(done.stdout), deep_field())


def test_no_clobber(tmp_path: Path) -> None:
    path = tmp_path / "a.adf.h5"
    files.write_adf(golden_field(), path, clobber=False)
    with pytest.raises(FileError, match="exists"):
        files.write_adf(deep_field(), path, clobber=False)
    assert_same(files.read_adf(path), golden_field())


def refusal(path: Path, message: str, read: Callable = files.read_adf) -> None:
    helpers_files.refusal(read, path, message)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("bunny.obj", b"v 0 0 0\n", r"mesh: build a field first: voxtool adf-build \S+bunny\.obj$"),
        ("bunny", b"ply\nformat ascii 1.0\n", "is a mesh: build a field first: voxtool adf-build"),
        ("a.svo.xml", b"<?xml?>", "is an octree: build a field first: voxtool adf-build MESH"),
        ("a.adf.h5", b"", "is empty"),
        ("a.adf.h5", b"hello", r"is no distance field: expected HDF5 \(\.adf\.h5\)"),
        ("a.adf.h5", b"\x89HDF\r\n\x1a\n", "damaged HDF5 file"),
    ],
)
def test_file_of_another_kind(tmp_path: Path, name: str, data: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(data)
    refusal(tmp_path / name, message)


def test_octree_and_field_name_the_missing_step(tmp_path: Path) -> None:
    files.write_svo(golden_octree(), tmp_path / "a.svo.h5")
    message = "holds 'voxtool-svo', not a distance field .*: build a field first: voxtool adf-build"
    refusal(tmp_path / "a.svo.h5", message)
    message = "holds 'voxtool-adf', not an octree .*: voxelize a mesh first: voxtool voxelize MESH"
    refusal(DATA / "v1.0.adf.h5", message, files.read_svo)
    refusal(tmp_path / "none.adf.h5", "there is no such file")
    refusal(tmp_path, "is a folder")


# Hostile files


def hostile(folder: Path, change: Callable[[h5py.File], None]) -> Path:
    path = folder / "a.adf.h5"
    files.write_adf(golden_field(), path)
    return changed_h5(path, change)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("format", None, "an HDF5 file, but no distance field: attribute format=voxtool-adf"),
        ("format", text("voxtool-tet"), "holds 'voxtool-tet', not a distance field"),
        ("depth", 1, "attribute depth is '1' where 2 is expected"),
        ("depth", 22, "attribute depth is 22: leaves have levels 1 to 21"),
        ("max_level", 0, "attribute max_level is 0: leaves have levels 1 to 21"),
        ("m", 2**40, r"dataset cells has shape \(3, 3, 3, 2\) where \(1099511627776, "),
        ("m", -3, "dataset cells has shape"),
        ("r", 5, "dataset hash has shape"),
        ("origin", [np.nan, 0, 0], "attribute origin .* is not finite"),
        ("side", 0.0, "attribute side is 0.0: a positive number"),
        ("side", np.inf, "attribute side is inf: a positive number"),
        ("tolerance", -1.0, "attribute tolerance is -1.0: a finite number from 0"),
        ("tolerance", np.inf, "attribute tolerance is inf: a finite number from 0"),
        ("lipschitz", np.nan, "attribute lipschitz is nan: a finite number from 0"),
        ("band", np.nan, "attribute band is nan: a number from 0"),
        ("band", -0.5, "attribute band is -0.5: a number from 0"),
        ("continuous", 2, "attribute continuous is '2' where 0 or 1"),
        (
            "sign",
            text("parity"),
            "attribute sign is 'parity' where pseudonormal or winding or none",
        ),
        ("reached", text("{"), "attribute reached is not JSON"),
    ],
)
def test_attributes(tmp_path: Path, name: str, value: Any, message: str) -> None:
    refusal(hostile(tmp_path, attribute(name, value)), message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            stored("voxels", lambda d: d.astype("f8")),
            "voxels is not of type float32, little-endian",
        ),
        (
            stored("voxels", lambda d: d[:8]),
            r"dataset bounds has shape \(9, 2, 2, 2\) where \(8, 2, 2, 2\)",
        ),
        (
            stored("voxels", lambda d: d[:, 1:]),
            r"dataset voxels has shape \(9, 2, 3, 3\)",
        ),
        (
            stored("voxels", lambda d: d[:0]),
            "dataset bounds has shape",
        ),
        (
            stored("cells", lambda d: d[..., :1]),
            r"has shape \(3, 3, 3, 1\) where \(3, 3, 3, \(2, 3\)\) is expected",
        ),
        (
            stored("cells", lambda d: np.insert(d, 1, 0, 3)),
            "field cells: identifiers of 8 bytes for level 1",
        ),
        (
            stored("hash", lambda d: d.astype("u2")),
            "hash is not of type uint8",
        ),
        (
            stored("hash", lambda d: d[..., :2]),
            r"dataset hash has shape \(4, 4, 4, 2\)",
        ),
        (
            stored("bounds", lambda d: d[1:]),
            "dataset bounds has shape",
        ),
        (edited("voxels", (3, 0, 0, 0), np.nan), "field voxels: .* finite distances"),
        (edited("cells", (0, 0, 0), (0, 0)), "field cells: they do not have each of the 9 blocks"),
        (edited("cells", (2, 2, 2), (0, 1)), "field cells: a free slot names a block"),
        (edited("hash", (1, 1, 1), (0, 0, 0, 2)), "field"),
        (edited("hash", (0, 0, 0), (0, 0, 0, 0)), "an offset is out of range"),
        (edited("hash", (0, 0, 0), (3, 0, 0, 2)), "an offset is out of range"),
        (edited("bounds", (0, 0, 0, 0), 7), "field bounds: they are not those of the leaves"),
    ],
)
def test_datasets(tmp_path: Path, change: Callable, message: str) -> None:
    path = hostile(tmp_path, change)
    with memory_below(8 << 20):
        refusal(path, message)


@pytest.mark.slow
def test_damage_of_any_kind() -> None:
    def read(data: bytes) -> DistanceField:
        found = from_bytes(data)
        assert np.isfinite(found.distance(np.full((1, 3), 0.4))).all()
        return found

    check_truncated(to_bytes(golden_field()), read)
    for seed in range(2):
        check_mutants(to_bytes(golden_field()), read, seed, least=60)


# What cannot be written


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"plan": {"a": "x" * 70_000}}, "attribute plan has .* bytes: at most 60000 fit"),
        ({"reached": {"a": float("inf")}}, "attribute reached cannot be JSON"),
        ({"reached": {"a": np.int64(1)}}, "attribute reached cannot be JSON"),
        ({"units": "a\nb"}, "attribute units has characters that cannot be printed"),
        ({"sign": "parity"}, "attribute sign is 'parity'"),
        ({"side": float("nan")}, "attribute side is nan"),
        ({"max_level": 30}, "attribute max_level is 30"),
    ],
)
def test_what_would_not_read_is_not_written(change: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=message):
        files.write_adf(replace(golden_field(), **change), tmp_path / "a.adf.h5")
    assert list(tmp_path.iterdir()) == []
