"""Options that several subcommands share, as decorators, and what goes to stderr."""

from __future__ import annotations

import json
import sys
import time
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.opencl import Device

    Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
PROGRESS_AFTER = 1.0  # seconds


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
        if not 0 < number < float(1 << 62):
            self.fail(f"{value!r} is no number of bytes: write 800M or 8G", param, ctx)
        return int(number)


def device_option(function: Callable[..., Any]) -> Callable[..., Any]:
    return click.option(
        "--device",
        metavar="DEVICE",
        help="Number, kind (cpu, gpu) or part of a name, as `voxtool devices` lists them; "
        "default $VOXTOOL_DEVICE, or the first that works, GPUs first.",
    )(function)


def json_option(function: Callable[..., Any]) -> Callable[..., Any]:
    return click.option("--json", "as_json", is_flag=True, help="Print JSON.")(function)


def quiet_option(function: Callable[..., Any]) -> Callable[..., Any]:
    return click.option("-q", "--quiet", is_flag=True, help="Nothing on stderr but errors.")(
        function
    )


def verbose_option(function: Callable[..., Any]) -> Callable[..., Any]:
    return click.option(
        "-v", "--verbose", is_flag=True, help="The device, and the time of each stage, on stderr."
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


def print_json(value: Any) -> None:
    click.echo(json.dumps(value, indent=2))


def tell(message: str, quiet: bool = False) -> None:
    """A line on stderr."""
    if not quiet:
        click.echo(f"voxtool: {message}", err=True)


class Progress:
    """A bar of the plan's stages on stderr, if it is a terminal and the work is long."""

    def __init__(self, device: Device, stages: list[str], quiet: bool) -> None:
        self.stages = stages
        self.shown = False
        self.start = time.perf_counter()
        self.enabled = not quiet and sys.stderr.isatty()
        device.on_stage = self._enter

    def _enter(self, stage: str) -> None:
        if not self.enabled or time.perf_counter() - self.start < PROGRESS_AFTER:
            return
        done = self.stages.index(stage) if stage in self.stages else len(self.stages)
        bar = "#" * done + "." * (len(self.stages) - done)
        click.echo(f"\r\033[K[{bar}] {stage}", err=True, nl=False)
        self.shown = True

    def finish(self) -> None:
        if self.shown:
            click.echo("\r\033[K", err=True, nl=False)
