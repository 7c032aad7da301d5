"""A process that tries cases. It may crash, hang or run out of memory: then it is replaced."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import re
import resource
import shutil
import signal
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from . import samples
from .cases import Case, case_of
from .judge import SECRET_WORD, Finding, Tools, memory
from .use import run

MOST_MEMORY = 6 << 30  # bytes of address space beyond what the device's driver takes
OLD_AGE = 1 << 30  # bytes of memory at which a process is replaced
GRACE = 30.0  # seconds beyond the time limit, for the process to end itself
FRAME = re.compile(r'File ".*?/(voxtool/[^"]+|kernels/[^"]+)", line \d+ in (\w+)')


class Worker:
    """A process and the pipe to it. `limit` is the time that a case may take, in seconds."""

    def __init__(self, folder: Path, seed: int, device: str, limit: float) -> None:
        self.folder, self.seed, self.device, self.limit = folder, seed, device, limit
        self.log = Path(tempfile.mkdtemp(dir=folder)) / "log"
        self.process: Any = None

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        arguments = (other, self.folder, self.log, self.seed, self.device, self.limit)
        self.process = context.Process(target=serve, args=arguments, daemon=True)
        self.process.start()
        other.close()
        if not self.pipe.poll(300) or self.pipe.recv() != "ready":
            raise RuntimeError(f"a worker does not start: {self.log.read_text()[-2000:]}")

    def stop(self) -> None:
        if self.process:
            self.process.kill()
            self.process.join()
            self.process = None

    def ask(self, request: Case | tuple[str, int]) -> list[Finding]:
        """The findings of a case, or of the case of a kind and a number."""
        if not self.process:
            self.start()
        try:
            self.pipe.send(request)
            if self.pipe.poll(self.limit + GRACE):
                findings, resident = self.pipe.recv()
                if resident > OLD_AGE:
                    self.stop()
                return findings
            what = "hang"
        except (EOFError, OSError):
            self.process.join(GRACE)
            what = "crash"
        code = self.process.exitcode
        self.stop()
        text = self.log.read_text(errors="replace") if self.log.exists() else ""
        if "Timeout (" in text:
            what = "hang"
        frames = FRAME.findall(text)
        place = ":".join(frames[0]).removeprefix("voxtool/") if frames else "no frame of voxtool"
        name = signal.Signals(-code).name if code and code < 0 else f"exit code {code}"
        return [Finding(what, place, f"{name}: {' '.join(text.split())[:300]}")]


def serve(pipe: Any, folder: Path, log: Path, seed: int, device: str, limit: float) -> None:
    """Try the cases that come through the pipe, until it is closed."""
    work, temporary = log.parent / "work", log.parent / "temporary"
    with log.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    faulthandler.enable(2)
    temporary.mkdir(exist_ok=True)
    tempfile.tempdir = os.environ["TMPDIR"] = str(temporary)
    import voxtool

    contents = samples.read_all(folder)
    tools = Tools(voxtool.open_device(device), device)
    (folder / "secret.txt").write_text(f"{SECRET_WORD}\n")
    tools.load(folder)
    new_folder(work, contents, with_samples=False)
    run(Case(0, "a.obj", "obj", contents["obj"]), tools)  # imports, and the device's first work
    space = memory("VmSize") + MOST_MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (space, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pipe.send("ready")
    while True:
        try:
            request = pipe.recv()
        except EOFError:
            return
        case = (
            request
            if isinstance(request, Case)
            else case_of(request[0], seed, request[1], contents)
        )
        new_folder(work, contents, with_samples=bool(case.words))
        if case.name:
            Path(case.name).write_bytes(case.content)
        faulthandler.dump_traceback_later(limit, exit=True)
        findings = run(case, tools)
        faulthandler.cancel_dump_traceback_later()
        left = [path.name for path in temporary.iterdir()]
        if left:
            findings.append(Finding("temporary file left", case.format or case.words[0], f"{left}"))
            for path in temporary.iterdir():
                path.unlink()
        pipe.send((findings, memory("VmRSS")))


def new_folder(work: Path, contents: dict[str, bytes], with_samples: bool) -> None:
    """Make the current folder a new one: empty, or with the samples and some odd names."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    os.chdir(work)
    if not with_samples:
        return
    for format, content in contents.items():
        Path(f"a.{format}").write_bytes(content)
    Path("folder").mkdir()
    Path("empty").touch()
    Path("report.json").write_text("{}")
    with suppress(OSError):  # where the file system takes such names
        for name in ("new\nline.obj", os.fsdecode(b"\xff.obj")):
            Path(name).write_bytes(contents["obj"])
