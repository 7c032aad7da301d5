"""Files that a mesh names: material libraries, buffers and textures, in its own folder alone."""

from __future__ import annotations

import base64
import binascii
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from urllib.parse import unquote_to_bytes

from voxtool.errors import MeshError, one_line, printable

DATA = re.compile(r"data:[^,]{0,200},")
SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")  # http:, file: and C:


_noted: ContextVar[list[str] | None] = ContextVar("noted", default=None)


@contextmanager
def noting() -> Iterator[list[str]]:
    """Yield a list that takes the names of the files beside meshes that this block reads."""
    token = _noted.set(names := [])
    try:
        yield names
    finally:
        _noted.reset(token)


class Companions:
    """The files that a mesh names and that may be read.

    Parameters
    ----------
    name : str
        Name of the mesh, for messages.
    folder : str, optional
        The folder of the mesh; None where it is read from a stream.
    limit : int
        Bytes that all of them may have.
    """

    def __init__(self, name: str, folder: str | None, limit: int) -> None:
        self.name, self.folder, self.left = name, folder, limit

    def read(self, uri: str, what: str, *, quoted: bool = False) -> bytes:
        """Return the bytes that a relative path or a data: URI names.

        Parameters
        ----------
        what : str
            What is there, for messages.
        quoted : bool
            Whether it is a URI, with %20 and its kin.

        Raises
        ------
        MeshError
            If there is no such file in the folder of the mesh or below, or it is too large.
        """
        if quoted and (data := DATA.match(uri)):
            return self._inside(uri[data.end() :], data[0], what)
        shown = f"{self.name}: {what} {printable(uri)[:80]!r}"
        path = os.fsdecode(unquote_to_bytes(uri)) if quoted else uri
        path = path.replace("\\", "/")
        steps = path.split("/")
        if SCHEME.match(path) or path.startswith("/") or ".." in steps or "\0" in path:
            raise MeshError(
                f"{shown} is not in the folder of the mesh, and nothing else is opened: put it "
                "there and name it alone"
            )
        if self.folder is None:
            raise MeshError(f"{shown} is another file, and a stream has no folder: give the path")
        return self._beside(shown, path)

    def _beside(self, shown: str, path: str) -> bytes:
        folder = os.path.realpath(self.folder or ".")
        whole = os.path.realpath(os.path.join(folder, path))
        if os.path.commonpath([folder, whole]) != folder:
            raise MeshError(f"{shown} is a link that leaves the folder of the mesh: copy it there")
        try:
            with open(os.open(whole, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb") as file:
                status = os.fstat(file.fileno())
                if not stat.S_ISREG(status.st_mode):
                    raise MeshError(f"{shown} is no file")
                self._take(shown, status.st_size)
                if (noted := _noted.get()) is not None:
                    noted.append(whole)
                return file.read(status.st_size)
        except FileNotFoundError:
            raise MeshError(
                f"{shown} is missing: put it into the folder of the mesh, or export a .glb, which "
                "holds it"
            ) from None
        except (OSError, ValueError) as error:
            raise MeshError(f"{shown} cannot be read: {one_line(error)}") from None

    def _inside(self, text: str, head: str, what: str) -> bytes:
        self._take(f"{self.name}: {what}", len(text))
        if not head.endswith(";base64,"):
            return unquote_to_bytes(text)
        try:
            return base64.b64decode(text, validate=False)
        except (binascii.Error, ValueError) as error:
            raise MeshError(f"{self.name}: {what}: its base64 is damaged: {error}") from None

    def _take(self, shown: str, size: int) -> None:
        self.left -= size
        if self.left < 0:
            raise MeshError(f"{shown}: the files of the mesh take more memory than is allowed")
