"""Octrees whose attributes stay in their file: what is said of them is what is said in memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.attributes import attributed

from voxtool.arrays import Slices
from voxtool.errors import FileError, MemoryLimitError
from voxtool.files import open_svo, write_svo
from voxtool.svo.octree import attributes
from voxtool.svo.octree.octree import Octree, in_memory


@pytest.fixture
def stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of an octree with every attribute, which is read in many blocks."""
    monkeypatch.setattr(attributes, "BLOCK", 7)
    path = tmp_path / "all.svo.h5"
    write_svo(attributed(), path)
    return path


@pytest.mark.parametrize("names", [None, ("label",), ("colour", "area")])
def test_a_stored_octree_is_described_as_in_memory(names, stored: Path) -> None:
    octree = attributed()
    if names:
        octree = replace(octree, attributes=tuple(map(octree.attribute, names)))
        write_svo(octree, stored)
    with open_svo(stored) as found:
        assert not isinstance(found, Octree)
        for one in found.attributes:
            assert isinstance(one.values, Slices)
            own = octree.values(one.name).of_bricks(slice(3, 40))
            np.testing.assert_array_equal(found.values(one.name).of_bricks(slice(3, 40)), own)
        assert found.summary() == octree.summary()
        assert found.digest() == octree.digest()
        assert found.set_digest() == octree.set_digest()
        assert in_memory(found) == octree


def test_attributes_are_read_by_name_and_within_memory(stored: Path) -> None:
    octree, kept = attributed(), ("label", "area")
    with open_svo(stored) as found:
        assert in_memory(found.only(kept)) == octree.only(kept)
        loaded = in_memory(found, names=kept)
        assert {type(one.values) for one in loaded.attributes} == {np.ndarray, Slices}
        assert loaded.digest() == octree.digest()
        size = octree.nbytes + sum(octree.attribute(name).nbytes for name in kept)
        assert in_memory(found, size, kept)
        message = "attributes label, area need .* are allowed: allow more"
        with pytest.raises(MemoryLimitError, match=message):
            in_memory(found, size - 1, kept)


@pytest.mark.parametrize(
    ("dataset", "value", "message"),
    [
        ("label_values", 9, "label: 9 where there are 3 names"),
        ("normal_values", 2.0, "normal: a number that is not from -1 to 1"),
        ("area_masks", (1 << 64) - 1, "area: its masks hold voxels that are not set"),
        ("fraction_masks", 0, "fraction: .* values for .* voxels"),
    ],
)
def test_a_damaged_attribute_is_refused(dataset: str, value, message: str, stored: Path) -> None:
    with h5py.File(stored, "r+") as file:
        rows = np.flatnonzero(file["bricks"][:]) if "masks" in dataset else [-1]
        file[dataset][int(rows[-1])] = value
    with pytest.raises(FileError, match=message), open_svo(stored):
        pass
