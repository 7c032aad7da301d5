"""Options that several subcommands share, as decorators, and what goes to stderr."""

from __future__ import annotations

import functools
import json
import math
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
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
PROGRESS_AFTER = 1.0  # seconds
SAMPLES = 100_000  # points on each surface that a deviation is measured at
# What a context keeps: the Progress that is shown, the warnings so far, whether stdout takes the
# result of the command, and whether JSON has been printed.
BAR, WARNINGS, TO_STDOUT, PRINTED = (
    f"voxtool.{name}" for name in ("bar", "warnings", "to_stdout", "printed")
)


class Parsed(click.ParamType):
    """What a function makes of a text; where it raises ValueError, the error is text and hint."""

    def __init__(self, name: str, parse: Callable[[str], Any], hint: str) -> None:
        self.name, self.parse, self.hint = name, parse, hint

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):  # a default
            return value
        try:
            return self.parse(value)
        except ValueError:
            self.fail(f"{value!r}{self.hint}", param, ctx)


def bytes_of(text: str) -> int:
    """The number of bytes in 800000000, 800M or 8G."""
    text = text.upper().removesuffix("B").removesuffix("I")
    unit = text[-1:] if text[-1:] in UNITS else ""
    number = float(text.removesuffix(unit)) * UNITS[unit]
    if not 1 <= number < float(1 << 62):
        raise ValueError
    return int(number)


BYTES = Parsed("bytes", bytes_of, " is no number of bytes: write 800M or 8G")


def plane_of(text: str, number: Callable[[str], Any]) -> tuple[str, Any]:
    """An axis and where a plane crosses it: z=0.5."""
    axis, _, place = text.partition("=")
    if axis not in ("x", "y", "z"):
        raise ValueError
    return axis, number(place)


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


class Level(click.ParamType):
    """A level of the octree, or voxel."""

    name = "level"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> int | str:
        if value == "voxel":
            return value
        try:
            return int(value)
        except ValueError:
            self.fail(f"{value!r}: choose voxel, or a level, from 0 (bricks) on", param, ctx)


class Number(click.ParamType):
    """A finite number, or a positive one."""

    name = "number"

    def __init__(self, positive: bool = False) -> None:
        self.positive = positive

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        numbers = numbers_of(value, 1)
        if numbers is None or (self.positive and numbers[0] <= 0):
            kind = "positive" if self.positive else "finite"
            self.fail(f"{value!r} is no {kind} number", param, ctx)
        return numbers[0]


class Vector(click.ParamType):
    """X,Y,Z; a direction may be an axis: z or -y."""

    name = "vector"

    def __init__(self, axes: bool = False) -> None:
        self.axes = axes

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float]:
        if isinstance(value, tuple):
            return value  # pyright: ignore[reportReturnType]
        numbers = numbers_of(value, 3)
        if numbers is not None:
            return numbers[0], numbers[1], numbers[2]
        axis = AXES.get(value[-1:].lower())
        if self.axes and axis and value[:-1] in ("", "+", "-"):
            sign = -1.0 if value[:-1] == "-" else 1.0
            return sign * axis[0], sign * axis[1], sign * axis[2]
        hint = "write 0,0,1, z or -z" if self.axes else "write three numbers, as 1,2.5,-3"
        self.fail(f"{value!r}: {hint}", param, ctx)


class Range(click.ParamType):
    """A,B, or the word full."""

    name = "range"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float] | str:
        if isinstance(value, tuple) or value == "full":
            return value
        numbers = numbers_of(value, 2)
        if numbers is None:
            self.fail(f"{value!r}: write two numbers, as 0.5,2, or full", param, ctx)
        return numbers[0], numbers[1]


class Size(click.ParamType):
    """WIDTHxHEIGHT, or one number for both."""

    name = "size"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        width, times, height = str(value).lower().partition("x")
        sides = (width, height if times else width)
        if not all(side.isdecimal() and 0 < len(side) < 7 and int(side) for side in sides):
            self.fail(f"{value!r} is no size: write 800x600, or 512 for both sides", param, ctx)
        return int(sides[0]), int(sides[1])


