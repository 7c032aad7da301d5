"""Some cases of a fixed seed, each kind on one driver; `make fuzz` and the CI try others."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import opened, usable_devices

from . import samples
from .cases import KINDS, Case
from .driver import Session
from .worker import Worker

# how many, and the place of the driver
CASES = {"files": (80, 0), "looks": (60, 0), "lies": (60, -1), "arguments": (40, -1)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_new_is_found(kind: str, tmp_path: Path) -> None:
    count, driver = CASES[kind]
    session = Session(tmp_path, 1, str(usable_devices()[driver][0]), effort=0)
    assert session.run(kind, 0, seconds=300, most=count) == count
    assert not [found.finding for found in session.found.values()]


@pytest.mark.slow
def test_a_process_that_ends_is_replaced(tmp_path: Path) -> None:
    """Its case is named, and those sent with it are tried again."""
    index = usable_devices()[0][0]
    samples.write_all(tmp_path, opened(index))
    worker = Worker(tmp_path, str(index), limit=1)
    quick = Case(0, words=("svo-info", "a.svo.h5"))
    slow = Case(1, words=("bench", "voxelize", "a.obj", "--dims", "256", "--repeat", "1000"))
    try:
        before, found, after = worker.ask_all([quick, slow, quick])
    finally:
        worker.stop()
    assert before == after == []
    assert [finding.what for finding in found] == ["hang"]
