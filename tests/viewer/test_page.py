"""Pages without a browser: what they hold, how large they are, and what they refuse."""

from __future__ import annotations

import base64
import json
import re
import sys
import tempfile
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers import meshes
from helpers.cli import fail, run, told
from lxml import html

import voxtool
from voxtool.viewer import job, page
from voxtool.viewer.octrees import octree_content

MOST_BASE = 60_000  # bytes of a page without data
MOST_RATIO = 1.4  # of the bytes of a page's data to those of the file


def voxels_of(octree: voxtool.Octree) -> np.ndarray:
    """The voxels that a page holds, found by its description alone."""
    content = octree_content(octree)
    children, bricks = content.arrays["children"], content.arrays["bricks"]
    dense = np.zeros((1 << content.facts["root"],) * 3, bool)
    cells, at, brick = [(0, 0, 0)], 0, 0
    for d, count in enumerate(content.facts["levels"]):
        side, below = 1 << (content.facts["root"] - 1 - d), []
        assert count == len(cells)
        last = side == 4
        for x, y, z in cells:
            held, refined = map(int, children[at])
            at += 1
            for octant in range(8):
                low = (
                    x + side * (octant & 1),
                    y + side * (octant >> 1 & 1),
                    z + side * (octant >> 2),
                )
                if not held >> octant & 1:
                    continue
                if last:
                    mask = int(bricks[brick][0]) | int(bricks[brick][1]) << 32
                    brick += 1
                    for bit in (b for b in range(64) if mask >> b & 1):
                        place = [
                            sum((bit >> (3 * i + a) & 1) << i for i in range(2)) + low[a]
                            for a in range(3)
                        ]
                        dense[tuple(place)] = True
                elif refined >> octant & 1:
                    below.append(low)
                else:
                    dense[tuple(slice(n, n + side) for n in low)] = True
        cells = below
    assert (at, brick) == (len(children), len(bricks))
    return dense


