"""voxtool selftest: whether a device computes correctly."""

from __future__ import annotations

import platform
from typing import TYPE_CHECKING

import click

from voxtool.cli.options import device_option, flag, json_option, print_json, together
from voxtool.errors import CheckError
from voxtool.version import __version__

if TYPE_CHECKING:
    from voxtool.opencl import Device
    from voxtool.selftest.case import Case, Outcome

HEADER = f"{'case':<38}{'error':>9}{'bound':>9}  {'unit':<14}{'verdict':<9}{'s':>5}"


@click.command("selftest")
@together(
    device_option,
    flag("--full", "More and larger inputs, for some minutes."),
    json_option,
    flag("-q --quiet", "Print only cases that fail, and the verdict."),
)  # fmt: skip
def command(device_name: str | None, full: bool, as_json: bool, quiet: bool) -> None:
    """Check in a minute whether a device computes correctly.

    Each case is stiff or extreme, and compared with an oracle: rational arithmetic, quadrature, a
    formula, or a digest that is the same on every device. Columns: the measured error, the largest
    correct error, and the time in s, with the compilation of kernels. The units are the case's
    own; docs/devices.md says what each case checks. The exit code is 1 if a case fails.

    \b
    Examples:
      voxtool selftest --device cpu
      voxtool selftest --full --json
    """
    from voxtool.opencl import shared_device
    from voxtool.selftest import CASES

    report(shared_device(device_name), CASES, full, as_json, quiet)


def report(device: Device, cases: tuple[Case, ...], full: bool, as_json: bool, quiet: bool) -> None:
    """Run the cases and print their outcomes.

    Raises
    ------
    CheckError : a case failed.
    """
    from voxtool.selftest import selftest

    info = device.info
    if not as_json and not quiet:
        click.echo(f"voxtool {__version__}; {info.name}, {info.platform} {info.driver}\n\n{HEADER}")
    outcomes: list[Outcome] = []
    for outcome in selftest(device, full, cases):
        outcomes.append(outcome)
        if not as_json and not (quiet and outcome.passed):
            click.echo(line(outcome))
    failed = [o.case.name for o in outcomes if not o.passed]
    if as_json:
        print_json(
            {
                "voxtool": __version__,
                "device": info.as_dict(),
                "machine": platform.machine(),
                "python": platform.python_version(),
                "full": full,
                "verdict": "failed" if failed else "ok",
                "cases": [o.as_dict() for o in outcomes],
            }
        )
    name = f"{info.name} ({info.platform})"
    if failed:
        raise CheckError(
            f"{len(failed)} of {len(cases)} cases failed on {name}: {', '.join(failed)}: update "
            "its driver, or choose another device: see docs/devices.md"
        )
    if not as_json:
        seconds = sum(o.seconds for o in outcomes)
        click.echo(
            f"{'' if quiet else chr(10)}{len(cases)} of {len(cases)} cases within their bounds, "
            f"{seconds:.0f} s: {name} can be trusted"
        )


def line(outcome: Outcome) -> str:
    """Return a row of the table, and below it why a case has no error."""
    case = outcome.case
    error = "-" if outcome.message else f"{outcome.error:.2g}"
    row = (
        f"{case.name:<38}{error:>9}{case.bound:>9.3g}  {case.unit:<14}"
        f"{'ok' if outcome.passed else 'FAILED':<9}{outcome.seconds:5.1f}"
    )
    return f"{row}\n    {outcome.message}" if outcome.message else row
