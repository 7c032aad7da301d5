"""Octrees as voCCeL exports them, against files made by hand from [voCCeL, listing 5.1]."""

from __future__ import annotations

import gzip
import io
from pathlib import Path

import numpy as np
import pytest
from helpers.cli import fail, run, told
from helpers.files import assert_same, check_damaged, memory_below, refusal
from helpers.octree import ball, octree_from_dense
from lxml import etree

from voxtool import files
from voxtool.errors import FileError
from voxtool.files.octrees import svo_xml, voccel
from voxtool.grid import Grid
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.octree import Octree

VALID, INSIDE = 1 << 30, 1 << 31
SIZE, DEPTH = ' size="17"', ' depth="3"'


def by_hand(size: str = SIZE, depth: str = DEPTH, **words: int) -> str:
    """Return the document of a grid of dim 16 in which octant 1 (x from 8 on) is refined, octant 2
    (y from 8 on) is inside, and voxels (8, 0, 0) and (15, 7, 7) are set.

    It is indented as pugixml does. Words by the names root, refined, inside, empty and brick0 to
    brick7 replace those of the nodes.
    """
    children = [VALID + 2 * i for i in range(8)]  # 32-bit words of the bricks
    level1 = [words.get("empty", 0)] * 8
    level1[1], level1[2] = words.get("refined", VALID), words.get("inside", INSIDE)
    levels = [
        [(words.get("parent", 0), words.get("root", VALID))],
        [(VALID, child) for child in level1],
        [(VALID + 1, words.get(f"brick{i}", child)) for i, child in enumerate(children)],
    ]
    masks = [0] * 16
    masks[0], masks[15] = 1, 1 << 31
    text = "".join(
        "\t\t<level>\n"
        + "".join(f'\t\t\t<node parent="{p}" child="{c}" />\n' for p, c in nodes)
        + "\t\t</level>\n"
        for nodes in levels[: 2 + (words.get("levels", 3) == 3)]
    )
    held = "".join(f"\t\t<bitmask>{mask}</bitmask>\n" for mask in masks)
    return (
        f'<?xml version="1.0"?>\n<octree dim="16"{size}{depth}>\n\t<offset>0 1 9</offset>\n'
        f'\t<levels>\n{text}\t</levels>\n\t<subgrid size="16">\n{held}\t</subgrid>\n</octree>\n'
    )


def read(text: str | bytes) -> Octree:
    data = text.encode() if isinstance(text, str) else text
    return svo_xml.read(io.BytesIO(data), len(data))


def write(octree: Octree) -> bytes:
    file = io.BytesIO()
    svo_xml.write_voccel(octree, file)
    return file.getvalue()


def expected() -> np.ndarray:
    dense = np.zeros((16, 16, 16), bool)
    dense[8, 0, 0] = dense[15, 7, 7] = True
    dense[:8, 8:, :8] = True
    return dense


@pytest.mark.parametrize(
    "text",
    [
        by_hand(),
        by_hand(size=""),
        by_hand(depth=""),
        by_hand(size="", depth=""),
        by_hand().replace("offset>", "offsets>"),  # as the first line of the listing has it
        by_hand().replace("<octree", '<!DOCTYPE octree SYSTEM "svo.dtd">\n<octree'),
        by_hand(parent=7, empty=12345),  # links that are not valid
    ],
    ids=["listing", "no size", "no depth", "dim alone", "offsets", "doctype", "left links"],
)
def test_a_file_by_hand_is_read(text: str) -> None:
    octree = read(text)
    octree.validate()
    assert octree.grid == Grid((16, 16, 16), (0, 0, 0), (1, 1, 1))  # pyright: ignore
    assert (octree.mode, octree.fill) == ("solid", "parity")
    assert octree.offsets.tolist() == [0, 1, 9, 17]
    assert np.array_equal(octree.to_dense(), expected())


