"""Options that several subcommands share, as decorators; output on stderr; the progress bar."""

from __future__ import annotations

import functools
import json
import math
import re
import sys
import threading
from contextlib import contextmanager
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Self

import click

from voxtool.choices import LENGTH_UNITS, MAX_DIM, MIN_DIM, NORMALIZED
from voxtool.errors import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

DIM = click.IntRange(MIN_DIM, MAX_DIM)
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
PROGRESS_AFTER = 1.0  # seconds
# Keys of a context's `meta`: the Progress that is shown, the warnings so far, those of the job that
# runs, whether stdout takes the result of the command, whether JSON has been printed, and the list
# that takes the lines for stderr.
BAR, WARNINGS, HELD, TO_STDOUT, PRINTED, LINES = (
    f"voxtool.{name}" for name in ("bar", "warnings", "held", "to_stdout", "printed", "lines")
)
UNSAID: list[OSError] = []  # why stderr did not take what the command said


class Parsed(click.ParamType):
    """A parameter type made of a function; the error of its ValueError is the text and a hint."""

    def __init__(self, name: str, parse: Callable[[str], Any], hint: str) -> None:
        self.name, self.parse, self.hint = name, parse, hint

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):  # a default
            return value
        try:
            return self.parse(value)
        except ValueError:
            self.fail(f"{value!r}{self.hint}", param, ctx)


class Alias(click.Choice[str]):
    """A choice of names that accepts their aliases, too."""

    def __init__(self, names: Sequence[str], aliases: Mapping[str, str]) -> None:
        super().__init__(names)
        self.aliases = aliases

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        return super().convert(self.aliases.get(value, value), param, ctx)


class List(click.ParamType):
    """Values of another type, separated by commas."""

    name = "list"

    def __init__(self, each: click.ParamType) -> None:
        self.each = each

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return [self.each.convert(word.strip(), param, ctx) for word in str(value).split(",")]


def numbers_of(text: str, count: int) -> tuple[float, ...]:
    """Return this many finite numbers, which commas separate."""
    numbers = tuple(map(float, text.split(",")))
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError
    return numbers


def places_of(text: str, count: int) -> tuple[float | str, ...]:
    """Return this many finite numbers, or percentiles as written, which commas separate."""
    words = [word.strip() for word in text.split(",")]
    numbers = numbers_of(",".join(word.removesuffix("%") for word in words), count)
    shares = [word.endswith("%") for word in words]
    if any(share and not 0 <= number <= 100 for share, number in zip(shares, numbers, strict=True)):
        raise ValueError
    return tuple(w if s else n for w, s, n in zip(words, shares, numbers, strict=True))


def positive_of(text: str) -> float:
    """Return a positive number."""
    if (number := numbers_of(text, 1)[0]) <= 0:
        raise ValueError
    return number


def radius_of(text: str) -> float:
    """Return a number that is not negative."""
    if (number := numbers_of(text, 1)[0]) < 0:
        raise ValueError
    return number


def number_to_keep(text: str) -> int:
    """Return a number of components, or 1 for "largest"."""
    if text == "largest":
        return 1
    if not text.isdecimal() or not int(text):
        raise ValueError
    return int(text)


def bytes_of(text: str) -> int:
    """Return the number of bytes in 800000000, 800M or 8G."""
    text = text.upper().removesuffix("B").removesuffix("I")
    unit = text[-1:] if text[-1:] in UNITS else ""
    number = float(text.removesuffix(unit)) * UNITS[unit]
    if not 1 <= number < float(1 << 62):
        raise ValueError
    return int(number)


def plane_of(text: str, number: Callable[[str], Any]) -> tuple[str, Any]:
    """Return an axis and where a plane crosses it: z=0.5."""
    axis, _, place = text.partition("=")
    if axis not in AXES:
        raise ValueError
    return axis, number(place)


def direction_of(text: str) -> tuple[float, ...]:
    """Return three numbers, or the direction of an axis: z or -y."""
    axis = AXES.get(text[-1:].lower())
    if axis and text[:-1] in ("", "+", "-"):
        return tuple(float(f"{text[:-1]}{number}") for number in axis)
    return numbers_of(text, 3)


def size_of(text: str) -> tuple[int, ...]:
    """Return the width and height in 800x600, or in 512 for both."""
    width, times, height = text.lower().partition("x")
    sides = (width, height if times else width)
    if not all(side.isdecimal() and 0 < len(side) < 7 and int(side) for side in sides):
        raise ValueError
    return tuple(map(int, sides))


