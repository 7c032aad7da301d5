"""A case of the selftest: a measurement, its oracle, and the largest correct error."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import MeshWarning, VoxtoolError, one_line

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.opencl import Device

    Measure = Callable[[Device, bool], float]


@dataclass(frozen=True)
class Case:
    """One line of the table: a few words, the work and its oracle, the unit of error and bound, and
    the largest correct error as documented.

    measure(device, full) returns the error; full asks for more and larger inputs.
    """

    name: str
    what: str
    unit: str
    bound: float
    measure: Measure

    def run(self, device: Device, full: bool = False) -> Outcome:
        """Measure. A faulty device may make anything fail: every exception is a verdict."""
        start = perf_counter()
        error, message = math.nan, ""
        try:
            # an error that is not a number is not within the bound
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore", MeshWarning)  # the meshes are bad on purpose
                error = float(self.measure(device, full))
        except VoxtoolError as failure:
            message = one_line(failure)
        except Exception as failure:
            message = f"{type(failure).__name__}: {one_line(failure)}"
        return Outcome(self, error, message, perf_counter() - start)


@dataclass(frozen=True)
class Outcome:
    """The outcome of a case: its error, or NaN and the message of an exception; and its seconds."""

    case: Case
    error: float
    message: str
    seconds: float

    @property
    def passed(self) -> bool:
        return self.error <= self.case.bound

    def as_dict(self) -> dict[str, Any]:
        """JSON types; an error that is not finite is null."""
        case = self.case
        return {
            "name": case.name, "what": case.what,
            "error": self.error if math.isfinite(self.error) else None, "bound": case.bound,
            "unit": case.unit, "verdict": "ok" if self.passed else "failed",
            "message": self.message, "seconds": self.seconds,
        }  # fmt: skip


def case(name: str, what: str, unit: str, bound: float) -> Callable[[Measure], Case]:
    """Return a decorator that makes a case of the function that measures it."""
    return lambda measure: Case(name, what, unit, bound, measure)