def by_listing(active: np.ndarray, masks: np.ndarray) -> str:
    """Return the document of an octree of dim 64, built from the ascending Morton codes of its
    active nodes of 8 voxels a side as [voCCeL, listing A.2] does, and the words of their bricks."""
    above = np.unique(active >> 3)  # the active nodes of 16 voxels a side
    level1 = np.zeros((8 * len(above), 2), np.int64)
    level1[:, 0] = VALID + np.repeat(above, 8)
    owners = 8 * np.searchsorted(above, active >> 3) + active % 8
    level1[owners, 1] = VALID + 8 * np.arange(len(active))
    level0 = np.stack([np.repeat(owners, 8), 2 * np.arange(8 * len(active))], axis=1) + VALID
    level2 = np.zeros((64, 2), np.int64)
    level2[:, 0] = VALID + np.arange(64) // 8
    level2[above, 1] = VALID + 8 * np.arange(len(above))
    level3 = np.stack([np.full(8, VALID), VALID + 8 * np.arange(8)], axis=1)
    levels = [np.array([[0, VALID]]), level3, level2, level1, level0]
    row = '<node parent="%d" child="%d"/>'
    text = "".join(
        "<level>" + "".join(row % tuple(node) for node in nodes.tolist()) + "</level>"
        for nodes in levels
    )
    size = sum(map(len, levels))
    return (
        f'<octree dim="64" size="{size}" depth="5"><offset>0 1 9 73 {73 + len(level1)}</offset>'
        f'<levels>{text}</levels><subgrid size="{masks.size}">'
        + "".join(f"<bitmask>{mask}</bitmask>" for mask in masks.tolist())
        + "</subgrid></octree>"
    )


def test_an_octree_by_listing_a2_is_read() -> None:
    """Voxel by voxel: x in the lowest bits of codes, and of the two words of a brick the low one
    first."""
    random = np.random.default_rng(7)
    active = np.sort(random.choice(512, 90, replace=False))
    masks = random.integers(0, 1 << 32, 16 * len(active))
    octree = read(by_listing(active, masks))
    expected = np.zeros((64, 64, 64), bool)
    for i, code in enumerate(active.tolist()):
        for j in range(512):  # voxels of a node in Morton order
            if masks[16 * i + j // 32] >> j % 32 & 1:
                bits = code << 9 | j
                x, y, z = (sum((bits >> 3 * b + a & 1) << b for b in range(6)) for a in range(3))
                expected[x, y, z] = True
    assert np.array_equal(octree.to_dense(), expected)
    assert np.array_equal(read(write(octree)).nodes, octree.nodes)


def test_what_is_written_is_the_file_by_hand() -> None:
    octree = read(by_hand())
    lines = [line.strip().replace(" />", "/>") for line in by_hand().splitlines()]
    written = write(octree).decode().replace("\n  ", " ").splitlines()
    assert written[1:] == lines[1:]


@pytest.mark.parametrize("mode", ["solid", "surface26"])
def test_there_and_back(mode: str, tmp_path: Path) -> None:
    """A grid and a mode give back all that the file leaves out."""
    octree = octree_from_dense(ball((19, 16, 11)), mode, "parity" if mode == "solid" else "none")
    files.write_svo(octree, tmp_path / "a.voccel.xml")
    text = (tmp_path / "a.voccel.xml").read_text()
    assert "mode" not in text
    assert "origin" not in text
    found = files.read_svo(tmp_path / "a.voccel.xml")
    assert found.grid.shape == (19,) * 3
    assert_same(voccel.placed(found, octree.grid, mode), octree)
    with pytest.raises(FileError, match=r"its dim is 19, that of the grid is 20: name a grid"):
        voccel.placed(found, Grid((20, 19, 1), (0, 0, 0), (1, 1, 1)), None)  # pyright: ignore
    with pytest.raises(FileError, match="padding"):
        voccel.placed(found, Grid((19, 9, 1), (0, 0, 0), (1, 1, 1)), None)  # pyright: ignore


def test_merged_subtrees_are_refused(tmp_path: Path) -> None:
    merged = MergedOctree.of(octree_from_dense(ball((9, 9, 9))))
    with pytest.raises(FileError, match="holds no merged subtrees"):
        files.write_svo(merged, tmp_path / "a.voccel.xml")


# The command line


def test_commands(here: Path) -> None:
    """import gives back the place and the mode, which the file leaves out."""
    run("voxelize bunny.obj --dim 16 --mode surface26 -o a.svo.h5")
    run("voxelize bunny.obj --dim 16 --mode surface26 -o a.voccel.xml --doctype")
    assert Path("a.voccel.xml").read_text().splitlines()[1] == svo_xml.DOCTYPE.strip()
    run("import a.voccel.xml --like a.svo.h5 --mode surface26 -o b.svo.h5")
    run("import - --from voccel.xml -o c.svo.h5", Path("a.voccel.xml").read_bytes())
    one, two, three = map(files.read_svo, ("a.svo.h5", "b.svo.h5", "c.svo.h5"))
    assert one.digest() == two.digest()
    assert (three.mode, three.grid.pitch, three.count) == ("solid", (1.0,) * 3, one.count)
    run("svo-dag --expand a.svo.h5 -o d.voccel.xml")
    assert Path("d.voccel.xml").read_bytes() == write(one)
    assert told("svo-info --dtd --json") == {"dtd": svo_xml.DTD.read_text()}
    assert "Missing argument 'FILE'" in fail("svo-info", 2)
    Path("octree.dtd").write_text(run("svo-info --dtd").stdout)
    parser = etree.XMLParser(dtd_validation=True, load_dtd=True)
    root = etree.parse("a.voccel.xml", parser).getroot()
    assert root.attrib == {"dim": "16", "size": str(len(one.nodes)), "depth": "3"}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("import a.npy --mode solid", "--like and --mode go with a .voccel.xml"),
        ("import a.voccel.xml --threshold 1 --plan", "drop --threshold and --plan"),
        ("voxelize bunny.obj --doctype", "--doctype goes with .svo.xml and .voccel.xml"),
    ],
)
def test_options_that_do_not_go_together(here: Path, command: str, message: str) -> None:
    assert message in fail(command, 2)