@pytest.mark.parametrize("mode", ["solid", "surface26"])
@pytest.mark.parametrize("shape", [(3, 9, 2), (8, 8, 8), (20, 9, 33)])
def test_a_page_holds_the_voxels(shape: tuple[int, int, int], mode: str) -> None:
    rng = np.random.default_rng(sum(shape))
    dense = rng.random(shape) < 0.2
    dense[: shape[0] // 2] = True
    octree = voxtool.Octree.from_dense(dense, mode=mode)
    found = voxels_of(octree)
    assert found.sum() == dense.sum()
    assert np.array_equal(found[tuple(map(slice, shape))], dense)


def test_a_page_of_nothing() -> None:
    empty = voxtool.Octree.from_dense(np.zeros((8, 8, 8)))
    assert not voxels_of(empty).any()


def test_the_page_is_small_and_holds_its_data(here: Path) -> None:
    said = told("view bunny.svo.h5 --no-open --json")
    text = Path("bunny.html").read_text(encoding="utf-8")
    assert said["bytes"] == len(text.encode()) == said["base_bytes"] + said["data_bytes"]
    assert said["base_bytes"] < MOST_BASE
    with h5py.File("bunny.svo.h5") as file:
        assert said["data_bytes"] < MOST_RATIO * file.id.get_filesize()
    octree = voxtool.read_svo("bunny.svo.h5")
    content = octree_content(octree)
    assert said["digest"] == content.digest()
    tree = html.fromstring(text)
    for name, array in content.arrays.items():
        planes = zlib.decompress(base64.b64decode(tree.get_element_by_id(f"data-{name}").text))
        whole = np.frombuffer(planes, np.uint8).reshape(array.itemsize, -1).T
        assert np.array_equal(np.ascontiguousarray(whole).view(array.dtype).ravel(), array.ravel())


def test_a_mesh_is_voxelized_first(here: Path) -> None:
    run("view open.obj --no-open -q")
    expected = voxtool.voxelize("open.obj", dim=256)
    tree = html.fromstring(Path("open.html").read_text(encoding="utf-8"))
    assert json.loads(tree.get_element_by_id("facts").text)["voxels"] == expected.count


def test_stdin_and_stdout(here: Path) -> None:
    piped = run("view - -o - -q", stdin=Path("bunny.svo.h5").read_bytes()).stdout
    run("view bunny.svo.h5 --no-open -q")
    named = Path("bunny.html").read_text(encoding="utf-8")
    assert len(named.splitlines()) == len(piped.splitlines())


def test_a_name_that_is_no_utf_8(here: Path) -> None:
    Path("bunny.obj").rename("\udcff.obj")
    assert run("view \udcff.obj --no-open -o a.html").exit_code == 0
    assert "<title>octree ?.obj</title>" in Path("a.html").read_text("utf-8")


def test_markup_is_escaped() -> None:
    evil = "</script><img src=x onerror=alert(1)>&lt;$title"
    octree = voxtool.Octree.from_dense(np.ones((8, 8, 8)), units=evil)
    tree = html.fromstring(job.plan_view(octree, f"{evil}.svo.h5").run().html)
    assert not tree.xpath("//img")
    assert tree.xpath("//title")[0].text.endswith("onerror=alert(1)>&lt;$title.svo.h5")
    scripts = tree.xpath("//script[not(@type)]")
    assert len(scripts) == 1
    assert json.loads(tree.get_element_by_id("facts").text)["units"] == evil


def test_the_policy_names_the_script_and_forbids_the_rest() -> None:
    octree = voxtool.Octree.from_dense(np.ones((8, 8, 8)))
    text = job.plan_view(octree, "a").run().html
    policy = html.fromstring(text).xpath("//meta[@http-equiv]")[0].get("content")
    assert policy.startswith("default-src 'none'; ")
    assert "unsafe" not in policy
    assert re.findall(r"https?://", text) == []


def test_the_notebook_shows_a_frame() -> None:
    octree = voxtool.Octree.from_dense(np.ones((8, 8, 8)))
    made = job.plan_view(octree, "a").run()
    frame = html.fromstring(made._repr_html_())
    assert frame.get("srcdoc") == made.html
    assert "allow-same-origin" not in frame.get("sandbox")


def test_octrees_too_large_for_a_page(here: Path, monkeypatch) -> None:
    """The line names the finest level that fits, a dim, and --serve; and they fit."""
    monkeypatch.setattr(job, "MOST_DATA", 2_000)
    message = fail("view bunny.svo.h5 --no-open", 4)
    found = re.search(
        r"more than a page holds, 2 kB: --level (\d+) shows its nodes instead of voxels, or "
        r"voxelize with --dim (\d+) or so, or serve them beside the page \(voxtool view --serve",
        message,
    )
    assert found
    assert "more than a page" in fail(f"view bunny.svo.h5 --no-open --level {int(found[1]) - 1}", 4)
    said = told(f"view bunny.svo.h5 --no-open --level {found[1]} --json")
    assert said["base_bytes"] < MOST_BASE
    run(f"voxelize bunny.obj --dim {found[2]} -q -o small.svo.h5")
    run("view small.svo.h5 --no-open -q")


def test_fields_too_large_for_a_page(here: Path, monkeypatch) -> None:
    ball = voxtool.mesh_from_arrays(*meshes.icosphere(3))
    field = voxtool.build_adf(ball, tolerance=1e-2, max_level=7)
    assert not field.reached["missed"]
    monkeypatch.setattr(job, "MOST_DATA", job.plan_view(field, "a").plan.content.nbytes // 3)
    with pytest.raises(voxtool.MemoryLimitError) as error:
        job.plan_view(field, "a").run()
    found = re.search(
        r"build it with --max-level (\d) or --tolerance ([\d.e-]+),", str(error.value)
    )
    assert found
    for less in ({"max_level": int(found[1])}, {"tolerance": float(found[2]), "max_level": 7}):
        smaller = voxtool.build_adf(ball, **{"tolerance": 1e-2, **less})
        job.plan_view(smaller, "a").run()
        assert len(smaller.voxels) > len(field.voxels) / 20
    voxtool.write_adf(field, "ball.adf.h5")
    assert "is of octrees: this is a field" in fail("view ball.adf.h5 --level 1 --no-open", 3)


@pytest.mark.parametrize("level", [0, 1, 3])
def test_a_page_ends_at_a_level(level: int) -> None:
    dense = np.random.default_rng(5).random((33, 64, 50)) < 0.002
    dense[:16, :32, :40] = True
    octree = voxtool.Octree.from_dense(dense)
    content = octree_content(octree, level)
    assert set(content.arrays) == {"children", "shares"}
    side = 4 << level
    ends = [-n % side for n in dense.shape]
    padded = np.pad(dense, [(0, end) for end in ends])
    shape = [w for n in padded.shape for w in (n // side, side)]
    shares = padded.reshape(shape).mean(axis=(1, 3, 5))
    found = content.arrays["shares"]
    partly = shares[(shares > 0) & (shares < 1)].astype(np.float32)
    assert sorted(found[found < 1]) == sorted(partly)
    counts = octree.count_by_level()
    above = sum(count for number, count in counts.items() if number > level)
    assert found.sum() * side**3 + above == dense.sum()
    held = content.arrays["children"][:, 0]
    assert np.bitwise_count(held[-content.facts["levels"][-1] :]).sum() == len(found)


def test_comments_and_spaces_are_left_out_and_nothing_else() -> None:
    shader = page.fragment_of(octree_content(voxtool.Octree.from_dense(np.ones((8, 8, 8)))))
    for made in (shader, *map(page._scripts, ("octree", "field", "volume"))):
        assert "/**" not in made.replace("/** @type", "")
        assert not re.search(r"^\s*//", made, re.MULTILINE)
    assert "float brightness(" in shader
    for name in ("octree", "field", "volume"):
        files = (*page.SHARED, *page.EXTRAS[name], name)
        whole = "".join((page.ASSETS / f"{file}.js").read_text(encoding="utf-8") for file in files)
        code = re.sub(r"/\*(?s:.*?)\*/|^\s*//.*$| // .*$", "", whole, flags=re.MULTILINE)
        assert tokens(page._scripts(name)) == tokens(code)


def tokens(code: str) -> list[str]:
    """Return the words, texts and punctuation marks of a script, signs with the space before."""
    return re.findall(r'"(?:[^"\\\n]|\\.)*"|`[^`]*`|(?<=[-+])\s+[-+]|\w+|\S', code)


@pytest.mark.parametrize("notebook", [False, True])
def test_the_library_shows_a_page(notebook: bool, here: Path, monkeypatch) -> None:
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr("sys.modules", {**sys.modules, **({"ipykernel": sys} if notebook else {})})
    monkeypatch.setattr(tempfile, "tempdir", str(here))
    octree = voxtool.read_svo("bunny.svo.h5")
    shown = voxtool.view(octree)
    files = list(here.glob("voxtool-*/view.html"))
    assert len(files) == len(opened) == (not notebook)
    assert all(file.read_text(encoding="utf-8") == shown.html for file in files)
    named = voxtool.view(Path("bunny.svo.h5"), "a.html")
    assert Path("a.html").read_text(encoding="utf-8") == named.html
    assert named.content.digest() == shown.content.digest()
    assert opened[-1:] == ([] if notebook else [Path("a.html").absolute().as_uri()])


def test_meshes_are_shown_as_octrees() -> None:
    box = voxtool.mesh_from_arrays(*meshes.open_box(0, (4, 3, 2)))
    made = voxtool.plan_view(box).run()
    expected = voxtool.voxelize(box)
    assert made.content.digest() == octree_content(expected).digest()
    with pytest.raises(voxtool.VoxtoolError, match="cannot be drawn"):
        voxtool.plan_view(np.ones(3))


def test_a_page_of_a_field_is_small(here: Path) -> None:
    said = told("view bunny.adf.h5 --no-open --json")
    assert said["kind"] == "field"
    assert said["base_bytes"] < MOST_BASE
    with h5py.File("bunny.adf.h5") as file:
        assert said["data_bytes"] < MOST_RATIO * file.id.get_filesize()


def test_a_page_of_a_volume_is_small(here: Path) -> None:
    said = told("view volume.tet.h5 --no-open --json")
    assert said["kind"] == "volume"
    assert said["base_bytes"] < MOST_BASE
    with h5py.File("volume.tet.h5") as file:
        assert said["data_bytes"] < MOST_RATIO * file.id.get_filesize()


def test_headers_of_kernels_become_glsl() -> None:
    made = page.glsl_of("tets/pictures/segment.h")
    numbers = re.compile(r"\d+\.\d+(?:e-?\d+)?f")
    source = (page.kernel_folder() / "tets/pictures/segment.h").read_text(encoding="utf-8")
    code = re.sub(r"^\s*//.*\n", "", source, flags=re.MULTILINE)
    assert numbers.findall(made) == numbers.findall(code)
    for foreign in ("floats", "ints", "#include", "*zeta", "&", "to_int", "as_float"):
        assert foreign not in made
