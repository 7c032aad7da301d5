"""Attributes of voxels: access, checks, digests and files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.attributes import attributed, scattered, sizes
from helpers.files import DATA

import voxtool
from voxtool.errors import FileError, VoxtoolError
from voxtool.morton import morton_decode
from voxtool.svo.octree.attributes import KINDS, Attribute
from voxtool.svo.octree.octree import Octree


def test_values_of_bricks_are_in_the_order_of_voxels() -> None:
    octree = attributed()
    level = octree.levels()[-1]
    dense = octree.to_dense()
    corners = 4 * morton_decode(level.codes)
    offsets = morton_decode(np.arange(64))
    for name in KINDS:
        attribute, values = octree.attribute(name), octree.values(name)
        found = values.of_bricks(slice(None))
        taken = 0
        for brick, corner in enumerate(corners):
            held = int(attribute.held(octree.bricks)[brick])
            for bit, offset in enumerate(offsets):
                at = tuple(corner + offset)
                inside = all(a < n for a, n in zip(at, octree.grid.shape, strict=True))
                wanted = np.zeros_like(attribute.blank)
                if held >> bit & 1:
                    wanted = attribute.values[taken]
                    taken += 1
                elif inside and dense[at]:
                    wanted = attribute.blank
                assert np.array_equal(found[brick, bit], wanted)
        assert taken == len(attribute.values)
        some = np.array([5, 0, 17])
        assert np.array_equal(values.of_bricks(some), found[some])
    leaves = sizes(octree)[1]
    assert np.array_equal(
        octree.values("label").of_leaves(leaves), octree.attribute("label").leaves
    )
    assert (octree.values("fraction").of_leaves(leaves) == 1).all()


def test_files_keep_attributes(tmp_path: Path) -> None:
    octree = attributed()
    octree.validate()
    voxtool.write_svo(octree, tmp_path / "a.svo.h5")
    read = voxtool.read_svo(tmp_path / "a.svo.h5")
    assert read == octree
    assert read.attributes == octree.attributes
    assert read.digest() == octree.digest()
    with pytest.raises(
        FileError, match=r"XML holds no attributes of voxels: write them to \.svo\.h5"
    ):
        voxtool.write_svo(octree, tmp_path / "a.svo.xml")
    assert not (tmp_path / "a.svo.xml").exists()


def test_the_tiny_file_reads() -> None:
    octree = voxtool.read_svo(DATA / "v3.0.svo.h5")
    assert isinstance(octree, Octree)
    assert octree.attribute("label").names == ("left", "right")
    assert octree.digest() == "027b684d14e32acddcd9b96394f2daf51a0333b97e7fb4fba103be8f986f03e1"


def test_digests_cover_names_and_values() -> None:
    octree = attributed()
    digests = {octree.digest(), scattered().digest()}
    label, *others = octree.attributes
    values = np.array(label.values)
    values[7] ^= 1
    for changed in (
        replace(label, values=values),
        replace(label, names=("head", "size", "a b")),
        replace(label, default=1),
    ):
        digests.add(replace(octree, attributes=(changed, *others)).digest())
    assert len(digests) == 5
    assert octree.set_digest() == scattered().set_digest()
    assert octree != scattered()


def test_attributes_that_do_not_fit_are_refused() -> None:
    octree = attributed()
    label, _, normal, area, fraction, _ = octree.attributes
    for changed, message in (
        (replace(label, values=label.values[1:]), "values for .* voxels"),
        (replace(label, leaves=label.leaves[1:]), "values for .* leaves"),
        (replace(label, names=("one",)), "where there are 1 names"),
        (replace(fraction, masks=~octree.bricks), "voxels that are not set"),
        (replace(fraction, values=fraction.values + 1), "not from 0 to 1"),
        (replace(area, values=-area.values), "not from 0 to 3.40282347e\\+38"),
        (replace(normal, values=normal.values * np.float32(np.nan)), "not from -1 to 1"),
    ):
        with pytest.raises(FileError, match=message):
            replace(octree, attributes=(changed,)).validate()
    with pytest.raises(FileError, match="each name once"):
        replace(octree, attributes=(label, label)).validate()
    with pytest.raises(VoxtoolError, match="attribute 'taste' is unknown: choose one of label"):
        replace(label, name="taste")
    with pytest.raises(VoxtoolError, match="attribute label of type int64: give u1 or u2 or u4"):
        replace(label, values=label.values.astype(np.int64))
    with pytest.raises(VoxtoolError, match=r"attribute colour of shape \(3, 3\): give \(N, 4\)"):
        Attribute("colour", np.zeros((3, 3), np.uint8), np.zeros((0, 4), np.uint8))
    with pytest.raises(VoxtoolError, match="has no attribute 'label', it has none"):
        scattered().attribute("label")


def test_damaged_files_are_refused_in_a_line(tmp_path: Path) -> None:
    import h5py

    path = tmp_path / "a.svo.h5"

    def damage(change: object, message: str) -> None:
        voxtool.write_svo(attributed(), path)
        with h5py.File(path, "r+") as h5:
            change(h5)  # type: ignore[operator]
        with pytest.raises(FileError, match=message):
            voxtool.read_svo(path)

    def replaced(name: str, array: np.ndarray) -> object:
        def change(h5: object) -> None:
            del h5[name]  # type: ignore[attr-defined]
            h5[name] = array  # type: ignore[index]

        return change

    def described(text: str) -> object:
        return lambda h5: h5.attrs.__setitem__("attributes", np.bytes_(text.encode()))

    damage(replaced("label_values", np.zeros(3, "<u2")), "3 values for .* voxels")
    damage(replaced("label_values", np.zeros(3, "<f4")), "label_values is not of type uint16")
    damage(replaced("label_names", np.frombuffer(b"one", "u1")), "a name is not ended")
    damage(replaced("label_names", np.frombuffer(b"\xff\0", "u1")), "label_names is not UTF-8")
    damage(described("[]"), "attributes is not a JSON object")
    damage(described('{"taste": {}}'), "'taste' is not described")
    damage(described('{"label": {"dtype": "O", "masked": false, "default": 0}}'), "dtype is 'O'")
    one = '{"label": {"dtype": "u2", "masked": false, "default": "x"}}'
    damage(described(one), "label has no such default")
