"""A second process that clears up after this one, if this one crashes or is killed.

It is forked before drivers are loaded, and waits at the end of a pipe. Through the pipe it learns
which files are being written and which device is used. If the pipe closes without a farewell, it
removes the files and prints one line. Only the program starts it; in a library, and where there is
no fork, the functions here only keep the list of files.
"""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from collections.abc import Sequence

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")  # end the program, not the watcher
FILE, WRITTEN, DEVICE, END = b"fwde"  # the first byte of a message; a zero byte ends it

LONGEST_WAIT = 5.0  # seconds for another thread to let `making` go

# Held while a temporary file or folder is made and named by `writing`: removing waits for it.
making = threading.RLock()

_files: set[str] = set()  # being written by this process
_watcher: tuple[int, int] | None = None  # its process and the end of the pipe to write to


def start() -> None:
    """Start the watcher."""
    global _watcher
    if not hasattr(os, "fork"):
        return
    with suppress(OSError):  # without more processes or files, there is no watcher
        read_end, write_end = os.pipe()
        process = os.fork()
        if process:
            os.close(read_end)
            _watcher = process, write_end
        else:
            os.close(write_end)
            _wait(read_end)


def stop() -> None:
    """End the watcher, which then does nothing."""
    global _watcher
    if _watcher:
        _tell(END)
        (process, pipe), _watcher = _watcher, None
        with suppress(OSError):
            os.close(pipe)
            os.waitpid(process, 0)


def writing(path: str | os.PathLike[str]) -> None:
    """Say that a temporary file or folder is being written."""
    _files.add(os.path.abspath(path))
    _tell(FILE, os.path.abspath(path))


def written(path: str | os.PathLike[str]) -> None:
    """Say that a temporary file is in its place, or removed."""
    _files.discard(os.path.abspath(path))
    _tell(WRITTEN, os.path.abspath(path))


def using(device: str, others: Sequence[str] = ()) -> None:
    """Say which device computes, and which others --device could name."""
    _tell(DEVICE, "\n".join((device, *others)))


def remove_files() -> None:
    """Remove every temporary file and folder that this process is writing, just before it ends.

    No thread can make another one after that, since the lock is kept.
    """
    making.acquire(timeout=LONGEST_WAIT)
    _remove(_files.copy())


def _remove(paths: set[str]) -> None:
    for path in sorted(paths, key=_is_owner):
        if _is_owner(path):
            from voxtool.claims import release

            release(path)
        elif os.path.isdir(path):
            import shutil

            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                os.unlink(path)


def _is_owner(path: str) -> bool:
    """Return whether a file names the run that owns an output (claims.py)."""
    return path.endswith(".owner")


def _tell(kind: int, text: str = "") -> None:
    if _watcher:
        with suppress(OSError):
            os.write(_watcher[1], bytes([kind]) + os.fsencode(text) + b"\0")


def _wait(pipe: int) -> NoReturn:
    """Read the pipe until its writer ends, clear up, and end this process."""
    code = 1
    try:
        for name in SIGNALS:
            if number := getattr(signal, name, None):
                signal.signal(number, signal.SIG_IGN)
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1):  # the reader of stdout must see its end
            os.dup2(nowhere, stream)
        received = b""
        while part := os.read(pipe, 1 << 16):
            received += part
        _clear_up(received)
        code = 0
    finally:
        os._exit(code)


def _clear_up(received: bytes) -> None:
    device, others = "the device", []
    files = set()
    for message in received.split(b"\0")[:-1]:
        kind, text = message[0], os.fsdecode(message[1:])
        if kind == END:
            return
        if kind == DEVICE:
            device, *others = text.split("\n")
        elif kind == FILE:
            files.add(text)
        else:
            files.discard(text)
    _remove(files)
    hint = f": {'; '.join(others)}" if others else " (voxtool devices lists them)"
    line = (
        f"voxtool: error: the command ended without a result: it was killed, or the driver of"
        f" {device} crashed: free some memory, or choose another device with --device{hint}\n"
    )
    os.write(2, line.encode(errors="backslashreplace"))
