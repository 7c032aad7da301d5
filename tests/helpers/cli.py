"""The command line in tests: in this process through click's runner, or in one of its own."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from voxtool.cli import main

ROOT = Path(__file__).parents[2]
MODULE = (sys.executable, "-m", "voxtool")
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
# An environment whose commands are those installed beside this Python.
SHELL = {**ENVIRONMENT, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}


def write_obj(path: Path, vertices, faces) -> None:
    lines = ["v {!r} {!r} {!r}".format(*v) for v in np.asarray(vertices, float).tolist()]
    lines += ["f {} {} {}".format(*f) for f in (np.asarray(faces) + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def invoke(command: str, stdin: bytes = b"") -> Result:
    result = CliRunner().invoke(main.cli, shlex.split(command), input=stdin, prog_name="voxtool")
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def run(command: str, stdin: bytes = b"") -> Result:
    """A command that succeeds."""
    result = invoke(command, stdin)
    assert result.exit_code == 0, result.stderr
    return result


def told(command: str, stdin: bytes = b"") -> dict[str, Any]:
    """Return the JSON of a command that succeeds."""
    return json.loads(run(command, stdin).stdout)


def fail(command: str, code: int | None = None, stdin: bytes = b"") -> str:
    """The message of a command that fails: one line on stderr, and nothing written; with --json
    the same on stdout as JSON. The exit code is 4 where a device or a limit of memory is asked for,
    else 3, unless another is given."""
    if code is None:
        code = 4 if "--device" in command or "--max-memory" in command else 3
    before = {p: p.read_bytes() for p in Path().iterdir() if p.is_file()}
    result = invoke(command, stdin)
    assert result.exit_code == code, result.output
    assert result.stderr.startswith("voxtool: error: ")
    assert result.stderr.endswith("\n")
    assert result.stderr.count("\n") == 1, result.stderr
    assert {p: p.read_bytes() for p in Path().iterdir() if p.is_file()} == before
    message = result.stderr.removeprefix("voxtool: error: ").rstrip()
    if "--json" in command:
        error = json.loads(result.stdout)["error"]
        assert (error["message"], error["exit_code"]) == (message, code)
    else:
        assert result.stdout_bytes == b""
    return message


def process(command: str, **more) -> subprocess.CompletedProcess[bytes]:
    """A command in a process of its own."""
    words = [*MODULE, *shlex.split(command)]
    return subprocess.run(words, env=ENVIRONMENT, capture_output=True, timeout=120, **more)


def on_terminal(command: str, after: float, here: Path) -> tuple[int, str, str]:
    """Exit code and stdout of a command whose stderr is a terminal, and what was sent to that."""
    pty = pytest.importorskip("pty")
    master, slave = pty.openpty()
    code = (
        "from voxtool.cli import options\n"
        f"options.PROGRESS_AFTER = {after}\n"
        "from voxtool.__main__ import main\n"
        "main()\n"
    )
    words = [sys.executable, "-c", code, *shlex.split(command)]
    with subprocess.Popen(
        words, cwd=here, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=slave
    ) as child:
        os.close(slave)
        sent = b""
        while True:
            try:
                piece = os.read(master, 4096)
            except OSError:  # the other end is closed
                break
            if not piece:
                break
            sent += piece
        assert child.stdout
        out = child.stdout.read()
    os.close(master)
    return child.returncode, out.decode(), sent.decode()


def screen(sent: str) -> list[str]:
    """Return the final content of a terminal."""
    lines, row, column = [""], 0, 0
    for character in sent:
        if character == "\r":
            column = 0
        elif character == "\n":
            lines.append("")
            row, column = row + 1, 0
        else:
            line = lines[row].ljust(column)
            lines[row] = line[:column] + character + line[column + 1 :]
            column += 1
    return [line.rstrip() for line in lines]
