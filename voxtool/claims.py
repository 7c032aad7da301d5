"""One run at a time: a file that names the run which owns an output, under a lock that the system
takes back however the run ends.

`flock` (Linux, macOS) and `msvcrt.locking` (Windows) lock the file, on network file systems, too,
if these have locks. Where they have none, or where another machine's locks may not be seen, what
the file says decides: a process of this machine is looked for, and the owner on another machine
gives a sign of life, the file's time, every BEAT seconds.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import json
import os
import platform
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from voxtool.errors import FileError

OWNER = ".owner"  # the end of the name of each such file
BEAT = 4.0  # seconds between signs of life
PATIENCE = 2.5  # beats without one after which the owner on another machine is dead
GONE = {errno.ENOENT, errno.ESTALE}  # the run before has just ended
TAKEN = {errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES}
PLACE = 1 << 30  # of the byte that is locked on Windows, where locked bytes cannot be read

_held: dict[str, Claim] = {}  # of this process


class Claim:
    """The ownership of an output, from the construction until it is released.

    Parameters
    ----------
    file : names the owner; its name ends with OWNER.
    output : what is owned, for messages.

    Raises
    ------
    FileError
        If another run owns the output.
    OSError
        If the file cannot be made.
    """

    def __init__(self, file: Path, output: object) -> None:
        self.file, self.output = Path(os.path.abspath(file)), output
        self._token = os.urandom(8).hex()
        while True:
            self._handle = _opened(self.file)
            try:
                known = self._lock()
                if os.path.samestat(os.fstat(self._handle), os.stat(self.file)):
                    break
            except BaseException as error:
                os.close(self._handle)
                if not isinstance(error, OSError) or error.errno not in GONE:
                    raise
            else:
                os.close(self._handle)
        try:
            self._take(known)
        except BaseException:
            os.close(self._handle)
            raise
        _held[str(self.file)] = self
        self._ended = threading.Event()
        threading.Thread(target=self._beat, daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    @property
    def holds(self) -> bool:
        """True while the output is owned: where locks are not known, a run that was stopped may
        have lost it."""
        return _record(self.file).get("token") == self._token

    def release(self, *, keep: bool = False) -> None:
        """Give the output back, and remove the file unless it is to be kept."""
        _held.pop(str(self.file), None)
        self._ended.set()
        with suppress(OSError):
            if self.holds:
                os.ftruncate(self._handle, 0)
                if not keep and os.name != "nt":
                    self.file.unlink()  # while it is locked
        os.close(self._handle)
        if os.name == "nt" and not keep:
            with suppress(OSError):  # the next owner has opened it
                self.file.unlink()

    def _lock(self) -> bool:
        """Lock the file; return whether the system knows of locks there."""
        try:
            if os.name == "nt":
                import msvcrt

                os.lseek(self._handle, PLACE, os.SEEK_SET)
                msvcrt.locking(self._handle, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
            else:
                import fcntl

                fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in TAKEN:
                raise self._refusal(_record(self.file)) from None
            return False
        return True

    def _take(self, known: bool) -> None:
        """Write who owns the output, unless the owner before is alive."""
        before = _record(self.file)
        here = before.get("machine") == machine()
        if before and not (here and known) and (_runs(before) if here else self._shows_life()):
            raise self._refusal(before)
        record = {"process": os.getpid(), "started": _start_of(os.getpid()), "token": self._token}
        text = json.dumps({"host": platform.node(), "machine": machine(), **record}).encode()
        os.ftruncate(self._handle, 0)
        os.lseek(self._handle, 0, os.SEEK_SET)
        os.write(self._handle, text)
        if not known:  # of several that begin at once the last one stays
            time.sleep(BEAT / 16)
            if not self.holds:
                raise self._refusal(_record(self.file))

    def _shows_life(self) -> bool:
        """Return whether the file's time changes within PATIENCE beats."""
        first, end = _time_of(self.file), time.monotonic() + PATIENCE * BEAT
        while time.monotonic() < end:
            time.sleep(BEAT / 8)
            if _time_of(self.file) != first:
                return True
        return False

    def _beat(self) -> None:
        while not self._ended.wait(BEAT):
            with suppress(OSError):
                os.utime(self.file)

    def _refusal(self, owner: dict[str, Any]) -> FileError:
        who = ""
        if owner:
            who = f" (process {owner.get('process')} on {owner.get('host')})"
        return FileError(
            f"another run{who} is making {self.output}: wait until it ends, or name another output"
        )


def release(file: str) -> None:
    """Give an output back that this process, or one that has died, owned; and remove the folder
    that a file called OWNER stands for, if nothing else is there."""
    with suppress(OSError, FileError):
        if os.path.exists(file):
            (_held.get(file) or Claim(Path(file), file)).release()
        if os.path.basename(file) == OWNER:
            os.rmdir(os.path.dirname(file))


@functools.cache
def machine() -> str:
    """Return a key of the machine, or of the container, in which numbers of processes mean
    something."""
    processes = 0
    with suppress(OSError):
        processes = os.stat("/proc/self/ns/pid").st_ino
    return hashlib.sha256(f"{platform.node()} {processes}".encode()).hexdigest()[:8]


def _opened(file: Path) -> int:
    return os.open(file, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)


def _record(file: Path) -> dict[str, Any]:
    """Return what a file says of its owner; {} if it says nothing."""
    with suppress(OSError, ValueError):
        found = json.loads(file.read_bytes())
        return found if isinstance(found, dict) else {}
    return {}


def _time_of(file: Path) -> int:
    """Return the time of a file in nanoseconds, as the server of a network file system has it."""
    with suppress(OSError), open(file, "rb") as opened:
        return os.fstat(opened.fileno()).st_mtime_ns
    return 0


def _runs(owner: dict[str, Any]) -> bool:
    """Return whether a process of this machine runs."""
    process = owner.get("process", 0)
    try:
        if os.name != "nt":  # os.kill would end the process there
            os.kill(process, 0)
    except (ProcessLookupError, OverflowError, TypeError):
        return False
    except OSError:  # it is another user's
        pass
    return owner.get("started") == _start_of(process)


def _start_of(process: int) -> int | None:
    """Return when a process began, in ticks of the system; None where it does not say."""
    with suppress(OSError, ValueError, IndexError):
        return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19])
    return None
