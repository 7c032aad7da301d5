"""Free memory and disk space, and errors for requests beyond them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from voxtool import limits
from voxtool.errors import FileError, MemoryLimitError, human

_allowed: ContextVar[int | None] = ContextVar("allowed memory", default=None)


def available_memory() -> int:
    """Return the bytes of memory that this process can still take: what the machine has free,
    within the limits of its control groups, of `ulimit -v` and of `at_most`; at most 2**60."""
    free = min(_free_memory(), limits.group_memory(), limits.address_space())
    most = allowed_memory()
    return free if most is None else min(free, most)


def allowed_memory() -> int | None:
    """Return the bytes that `at_most` allows here; None outside of it."""
    return _allowed.get()


@contextmanager
def at_most(most: int | None) -> Iterator[None]:
    """Let each request of this block take at most `most` bytes; None sets no limit."""
    token = _allowed.set(most)
    try:
        yield
    finally:
        _allowed.reset(token)


def _free_memory() -> int:
    with suppress(OSError, ValueError, StopIteration), open("/proc/meminfo") as lines:
        return 1024 * int(next(line.split()[1] for line in lines if "MemAvailable" in line))
    with suppress(AttributeError, OSError, ValueError):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return limits.UNLIMITED


def check_memory(
    size: int, what: str, instead: str = "choose a smaller dim", most: int | None = None
) -> None:
    """Check that a request fits in free memory, and in `most` bytes.

    Raises
    ------
    MemoryLimitError : names both sizes and what to do instead.
    """
    for limit, state in ((most, "allowed"), (available_memory(), "free")):
        if limit is not None and size > limit:
            needed = f"{what} need {human(size)} and {human(limit)} are {state}"
            raise MemoryLimitError(f"{needed}: {instead}")


def check_disk(path: str | os.PathLike[str], size: int, instead: str) -> None:
    """Check that the disk has room for a file of `size` bytes.

    Raises
    ------
    FileError : names the path, both sizes and what to do instead.
    """
    folder = Path(os.path.realpath(path)).parent
    free = shutil.disk_usage(folder).free
    if size > free:
        raise FileError(
            f"{path} would take {human(size)} and its disk has {human(free)} free: {instead}"
        )
