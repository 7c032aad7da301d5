"""Files for tests: the contents of the golden files, HDF5 files that are changed or damaged, and
programs that read and write."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.field import plain_field, point
from helpers.tets import assembly, built, lattice, linear, unstructured

from voxtool.adf.field.cells import cell_of, key_of
from voxtool.adf.field.field import DistanceField, assemble
from voxtool.adf.field.spatial_hash import SpatialHash
from voxtool.errors import VoxtoolError
from voxtool.tets.volume.volume import TetVolume

ROOT = Path(__file__).parents[2]
DATA = ROOT / "tests" / "data"
Change = Callable[[h5py.File], Any]


# Contents


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
    arrays = ("voxels", "cells", "hash", "bounds")
    head = {f.name: getattr(field, f.name) for f in dataclasses.fields(field)}
    head = {name: value for name, value in head.items() if name not in arrays}
    hash = SpatialHash(m, r, offsets)
    return assemble(identifiers, keys, field.voxels, field.bounds, hash, **head)


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


def golden_volume(layout: str = "raycast") -> TetVolume:
    """Three boxes in a row; a pyramid too, except for hexahedra, and scalars that differ."""
    points, cells = lattice((3, 1, 1))
    points = points * (0.7, 1.3, 2) + np.array([10, 0, -3])
    head = {"source_sha256": "0f" * 32, "name": "golden.vtu", "units": "mm"}
    said = {"plan": {"left_out": {"anchors": "none"}}, "report": {"merged_points": 7}}
    if layout == "hexahedra":
        values = [np.array([2.0, -1, 0.5])]
        mesh = unstructured(points, [("hexahedron", cells)], values, **head)
        return replace(built(mesh, layout), **said)
    points = np.concatenate([points, [(9, 0.5, -2)]])
    scalars = linear(points) + (np.arange(len(points)) % 3) ** 2
    blocks = [("pyramid", [(0, 8, 12, 4, 16)]), ("hexahedron", cells)]
    return replace(built(unstructured(points, blocks, scalars, **head), layout), **said)


def constant_volume() -> TetVolume:
    mesh = assembly((2, 2, 2), 0)
    values = [np.arange(len(block), dtype=float) for _, block in mesh.cells]
    return built(unstructured(mesh.points, mesh.cells, values))


def flat_volume() -> TetVolume:
    """A volume that holds heights."""
    points, cells = lattice((2, 2, 2))
    return built(unstructured(points * (1, 1, 1e-9), [("hexahedron", cells)]))


def assert_same(a: Any, b: Any) -> None:
    """Two octrees, fields or volumes agree in all that a file holds, and in the types."""
    assert type(a) is type(b)
    if hasattr(a, "digest"):
        assert a.digest() == b.digest()
    for field in dataclasses.fields(a):
        one, two = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == two.dtype
            assert np.array_equal(one, two)
        elif isinstance(one, dict):
            assert json.dumps(one) == json.dumps(two)  # the order of keys, too
        elif dataclasses.is_dataclass(one):
            assert_same(one, two)
        else:
            assert str(one) == str(two)  # every bit of a float


# Changes


def changed_h5(path: Path, change: Change) -> Path:
    """The path of an HDF5 file after a change."""
    with h5py.File(path, "r+") as h5:
        change(h5)
    return path


def attribute(name: str, value: Any) -> Change:
    """A change: the attribute has another value, or is missing where that is None."""

    def change(h5: h5py.File) -> None:
        del h5.attrs[name]
        if value is not None:
            h5.attrs[name] = value

    return change


def text(value: str) -> np.bytes_:
    return np.bytes_(value.encode())


def newer_minor_version(h5: h5py.File) -> None:
    """A change: minor version 7, with an attribute and a dataset that no version has."""
    major = bytes(h5.attrs["format_version"]).decode()[0]  # pyright: ignore
    attribute("format_version", text(f"{major}.7"))(h5)
    h5.attrs["new"] = 1
    h5["a new dataset"] = np.zeros(5)


def replaced(name: str, make: Callable[[h5py.File, np.ndarray], Any]) -> Change:
    """A change: the dataset is removed, and `make` may store something else by its name."""

    def change(h5: h5py.File) -> None:
        data = h5[name][()]  # pyright: ignore
        del h5[name]
        make(h5, data)  # pyright: ignore

    return change


def stored(name: str, make: Callable[[np.ndarray], Any], **options: Any) -> Change:
    """A change: the dataset holds what `make` returns."""
    return replaced(name, lambda h5, data: h5.create_dataset(name, data=make(data), **options))


def edited(name: str, place: Any, value: Any) -> Change:
    """A change: a part of the dataset has another value."""

    def change(h5: h5py.File) -> None:
        h5[name][place] = value  # pyright: ignore

    return change


# Checks


def refusal(read: Callable[[Path], Any], path: Path, message: str) -> None:
    """Check that reading fails with one line that names the file."""
    with pytest.raises(VoxtoolError, match=message) as caught:
        read(path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


@contextmanager
def memory_below(limit: int) -> Iterator[None]:
    """Check that the block takes less memory, in bytes, at any time."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()


def check_damaged(data: bytes, read: Callable[[bytes], Any], seeds: int, least: int) -> None:
    """Check that every truncated file is refused, and that each of 200 damaged files a seed is
    refused in one line, or gives valid content.

    least : more than this number of 200 damaged files are refused.
    """
    step = max(1, len(data) // 60)
    for length in {*range(0, 200, 7), *range(200, len(data) - 3, step), len(data) - 3}:
        with pytest.raises(VoxtoolError):
            read(data[:length])
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        messages: list[str] = []
        with memory_below(16 << 20):
            for _ in range(200):
                try:
                    read(mutant(data, rng)).validate()
                except VoxtoolError as error:
                    messages.append(str(error))
        assert len(messages) > least
        assert not any("\n" in message for message in messages)


def mutant(data: bytes, rng: np.random.Generator) -> bytes:
    """The data with a bit flipped, or some bytes overwritten, copied from elsewhere or removed."""
    changed = bytearray(data)
    start, length = int(rng.integers(len(data))), int(rng.choice([1, 1, 1, 2, 4, 8, 64]))
    kind = rng.integers(4)
    if kind == 0:
        changed[start] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        changed[start : start + length] = bytes([int(rng.choice([0, 1, 127, 255]))]) * length
    elif kind == 2:
        other = int(rng.integers(len(data)))
        changed[start : start + length] = data[other : other + length]
    else:
        del changed[start : start + length]
    return bytes(changed)


def run_python(code: str, *words: Any, **options: Any) -> subprocess.CompletedProcess[bytes]:
    """The outcome of a program; an error of voxtool is a line on stderr and the exit code 1."""
    body = "".join(f"    {line}\n" for line in code.splitlines())
    program = (
        "import sys; sys.path.insert(0, 'tests')\n"
        f"import voxtool\ntry:\n{body}"
        "except voxtool.VoxtoolError as error:\n    print(error, file=sys.stderr); sys.exit(1)\n"
    )
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "timeout": 60} | options
    command = [sys.executable, "-c", program, *map(str, words)]
    return subprocess.run(command, cwd=ROOT, **options)


LIMITED = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (900, 900))\n"  # of a file
