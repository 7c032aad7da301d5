"""voxtool adf-info: summaries, JSON, digests and refusals."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.cli import fail, run, told, write_obj
from helpers.field import plain_field, point

from voxtool import read_adf, write_adf
from voxtool.adf.field.cells import cell_of

DATA = Path(__file__).parents[1] / "data"
GOLDEN = """\
origin       -1.5 0.1 0.001 mm
side         2.5 mm
sign         winding
tolerance    0.001 sides, 0.0025 mm
band         everywhere
levels       to 2, at most 2 asked for
leaves       64
faces        neighbours of other level may disagree
jumps        in 1 of 64 leaves, as across a hole
bytes        4,980
memory       1,516 bytes, 23.7 a leaf
steepest     1.5
hash         m 3, r 4, with w; load 33.3 %, 228 bits a key; identifiers of 32 bits

texture            bytes   x, y, z, channels
voxels               972       9 x 9 x 3 x 1   52.5 % less than eight float32 a leaf, 57.8 % a cell
cells                216       3 x 3 x 3 x 2   87.7 % less than with leaves
hash                 256       4 x 4 x 4 x 4
bounds                72       6 x 6 x 2 x 1

level        cells       leaves
    0            1            0
    1            8            0
    2            0           64

reached
  error: max 0.5, rms 0.25
  samples: 7

left out
  64-bit identifiers: levels 0 to 2

check: ok
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch) -> Path:
    """A folder with the golden field, and one without bounds whose identifiers have 64 bits."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(DATA / "v2.0.adf.h5", "small.adf.h5")
    deep = plain_field(
        lambda p: np.sqrt(point(p)),
        3e-3,
        14,
        bounds=False,
        band=0.125,
        continuous=True,
        reached={"error": {"max": 0.5, "\x1b[2J": [1, {"deep": None}]}, "samples": 1234567},
    )
    write_adf(deep, "deep.adf.h5")
    return tmp_path


def test_golden_field(here: Path) -> None:
    result = run("adf-info small.adf.h5 --check -v")
    assert result.stderr == ""
    assert result.stdout == GOLDEN
    first = GOLDEN[: GOLDEN.index("memory")]
    assert run("adf-info small.adf.h5 --check").stdout == f"{first}\ncheck: ok\n"


def test_deep_field(here: Path) -> None:
    text = run("adf-info deep.adf.h5 -v").stdout
    for words in (
        "band         0.125 sides, 0.125\n",
        "faces        neighbours agree\n",
        "jumps        unknown: without bounds\n",
        "identifiers of 64 bits\n",
        '  error: max 0.5, ?[2J (1, {"deep": null})\n',
        "  samples: 1,234,567\n",
    ):
        assert words in text
    assert "bounds  " not in text
    assert "check" not in text


@pytest.mark.parametrize("name", ["small.adf.h5", "deep.adf.h5"])
def test_json(name: str, here: Path) -> None:
    field = read_adf(name)
    found = told(f"adf-info {name} --json --check --digest")
    assert (found["check"], found["digest"]) == ("ok", field.digest())
    assert found["file_bytes"] == os.path.getsize(name)
    assert found["textures"] == field.sizes()
    with h5py.File(name) as file:
        shapes = {key: np.shape(file[key]) for key in found["textures"]}
    assert found["shapes"] == {
        key: [*shape[2::-1], *(shape[3:] or (1,))] for key, shape in shapes.items()
    }
    assert found["memory_bytes"] == sum(field.sizes().values())
    assert found["origin"] == list(field.origin)
    assert found["band"] == (None if np.isinf(field.band) else field.band)
    for attribute in ("side", "units", "sign", "tolerance", "max_level", "continuous", "lipschitz",
                      "depth", "reached", "plan", "source_sha256"):  # fmt: skip
        assert found[attribute] == getattr(field, attribute)
    cells, leaves = ([level[what] for level in found["levels"]] for what in ("cells", "leaves"))
    assert sum(cells) == found["blocks"] == len(field.voxels)
    assert sum(leaves) == found["leaves"] == 7 * found["blocks"] + 1
    assert cells == np.bincount(cell_of(field.blocks)[0], minlength=field.depth + 1).tolist()
    assert sum(n / 8**level for level, n in enumerate(leaves)) == pytest.approx(1)  # the cube
    hashed = found["hash"]
    assert (hashed["m"], hashed["r"], hashed["w"]) == (
        field.hash.m, field.hash.r, field.hash.has_w,
    )  # fmt: skip
    assert hashed["load"] == found["blocks"] / hashed["m"] ** 3
    assert hashed["bits_a_key"] == 8 * field.hash.offsets.nbytes / found["blocks"]
    assert hashed["identifier_bits"] == (64 if field.depth > 11 else 32)
    assert found["jumps"] == (1 if name == "small.adf.h5" else None)


def test_savings_are_those_of_the_text(here: Path) -> None:
    saved = told("adf-info deep.adf.h5 --json")["saved"]
    assert saved["voxels_of_cells"] == pytest.approx(1 - 27 / 64)  # "about 57 %"
    assert saved["voxels_of_leaves"] == pytest.approx(1 - 27 / 56, abs=1e-4)
    assert saved["cells"] == pytest.approx(7 / 8, abs=1e-4)  # "up to 87 %"


def test_digest_and_stdin(here: Path) -> None:
    digest = read_adf("deep.adf.h5").digest()
    assert run("adf-info deep.adf.h5 --digest").stdout == f"{digest}\n"
    data = Path("deep.adf.h5").read_bytes()
    assert run("adf-info - --digest", data).stdout == f"{digest}\n"
    assert "file_bytes" not in told("adf-info - --json", data)


@pytest.mark.parametrize("flag", ["", "--check", "--digest", "--json"])
def test_altered_field_is_refused_by_its_invariant(flag: str, here: Path) -> None:
    with h5py.File("small.adf.h5", "r+") as file:
        cells = file["cells"]
        assert isinstance(cells, h5py.Dataset)
        cells[0, 0, 0, 0] ^= 1
    assert "small.adf.h5: field" in fail(f"adf-info small.adf.h5 {flag}")


def test_failures_are_one_line(here: Path) -> None:
    write_obj(here / "bunny.obj", np.eye(3), [[0, 1, 2]])
    assert fail("adf-info bunny.obj") == (
        "bunny.obj is a mesh: build a field first: voxtool adf-build bunny.obj"
    )
    assert "voxelize a mesh first" in fail("svo-info small.adf.h5")
    assert "there is no such file" in fail("adf-info none.adf.h5")
    assert "stdin is empty" in fail("adf-info -")
