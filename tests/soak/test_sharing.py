"""Pairs of processes on one output, and kills of processes and of their helpers, of every command
that writes."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from helpers_cli import run
from helpers_writers import WINDOWED, WRITERS, Outputs, check_kill, check_pair

pytestmark = pytest.mark.soak


@pytest.fixture(scope="module")
def outputs(models: Path, tmp_path_factory: pytest.TempPathFactory) -> Outputs:
    run(f"voxelize {models}/bunny.obj --dim 400 -q -o {models}/big.svo.h5")
    run(f"voxelize {models}/open.obj --like {models}/big.svo.h5 -q -o {models}/other.svo.h5")
    return Outputs(models, tmp_path_factory.mktemp("outputs"))


def test_two_runs_on_one_output(rounds, outputs: Outputs, tmp_path: Path) -> None:
    """Half of them in windows, where what waits could be mixed."""
    codes: Counter[int] = Counter()
    for rng in rounds:
        writer = rng.choice(rng.choice([WINDOWED, WRITERS]))
        codes.update(check_pair(writer, rng, outputs, tmp_path))
    print(f"soak: exit codes of pairs: {dict(codes)}")


def test_killed_commands_leave_nothing_half(rounds, outputs: Outputs, tmp_path: Path) -> None:
    codes: Counter[int] = Counter()
    for rng in rounds:
        codes.update(check_kill(rng.choice(WRITERS), rng, outputs, tmp_path))
    print(f"soak: exit codes of kills: {dict(codes)}")
