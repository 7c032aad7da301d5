"""A case of the selftest: what is measured, against what, and how wrong it may be."""

from __future__ import annotations

import math
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import VoxtoolError, one_line

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.opencl import Device

    Measure = Callable[[Device, bool], float]


@dataclass(frozen=True)
class Case:
    """One line of the table.

    name : a few words; what : what is held against which oracle.
    unit : of error and bound; bound : the largest error that is right, by what docs promise.
    measure : called as measure(device, full) for the error; full asks for more and larger inputs.
    """

    name: str
    what: str
    unit: str
    bound: float
    measure: Measure

    def run(self, device: Device, full: bool = False) -> Outcome:
        """Measure. A device that is wrong may make anything fail: that is a verdict, too."""
        start = perf_counter()
        error, message = math.nan, ""
        try:
            with np.errstate(all="ignore"):  # what is no number is no error within the bound
                error = float(self.measure(device, full))
        except VoxtoolError as failure:
            message = one_line(failure)
        except Exception as failure:
            message = f"{type(failure).__name__}: {one_line(failure)}"
        return Outcome(self, error, message, perf_counter() - start)


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    error : as measured, NaN if it failed; message : how it failed, or "". seconds : it took.
    """

    case: Case
    error: float
    message: str
    seconds: float

    @property
    def passed(self) -> bool:
        return self.error <= self.case.bound

    def as_dict(self) -> dict[str, Any]:
        """JSON types; an error that is no number is null."""
        return {
            "name": self.case.name,
            "what": self.case.what,
            "error": self.error if math.isfinite(self.error) else None,
            "bound": self.case.bound,
            "unit": self.case.unit,
            "verdict": "ok" if self.passed else "failed",
            "message": self.message,
            "seconds": self.seconds,
        }


def case(name: str, what: str, unit: str, bound: float) -> Callable[[Measure], Case]:
    """Make a case of the function that measures it."""
    return lambda measure: Case(name, what, unit, bound, measure)
