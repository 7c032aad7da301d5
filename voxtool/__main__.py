"""The program `voxtool`. Signals, closed standard streams and crashes are provided for before
anything large is imported."""

from __future__ import annotations

import os
import signal
import sys
from typing import NoReturn

from voxtool import watch

# Name, mode and the flags that /dev/null is opened with in place of a closed stream.
STREAMS = (
    ("stdin", "r", os.O_WRONLY),
    ("stdout", "w", os.O_RDONLY),
    ("stderr", "w", os.O_RDWR),
)


def main() -> NoReturn:
    """Run the command line."""
    for name in watch.SIGNALS:
        number = getattr(signal, name, None)
        if number and signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
            signal.signal(number, _end)
    _open_streams()
    # Nothing here multiplies large matrices, and numpy's threads for it spin while they wait.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    watch.start()
    from voxtool.cli.main import cli

    try:
        cli.main(prog_name="voxtool")
    finally:
        watch.stop()


def _end(number: int, _: object) -> NoReturn:
    """End the program at once, without half-written files, and with one line."""
    watch.remove_files()
    watch.stop()
    clear = "\r\x1b[K" if os.isatty(2) else ""  # a progress bar
    try:
        os.write(2, f"{clear}voxtool: ended by {signal.Signals(number).name}\n".encode())
    finally:
        os._exit(128 + number)


def _open_streams() -> None:
    """Open /dev/null in place of each closed standard stream, so that no file takes its number: for
    stdin and stdout the wrong way round, so that using them is an error."""
    for number, (name, mode, flags) in enumerate(STREAMS):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, flags)
            setattr(sys, name, os.fdopen(number, mode))


if __name__ == "__main__":
    main()