def colour_of(text: str) -> tuple[float, ...]:
    """Return red, green and blue from 0 to 1: #ff8000, 1,0.5,0 or a name."""
    if text in COLOURS:
        return COLOURS[text]
    if re.fullmatch("#[0-9a-fA-F]{6}", text):
        return tuple(byte / 255 for byte in bytes.fromhex(text[1:]))
    numbers = numbers_of(text, 3)
    if not all(0 <= number <= 1 for number in numbers):
        raise ValueError
    return numbers


POSITIVE = Parsed("number", positive_of, " is no positive number")
RADIUS = Parsed("radius", radius_of, " is no radius: give 1 voxel or more")
COMPONENTS = Parsed(
    "components", number_to_keep, " is no number of components: write largest, or 3"
)
BYTES = Parsed("bytes", bytes_of, " is no number of bytes: write 800M or 8G")
LEVEL = Parsed(
    "level",
    lambda text: text if text == "voxel" else int(text),
    ": choose voxel, or a level, from 0 (bricks) on",
)


def option(names: str, kind: Any, about: str, default: Any = None, **more: Any) -> Decorator:
    """Return an option. A tuple as its kind is a choice; the help shows a default."""
    if isinstance(kind, tuple):
        kind = click.Choice(kind)
    if default is not None:
        more = {"show_default": "[default:" not in about, **more, "default": default}
    return click.option(*names.split(), type=kind, help=about, **more)


def flag(names: str, about: str) -> Decorator:
    """Return an option without a value."""
    return click.option(*names.split(), is_flag=True, help=about)


def together(*decorators: Decorator) -> Decorator:
    """Return several decorators as one, in the order of the help."""
    return lambda function: functools.reduce(lambda f, one: one(f), decorators[::-1], function)


device_option = option(
    "--device device_name", str,
    "Number, kind (cpu, gpu) or part of a name, as `voxtool devices` lists them.  "
    "[default: $VOXTOOL_DEVICE, or the first that works, GPUs first]",
    metavar="DEVICE",
)  # fmt: skip
clobber_option = flag("--no-clobber", "Refuse to replace an existing file.")
clobber_options = together(
    clobber_option,
    flag("--overwrite", "Let the output replace an input of the command."),
)
strict_option = flag("--strict", "Exit with 1 if there is a warning about the input or the result.")
json_option = flag("--json as_json", "Print JSON.")
quiet_option = flag("-q --quiet", "Nothing on stderr but errors.")
verbose_option = flag("-v --verbose", "The device, and the time of each stage, on stderr.")
report_options = together(json_option, quiet_option, verbose_option)
plan_options = together(
    flag("--plan only_plan", "Print what would be done, left out and needed, and stop."),
    option("--max-memory", BYTES,
        "Refuse to use more on the device (800M, 8G).  [default: what it has]", metavar="BYTES"),
)  # fmt: skip


def length_options(mesh: str = "the mesh") -> Decorator:
    """Add --units and --scale."""
    return together(
        option("--units", LENGTH_UNITS,
            f"What the numbers of {mesh} mean, once scaled.  [default: what the file says]"),
        option("--scale", float, f"Factor of the coordinates of {mesh}.", 1.0),
    )  # fmt: skip


def normalize_option(stored: str) -> Decorator:
    """Add --normalize."""
    return option("--normalize", NORMALIZED,
        "Place the mesh first: unit: in the cube [0,1]^3, centred, its longest side 1; sphere: in "
        f"the ball of radius 1 at 0, its bounding box centred.  The transform is {stored}."
    )  # fmt: skip


def format_option(*formats: str) -> Decorator:
    """Add --format, as file_format."""
    return option("--format file_format", formats, "File format, instead of what the name says.")


def output_options(metavar: str, default: str) -> Decorator:
    """Add -o, --no-clobber and --overwrite."""
    about = f"Where to write; - is stdout. {default}"
    return together(option("-o --output", str, about, metavar=metavar), clobber_options)


def check_normals(format: str | None) -> None:
    """Refuse --normals for a mesh format that holds none."""
    from voxtool.files import NORMAL_FORMATS

    if format not in NORMAL_FORMATS:
        held = ", ".join(f".{name}" for name in NORMAL_FORMATS)
        raise click.UsageError(f"--normals: .{format} holds none: write one of {held}")


