"""Worker processes, and both ends of what they say to each other.

A worker is this program with the same command line and `--as-worker`. It reads a line of JSON for
each mesh, and answers with one; at the end of stdin it ends. A worker has up to DEPTH meshes at a
time, so that one is read and one is written while one is computed. If it dies, its meshes are tried
again, each alone in a worker: a crash costs the mesh that caused it.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import traceback
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from voxtool import watch
from voxtool.cli import options
from voxtool.cli.failures import FAILURES, failure_of
from voxtool.cli.runner import Item

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    Answer = dict[str, Any]

DEPTH = 3  # meshes in a worker: one is read, one computed, one written
BATCH = 64  # meshes, at most, that a worker of Dask does before it answers
BATCHES = 8  # of each worker of Dask, at least, so that all of them end at about the same time


@dataclass
class Task:
    """A mesh and its output, which is None for a report."""

    mesh: str
    output: str | None
    alone: bool = False  # in its worker, since one died that had it


class Workers:
    """Processes that do tasks.

    words : the command line of a worker, without the program; tasks : what is to be done;
    folder : the current one of a worker.
    """

    def __init__(
        self, words: Sequence[str], tasks: Sequence[Task], count: int, folder: str = "."
    ) -> None:
        self._command = [sys.executable, "-m", "voxtool", *words]
        self._folder = folder
        self._waiting = deque(tasks)
        self._lock = threading.Lock()
        self._answers: queue.SimpleQueue[tuple[Task, Answer] | None] = queue.SimpleQueue()
        self._processes: set[subprocess.Popen[bytes]] = set()
        self._threads = [
            threading.Thread(target=self._attend, daemon=True)
            for _ in range(min(count, len(tasks)))
        ]

    def answers(self) -> Iterator[tuple[Task, Answer]]:
        """Yield each task with its answer, as workers have them; end the workers if the loop
        ends before."""
        for thread in self._threads:
            thread.start()
        running = len(self._threads)
        try:
            while running:
                if answer := self._answers.get():
                    yield answer
                else:
                    running -= 1
        finally:
            with self._lock:
                self._waiting.clear()
                for process in self._processes:
                    assert process.stdin
                    process.stdin.close()
            for thread in self._threads:
                thread.join()

    def _attend(self) -> None:
        """Keep one worker busy until no task waits."""
        flying: dict[int, Task] = {}
        process, number = None, 0
        while True:
            while task := self._next(flying):
                process = process or self._start()
                flying[number] = task
                line = {"number": number, "mesh": task.mesh, "output": task.output}
                number += 1
                assert process.stdin
                with suppress(OSError, ValueError):  # closed: the answer will be missing
                    process.stdin.write(json.dumps(line).encode() + b"\n")
                    process.stdin.flush()
            if not flying:
                break
            assert process
            assert process.stdout
            if line := process.stdout.readline():
                answer = json.loads(line)
                self._answers.put((flying.pop(answer.pop("number")), answer))
            else:
                self._bury(process, list(flying.values()))
                process = None
                flying.clear()
        if process:
            self._end(process)
        self._answers.put(None)

    def _next(self, flying: Mapping[int, Task]) -> Task | None:
        """Return the next task for a worker that has these."""
        with self._lock:
            if not self._waiting or len(flying) >= DEPTH:
                return None
            alone = self._waiting[0].alone or any(task.alone for task in flying.values())
            return None if alone and flying else self._waiting.popleft()

    def _start(self) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=self._folder
        )
        with self._lock:
            self._processes.add(process)
        return process

    def _end(self, process: subprocess.Popen[bytes]) -> int:
        """Wait until a worker has ended; return its exit code."""
        with self._lock:
            self._processes.discard(process)
        assert process.stdin
        assert process.stdout
        with suppress(OSError):
            process.stdin.close()
        code = process.wait()
        process.stdout.close()
        return code

    def _bury(self, process: subprocess.Popen[bytes], tasks: list[Task]) -> None:
        """Fail the task of a worker that has died, or let each of several try again alone."""
        code = self._end(process)
        if len(tasks) > 1:
            again = [Task(task.mesh, task.output, alone=True) for task in tasks]
            with self._lock:
                self._waiting.extendleft(reversed(again))
            return
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        message = (
            f"its process ended with {how}: it was killed, or the driver crashed: free some "
            "memory, or choose another device with --device"
        )
        failure = {"kind": "crash", "message": message, "exit_code": 4}
        self._answers.put((tasks[0], {"error": failure, "lines": []}))


class Spread:
    """Workers of a Dask cluster that do tasks, each by a process of its own.

    words, tasks : as in `Workers`; address, count : the cluster's, as in tiles/cluster.py.
    """

    def __init__(
        self, words: Sequence[str], tasks: Sequence[Task], address: str, count: int | None
    ) -> None:
        self._words, self._tasks, self._address, self._count = words, tasks, address, count

    def answers(self) -> Iterator[tuple[Task, Answer]]:
        """Yield each task with its answer, as workers have them."""
        from voxtool.tiles.cluster import connected, results, threads_of

        with connected(self._address, self._count) as client:
            size = -(-len(self._tasks) // (BATCHES * threads_of(client)))
            size = min(size, BATCH) or 1
            batches = [self._tasks[i : i + size] for i in range(0, len(self._tasks), size)]
            given = self._words, os.getcwd()
            for _, answers in results(
                client, lambda batch: client.submit(do_batch, batch, *given, pure=False), batches
            ):
                yield from answers


def do_batch(tasks: Sequence[Task], words: Sequence[str], folder: str) -> list[tuple[Task, Answer]]:
    """Do some tasks by one process, within a worker of Dask."""
    return list(Workers(words, tasks, 1, folder).answers())


def serve(call: Callable[..., Any], values: Mapping[str, Any]) -> None:
    """Do the tasks that stdin names, as a worker: call(mesh=, output=, item=, **values)."""
    command = click.get_current_context().command
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not get among the answers
    device, writing = threading.Lock(), threading.Lock()
    unanswered: set[int] = set()

    def work(task: dict[str, Any]) -> None:
        item = Item(device)
        context = click.Context(command, info_name=command.name)
        context.params = {**values, "mesh": task["mesh"]}
        lines = context.meta[options.LINES] = []
        more = {"output": task["output"]} if task["output"] else {}
        try:
            with context, suppress(click.exceptions.Exit):  # after a plan
                call(mesh=task["mesh"], item=item, **{**values, **more})
        except FAILURES as error:
            item.facts["error"] = failure_of(error)
        except Exception as error:
            traceback.print_exc()
            message = f"{type(error).__name__}: {error}"
            item.facts["error"] = {"kind": "internal", "message": message, "exit_code": 1}
        answer = {**item.facts, "number": task["number"], "lines": lines}
        with writing:
            unanswered.discard(task["number"])
            answers.write(json.dumps(answer).encode() + b"\n")
            answers.flush()

    with ThreadPoolExecutor(DEPTH) as pool:
        for line in sys.stdin:
            task = json.loads(line)
            unanswered.add(task["number"])
            pool.submit(work, task)
        if unanswered:  # and nobody who waits for it
            watch.remove_files()
            watch.stop()
            os._exit(1)
