"""The limits of this process: those of its control groups (containers) and of `ulimit -v`."""

from __future__ import annotations

import functools
import sys
import threading
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

# The limit, what is used of it, and the key in memory.stat of cached files, which the kernel gives
# back when memory is short; of version 2 and version 1.
MEMORY_FILES = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)
UNLIMITED = 1 << 60  # version 1 writes almost 2**63 for no limit

_changed = threading.Condition()  # of the two below
_bounded = False  # whether a block of bounded_memory runs
_unbounded = 0  # blocks of unbounded_memory that run


@functools.cache
def memory_groups(root: str = "/") -> list[tuple[int, Path, Path, str]]:
    """Return the control groups that limit memory: limit in bytes, file of what is used, file of
    statistics, and the key there of cached files.

    Parameters
    ----------
    root
        The folder that holds proc/ and sys/; tests pass another one.
    """
    found = []
    for folder in _groups("memory", Path(root)):
        for limit_file, used, cached in MEMORY_FILES:
            with suppress(OSError, ValueError):  # no such file, or "max"
                limit = int((folder / limit_file).read_text())
                if limit < UNLIMITED:
                    found.append((limit, folder / used, folder / "memory.stat", cached))
    return found


def group_memory(root: str = "/") -> int:
    """Return the bytes that the control groups still allow; UNLIMITED without a limit."""
    left = UNLIMITED
    for limit, used, statistics, cached in memory_groups(root):
        with suppress(OSError, ValueError):
            taken = int(used.read_text())
            with suppress(OSError, ValueError):
                words = dict(line.split() for line in statistics.read_text().splitlines())
                taken -= int(words.get(cached, 0))
            left = min(left, max(limit - taken, 0))
    return left


def address_space() -> int:
    """Return the bytes of address space that `ulimit -v` still allows; UNLIMITED without a
    limit."""
    if sys.platform == "win32":
        return UNLIMITED
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return UNLIMITED
    return max(limit - mapped_memory(), 0)


def mapped_memory() -> int:
    """Return the bytes of address space that this process has mapped; 0 where the system does not
    say."""
    import resource

    with suppress(OSError, ValueError), open("/proc/self/statm") as statistics:
        return int(statistics.read().split()[0]) * resource.getpagesize()
    return 0


@contextmanager
def bounded_memory(size: int) -> Iterator[None]:
    """Let this process map at most `size` bytes more while the block runs: a request beyond that is
    a MemoryError. Only Linux has such a limit; it is one of the process, so threads share it: one
    block runs at a time, and none beside a block of `unbounded_memory`."""
    global _bounded
    with _changed:
        _changed.wait_for(lambda: not (_bounded or _unbounded))
        _bounded = True
    try:
        with _limited(size):
            yield
    finally:
        with _changed:
            _bounded = False
            _changed.notify_all()


@contextmanager
def unbounded_memory() -> Iterator[None]:
    """Keep blocks of `bounded_memory` in other threads from running beside this block, such as one
    that loads a driver: without memory, drivers crash or find no device."""
    global _unbounded
    with _changed:
        _changed.wait_for(lambda: not _bounded)
        _unbounded += 1
    try:
        yield
    finally:
        with _changed:
            _unbounded -= 1
            _changed.notify_all()


@contextmanager
def _limited(size: int) -> Iterator[None]:
    mapped = mapped_memory() if sys.platform == "linux" else 0
    if not mapped:  # or /proc is not there
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = mapped + size
    if soft != resource.RLIM_INFINITY:
        limit = min(limit, soft)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def processors(root: str = "/") -> int | None:
    """Return the number of processors that the control groups' quota amounts to, at least 1; None
    without a quota."""
    quotas = []
    for folder in _groups("cpu", Path(root)):
        with suppress(OSError, ValueError):  # version 2: "max 100000" or "150000 100000"
            quota, period = (folder / "cpu.max").read_text().split()
            quotas.append(int(quota) / int(period))
        with suppress(OSError, ValueError):  # version 1: -1 without a quota
            quota, period = (
                int((folder / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period")
            )
            quotas += [quota / period] if quota > 0 else []
    return max(-int(-min(quotas) // 1), 1) if quotas else None


def _groups(controller: str, root: Path) -> Iterator[Path]:
    """Yield the folders of this process's control groups, from its own to the outermost.

    A container may see its own group as the root, so folders need not exist.
    """
    mounted = root / "sys/fs/cgroup"
    with suppress(OSError), open(root / "proc/self/cgroup") as lines:
        for line in lines:
            number, controllers, path = line.rstrip("\n").split(":", 2)
            if controller in controllers.split(","):
                base = mounted / controller
            elif number == "0":
                base = mounted
            else:
                continue
            folder = base / path.lstrip("/")
            while folder != base.parent and ".." not in folder.parts:
                yield folder
                folder = folder.parent
