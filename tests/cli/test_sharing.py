"""Two runs on one output, and killed runs: a small instance of tests/soak/test_sharing.py."""

from __future__ import annotations

import os
import random
import signal
from pathlib import Path

import pytest
from helpers.writers import WRITERS, Outputs, check_kill, check_pair, made, start, until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name == "nt", reason="signals of POSIX"),
]
BY_NAME = {writer.name: writer for writer in WRITERS}


@pytest.fixture(scope="module")
def outputs(models: Path, tmp_path_factory: pytest.TempPathFactory) -> Outputs:
    return Outputs(models, tmp_path_factory.mktemp("outputs"))


def test_beside_a_stopped_run_every_other_is_refused(outputs: Outputs, tmp_path: Path) -> None:
    """The first then goes on to its own octree."""
    writer, models = BY_NAME["windows"], outputs.models
    first = start(writer, 0, models, tmp_path)
    until(lambda: any(tmp_path.glob("*.windows/*/*.0")))
    os.killpg(first.pid, signal.SIGSTOP)
    others = [start(writer, n, models, tmp_path, more) for n, more in ((1, ""), (0, "--resume"))]
    for other in others:
        _, said = other.communicate(timeout=120)
        assert (other.returncode, said.count("\n")) == (3, 1)
        assert f"another run (process {first.pid} on " in said
    os.killpg(first.pid, signal.SIGCONT)
    assert first.communicate(timeout=120) == (None, "")
    assert first.returncode == 0
    assert made(tmp_path) == outputs.of(writer, 0)


def test_two_runs_on_one_folder(outputs: Outputs, tmp_path: Path) -> None:
    check_pair(BY_NAME["slices"], random.Random(1), outputs, tmp_path)


def test_a_killed_run_leaves_nothing_half(outputs: Outputs, tmp_path: Path) -> None:
    check_kill(BY_NAME["zarr"], random.Random(2), outputs, tmp_path)
