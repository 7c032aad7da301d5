"""Interactive pages as HTML; voxtool.viewer makes them."""

from __future__ import annotations

from voxtool.files.storage.streams import PathLike, open_output

FORMATS = ("html",)


def write_page(html: str, path: PathLike, clobber: bool = True, format: str = "html") -> None:
    """Write a page, as UTF-8; `-` writes stdout.

    Raises
    ------
    FileError
        The file cannot be written, or it exists and `clobber` is False.
    """
    with open_output(path, clobber=clobber) as file:
        file.write(html.encode())
