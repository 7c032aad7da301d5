"""Jobs: work that is planned once, described, and then run or refused.

A wing's `plan_...` function reads and surveys its input, decides, and returns a Job. Its decisions
are a Plan: a frozen dataclass of plain numbers, which says everything that can be said beforehand.
`--plan`, the progress bar, `-v`, the benchmarks and the stored output all read the same Plan, and
`run()` follows it.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import inspect
import os
import sys
import warnings
from abc import ABC, abstractmethod
from dataclasses import astuple, dataclass, fields, replace
from operator import attrgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Generic, ParamSpec, Self, TypeVar

from voxtool.errors import MemoryLimitError, MeshWarning, human
from voxtool.memory import available_memory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from voxtool.opencl import Device

Options = ParamSpec("Options")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Cost:
    """Predicted bytes: at peak on the device and on the host beside it, and of the largest single
    allocation on the device."""

    device: int
    host: int = 0
    largest: int = 0

    @classmethod
    def most(cls, costs: Iterable[Cost]) -> Cost:
        """Return the largest of each number; 0 if there are none."""
        found = [astuple(cost) for cost in costs]
        return cls(*map(max, zip(*found, strict=True))) if found else cls(0)

    def shortage(self, max_memory: int, max_allocation: int) -> str:
        """Return what a message says if the device has fewer bytes than these, in total or in one
        buffer, or the host where there is no device; otherwise ""."""
        if not self.device:
            short = self.host > max_memory
            needed = f"would need {human(self.host)} of memory, of {human(max_memory)} allowed"
            return needed if short else ""
        if self.device <= max_memory and self.largest <= max_allocation:
            return ""
        return (
            f"would need {human(self.device)} of memory ({human(self.largest)} in one buffer), of "
            f"{human(max_memory)} ({human(max_allocation)}) allowed"
        )


class Plan(ABC):
    """The decisions of a job before it runs: the base of frozen dataclasses of numbers, names and
    tuples.

    Attributes
    ----------
    stages
        the stages that will run, in order.
    reasons
        why parts are not compiled, allocated or run, by their names; "" if they are.
    facts
        attributes that `as_dict` gives before the stages, as "name" or "name: path.to.it"; by
        default all fields.
    predicted, costs
        attributes, in the same way, and members of `cost` that it gives after what is left out.
    refusal
        text of the error if memory is short, with {plan} and {shortage}.
    """

    stages: Sequence[str]
    reasons: Mapping[str, str] = MappingProxyType({})
    facts: ClassVar[tuple[str, ...] | None] = None
    predicted: ClassVar[tuple[str, ...]] = ()
    costs: ClassVar[tuple[str, ...]] = ("device",)
    refusal: ClassVar[str]

    @property
    @abstractmethod
    def cost(self) -> Cost:
        """The memory that the job is predicted to take."""

    @property
    def left_out(self) -> dict[str, str]:
        """Reasons by the name of what is not compiled, allocated or run."""
        return {what: why for what, why in self.reasons.items() if why}

    def decisions(self) -> dict[str, Any]:
        """The facts, the stages and what is left out, in JSON types; some outputs store them."""
        facts = [f.name for f in fields(self)] if self.facts is None else self.facts  # pyright: ignore
        return self._told([*facts, "stages", "left_out"])

    def as_dict(self) -> dict[str, Any]:
        """All of the plan in JSON types."""
        predicted = {f"predicted_{name}": size for name, size in self._told(self.predicted).items()}
        costs = {f"predicted_{name}_bytes": getattr(self.cost, name) for name in self.costs}
        return {**self.decisions(), **predicted, **costs}

    @abstractmethod
    def rows(self) -> list[tuple[str, str]]:
        """Names and texts, which `--plan` prints before the stages."""

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError if the job needs more bytes than these, in total or in one
        buffer; the message says what helps."""
        if shortage := self.cost.shortage(max_memory, max_allocation):
            raise MemoryLimitError(self.refusal.format(plan=self, shortage=shortage))

    def _told(self, names: Iterable[str]) -> dict[str, Any]:
        """Return attributes in JSON types, by name."""
        pairs = (name.partition(": ") for name in names)
        return {name: _json(attrgetter(path or name)(self)) for name, _, path in pairs}


def _json(value: Any) -> Any:
    """Return a value whose tuples have become lists."""
    return [_json(item) for item in value] if isinstance(value, tuple) else value


