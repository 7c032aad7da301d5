"""Sends numbers to workers, and keeps a small case of each finding."""

from __future__ import annotations

import itertools
import re
import shlex
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import voxtool

from . import samples
from .cases import Case, case_of
from .judge import Finding
from .worker import Worker

BATCH = 16  # cases that a worker is sent at once
Items = TypeVar("Items", bound=Sequence[Any])


@dataclass
class Found:
    """The first case of a finding, made smaller, and how many there were."""

    finding: Finding
    case: Case
    count: int = 1
    path: Path | None = None


@dataclass
class Session:
    """A run of the fuzzer.

    Attributes
    ----------
    folder : of the samples, the workers' files and the saved cases.
    limit, effort : processor seconds that a case may take; seconds for making one smaller.
    """

    folder: Path
    seed: int
    device: str
    workers: int = 1
    limit: float = 20.0
    effort: float = 30.0
    found: dict[str, Found] = field(default_factory=dict)
    contents: dict[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.folder = self.folder.resolve()
        self.folder.mkdir(parents=True, exist_ok=True)
        samples.write_all(self.folder, voxtool.open_device(self.device))
        self.contents = samples.read_all(self.folder)
        self._lock = threading.Lock()

    def run(self, kind: str, start: int, seconds: float, most: int | None = None) -> int:
        """Try the cases from number `start` on, for a time or a count; return the next number."""
        numbers = iter(itertools.count(start) if most is None else range(start, start + most))
        tried: list[int] = []

        def work() -> None:
            worker = self._worker()
            end = time.monotonic() + seconds
            try:
                while time.monotonic() < end and (batch := self._batch(numbers)):
                    findings = worker.ask_all([(kind, self.seed, number) for number in batch])
                    for number, found in zip(batch, findings, strict=True):
                        for finding in found:
                            case = case_of(kind, self.seed, number, self.contents)
                            self.note(finding, kind, case, worker)
                    tried.extend(batch)
            finally:
                worker.stop()

        threads = [threading.Thread(target=work) for _ in range(self.workers)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return max(tried, default=start - 1) + 1

    def _worker(self) -> Worker:
        worker = Worker(self.folder, self.device, self.limit)
        worker.start()
        return worker

    def _batch(self, numbers: Iterator[int]) -> list[int]:
        with self._lock:
            return list(itertools.islice(numbers, BATCH))

    def note(self, finding: Finding, kind: str, case: Case, worker: Worker) -> None:
        """Count a finding; make the case of a new one smaller, save it and report it."""
        with self._lock:
            if finding.key in self.found:
                self.found[finding.key].count += 1
                return
            found = self.found[finding.key] = Found(finding, case)
        found.case = smaller(case, finding.key, worker, self.effort)
        found.path = self.save(found, kind)
        print(f"{finding.key}: {finding.detail}\n    {found.path}", flush=True)

    def save(self, found: Found, kind: str) -> Path:
        """Write the case and a description of it; return the description's path."""
        case, finding = found.case, found.finding
        name = re.sub(r"[^\w.-]+", "-", f"{finding.key} {kind} {case.number}")
        folder = self.folder / "findings"
        folder.mkdir(exist_ok=True)
        again = f"--kind {kind} --seed {self.seed} --case {case.number} --device {self.device}"
        lines = [finding.key, finding.detail, f"python -m tests.fuzz {again}"]
        if case.words:
            lines.append(f"voxtool {shlex.join(case.words)}")
        else:
            (folder / f"{name}.{case.format}").write_bytes(case.content)
        path = folder / f"{name}.txt"
        path.write_text("\n".join(lines) + "\n", errors="backslashreplace")
        return path


def smaller(case: Case, key: str, worker: Worker, seconds: float) -> Case:
    """A case with fewer words, or a shorter file, that still has the finding."""
    end = time.monotonic() + seconds

    def fails(changed: Case) -> bool:
        return any(finding.key == key for finding in worker.ask(changed))

    if case.words:
        words = shortest(case.words, lambda w: bool(w) and fails(replace(case, words=w)), end)
        return replace(case, words=words)
    content = shortest(case.content, lambda c: fails(replace(case, content=c)), end)
    return replace(case, content=content)


def shortest(items: Items, fails: Callable[[Items], bool], end: float) -> Items:
    """A part of the items that still fails, found by leaving out ever smaller pieces until the time
    `end` (delta debugging, Zeller and Hildebrandt 2002)."""
    size = len(items) // 2
    while size and time.monotonic() < end:
        before, place = len(items), 0
        while place < len(items) and time.monotonic() < end:
            shorter: Any = items[:place] + items[place + size :]  # pyright: ignore
            if fails(shorter):
                items = shorter
            else:
                place += size
        size = size // 2 if len(items) == before else min(size, len(items) // 2)
    return items
