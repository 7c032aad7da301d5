"""A file appears whole or not at all: write beside the target, fsync, rename.

A killed process leaves the old file or folder or none, and at worst a hidden
`.NAME.MACHINE-PROCESS-RANDOM.tmp`, which is removed when the next file is written beside it.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from voxtool import watch
from voxtool.claims import OWNER, Claim, machine
from voxtool.errors import FileError

if TYPE_CHECKING:
    from collections.abc import Iterator

NO_LINKS = {errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK}
OCCUPIED = {errno.ENOTEMPTY, errno.EEXIST, errno.EACCES}  # EACCES on Windows
_outputs = threading.local()
MARK = ".voxtool"  # the empty file in folders that an export wrote
HINTS = {
    errno.ENOSPC: "the disk is full: free some space, or write to another disk",
    errno.EDQUOT: "the disk quota is used up: free some space, or write to another disk",
    errno.EFBIG: "the file would be larger than its disk or a limit (ulimit -f) allows",
    errno.EROFS: "the disk is read-only: choose another folder",
    errno.EACCES: "no permission: choose another folder",
    errno.EPERM: "no permission: choose another folder",
    errno.EBADF: "it is closed",
    errno.ENAMETOOLONG: "the name is too long: shorten it",
}


def check_target(
    target: str | os.PathLike[str], clobber: bool = True, folder: bool = False
) -> None:
    """Raise FileError, before any work, if a file, or with `folder` a folder, cannot be written:
    where it lies is missing or read-only, it is the other of the two, or it exists and clobber is
    False. A folder that holds something else than an export is not replaced."""
    target = Path(target)
    if folder:
        _check_replaced(target)
    elif os.path.isdir(target):  # a name that is too long raises no error here
        raise FileError(f"cannot write {target}: it is a folder: name a file in it")
    if not clobber and os.path.lexists(target):
        raise _refusal(target)
    above = Path(os.path.realpath(target)).parent
    if not os.path.exists(above):
        raise FileError(f"cannot write {target}: there is no folder {above}: create it first")
    if not os.path.isdir(above):
        raise FileError(f"cannot write {target}: {above} is a file, not a folder")
    if not _is_device(target) and not os.access(above, os.W_OK | os.X_OK):
        raise FileError(f"cannot write {target}: {HINTS[errno.EACCES]}")


@contextmanager
def atomic_path(target: str | os.PathLike[str], clobber: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `target`; the file replaces the target when the block ends.

    The file exists, is empty and has mode 0666 & ~umask. If the block raises any exception, the
    file is removed and the target is unchanged. A symbolic link is followed; a device or pipe
    (/dev/null, /dev/stdout) gets the bytes at the end.

    Parameters
    ----------
    clobber : False refuses an existing target, including one that appears during the block.

    Raises
    ------
    FileError : the target cannot be written, or exists and clobber is False.
    """
    target = Path(target)
    check_target(target, clobber)
    with suppress(AttributeError, ValueError):  # none on Windows; not in the main thread
        if signal.getsignal(signal.SIGXFSZ) == signal.SIG_IGN:  # though drivers may handle it
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    temporary: Path | None = None
    try:
        if _is_device(target):
            import tempfile

            real, folder = target, Path(tempfile.gettempdir())
        else:
            real = Path(os.path.realpath(target))
            folder = real.parent
        with watch.making:
            temporary = _create_beside(folder, target.name)
            watch.writing(temporary)
        yield temporary
        _put_in_place(temporary, real, clobber)
    except OSError as error:
        if not _is_ours(error, temporary, target):
            raise
        raise write_error(target, error) from error
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            watch.written(temporary)


