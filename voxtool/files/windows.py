"""The windows of an octree that are finished, in a folder beside the file that they become.

`NAME.windows` holds `windows.jsonl`: a line that says of which request, then one for each finished
window; and a file for each, the states of its nodes and its bricks as they are in memory. A killed
run leaves the folder, and the next one takes what is whole: a window counts if its file has the
SHA-256 that its line says.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np

from voxtool import watch
from voxtool.errors import FileError, human
from voxtool.files.atomic import atomic_path, write_error
from voxtool.svo.layout import BRICK

READ = 1 << 24  # bytes read at once
VERSION = 1
Key = tuple[int, int, int, int]  # the window's low corner and its side, in voxels


class Windows:
    """Finished windows.

    Parameters
    ----------
    target : the file that they become.
    request : what is made, in JSON types.
    needed : bytes on the disk that they and the file are predicted to take.
    resume : take the windows of an earlier run with the same request; otherwise they are removed.
    keep : leave the folder if this run fails.

    Raises
    ------
    FileError
        If the folder cannot be written, the disk has too little room, or with `resume` the folder
        is of another request.
    """

    def __init__(
        self,
        target: str,
        request: dict[str, Any],
        needed: int = 0,
        *,
        resume: bool = False,
        keep: bool = True,
    ) -> None:
        self.folder = Path(f"{target}.windows")
        self._journal = self.folder / "windows.jsonl"
        self._lines: dict[Key, dict[str, Any]] = {}
        head = {"voxtool": "windows", "version": VERSION, "request": request}
        try:
            if resume and self._journal.exists():
                self._read(head)
            else:
                self.remove()
            self._check_room(needed)
            if not self._lines:
                self.remove()
                self.folder.mkdir()
                self._write(json.dumps(head))
        except OSError as error:
            raise write_error(self.folder, error) from error
        if not keep:
            watch.writing(self.folder)
        self.keep = keep

    def _check_room(self, needed: int) -> None:
        """Raise FileError if the disk has too little room for the windows that are missing."""
        there = sum(file.stat().st_size for file in self.folder.glob("*"))
        free = shutil.disk_usage(self.folder.absolute().parent).free
        if needed - there > free:
            raise FileError(
                f"{self.folder.with_suffix('')} needs about {human(needed - there)} of disk, of "
                f"{human(free)} free: free some space, or write to another disk"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None or not self.keep:
            self.remove()

    def __contains__(self, key: Key) -> bool:
        return key in self._lines

    def __len__(self) -> int:
        return len(self._lines)

    def _read(self, head: dict[str, Any]) -> None:
        """Take the windows that an earlier run finished."""
        lines = []
        for text in self._journal.read_text(encoding="utf-8").splitlines():
            with suppress(ValueError):  # a line that was cut off
                lines.append(json.loads(text))
        if not lines or lines[0] != head:
            raise FileError(
                f"{self.folder} is of another mesh, grid or options: leave out --resume, which "
                "removes it"
            )
        for line in lines[1:]:
            with suppress(OSError, KeyError, TypeError, ValueError):
                key: Key = tuple(line["window"])
                if self._digest(self._path(key)) == line["sha256"]:
                    self._lines[key] = line

    def put(self, key: Key, levels: Sequence[np.ndarray], bricks: np.ndarray, voxels: int) -> None:
        """Store a window: the states of its levels, its bricks, and the number of its voxels."""
        path, sha = self._path(key), hashlib.sha256()
        try:
            with atomic_path(path) as temporary, open(temporary, "wb") as file:
                for array in (*levels, bricks):
                    sha.update(array.data)
                    file.write(array.data)
            sizes = [len(states) for states in levels]
            line = {"window": key, "levels": sizes, "bricks": len(bricks), "voxels": voxels}
            self._lines[key] = line | {"sha256": sha.hexdigest()}
            self._write(json.dumps(self._lines[key]))
        except OSError as error:
            raise write_error(path, error) from error

    def get(self, key: Key) -> tuple[tuple[np.ndarray, ...], int]:
        """Return the states of the levels of a window, and the number of its bricks."""
        line = self._lines[key]
        with open(self._path(key), "rb") as file:
            levels = tuple(np.frombuffer(file.read(size), np.uint8) for size in line["levels"])
        return levels, line["bricks"]

    @property
    def voxels(self) -> int:
        """The number of voxels of all windows."""
        return sum(line["voxels"] for line in self._lines.values())

    def take(self, key: Key) -> Iterator[np.ndarray]:
        """Yield the bricks of a window in blocks; its file is then removed."""
        path = self._path(key)
        with open(path, "rb") as file:
            file.seek(sum(self._lines[key]["levels"]))
            while block := file.read(READ):
                yield np.frombuffer(block, BRICK)
        path.unlink()

    def remove(self) -> None:
        """Remove the folder, if it is one of finished windows."""
        if self.folder.exists() and not self._journal.exists() and any(self.folder.iterdir()):
            raise FileError(f"{self.folder} is in the way: rename it")
        shutil.rmtree(self.folder, ignore_errors=True)
        watch.written(self.folder)

    def _path(self, key: Key) -> Path:
        return self.folder / "-".join(map(str, key))

    def _write(self, line: str) -> None:
        """Add a line to the journal."""
        with open(self._journal, "a", encoding="utf-8") as file:
            file.write(f"{line}\n")
            file.flush()
            os.fsync(file.fileno())

    @staticmethod
    def _digest(path: Path) -> str:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
