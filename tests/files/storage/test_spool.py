"""Arrays that wait in a file without a name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from voxtool.errors import FileError
from voxtool.files.storage.spool import Spool


def test_two_spools_of_one_target_do_not_meet(tmp_path: Path) -> None:
    with Spool(tmp_path / "a") as one, Spool(tmp_path / "a") as two:
        assert not list(tmp_path.iterdir())
        pieces = [(store, store.put(np.arange(n, n + 9.0).reshape(3, 3)), n)
            for n in range(20) for store in (one, two)]  # fmt: skip
        for store, piece, n in pieces:
            np.testing.assert_array_equal(store.get(piece), np.arange(n, n + 9.0).reshape(3, 3))
        two.clear()
        np.testing.assert_array_equal(one.mapped(np.float64, (180,))[:9], np.arange(9.0))
        with pytest.raises(FileError, match="the disk lost what waited there"):
            two.get(pieces[1][1])