def input_twice(one: str, other: str) -> click.UsageError:
    """Return the error of two inputs that are both stdin."""
    return click.UsageError(f"{one} and {other} cannot both be stdin: name a file for one")


def points_of(points: str | None, name: str, other: str, hint: str) -> str:
    """Return POINTS, which are stdin by default, unless the other input is, or a terminal."""
    if (points or "-") == other == "-":
        raise input_twice(name, "POINTS")
    if points in (None, "-") and sys.stdin.isatty():
        raise click.UsageError(f"there are no POINTS: {hint}")
    return points or "-"


def shown(source: str) -> str:
    """Return the name of an input in messages."""
    return "stdin" if source == "-" else printable(source)


def output_of(source: str, extension: str) -> str:
    """Return the output of an input: bunny.EXTENSION in the current folder for bunny.obj.gz and
    bunny.svo.h5, stdout for stdin."""
    if source == "-":
        return "-"
    name = PurePath(source).name
    stem = re.sub(r"(?<=.)(\.svo|\.adf|\.tet)?\.[^.]+(\.gz)?$", "", name, flags=re.IGNORECASE)
    return f"{stem}.{extension}"


def _meta() -> dict[str, Any]:
    """Return the notes of this call of the command line."""
    context = click.get_current_context(silent=True)
    return context.meta if context else {}


def print_json(value: Any, err: bool = False) -> None:
    """Print the one JSON document of a command, on stdout or on stderr."""
    text = json.dumps(value, indent=2)
    if err:
        say(text)
    else:
        click.echo(text)
    _meta()[PRINTED] = True


def issued_warnings() -> list[str]:
    """Return the library's warnings in this call of the command line, in order, each once."""
    return _meta().setdefault(WARNINGS, [])


@contextmanager
def holding_warnings() -> Iterator[list[str]]:
    """Yield a list that takes the warnings of this block, which are not printed."""
    meta = _meta()
    outer, meta[HELD] = meta.get(HELD), []
    try:
        yield meta[HELD]
    finally:
        meta[HELD] = outer


def warn(message: str) -> None:
    """Print `voxtool: warning: ...` on stderr, each message once."""
    held = _meta().get(HELD)
    issued = issued_warnings()
    if held is not None:
        held.append(message)
    elif message not in issued:
        issued.append(message)
        tell(f"warning: {message}")


def is_quiet() -> bool:
    """Return True if the command that runs has -q."""
    context = click.get_current_context(silent=True)
    return bool(context and context.params.get("quiet"))


def tell(message: str) -> None:
    """Print a line on stderr, unless -q is given; errors are printed at the end of the command."""
    if is_quiet():
        return
    meta = _meta()
    if (lines := meta.get(LINES)) is not None:
        lines.append(message)
        return
    if bar := meta.get(BAR):
        bar.erase()
    say(f"voxtool: {printable(message)}")


def say(text: str, end: str = "\n") -> None:
    """Print a text on stderr. If its disk is full, the command goes on, and ends with exit code 3
    (UNSAID)."""
    try:
        click.echo(f"{text}{end}", err=True, nl=False)
    except BrokenPipeError:
        raise
    except OSError as error:
        from voxtool.files.storage.streams import discard

        UNSAID.append(error)
        discard(sys.stderr)


class Progress:
    """A bar of stages on stderr, if it is a terminal and the work takes longer than a second.

    It is a context manager, within a command: at its end, by an error too, the bar is erased.
    stages : all stages, those that have ended included.
    """

    def __init__(self, stages: Iterable[str] = ()) -> None:
        self.stages = list(stages)
        self.done = 0
        self.stage = ""
        self.percent = 0  # of the stage, where it says so
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

    def enter(self, stage: str) -> None:
        """Begin a stage; one that is not in `stages` is shown and does not count."""
        with self.lock:
            self.stage, self.percent = stage, 0
            if stage in self.stages:
                self.done = self.stages.index(stage)
            self._draw()

    def share(self, done: float) -> None:
        """Show how much of the stage is done, from 0 to 1."""
        if (percent := int(100 * done)) != self.percent:
            with self.lock:
                self.percent = percent
                self._draw()

    def erase(self) -> None:
        """Clear the line, until the next stage begins."""
        with self.lock:
            if self.width:
                say(f"\r{' ' * self.width}\r", "")
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
        text = f"{bar}{self.stage}{f' {self.percent} %' if self.percent else ''}"
        say(f"\r{text:<{self.width}}", "")
        self.width = len(text)
