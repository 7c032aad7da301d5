"""Write a page about a device: its selftest, the golden digests, and tables of bench.

    python -m tests.gpu_report gpu

The work is done in stages. Each has a time limit, and its output is kept in build/gpu. Run the
command again to go on: a stage is repeated only if the source has changed or it did not finish.
The page, docs/gpu/NAME.md, is written from all outputs. Nothing is fetched: the examples make a
mesh and a volume, and .obj and .vtu files in the folder `models` are measured beside them.
"""

from __future__ import annotations

import argparse
import datetime
import functools
import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import voxtool
from voxtool.opencl.discovery import DeviceInfo
from voxtool.version import __version__

ROOT = Path(__file__).parents[1]
HERE = Path("build/gpu")
MODELS = Path("models")
LIMIT = 450  # seconds that a stage may take
BENCHES = {  # of each kind of model, with the options that keep a stage within its limit
    ".obj": (
        "voxelize MODEL --dims 64,256,512,1024,2048 --samples 0",
        "extract MODEL --dims 256,512,1024,2048 --fills parity --samples 0",
        "adf MODEL --tolerances 1e-2,1e-3 --levels 7,9",
        "distance MODEL --grids 64",
    ),
    ".vtu": ("tets MODEL --scalar density",),
}


@dataclass(frozen=True)
class Result:
    """The output of a stage. `source` identifies the source code that ran; `code` is the exit code,
    or None where the stage was stopped at its limit."""

    command: str
    source: str
    code: int | None
    seconds: float
    output: str

    @property
    def verdict(self) -> str:
        """The end of the stage in words: passed, failed or stopped, and its time."""
        if self.code is None:
            return f"stopped after {self.seconds:.0f} s"
        return f"{'passed' if self.code == 0 else f'FAILED ({self.code})'}, {self.seconds:.0f} s"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.gpu_report", description=__doc__)
    parser.add_argument("device", nargs="?", default="gpu", help="as voxtool's --device")
    parser.add_argument("--seconds", type=float, default=480, help="for the stages of this run")
    parser.add_argument("--only", default="", help="run only commands that match")
    given = parser.parse_args()
    os.chdir(ROOT)
    info = voxtool.open_device(given.device).info
    name = re.sub(r"[^a-z0-9]+", "-", f"{info.name} {info.platform}".lower()).strip("-")
    results = run_stages(stages(str(info.index)), HERE / name, given.seconds, given.only)
    page = Path("docs/gpu", f"{name}.md")
    page.parent.mkdir(exist_ok=True)
    page.write_text(page_of(info, results), encoding="utf-8")
    passed = sum(1 for found in results.values() if found and found.code == 0)
    print(f"{page}: {passed} of {len(results)} stages passed")
    return passed < len(results)


def stages(device: str) -> list[str]:
    """The commands, in order; models come before the benches that read them."""
    models = [HERE / "bunny.obj", HERE / "volume.vtu"]
    models += sorted(path for end in BENCHES for path in MODELS.glob(f"*{end}"))
    return [
        *(f"python examples/make_{path.stem}.py -o {path}" for path in models[:2]),
        f"python -m voxtool selftest --full --device {device}",
        *(f"python -m tests.golden.report {path.stem} --device {device}"
          for path in sorted(Path("tests/golden").glob("*.json"))),
        *(f"python -m voxtool bench {bench.replace('MODEL', str(model))} --device {device}"
          for model in models for bench in BENCHES[model.suffix]),
    ]  # fmt: skip


def run_stages(
    commands: list[str], folder: Path, seconds: float, only: str = "", limit: float = LIMIT
) -> dict[str, Result | None]:
    """The result of each command. Those that have none and match the pattern `only` are run, each
    for at most `limit` seconds, until `seconds` have passed."""
    folder.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + seconds
    results = {}
    for command in commands:
        path = folder / (re.sub(r"[^\w.-]+", "-", command) + ".json")
        found = Result(**json.loads(path.read_text("utf-8"))) if path.exists() else None
        if found and (found.source != source() or found.code is None):
            found = None
        left = end - time.monotonic()
        if not found and left > 0 and re.search(only, command):
            print(f"{command} ...", flush=True)
            found = run(command, min(limit, left))
            path.write_text(json.dumps(asdict(found)), encoding="utf-8")
            print(f"    {found.verdict}", flush=True)
        results[command] = found
    return results


@functools.cache
def source() -> str:
    """The SHA-256 of the package, the kernels and the golden digests."""
    digest = hashlib.sha256()
    for folder in ("voxtool", "kernels", "tests/golden"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".cl", ".h", ".json"):
                digest.update(path.read_bytes())
    return digest.hexdigest()


def run(command: str, seconds: float) -> Result:
    """Run a command for at most `seconds`."""
    start = time.monotonic()
    try:
        done = subprocess.run(
            [sys.executable, *shlex.split(command)[1:]],
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=seconds, check=False,
        )  # fmt: skip
        code, output = done.returncode, done.stdout
    except subprocess.TimeoutExpired as stopped:
        code, output = None, stopped.stdout or b""
    text = output.decode("utf-8", "replace")
    return Result(command, source(), code, round(time.monotonic() - start, 1), text)


def page_of(info: DeviceInfo, results: dict[str, Result | None]) -> str:
    """The page, in Markdown."""
    lines = [
        f"# {info.name}", "",
        f"{info.platform}, driver {info.driver}, {info.opencl}, {info.units} compute units, "
        f"{info.memory / 1e9:.1f} GB, {'' if info.fp64 else 'no '}float64. voxtool {__version__}, "
        f"{datetime.date.today()}. `make gpu-report` made this page.", "",
        "| stage | result |", "| --- | --- |",
    ]  # fmt: skip
    for command, found in results.items():
        lines.append(f"| `{command}` | {found.verdict if found else 'not run'} |")
    for command, found in results.items():
        if found and found.output.strip():
            body = (line.rstrip() for line in found.output.strip("\n").splitlines())
            lines += ["", f"## {command}", "", "```", *body, "```"]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
