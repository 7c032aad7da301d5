"""Transfer functions as JSON files; voxtool.tets.pictures.transfer specifies their content."""

from __future__ import annotations

from voxtool.errors import FileError, VoxtoolError, human
from voxtool.files.storage.streams import PathLike, input_name, open_stream, read_error
from voxtool.tets.pictures.transfer import TransferFunction

LARGEST = 1 << 20  # bytes: many times what the most points take


def read_transfer(path: PathLike) -> TransferFunction:
    """Read a transfer function; `-` reads stdin.

    Raises
    ------
    FileError
        no such file, or one that is too large or holds none.
    """
    name = input_name(path)
    try:
        with open_stream(path) as (file, _, _):
            data = file.read(LARGEST + 1)
    except OSError as error:
        raise read_error(name, error) from error
    if len(data) > LARGEST:
        raise FileError(f"{name}: a transfer function has at most {human(LARGEST)}: choose a .json")
    try:
        return TransferFunction.from_json(data.decode())
    except UnicodeDecodeError:
        raise FileError(f"{name}: no text, so no transfer function: choose a .json") from None
    except VoxtoolError as error:
        raise FileError(f"{name}: {error}") from error