@contextmanager
def atomic_folder(target: str | os.PathLike[str], clobber: bool = True) -> Iterator[Path]:
    """Yield an empty temporary folder beside `target`; it becomes the target when the block ends.

    If the block raises any exception, the folder is removed and the target is unchanged. A folder
    that an export has written, which holds the file MARK, is replaced; any other one is refused,
    unless it is empty.

    Parameters
    ----------
    clobber : False refuses an existing target.

    Raises
    ------
    FileError : the target cannot be written, or holds something else.
    """
    target = Path(target)
    check_target(target, clobber, folder=True)
    real = Path(os.path.realpath(target))
    with watch.making:
        temporary = _name_beside(real.parent, target.name)
        try:
            temporary.mkdir()
        except OSError as error:
            raise write_error(target, error) from error
        watch.writing(temporary)
    try:
        yield temporary
        (temporary / MARK).touch()
        for path in temporary.rglob("*"):
            if path.is_file():
                _sync(path, os.O_RDWR)
                count(path.stat().st_size)
        check_target(target, clobber, folder=True)
        _replace_folder(temporary, real)
    except OSError as error:
        raise write_error(target, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        watch.written(temporary)


def _check_replaced(target: Path) -> None:
    """Raise FileError if a folder cannot take the place of what is there. Another run may replace
    it at the same time, and remove the old one while its names are read: then look again."""
    while True:
        try:
            before = target.stat()
            held = os.listdir(target)
            if not held or MARK in held:
                return
            if os.path.samestat(before, target.stat()):
                break
        except FileNotFoundError:
            return
        except NotADirectoryError:
            raise FileError(
                f"cannot write {target}: it is a file, and a folder is to be written"
            ) from None
    raise FileError(
        f"cannot write {target}: the folder holds files that no export wrote: name another"
    )


def _replace_folder(made: Path, target: Path) -> None:
    """Put a folder in the place of another one, whatever other processes put there meanwhile; what
    was there is then in the place of `made`, or removed."""
    while True:
        try:
            made.rename(target)  # there is nothing, or an empty folder
            return
        except OSError as error:
            if error.errno not in OCCUPIED or target.is_file():
                raise
        if _exchanged(made, target):
            return
        aside = made.with_suffix(".old")
        with suppress(FileNotFoundError):
            target.rename(aside)
        placed = True
        try:
            made.rename(target)
        except OSError as error:
            if error.errno not in OCCUPIED:
                aside.rename(target)
                raise
            placed = False  # another run was sooner
        shutil.rmtree(aside, ignore_errors=True)
        if placed:
            return


def _exchanged(one: Path, other: Path) -> bool:
    """Exchange two folders at once, where the system can; return whether it did."""
    if sys.platform != "linux":
        return False
    import ctypes

    try:
        rename = ctypes.CDLL(None).renameat2
    except (OSError, AttributeError):
        return False
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return rename(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0


@contextmanager
def alone(output: str | os.PathLike[str], patience: float = 0) -> Iterator[Claim]:
    """Own an output of several files while the block runs, by a hidden file beside it.

    Parameters
    ----------
    patience : seconds to wait for another run that makes it.

    Raises
    ------
    FileError : another run makes it, or the folder cannot be written.
    """
    above, name = os.path.split(os.path.realpath(output))
    end = time.monotonic() + patience
    while True:
        try:
            claim = Claim(Path(above, f".{name}{OWNER}"), output)
            break
        except FileError:
            if time.monotonic() >= end:
                raise
            time.sleep(0.05)
        except OSError as error:
            raise write_error(output, error) from error
    watch.writing(claim.file)
    try:
        yield claim
    finally:
        claim.release()
        watch.written(claim.file)


def write_error(target: str | os.PathLike[str], error: OSError) -> FileError:
    """Return the error of writing `target`, in one line with a hint."""
    hint = HINTS.get(error.errno or 0, error.strerror or str(error))
    return FileError(f"cannot write {target}: {hint}")


def _refusal(target: Path) -> FileError:
    return FileError(f"{target} exists: name another file, or drop --no-clobber to replace it")


def _is_ours(error: OSError, temporary: Path | None, target: Path) -> bool:
    """Return True if an error concerns the file that is written, not one that the block reads."""
    if isinstance(error, BrokenPipeError) or error.errno is None:
        return False
    names = (None, str(temporary), str(target), os.path.realpath(target))
    return temporary is None or error.filename in names


def _is_device(path: Path) -> bool:
    with suppress(OSError):  # such as a name that is too long
        return path.is_char_device() or path.is_fifo() or path.is_socket()
    return False


def _create_beside(folder: Path, name: str) -> Path:
    """Return a new empty file that becomes `name`."""
    flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0)
    path = _name_beside(folder, name)
    os.close(os.open(path, flags, 0o666))  # the system applies the umask
    return path


def _name_beside(folder: Path, name: str) -> Path:
    """Return the name, after this machine and process, of a new file or folder that becomes `name`;
    what processes that have died left beside it is removed."""
    sweep(folder)
    return folder / f"{_stem(name)}{os.getpid()}-{os.urandom(8).hex()}.tmp"


def remove_with_temporaries(target: Path) -> None:
    """Remove a file, and what processes of this machine have begun for it, which fail then."""
    target.unlink(missing_ok=True)
    for name, _ in _begun(target.parent):
        if name.startswith(_stem(target.name)):
            _remove(target.parent / name)


def sweep(folder: Path) -> None:
    """Remove what processes of this machine that have died began in a folder."""
    if os.name == "nt":  # os.kill would end the process there
        return
    for name, process in _begun(folder):
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            _remove(folder / name)
        except (OSError, OverflowError):  # it is another user's
            continue


def _stem(name: str) -> str:
    return f".{name[:40]}.{machine()}-"


def _begun(folder: Path) -> Iterator[tuple[str, int]]:
    """Yield the names of what processes of this machine began, and the processes."""
    with suppress(OSError):
        for name in os.listdir(folder):
            process = name.rpartition(f".{machine()}-")[2].split("-")[0]
            if name.startswith(".") and name.endswith(".tmp") and process.isdecimal():
                yield name, int(process)


def written() -> int:
    """Return the bytes of all outputs that this thread has written."""
    return getattr(_outputs, "bytes", 0)


def count(size: int) -> None:
    """Add the bytes of an output to those that this thread has written."""
    _outputs.bytes = written() + size


def _remove(path: Path) -> None:
    """Remove a file or a folder with all that is in it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _put_in_place(temporary: Path, target: Path, clobber: bool) -> None:
    count(temporary.stat().st_size)
    if _is_device(target):
        with temporary.open("rb") as source, target.open("wb") as sink:
            shutil.copyfileobj(source, sink, 1 << 20)
        return
    _sync(temporary, os.O_RDWR)
    if clobber:
        temporary.replace(target)
    else:
        _rename_new(temporary, target)
    with suppress(OSError):  # some systems cannot sync a folder
        _sync(target.parent, os.O_RDONLY)


def _sync(path: Path, flags: int) -> None:
    handle = os.open(path, flags | getattr(os, "O_BINARY", 0))
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _rename_new(temporary: Path, target: Path) -> None:
    """Rename, or refuse an existing target; if several processes do it at once, one succeeds."""
    try:
        if os.name == "nt":
            temporary.rename(target)  # refuses an existing target there
            return
        try:
            os.link(temporary, target)
        except OSError as error:
            if error.errno not in NO_LINKS:
                raise
            os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY))  # claims the name
            try:
                temporary.replace(target)
            except BaseException:
                target.unlink()
                raise
    except FileExistsError:
        raise _refusal(target) from None
