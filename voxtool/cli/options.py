"""Options that several subcommands share, as decorators, and what goes to stderr."""

from __future__ import annotations

import json
import sys
import threading
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Self

import click

from voxtool.choices import MAX_DIM, MIN_DIM

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

DIM = click.IntRange(MIN_DIM, MAX_DIM)
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
PROGRESS_AFTER = 1.0  # seconds
SAMPLES = 100_000  # points on each surface that a deviation is measured at
# What a context keeps: the Progress that is shown, the warnings so far, whether stdout takes the
# result of the command, and whether JSON has been printed.
BAR, WARNINGS, TO_STDOUT, PRINTED = (
    f"voxtool.{name}" for name in ("bar", "warnings", "to_stdout", "printed")
)


class Bytes(click.ParamType):
    """A number of bytes: 800000000, 800M or 8G."""

    name = "bytes"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        text = str(value).upper().removesuffix("B").removesuffix("I")
        unit = text[-1:] if text[-1:] in UNITS else ""
        try:
            number = float(text.removesuffix(unit)) * UNITS[unit]
        except ValueError:
            number = -1
        if not 1 <= number < float(1 << 62):
            self.fail(f"{value!r} is no number of bytes: write 800M or 8G", param, ctx)
        return int(number)


class Alias(click.Choice[str]):
    """A choice of names that accepts their aliases, too."""

    def __init__(self, names: Sequence[str], aliases: Mapping[str, str]) -> None:
        super().__init__(names)
        self.aliases = aliases

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        return super().convert(self.aliases.get(value, value), param, ctx)


class List(click.ParamType):
    """Values of another type, with commas between them."""

    def __init__(self, each: click.ParamType) -> None:
        self.each = each
        self.name = "list"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> list[object]:
        if isinstance(value, list):
            return value
        return [self.each.convert(word.strip(), param, ctx) for word in str(value).split(",")]


device_option = click.option(
    "--device",
    metavar="DEVICE",
    help="Number, kind (cpu, gpu) or part of a name, as `voxtool devices` lists them.  "
    "[default: $VOXTOOL_DEVICE, or the first that works, GPUs first]",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Nothing on stderr but errors.")
verbose_option = click.option(
    "-v", "--verbose", is_flag=True, help="The device, and the time of each stage, on stderr."
)
strict_option = click.option(
    "--strict", is_flag=True, help="Exit with 1 if there is a warning of the input or the result."
)


def format_option(*formats: str) -> Decorator:
    """--format, as file_format."""
    return click.option(
        "--format",
        "file_format",
        type=click.Choice(formats),
        help="File format, instead of what the name says.",
    )


def plan_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """--plan, as only_plan, and --max-memory."""
    function = click.option(
        "--max-memory",
        type=Bytes(),
        metavar="BYTES",
        help="Refuse to use more on the device (800M, 8G).  [default: what it has]",
    )(function)
    return click.option(
        "--plan",
        "only_plan",
        is_flag=True,
        help="Print what would be done, left out and needed, and stop.",
    )(function)


def output_options(metavar: str, default: str) -> Decorator:
    """-o and --no-clobber."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        function = click.option(
            "--no-clobber", is_flag=True, help="Refuse to replace an existing file."
        )(function)
        return click.option(
            "-o", "--output", metavar=metavar, help=f"Where to write; - is stdout. {default}"
        )(function)

    return decorate


def output_of(mesh: str, extension: str) -> str:
    """bunny.obj.gz -> bunny.svo.h5, in the current folder; stdin -> stdout."""
    if mesh == "-":
        return "-"
    name = PurePath(mesh).name
    if name.lower().endswith(".gz"):
        name = name[:-3]
    return f"{PurePath(name).stem}.{extension}"


def print_json(value: Any, err: bool = False) -> None:
    """Print the one JSON document of a command, on stdout or on stderr."""
    click.echo(json.dumps(value, indent=2), err=err)
    if context := click.get_current_context(silent=True):
        context.meta[PRINTED] = True


def issued_warnings() -> list[str]:
    """The library's warnings in this call of the command line, in order, each once."""
    context = click.get_current_context(silent=True)
    return context.meta.setdefault(WARNINGS, []) if context else []


def warn(message: str) -> None:
    """Print `voxtool: warning: ...` on stderr, each message once."""
    issued = issued_warnings()
    if message not in issued:
        issued.append(message)
        tell(f"warning: {message}")


def is_quiet() -> bool:
    """True if the command that runs has -q."""
    context = click.get_current_context(silent=True)
    return bool(context and context.params.get("quiet"))


def tell(message: str) -> None:
    """Print a line on stderr, unless -q is given; errors are printed at the end of the command."""
    if is_quiet():
        return
    context = click.get_current_context(silent=True)
    bar: Progress | None = context.meta.get(BAR) if context else None
    if bar:
        bar.erase()
    click.echo(f"voxtool: {message}", err=True)


class Progress:
    """A bar of stages on stderr, if it is a terminal and the work takes longer than a second.

    A context manager, within a command: when it ends, by an error too, the bar is erased.
    """

    def __init__(self, stages: Iterable[str] = ()) -> None:
        self.stages = list(stages)
        self.done = 0
        self.stage = ""
        self.width = 0  # of what is shown
        self.due = False
        self.lock = threading.Lock()
        self.timer = threading.Timer(PROGRESS_AFTER, self._appear)
        self.timer.daemon = True

    def __enter__(self) -> Self:
        if sys.stderr and sys.stderr.isatty() and not is_quiet():
            click.get_current_context().meta[BAR] = self
            self.timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.timer.cancel()
        with self.lock:
            self.due = False
        self.erase()
        click.get_current_context().meta.pop(BAR, None)

    def plan(self, stages: Iterable[str]) -> None:
        """All stages, those that have ended included."""
        self.stages = list(stages)

    def enter(self, stage: str) -> None:
        """A stage begins; one that was not foreseen is named and does not count."""
        with self.lock:
            self.stage = stage
            if stage in self.stages:
                self.done = self.stages.index(stage)
            self._draw()

    def erase(self) -> None:
        """Clear the line, until the next stage begins."""
        with self.lock:
            if self.width:
                click.echo(f"\r{' ' * self.width}\r", err=True, nl=False)
                self.width = 0

    def _appear(self) -> None:
        with self.lock:
            self.due = not self.timer.finished.is_set()  # cancelled in the meantime
            self._draw()

    def _draw(self) -> None:
        if not self.due:
            return
        left = len(self.stages) - self.done
        bar = f"[{'#' * self.done}{'.' * left}] " if self.stages else ""
        text = f"{bar}{self.stage}"
        click.echo(f"\r{text:<{self.width}}", err=True, nl=False)
        self.width = len(text)
