"""The rows of `python -m tests.large_work`: both files are compared, and a peak is one's own."""

from __future__ import annotations

import numpy as np
import pytest

from tests import large_work


def test_a_row_of_a_command(monkeypatch: pytest.MonkeyPatch, here) -> None:
    work = "voxelize {bunny} --mode surface26 --dim 300 -o OUT"
    monkeypatch.setattr(large_work, "WORKS", ((work, "400k"),))
    head, row = large_work.rows({"bunny": "bunny.obj"}, 1)
    assert len(head) == len(row)
    assert row[:2] == ["`voxelize bunny.obj --mode surface26 --dim 300`", "400k"]
    assert all(float(cell.replace(",", "")) > 0 for cell in row[2:])
    monkeypatch.setattr("filecmp.cmp", lambda *_, **__: False)
    with pytest.raises(SystemExit, match="the files differ"):
        list(large_work.rows({"bunny": "bunny.obj"}, 1))


def test_a_failed_command_ends_it(here) -> None:
    with pytest.raises(SystemExit, match=r"voxelize absent\.obj: exit status"):
        large_work.measured("voxelize absent.obj")


def test_the_subdivided_mesh(here) -> None:
    assert large_work.write_subdivided("bunny.obj", "fine.ply") % 4**large_work.TIMES == 0
    assert np.fromfile("fine.ply", np.uint8).size > 1_000_000
