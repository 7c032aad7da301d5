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
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from . import samples
from .cases import Case, case_of
from .judge import SECRET_WORD, Finding, Tools, memory
from .use import run

MOST_MEMORY = 6 << 30  # bytes of address space beyond what the device's driver takes
OLD_AGE = 1 << 30  # bytes of memory at which a process is replaced
WAIT = 6  # times the limit of processor time that a case may take by the clock
GRACE = 30.0  # seconds beyond that, for the process to end itself
FRAME = re.compile(r'File ".*?/(voxtool/[^"]+|kernels/[^"]+)", line \d+ in (\w+)')


Numbered = tuple[str, int, int]  # kind, seed and number of a case, which the process makes itself


class Worker:
    """A process and the pipe to it. `limit` is the processor time that a case may take, in s."""

    def __init__(self, folder: Path, device: str, limit: float) -> None:
        self.folder, self.device, self.limit = folder, device, limit
        self.log = Path(tempfile.mkdtemp(dir=folder)) / "log"
        self.process: Any = None

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        arguments = (other, self.folder, self.log, self.device, self.limit)
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

    def ask(self, case: Case) -> list[Finding]:
        """The findings of a case."""
        return self.ask_all([case])[0]

    def ask_all(self, cases: Sequence[Case | Numbered]) -> list[list[Finding]]:
        """The findings of each case. All are sent at once, so that neither process waits for the
        other after each; after a crash the rest is sent again."""
        answers: list[list[Finding]] = []
        while len(answers) < len(cases):
            if not self.process:
                self.start()
            rest = cases[len(answers) :]
            try:
                self.pipe.send(rest)
                for _ in rest:
                    if not self.pipe.poll(WAIT * self.limit + GRACE):
                        raise TimeoutError
                    findings, resident = self.pipe.recv()
                    answers.append(findings)
                    if resident > OLD_AGE:
                        self.stop()
                        break
            except (EOFError, OSError) as error:
                answers.append([self._end("hang" if isinstance(error, TimeoutError) else "crash")])
        return answers

    def _end(self, what: str) -> Finding:
        """The finding of a process that has crashed or hangs."""
        if what == "crash":
            self.process.join(GRACE)
        code = self.process.exitcode
        self.stop()
        text = self.log.read_text(errors="replace") if self.log.exists() else ""
        if "Timeout (" in text or code == -signal.SIGPROF:
            what = "hang"
        frames = FRAME.findall(text)
        place = ":".join(frames[0]).removeprefix("voxtool/") if frames else "no frame of voxtool"
        name = signal.Signals(-code).name if code and code < 0 else f"exit code {code}"
        return Finding(what, place, f"{name}: {' '.join(text.split())[-600:]}")


def serve(pipe: Any, folder: Path, log: Path, device: str, limit: float) -> None:
    """Try the cases that come through the pipe, until it is closed."""
    with log.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    faulthandler.enable(2)
    faulthandler.register(signal.SIGPROF, 2, all_threads=False, chain=True)  # and end
    work, temporary = log.parent / "work", log.parent / "temporary"
    work.mkdir(exist_ok=True)
    temporary.mkdir(exist_ok=True)
    tempfile.tempdir = os.environ["TMPDIR"] = str(temporary)
    os.environ["VOXTOOL_DEVICE"] = device  # of commands without --device
    os.chdir(work)
    from voxtool import opencl

    contents = samples.read_all(folder)
    tools = Tools(opencl.shared_device(device), device)
    (folder / "secret.txt").write_text(f"{SECRET_WORD}\n")
    tools.load(folder)
    fill_folder(contents)
    run(Case(0, "a.obj", "obj"), tools)  # imports, and the device's first work
    space = memory("VmSize") + MOST_MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (space, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pipe.send("ready")
    filled: dict[str, tuple[int, int]] = {}
    with suppress(EOFError):
        while True:
            for case in pipe.recv():
                case = case if isinstance(case, Case) else case_of(*case, contents)
                if not filled or listing() != filled:
                    fill_folder(contents)
                    filled = listing()
                pipe.send((try_case(case, tools, limit, temporary), memory("VmRSS")))


def try_case(case: Case, tools: Tools, limit: float, temporary: Path) -> list[Finding]:
    """The findings of a case, which may take `limit` seconds of processor time."""
    if case.name:
        samples.put(Path(case.name), case.format, case.content)
    signal.setitimer(signal.ITIMER_PROF, limit)
    faulthandler.dump_traceback_later(WAIT * limit, exit=True)
    findings = run(case, tools)
    faulthandler.cancel_dump_traceback_later()
    signal.setitimer(signal.ITIMER_PROF, 0)
    for name in os.listdir(temporary):
        findings.append(Finding("temporary file left", "the folder for them", name))
        remove(temporary / name)
    if case.name:
        remove(Path(case.name))
    return findings


def remove(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def fill_folder(contents: dict[str, bytes]) -> None:
    """Make the current folder one of the samples and some odd names, and of nothing else."""
    for path in Path().iterdir():
        remove(path)
    for format, content in contents.items():
        samples.put(Path(f"a.{format}"), format, content)
    Path("folder").mkdir()
    Path("empty").touch()
    with suppress(OSError):  # where the file system takes such names
        for name in ("new\nline.obj", os.fsdecode(b"\xff.obj")):
            Path(name).write_bytes(contents["obj"])


def listing() -> dict[str, tuple[int, int]]:
    """The time and size of each file of the current folder."""
    stats = {entry.name: entry.stat() for entry in os.scandir()}
    return {name: (stat.st_mtime_ns, stat.st_size) for name, stat in stats.items()}