class Colour(click.ParamType):
    """Red, green and blue: #ff8000, or 1,0.5,0; white and black have names."""

    name = "colour"

    def __init__(self, none: bool = False) -> None:
        self.none = none

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...] | str:
        if isinstance(value, tuple) or (self.none and value == "none"):
            return value
        if value in COLOURS:
            return COLOURS[value]
        hexadecimal = value.removeprefix("#")
        if value.startswith("#") and len(hexadecimal) == 6 and hexadecimal.isalnum():
            try:
                return tuple(byte / 255 for byte in bytes.fromhex(hexadecimal))
            except ValueError:
                pass
        numbers = numbers_of(value, 3)
        if numbers is None or not all(0 <= v <= 1 for v in numbers):
            known = "white, black, none" if self.none else "white, black"
            self.fail(
                f"{value!r} is no colour: write #ff8000, 1,0.5,0 (from 0 to 1), {known}", param, ctx
            )
        return numbers


def numbers_of(text: Any, count: int) -> tuple[float, ...] | None:
    """So many finite numbers with commas between them, or None."""
    try:
        numbers = tuple(float(word) for word in str(text).split(","))
    except ValueError:
        return None
    return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else None


def option(names: str, kind: Any, about: str, default: Any = None, **more: Any) -> Decorator:
    """An option. A tuple as its kind is a choice; a default is shown unless the help has one."""
    if isinstance(kind, tuple):
        kind = click.Choice(kind)
    if default is not None:
        more = {"show_default": "[default:" not in about, **more, "default": default}
    return click.option(*names.split(), type=kind, help=about, **more)


def flag(names: str, about: str) -> Decorator:
    """An option without a value."""
    return click.option(*names.split(), is_flag=True, help=about)


def together(*decorators: Decorator) -> Decorator:
    """Several decorators as one, in the order of the help."""
    return lambda function: functools.reduce(lambda f, one: one(f), decorators[::-1], function)


device_option = option(
    "--device device_name", str,
    "Number, kind (cpu, gpu) or part of a name, as `voxtool devices` lists them.  "
    "[default: $VOXTOOL_DEVICE, or the first that works, GPUs first]",
    metavar="DEVICE",
)  # fmt: skip
bbox_option = option(
    "--bbox", float, "Box that the grid covers, in world units, instead of the mesh's.", nargs=6,
    metavar="X0 Y0 Z0 X1 Y1 Z1",
)  # fmt: skip
clobber_option = flag("--no-clobber", "Refuse to replace an existing file.")
strict_option = flag("--strict", "Exit with 1 if there is a warning of the input or the result.")
json_option = flag("--json as_json", "Print JSON.")
quiet_option = flag("-q --quiet", "Nothing on stderr but errors.")
verbose_option = flag("-v --verbose", "The device, and the time of each stage, on stderr.")
report_options = together(json_option, quiet_option, verbose_option)
plan_options = together(
    flag("--plan only_plan", "Print what would be done, left out and needed, and stop."),
    option("--max-memory", BYTES,
        "Refuse to use more on the device (800M, 8G).  [default: what it has]", metavar="BYTES"),
)  # fmt: skip


def format_option(*formats: str) -> Decorator:
    """--format, as file_format."""
    return option("--format file_format", formats, "File format, instead of what the name says.")


def output_options(metavar: str, default: str) -> Decorator:
    """-o and --no-clobber."""
    about = f"Where to write; - is stdout. {default}"
    return together(option("-o --output", str, about, metavar=metavar), clobber_option)


def input_twice(one: str, other: str) -> click.UsageError:
    """The error of two inputs that are both stdin."""
    return click.UsageError(f"{one} and {other} cannot both be stdin: name a file for one")


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
