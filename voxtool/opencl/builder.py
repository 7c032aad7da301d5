"""The programs of a device, each built once, also beside other work.

Drivers release Python's lock while they compile or load a program. So work that knows which
programs it will use has them built by threads, while it prepares its data or uses the first ones.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from contextvars import copy_context
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from voxtool.opencl import launch, program

if TYPE_CHECKING:
    from collections.abc import Iterable

THREADS = 2  # drivers compile little side by side
ALONE = "Oclgrind"  # a platform whose compiler crashes beside other threads

Request = tuple[str, Mapping[str, int | str]]  # a source in kernels/, and its -D options


@dataclass(frozen=True)
class Built:
    """A program, and the signatures of its kernels by name."""

    program: Any
    signatures: dict[str, launch.Signature]


class Builder:
    """Builds the programs of a context. Threads may share it."""

    def __init__(self, cl: Any, context: Any, platform: str) -> None:
        self._of = cl, context, platform
        self._built: dict[Any, Built] = {}
        self._locks: dict[Any, threading.Lock] = {}  # held while a program is built

    def program(self, source: str, defines: Mapping[str, int | str]) -> Built:
        """Return the program of kernels/`source` with the given -D options; waits for a thread that
        builds it. Raises DeviceError if it does not build."""
        key = _key(source, defines)
        with self._locks.setdefault(key, threading.Lock()):
            if key not in self._built:
                signatures = launch.signatures(program.flatten(source), defines)
                self._built[key] = Built(
                    program.build(*self._of, source, defines), {s.name: s for s in signatures}
                )
            return self._built[key]

    def prepare(self, requests: Iterable[Request]) -> None:
        """Begin to build programs in the background, in this order, but those that are built."""
        waiting = deque(request for request in requests if _key(*request) not in self._built)
        threads = 0 if self._of[2] == ALONE else min(THREADS, len(waiting))

        def build_waiting() -> None:
            with suppress(IndexError):  # none is left
                while True:
                    request = waiting.popleft()
                    with suppress(Exception):  # who uses the program meets the error
                        self.program(*request)

        for _ in range(threads):
            threading.Thread(target=copy_context().run, args=(build_waiting,)).start()

    @property
    def requests(self) -> set[Any]:
        """The sources and options of all programs that were built."""
        return set(self._built)


def _key(source: str, defines: Mapping[str, int | str]) -> Any:
    return source, *sorted(defines.items())
