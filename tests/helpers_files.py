"""Files for tests of readers: HDF5 files that are changed, truncated and mutated."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from voxtool.errors import VoxtoolError

Change = Callable[[h5py.File], Any]


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
    """A change: version 1.7, with an attribute and a dataset that this version does not have."""
    attribute("format_version", text("1.7"))(h5)
    h5.attrs["new"] = 1
    h5["a new dataset"] = np.zeros(5)


def stored(name: str, make: Callable[[np.ndarray], Any], **options: Any) -> Change:
    """A change: the dataset holds what `make` returns; it is missing where that is None."""

    def change(h5: h5py.File) -> None:
        data = make(h5[name][()])  # pyright: ignore
        del h5[name]
        if data is not None:
            h5.create_dataset(name, data=data, **options)

    return change


def edited(name: str, place: Any, value: Any) -> Change:
    """A change: a part of the dataset has another value."""

    def change(h5: h5py.File) -> None:
        h5[name][place] = value  # pyright: ignore

    return change


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


def check_truncated(data: bytes, read: Callable[[bytes], Any]) -> None:
    """Check that every truncated file is refused."""
    step = max(1, len(data) // 60)
    for length in {*range(0, 200, 7), *range(200, len(data) - 3, step), len(data) - 3}:
        with pytest.raises(VoxtoolError):
            read(data[:length])


def check_mutants(data: bytes, read: Callable[[bytes], Any], seed: int, least: int) -> None:
    """Check that each of 200 damaged files is refused in one line, or gives valid content.

    least : of the mutants, at least so many are refused.
    """
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
