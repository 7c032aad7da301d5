"""Arrays of data classes: read-only, and equal by content."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np


def read_only(array: np.ndarray) -> np.ndarray:
    """A view of an array that cannot be written to; the array itself stays as it is."""
    view = array.view()
    view.flags.writeable = False
    return view


def equal(a: Any, b: Any) -> bool:
    """Whether two dataclass instances are of one class and all their fields are equal; arrays by
    shape, dtype and content."""
    if type(a) is not type(b):
        return False
    return all(_same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.compare)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    return bool(a == b)