# Hostile files


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (by_hand(brick3=VALID + 3), "level 0, node 3 links to word 3, where no brick begins"),
        (by_hand(brick3=VALID + 2), "brick link"),
        (by_hand(brick3=INSIDE + VALID + 6), "brick link|inside flag"),
        (by_hand(brick3=6), "brick link"),
        (by_hand(inside=INSIDE + VALID), "children: 2 refined nodes on level 1"),
        (by_hand(refined=INSIDE + VALID), "inside flag of a refined node"),
        (by_hand(refined=VALID + 8), "child link"),
        (by_hand(root=0), "children: 0 refined"),
        (by_hand(parent=VALID), "parent link of the root"),
        (by_hand(levels=2), "2 levels where 3 are declared"),
        (by_hand(levels=2, size=""), "2 levels where 3 are declared|level element"),
        (by_hand(size=' size="9"'), "level element 3 has 8 nodes, not 0|more than the 18 node"),
        (by_hand(size=' size="16"'), "not a multiple of 8"),
        (by_hand(size=' size="x"'), "'x' is no unsigned 32-bit"),
        (by_hand(size=' size="17 17"'), "size '17 17' where the offsets say 17"),
        (by_hand(size=' size="81"'), "a level has more nodes"),
        (by_hand(size=' size="4294967295"'), "multiple of 8|more nodes"),
        (by_hand(depth=' depth="2"'), "attribute depth is '2' where 3 is expected"),
        (by_hand().replace("0 1 9<", "0 1 10<"), "not a multiple of 8"),
        (by_hand().replace("0 1 9<", "9 1 0<"), "ascend|size"),
        (by_hand(size="").replace("0 1 9<", "9 1 0<"), "ascend|size"),
        (by_hand(size="").replace("0 1 9<", "0 1 4294967295<"), "cannot hold|more nodes|multiple"),
        (by_hand(size="").replace('size="16"', 'size="18"'), "size '18' where the offsets say 16"),
        (by_hand().replace("0 1 9<", "0 1<"), "1 levels, but a grid of dim 16 has 3"),
        (by_hand().replace("<octree", '<octree units="m"'), "2 levels, but a grid of dim 16 has 3"),
    ],
)
def test_hostile_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.voccel.xml").write_text(text)
    refusal(files.read_svo, tmp_path / "a.voccel.xml", message)


def test_levels_without_a_size_take_no_memory_that_the_file_does_not_hold(tmp_path: Path) -> None:
    text = b'<octree dim="65536"><offset>0 1 9 73 585 4681 37449 299593 2396745 19173961 '
    text += b"153391689 1000000009 1000000009 1000000009 1000000009</offset><levels>"
    (tmp_path / "a.xml").write_bytes(text)
    (tmp_path / "a.xml.gz").write_bytes(gzip.compress(text, mtime=0))
    for name in ("a.xml", "a.xml.gz"):
        with memory_below(4 << 20):
            refusal(files.read_svo, tmp_path / name, "which the file cannot hold")


def test_too_many_bricks_for_the_links(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voccel, "MAX_BRICKS", 7)
    with pytest.raises(FileError, match=r"8 bricks are more than the 7 .* write \.svo\.xml"):
        write(read(by_hand()))


@pytest.mark.slow
@pytest.mark.parametrize("size", [SIZE, ""])
def test_damage_of_any_kind(size: str) -> None:
    def used(data: bytes) -> Octree:
        found = read(data)
        assert np.count_nonzero(found.to_dense()) == found.count
        return found

    check_damaged(by_hand(size).encode(), used, seeds=1, least=60)
