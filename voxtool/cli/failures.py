"""Errors as the command line reports them: a kind, a message on one line, an exit code."""

from __future__ import annotations

import errno
from typing import Any

import click

from voxtool.errors import (
    LESS,
    CheckError,
    DeviceError,
    FileError,
    GridError,
    MemoryLimitError,
    MeshError,
    VoxtoolError,
    printable,
)

# The name of an error in JSON, and the exit code; the first that fits.
ERRORS = (
    (CheckError, "check", 1),
    (click.ClickException, "usage", 2),
    (DeviceError, "device", 4),
    ((MemoryLimitError, MemoryError), "memory", 4),
    (MeshError, "mesh", 3),
    (GridError, "grid", 3),
    (FileError, "file", 3),
    (VoxtoolError, "value", 3),
    (OSError, "file", 3),
    (ImportError, "memory", 4),  # of an extra that is missing, a VoxtoolError says so
)
# Errors of a stream that is written; an error of a file names it.
STREAM_ERRORS = (errno.EBADF, errno.ENOSPC, errno.EIO, errno.EFBIG, errno.EDQUOT)
FAILURES = (click.ClickException, VoxtoolError, MemoryError, OSError, ImportError)


def failure_of(error: BaseException) -> dict[str, Any]:
    """Return the kind, message and exit_code of one of FAILURES."""
    kind, code = next((kind, code) for kinds, kind, code in ERRORS if isinstance(error, kinds))
    return {"kind": kind, "message": message_of(error), "exit_code": code}


def message_of(error: BaseException) -> str:
    """Return the message of an error, on one line."""
    if isinstance(error, click.ClickException):
        message = error.format_message()
        context = error.ctx if isinstance(error, click.UsageError) else None
        if message.startswith("Usage:"):
            return message
        hint = f" (see {context.command_path} -h)" if context else ""
        return f"{' '.join(message.split()).removesuffix('.')}{hint}"
    if isinstance(error, MemoryError):
        return f"this machine has not enough memory: {LESS}"
    if isinstance(error, ImportError):
        return f"a library cannot be loaded ({error}): free memory, or raise the limit of ulimit -v"
    if isinstance(error, OSError):
        if not error.filename and error.errno in STREAM_ERRORS:
            from voxtool.files.storage.atomic import write_error

            return str(write_error("standard output", error))
        where = f"{printable(error.filename)}: " if error.filename else ""
        return f"{where}{error.strerror or error}"
    return str(error)
