"""Commands that write, each with two requests for one output: pairs of them at once, and kills."""

from __future__ import annotations

import contextlib
import hashlib
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from helpers.cli import ENVIRONMENT, MODULE


@dataclass(frozen=True)
class Writer:
    """A command without its output, and what makes it two requests.

    output : in a folder of its own; waits : the name of a folder of windows, if there is one;
    apart : its files are made one after the other, so that a kill leaves some.
    """

    name: str
    command: str
    requests: tuple[str, str]
    output: str
    waits: str = ""
    apart: bool = False

    def words(self, request: int, models: Path, more: str = "") -> list[str]:
        """Return the command line of a request."""
        text = f"{self.command.format(m=models)} {self.requests[request]} -o {self.output} {more}"
        return [*MODULE, *shlex.split(text), "-q"]


def windowed(name: str, command: str, *requests: str) -> Writer:
    return Writer(name, command, (requests[0], requests[1]), "o.svo.h5", "o.svo.h5.windows")


SURFACE = ("", "--with-surface")
WINDOWED = [
    windowed("windows", "voxelize {m}/bunny.obj --dim 400 --max-memory 500k", *SURFACE),
    windowed("merged", "voxelize {m}/bunny.obj --dim 400 --dag --max-memory 300k", *SURFACE),
    windowed("flood", "voxelize {m}/bunny.obj --dim 700 --fill flood --max-memory 6M", *SURFACE),
    windowed(
        "fractions", "voxelize {m}/bunny.obj --mode fraction --face-fractions --max-memory 4M",
        "--dim 200", "--dim 201",
    ),
    windowed(
        "labels", "voxelize {m}/parts.glb --dim 600 --labels part --with-surface --max-memory 8M",
        "--attributes colour", "--attributes normal",
    ),
    windowed(
        "combine in windows", "combine {m}/big.svo.h5 {m}/other.svo.h5 --max-memory 500k",
        "", "--op xor",
    ),
    windowed(
        "morph in windows", "morph {m}/big.svo.h5 --max-memory 1M", "--dilate 2", "--erode 2"
    ),
]  # fmt: skip
MANY = "voxelize {m}/bunny.obj {m}/open.obj {m}/parts.glb --dim 60 --workers 2"
APART = [
    Writer("many", MANY, ("", "--mode surface26"), "out/", apart=True),
    Writer("frames", "render {m}/bunny.svo.h5 --turntable 5 --size 48", ("", "--up z"), "o%02d.png",
        apart=True),
]  # fmt: skip
WRITERS = [
    *WINDOWED,
    *APART,
    Writer("tar", MANY, ("", "--mode surface26"), "out.tar"),
    Writer("voxelize", "voxelize {m}/bunny.obj --dim 100", SURFACE, "o.svo.h5"),
    Writer("xml", "voxelize {m}/bunny.obj --dim 60", SURFACE, "o.svo.xml"),
    Writer("surface in windows", "extract {m}/big.svo.h5 --max-memory 1M",
        ("--style marching-cubes --level 0", "--style voxel-faces"), "o.ply"),
    Writer("field on disk", "adf-build {m}/bunny.obj --max-level 6 --max-memory 12M",
        ("--tolerance 1e-3", "--tolerance 2e-3"), "o.adf.h5"),
    Writer("zarr", "export {m}/bunny.svo.h5", ("", "--level 1"), "o.ome.zarr"),
    Writer("slices", "export {m}/bunny.svo.h5", ("", "--level 1"), "o/%04d.png"),
    Writer("npy", "export {m}/bunny.svo.h5", ("", "--invert"), "o.npy"),
    Writer("picture", "render {m}/bunny.svo.h5 --size 64", ("", "--view front"), "o.png"),
    Writer("loop", "render {m}/bunny.svo.h5 --turntable 5 --size 48", ("", "--up z"), "o.gif"),
    Writer("page", "view {m}/bunny.svo.h5 --no-open", ("", "--level 0"), "o.html"),
    Writer("combine", "combine {m}/bunny.svo.h5 {m}/box.svo.h5", ("", "--op xor"), "o.svo.h5"),
    Writer("morph", "morph {m}/bunny.svo.h5", ("--dilate 2", "--erode 1"), "o.svo.h5"),
    Writer("hollow", "hollow {m}/bunny.obj --wall 0.1", ("--dim 60", "--dim 64"), "o.stl"),
    Writer("dag", "svo-dag {m}/bunny.svo.h5", ("", "--expand"), "o.svo.h5"),
    Writer("repair", "repair {m}/open.obj", ("--dim 24", "--dim 28"), "o.ply"),
    Writer("import", "import {m}/mask.npy", ("", "--spacing 1,1,2"), "o.svo.h5"),
    Writer("distance", "distance {m}/bunny.obj {m}/points.csv", ("", "--gradient"), "o.csv"),
    Writer("adf-query", "adf-query {m}/bunny.adf.h5 {m}/points.csv", ("", "--gradient"), "o.npy"),
    Writer("svo-query", "svo-query {m}/bunny.svo.h5 {m}/points.csv", ("", "--nearest"), "o.csv"),
    Writer("tet-build", "tet-build {m}/volume.vtu",
        ("--scalar density", "--scalar momentum --component magnitude"), "o.tet.h5"),
]  # fmt: skip


