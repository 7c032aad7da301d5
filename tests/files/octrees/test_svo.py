"""Octrees as XML, and as data: what is written is read, and what is damaged, hostile or unsound is
refused in one line. test_records.py has what all formats share."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.files import assert_same, check_damaged, memory_below, refusal
from helpers.octree import golden_octree, octree_from_dense
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool import files
from voxtool.errors import FileError
from voxtool.files.octrees import svo_hdf5, svo_xml
from voxtool.files.storage import hdf5
from voxtool.grid import Grid
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.layout import INSIDE, VALID
from voxtool.svo.octree.octree import Octree

WRITE = {"svo.h5": svo_hdf5.write, "svo.xml": svo_xml.write, "svo.xml.gz": svo_xml.write_gz}
READ: dict[str, Callable[[Any, int], Octree]] = {
    "svo.h5": lambda file, size: hdf5.read([svo_hdf5.SCHEMA], file, size),
    "svo.xml": svo_xml.read,
    "svo.xml.gz": svo_xml.read_gz,
}


def to_bytes(octree: Octree, extension: str = "svo.xml") -> bytes:
    file = io.BytesIO()
    WRITE[extension](octree, file)
    return file.getvalue()


def from_bytes(data: bytes, extension: str = "svo.xml") -> Octree:
    return READ[extension](io.BytesIO(data), len(data))


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


# The octree itself


@given(dense=dense_arrays())
@settings(max_examples=40)
def test_slabs_are_the_dense_array(dense: np.ndarray) -> None:
    for mode in ("solid", "surface26"):
        octree = octree_from_dense(dense, mode, "none")
        image = VoxelImage.of(octree)
        for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
            found = np.concatenate(list(image.slabs(order)))
            assert np.array_equal(found, dense.transpose(order))
        found = np.concatenate(list(image.coordinates()))
        assert np.array_equal(found, np.argwhere(dense))
        assert octree.count == len(found)


def corrupt(name: str, index: Any, value: Any) -> Callable[[Octree], Octree]:
    """A change of an array of an octree, or of a field of its nodes ("parent" or "child")."""

    def change(octree: Octree) -> Octree:
        field = name in ("parent", "child")
        array = octree.nodes.copy() if field else getattr(octree, name).copy()
        (array[name] if field else array)[index] = value
        return replace(octree, **{"nodes" if field else name: array})

    return change


# golden_octree: offsets 0 1 9 25 121; the root and its first two children are refined
CORRUPTIONS = {
    "levels, but a grid": lambda o: replace(o, offsets=o.offsets[:-1]),
    "and ascend": corrupt("offsets", 0, 1),
    "not a multiple of 8": corrupt("offsets", 2, 10),
    "more nodes than the level above": corrupt("offsets", 2, 17),
    "they end at": lambda o: replace(o, nodes=o.nodes[:-8]),
    "octree bricks: 95 for 96": lambda o: replace(o, bricks=o.bricks[:-1]),
    "octree children: 1 refined nodes": corrupt("child", 1, 0),
    "inside flag of a refined node": corrupt("child", 0, VALID | INSIDE),
    "brick link": corrupt("child", 30, VALID | np.uint32(6)),
    "child link": corrupt("child", 2, VALID | np.uint32(16)),
    r"leaf \(link bits": corrupt("child", 3, 8),
    "inside flag of a surface": lambda o: replace(corrupt("child", 3, INSIDE)(o), mode="surface26"),
    "parent link of the root": corrupt("parent", 0, VALID),
    r"parent link \(the parent": corrupt("parent", 100, VALID),
    "octree padding: level 2, node 5": corrupt("child", 6, INSIDE),
    "octree padding: level 0": corrupt("bricks", slice(None), np.uint64(2**64 - 1)),
}


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_validate_names_the_broken_invariant(name: str) -> None:
    with pytest.raises(FileError, match=name):
        CORRUPTIONS[name](golden_octree()).validate()


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


# Round trips


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
    origin=st.tuples(*[st.floats(-1e90, 1e90)] * 3),
    pitch=st.tuples(*[st.floats(1e-95, 1e88)] * 3),
)
@settings(max_examples=50)
def test_every_float_survives(origin, pitch) -> None:
    octree = replace(golden_octree(), grid=Grid((19, 16, 11), origin, pitch))
    for extension in ("svo.h5", "svo.xml"):
        assert_same(from_bytes(to_bytes(octree, extension), extension), octree)


@pytest.mark.parametrize("extension", ["svo.xml", "svo.xml.gz", "xml", "XML.GZ"])
def test_format_is_chosen_by_extension_and_read_by_content(extension: str, tmp_path: Path) -> None:
    """The bytes depend on the content alone."""
    path = tmp_path / f"a.{extension}"
    files.write_svo(golden_octree(), path)
    assert path.read_bytes().startswith(b"<?xml" if extension[-1] in "lL" else b"\x1f\x8b")
    files.write_svo(golden_octree(), tmp_path / "b", format=extension.lower())
    assert (tmp_path / "b").read_bytes() == path.read_bytes()
    assert_same(files.read_svo(path.rename(tmp_path / "no-extension")), golden_octree())


def test_xml_is_valid_by_the_packaged_dtd() -> None:
    from lxml import etree

    with svo_xml.DTD.open("rb") as file:
        dtd = etree.DTD(file)
    for octree in (golden_octree(), octree_from_dense(np.zeros((9, 8, 8), bool))):
        assert dtd.validate(etree.fromstring(to_bytes(octree))), dtd.error_log


def test_plain_xml_needs_dim_alone() -> None:
    text = b"""<octree dim='8'><offset> 0 1\n9 </offset><levels><level>
      <node child="1073741824" parent="0"/></level><level>%s</level></levels>
      <subgrid size="16">%s<bitmask> 7 </bitmask></subgrid></octree>""" % (
        b"".join(b'<node parent="1073741824" child="%d"/>' % (VALID + n) for n in range(8)),
        b"<!-- low half first --><bitmask>0</bitmask>" * 15,
    )
    octree = from_bytes(text)
    assert octree.grid == Grid((8, 8, 8), (0, 0, 0), (1, 1, 1))  # pyright: ignore
    assert octree.bricks.tolist() == [0] * 7 + [7 << 32]


# Hostile XML


def edited(old: str, new: str, count: int = 1) -> bytes:
    whole = to_bytes(golden_octree()).decode()
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
    refusal(files.read_svo, tmp_path / "a.svo.xml", message)


def test_xml_with_a_doctype_reads_and_fetches_nothing() -> None:
    assert_same(from_bytes(edited(OPENING, DOCTYPE)), golden_octree())


@pytest.mark.parametrize("old", ['units="', "<offset>", '<node parent="', "<bitmask>"])
@pytest.mark.parametrize("padding", range(65_300, 65_540, 16))
def test_entities_after_a_doctype_are_refused(old: str, padding: int) -> None:
    doctype = f"{DOCTYPE}<!--{' ' * padding}-->"  # the reference meets the end of a chunk
    data = edited(OPENING, doctype).replace(old.encode(), f"{old}&x;".encode(), 1)
    with pytest.raises(FileError, match="entities are refused"):
        from_bytes(data)
    data = edited(OPENING, doctype).replace(old.encode(), f"{old}&#x20;".encode(), 1)
    if "node" not in old:  # a number there is strict: no spaces
        assert_same(replace(from_bytes(data), units="mm"), golden_octree())


def test_xml_error_names_the_line(tmp_path: Path) -> None:
    (tmp_path / "a.svo.xml").write_bytes(edited("<levels>", "<levels><oops/>"))
    refusal(files.read_svo, tmp_path / "a.svo.xml", "line 17: element oops inside levels")


def test_xml_in_utf16_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.svo.xml").write_bytes(to_bytes(golden_octree()).decode().encode("u16"))
    refusal(files.read_svo, tmp_path / "a.svo.xml", "no octree")


def test_xml_newer_minor_version_reads() -> None:
    data = edited('format_version="1.0"', 'format_version="1.4" labels="none"')
    assert_same(from_bytes(data), golden_octree())


def test_gzip_bomb_takes_neither_memory_nor_time(tmp_path: Path) -> None:
    head = to_bytes(golden_octree()).split(b"<levels>")[0]
    row = b'<node parent="0" child="0"/>\n'
    for bomb in (b" " * 200_000_000, b"<levels><level>" + row * 7_000_000):
        path = tmp_path / "a.svo.xml.gz"
        path.write_bytes(gzip.compress(head + bomb, 1, mtime=0))
        with memory_below(4 << 20):
            refusal(files.read_svo, path, "more text than its declared|more than the 242 node")


@pytest.mark.parametrize("extension", ["svo.xml", "svo.xml.gz"])
def test_declared_nodes_that_the_file_cannot_hold(tmp_path: Path, extension: str) -> None:
    text = b'<octree dim="65536"><offset>0 1 9 73 585 4681 37449 299593 2396745 19173961 '
    text += b"153391689 %d %d %d %d %d</offset><levels>" % (*[1000000009] * 4, 1000000009)
    path = tmp_path / f"a.{extension}"
    path.write_bytes(gzip.compress(text, mtime=0) if extension.endswith("gz") else text)
    with memory_below(4 << 20):
        refusal(
            files.read_svo, path, "1,000,000,009 nodes are declared, which the file cannot hold"
        )


# Damage of any kind


@pytest.mark.slow
@pytest.mark.parametrize("extension", ["svo.xml", "svo.xml.gz"])
def test_damage_of_any_kind(extension: str) -> None:
    def read(data: bytes) -> Octree:
        found = from_bytes(data, extension)
        assert np.count_nonzero(found.to_dense()) == found.count
        return found

    check_damaged(to_bytes(golden_octree(), extension), read, seeds=1, least=80)
