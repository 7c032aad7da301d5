"""Compiled programs, kept from one process to the next.

One file a program, named by the SHA-256 of everything it depends on: source, options, device and
driver. A file is written beside its place and renamed, so no lock is needed, and a process that is
killed does no harm. A file begins with the SHA-256 of its content: a damaged one is not used.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

from voxtool import watch
from voxtool.errors import DeviceWarning

ROOM = 64 << 20  # bytes that must be free: more than the programs of any command take
DIGEST = hashlib.sha256().digest_size


@functools.cache
def folder() -> Path | None:
    """Return the folder of compiled programs, made for this user alone; None if there is none to
    use.

    It is $XDG_CACHE_HOME/voxtool or ~/.cache/voxtool. A folder that others can write to is not
    used, because drivers run what it holds.
    """
    with suppress(OSError, RuntimeError):  # RuntimeError: there is no home
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        found = base / "voxtool"
        found.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = found.stat()
        private = os.name == "nt" or (state.st_uid == os.geteuid() and not state.st_mode & 0o022)
        pyopencl = base / "pytools"  # where it keeps its own
        folders = found, pyopencl if pyopencl.exists() else base
        writable = all(os.access(path, os.W_OK) for path in folders)
        if private and writable and shutil.disk_usage(found).free > ROOM:
            return found
    return None


@functools.cache
def temporary_folder() -> str:
    """Return a folder for this process's compiled programs, removed at its end."""
    with watch.making:
        made = tempfile.TemporaryDirectory(prefix="voxtool-")
        watch.writing(made.name)
    _kept_until_exit.append(made)
    return made.name


_kept_until_exit: list[tempfile.TemporaryDirectory[str]] = []


@functools.cache
def warn_once() -> None:
    """Warn that kernels are compiled anew in each process."""
    warnings.warn(
        "kernels are compiled anew in each process, because the folder for compiled kernels cannot"
        " be written or is full: set XDG_CACHE_HOME to another folder",
        DeviceWarning,
        stacklevel=2,
    )


def place(*parts: str) -> Path | None:
    """Return the file of a program that depends on these texts; None without a folder."""
    found = folder()
    if found is None:
        warn_once()
        return None
    return found / f"{hashlib.sha256(repr(parts).encode()).hexdigest()}.bin"


def load(file: Path) -> bytes | None:
    """Return the compiled program in a file; None if there is none or it is damaged."""
    with suppress(OSError):
        content = file.read_bytes()
        if hashlib.sha256(content[DIGEST:]).digest() == content[:DIGEST]:
            return content[DIGEST:]
    return None


def keep(file: Path, binary: bytes) -> None:
    """Write a compiled program to its file; warns if the disk is full."""
    beside = file.with_name(f"{file.name}.{os.urandom(8).hex()}")
    try:
        beside.write_bytes(hashlib.sha256(binary).digest() + binary)
        beside.replace(file)
    except OSError:
        warn_once()
        with suppress(OSError):
            beside.unlink()