def made(folder: Path) -> dict[str, str]:
    """Return the digests of the files of an output, without the times that a manifest has."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {
        str(path.relative_to(folder)): hashlib.sha256(_content(path)).hexdigest()
        for path in sorted(files)
        if path.name != "manifest.jsonl"
    }


def _content(path: Path) -> bytes:
    """Return the content of a file, of a tar without the lines that have times."""
    if path.suffix != ".tar":
        return path.read_bytes()
    import tarfile

    with tarfile.open(path) as tar:
        return b"".join(
            b"%s %s" % (member.name.encode(), tar.extractfile(member).read())  # pyright: ignore
            for member in tar
            if not member.name.endswith(".json")
        )


class Outputs:
    """The digests of what each request of a writer makes alone, computed once."""

    def __init__(self, models: Path, folder: Path) -> None:
        self.models, self._folder = models, folder
        self._known: dict[tuple[str, int], dict[str, str]] = {}

    def of(self, writer: Writer, request: int) -> dict[str, str]:
        """Return the digests of the files of a request."""
        key = writer.name, request
        if key not in self._known:
            folder = self._folder / f"{writer.name} {request}"
            folder.mkdir()
            subprocess.run(
                writer.words(request, self.models), cwd=folder, env=ENVIRONMENT, check=True
            )
            self._known[key] = made(folder)
            shutil.rmtree(folder)
        return self._known[key]


def run_alone(writer: Writer, request: int, models: Path, folder: Path) -> None:
    """Run a request, which succeeds."""
    subprocess.run(writer.words(request, models), cwd=folder, env=ENVIRONMENT, check=True)


def start(writer: Writer, request: int, models: Path, folder: Path, more: str = ""):
    """Start a request, whose processes are a group."""
    return subprocess.Popen(
        writer.words(request, models, more), cwd=folder, env=ENVIRONMENT, text=True,
        stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip


def check_pair(writer: Writer, rng: random.Random, outputs: Outputs, folder: Path) -> list[int]:
    """Run two requests at once, the first of which may be stopped for a while; return their codes.
    Each succeeds or is refused in one line, and the output is what one that succeeded makes."""
    requests = rng.choice([(0, 1), (1, 0), (0, 0)])
    expected = [outputs.of(writer, request) for request in requests]
    more = rng.choice(["", "--resume", "--no-keep"]) if writer.waits else ""
    stops = rng.random() < 0.5
    first = start(writer, requests[0], outputs.models, folder)
    if writer.waits and stops:  # in the middle of its windows
        until(lambda: first.poll() is not None or any(folder.glob("*.windows/*/*.0")))
    else:
        time.sleep(rng.uniform(0, 2))
    with contextlib.suppress(ProcessLookupError):
        os.killpg(first.pid, signal.SIGSTOP if stops else 0)
    second = start(writer, requests[1], outputs.models, folder, more)
    if stops:
        time.sleep(rng.uniform(0, 3))
        with contextlib.suppress(subprocess.TimeoutExpired):
            second.wait(rng.choice([0.01, 20]))
        with contextlib.suppress(ProcessLookupError):
            os.killpg(first.pid, signal.SIGCONT)
    codes = []
    for child in (first, second):
        _, said = child.communicate(timeout=300)
        codes.append(child.returncode)
        assert child.returncode in (0, 3), (writer.name, said)
        assert said.count("\n") == (child.returncode == 3), (writer.name, said)
        assert child.returncode == 0 or "is making" in said or "of another mesh" in said, said
    good = [each for each, code in zip(expected, codes, strict=True) if code == 0]
    assert good, (writer.name, codes)
    assert made(folder) in good, (writer.name, requests, codes, stops)
    empty(folder)
    return codes


def check_kill(writer: Writer, rng: random.Random, outputs: Outputs, folder: Path) -> list[int]:
    """Kill a command, and its helper too, at any moments; return the codes. Every file is old or
    new, and the next command makes the output and leaves nothing else."""
    codes = []
    old, new = rng.choice([(None, 0), (1, 0)])
    known = [outputs.of(writer, request) for request in (0, 1)]
    if old is not None:
        run_alone(writer, old, outputs.models, folder)
    for _ in range(rng.randint(1, 3)):
        child = start(writer, new, outputs.models, folder)
        time.sleep(rng.uniform(0.1, rng.choice([1, 3])))
        number = rng.choice([signal.SIGKILL] * 3 + [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
        send = rng.choice([os.kill, os.killpg])
        with contextlib.suppress(ProcessLookupError):
            send(child.pid, number)
        _, said = child.communicate(timeout=60)
        codes.append(child.returncode)
        early = ", in main\n" not in said  # the signal came before the first line of the program
        assert "Traceback" not in said or early, said
        seen = {
            name: sha
            for name, sha in made(folder).items()
            if not re.search(r"^\.|/\.[^/]*\.(tmp|owner)(/|$)|\.(windows|parts)/", name)
        }
        if writer.apart:
            odd = [
                name for name, sha in seen.items() if sha not in (each.get(name) for each in known)
            ]
            assert not odd, (writer.name, number, odd)
        else:
            assert seen in [{}, *known] if old is None else seen in known, (writer.name, number)
    resumes = ["--resume"] if writer.waits and rng.random() < 0.7 else []
    done = subprocess.run(
        [*writer.words(new, outputs.models), *resumes], cwd=folder, env=ENVIRONMENT,
        capture_output=True, text=True,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, ""), (writer.name, done.stderr)
    assert made(folder) == known[new], (writer.name, number)
    empty(folder)
    return codes


def until(true, seconds: float = 60) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not true() and time.monotonic() < end:
        time.sleep(0.005)


def empty(folder: Path) -> None:
    """Remove all that is in a folder."""
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
