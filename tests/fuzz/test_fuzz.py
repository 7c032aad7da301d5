"""Some cases of a fixed seed; `make fuzz` and the CI try others."""

from __future__ import annotations

from pathlib import Path

import pytest

from .cases import KINDS
from .driver import Session

CASES = {"files": 120, "arguments": 50}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_new_is_found(kind: str, device, tmp_path: Path) -> None:
    session = Session(tmp_path, 1, str(device.info.index), effort=0)
    assert session.run(kind, 0, seconds=300, most=CASES[kind]) == CASES[kind]
    assert not [found.finding for found in session.found.values()]
