"""Findings: every outcome that is neither a result nor one clear line."""

from __future__ import annotations

import json
import re
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from click.testing import CliRunner

import voxtool
from voxtool.cli import main
from voxtool.errors import VoxtoolError, VoxtoolWarning

from .cases import Case
from .mutate import SECRET

QUIET = (DeprecationWarning, PendingDeprecationWarning, ResourceWarning, ImportWarning)
PACKAGE = str(Path(voxtool.__file__).parent)
SECRET_WORD = "a-secret-word"
OUT_OF_MEMORY = re.compile("not enough memory|than fits in memory")


class Finding(NamedTuple):
    """A fault, its place and its details. Findings of the same fault and place count once."""

    what: str
    where: str
    detail: str = ""

    @property
    def key(self) -> str:
        return f"{self.what} in {self.where}"


@dataclass
class Tools:
    """The device and the valid contents that all cases share."""

    device: Any
    device_name: str
    mesh: Any = None
    distances: Any = None
    volume: Any = None
    findings: list[Finding] = field(default_factory=list)
    deepest: Any = ()  # the frames of the last error
    folder: Path = Path()  # of the samples

    def load(self, folder: Path) -> None:
        self.folder = folder
        self.mesh = voxtool.load_mesh(folder / "a.obj")
        self.distances = voxtool.read_adf(folder / "a.adf.h5")
        self.volume = voxtool.read_tet(folder / "a.raycast.tet.h5")
        sys.addaudithook(self._audit)

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and Path(SECRET).name in str(arguments[0]):
            self.found("another file is opened", place_of(traceback.extract_stack(), "a library"))

    def found(self, what: str, where: str, detail: object = "") -> None:
        self.findings.append(Finding(what, where, " ".join(str(detail).split())[:400]))


@contextmanager
def watched(tools: Tools, where: str, names: Path | None = None) -> Iterator[list[Any]]:
    """Note exceptions, warnings and unclear messages of the block. What the block appends to the
    list that is yielded, it has accepted.

    names : the file that an error message must name.
    """

    def note(message: Any, category: type[Warning], *_: Any, **__: Any) -> None:
        if issubclass(category, VoxtoolWarning):
            check_message(tools, where, str(message))
        elif not issubclass(category, QUIET):
            place = place_of(traceback.extract_stack(), where)
            tools.found("warning", place, f"{category.__name__}: {message}")

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = note
        try:
            yield []
        except BaseException as error:
            tools.deepest = traceback.extract_tb(error.__traceback__)
            place = place_of(tools.deepest, where)
            if isinstance(error, MemoryError) or isinstance(error.__cause__, MemoryError):
                tools.found("memory", place, error)
            elif isinstance(error, VoxtoolError):
                check_message(tools, place, str(error), names)
            else:
                tools.found("exception", place, f"{type(error).__name__}: {error}")


def check_message(tools: Tools, place: str, message: str, names: Path | None = None) -> None:
    """Note a message that is no printable line, names no file, or shows what is in another."""
    if names and not names.name.isprintable():
        place = "a message with an odd name"
    if not message or not message.isprintable() or len(message) > 1000:
        tools.found("no printable line", place, repr(message))
    elif names and names.name.isprintable() and names.name not in message:
        tools.found("file not named", place, message)
    if SECRET_WORD in message:
        tools.found("another file is shown", place, message)


def run_command(case: Case, tools: Tools, arithmetic: bool = False) -> int:
    """Run a command in this process; note what is no result and no clear line. Its exit code.

    arithmetic : note numpy's floating-point warnings, too, which commands do not show.
    """
    words = list(case.words)
    where = f"command {' '.join(words[: 2 if words[0] == 'bench' else 1])}"

    def overflow(kind: str, _: int) -> None:
        tools.found("numpy warning", place_of(traceback.extract_stack(), where), kind)

    shown = {"all": "call", "under": "ignore", "call": overflow} if arithmetic else {}
    with watched(tools, where), np.errstate(**shown):
        result = CliRunner().invoke(main.cli, words, input=b"", prog_name="voxtool")
        if isinstance(result.exception, SystemExit | None):
            check_stderr(case, result, tools, where)
            check_json(words, result, tools, where)
            return result.exit_code
        raise result.exception
    return -1


def check_stderr(case: Case, result: Any, tools: Tools, where: str) -> None:
    """Note other lines than `voxtool: ...`, and failures that have not one error line."""
    code, text = result.exit_code, result.stderr
    if code not in range(5):
        tools.found("exit code", where, code)
    if not re.search(case.has, text) or (
        case.lacks and re.search(case.lacks, text + result.stdout)
    ):
        tools.found("unclear message", where, text)
    lines = text.removesuffix("\n").split("\n") if text else []
    if lines and lines[0].startswith("Usage:"):  # a group by itself
        return
    if not all(word.isprintable() for word in case.words):
        where = "a message with an odd name"
    if sum(line.startswith("voxtool: error: ") for line in lines) != (code != 0):
        tools.found("not one error line", where, text or f"exit code {code}")
    for line in lines:
        if OUT_OF_MEMORY.search(line):
            tools.found("memory", where, line)
        elif not line.isprintable() or "\\udc" in line:
            tools.found("no printable line", where, repr(line))
        elif not line.startswith(("voxtool: ", "{", "}", " ")):
            tools.found("no printable line", where, line)
        if SECRET_WORD in line:
            tools.found("another file is shown", where, line)


def check_json(words: list[str], result: Any, tools: Tools, where: str) -> None:
    """Note output of --json that is no JSON: NaN and Infinity are none."""
    others = {"-o", "--output", "-", "--digest", "-h", "--help", "--version"}
    if "--json" not in words or others & {*words}:
        return

    def refuse(word: str) -> None:
        raise ValueError(word)

    try:
        json.loads(result.stdout, parse_constant=refuse)
    except ValueError as error:
        tools.found("invalid JSON", where, f"{error}: {result.stdout[:200]}")


def place_of(stack: Any, otherwise: str) -> str:
    """The module and function of the innermost frame in voxtool."""
    for frame in reversed(list(stack)):
        if frame.filename.startswith(PACKAGE):
            return f"{frame.filename.removeprefix(PACKAGE)[1:]}:{frame.name}"
    return otherwise


def memory(name: str) -> int:
    """Bytes of memory of this process; VmHWM is the peak since `reset_peak`."""
    with suppress(OSError), open("/proc/self/status") as lines:
        for line in lines:
            if line.startswith(name):
                return int(line.split()[1]) << 10
    return 0


def reset_peak() -> None:
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