class Job(ABC, Generic[Result]):
    """Work that has been planned.

    Attributes
    ----------
    device
        where it runs; None for a job of the host alone.
    plan
        what was decided.
    max_memory
        bytes that it may take, or None for what the device or the machine has.
    """

    device: Device | None
    plan: Any  # a Plan of the wing's own
    max_memory: int | None = None
    _progress: Callable[[str], None] | None = None

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that will run, in order."""
        return tuple(self.plan.stages)

    @property
    def left_out(self) -> dict[str, str]:
        """Reasons by the name of what is not compiled, allocated or run."""
        return dict(self.plan.left_out)

    @property
    def cost(self) -> Cost:
        """The memory that the job is predicted to take."""
        return self.plan.cost

    def describe(self) -> dict[str, Any]:
        """Return the plan in JSON types, as `--plan --json` prints it."""
        return self.plan.as_dict()

    def with_(self, **decisions: Any) -> Self:
        """Return the same job with decisions of its plan forced, for ablation and tests.

        Parameters
        ----------
        decisions
            fields of the plan, and their values.

        Raises
        ------
        TypeError
            the plan has no such field.
        """
        job = copy.copy(self)
        job.plan = replace(self.plan, **decisions)
        return job

    @property
    def limit(self) -> int:
        """Bytes that it may take on its device, or in memory if it has none."""
        if self.max_memory is not None:
            return self.max_memory
        return self.device.max_memory if self.device else available_memory()

    @property
    def shortage(self) -> str:
        """The memory that the job lacks on its device, as messages say it; "" if it lacks none."""
        largest = self.device.info.max_allocation if self.device else sys.maxsize
        return self.cost.shortage(self.limit, largest)

    @property
    def fits(self) -> bool:
        """True if the job takes no more memory than it may."""
        try:
            self.refuse()
        except MemoryLimitError:
            return False
        return True

    def refuse(self) -> None:
        """Raise MemoryLimitError if the job would take more memory than it may."""
        largest = self.device.info.max_allocation if self.device else sys.maxsize
        self.plan.refuse_beyond(self.limit, largest)

    def run(self, progress: Callable[[str], None] | None = None) -> Result:
        """Run the job.

        Parameters
        ----------
        progress
            called with the name of each stage as it begins.

        Raises
        ------
        MemoryLimitError
            it would not fit; nothing was begun.

        Warns
        -----
        MeshWarning
            the result may surprise: each of `findings`.
        """
        self.refuse()
        self._progress = progress
        with self.device.reporting(progress) if self.device else contextlib.nullcontext():
            result = self._run()
        for finding in self.findings(result):
            warnings.warn(finding, MeshWarning, stacklevel=_outside())
        return result

    @abstractmethod
    def _run(self) -> Result:
        """Do the work as the plan says."""

    def findings(self, result: Result) -> Iterable[str]:
        """Return warnings about a result, one line each: why it is empty, or what was wrong with
        the input."""
        return ()

    def notes(self, result: Result) -> Iterable[str]:
        """Return remarks on a result that are no warnings, one line each."""
        return ()

    def settle(self) -> None:
        """Decide now what is left open until the job runs, so that its plan can be printed."""

    def doubts(self, result: Result) -> Iterable[str]:
        """Return those of `notes` on decisions about the input that others may take otherwise."""
        return ()

    def details(self, result: Result) -> Iterable[str]:
        """Return remarks on how the result was made, one line each, which only `-v` prints."""
        return ()

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Name the stage to which the work in this block belongs."""
        if self.device:
            with self.device.stage(name):
                yield
            return
        if self._progress:
            self._progress(name)
        yield


def one_call(
    plan: Callable[Options, Job[Result]], name: str, result: type[Result]
) -> Callable[Options, Result]:
    """Return a function that plans a job and runs it: `voxelize`, from `plan_voxelize`.

    It has the parameters and the documentation of `plan`, and returns a `result`.
    """

    @functools.wraps(plan)
    def call(*arguments: Options.args, **options: Options.kwargs) -> Result:
        return plan(*arguments, **options).run()

    call.__name__ = call.__qualname__ = name
    call.__annotations__["return"] = result
    signature = inspect.signature(plan).replace(return_annotation=result)
    call.__signature__ = signature  # pyright: ignore[reportAttributeAccessIssue]
    return call


def _outside() -> int:
    """Return the stack level of the caller outside this package, so that a warning names its
    line."""
    package, frame, level = os.path.dirname(__file__), sys._getframe(1), 1
    while frame.f_back and frame.f_code.co_filename.startswith(package):
        frame, level = frame.f_back, level + 1
    return level
