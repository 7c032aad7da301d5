"""The windows of an octree that are finished, in a folder beside the file that they become.

`NAME.windows` holds `windows.jsonl`: a line that says of which request, then one for each finished
window; and the files of each, the states of its nodes, blocks of its bricks, and the arrays of its
attributes as they are in memory. Processes of a cluster that see the folder write their windows
into it. A killed run leaves the folder, and the next one takes what is whole: a window counts if
its files have the SHA-256 that its line says.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from voxtool import watch
from voxtool.errors import FileError, human
from voxtool.files.atomic import write_error
from voxtool.morton import distinct
from voxtool.svo.attributes import KINDS, Attribute
from voxtool.svo.layout import BRICK

BLOCK = 1 << 22  # bricks in a file
VALUES = 1 << 20  # values of an attribute that are read at once
PARTS = ("masks", "values", "leaves")  # of an attribute
JOURNAL = "windows.jsonl"
VERSION = 1
Key = tuple[int, int, int, int]  # the window's low corner and its side, in voxels


@dataclass(frozen=True)
class Window:
    """The content of a window: the states of its nodes by level, from the root down, its bricks,
    the number of its voxels, and their attributes; `known` is what else its job has to know of it,
    in JSON types."""

    levels: Sequence[np.ndarray]
    bricks: np.ndarray
    voxels: int
    sha256: str  # of the files that it is stored in
    attributes: Sequence[Attribute] = ()
    known: Any = None

    @classmethod
    def of(
        cls,
        levels: Sequence[np.ndarray],
        bricks: np.ndarray,
        voxels: int,
        attributes: Sequence[Attribute] = (),
        known: Any = None,
    ) -> Self:
        """Return a window with its SHA-256."""
        sha = hashlib.sha256()
        for array in (*levels, bricks, *(part for one in attributes for part in one.arrays)):
            sha.update(np.ascontiguousarray(array).data)
        return cls(levels, bricks, voxels, sha.hexdigest(), attributes, known)


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
        self.folder, self._resume, self._request = Path(f"{target}.windows"), resume, request
        self._journal = self.folder / JOURNAL
        self._lines: dict[Key, dict[str, Any]] = {}
        head = {"voxtool": "windows", "version": VERSION, "request": request}
        self.place = str(self.folder.absolute()), json.dumps(head)
        try:
            if resume and self._journal.exists():
                self._read(head)
            else:
                self.remove()
            self._check_room(needed)
            if not self._journal.exists():
                self.remove()
                self.folder.mkdir()
                self._write(self.place[1])
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

    def beside(self, name: str) -> Windows:
        """Return other windows of the same request, which wait in this folder, too."""
        request = {**self._request, "beside": name}
        return Windows(str(self.folder / name), request, resume=self._resume)

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
                x, y, z, side = map(int, line["window"])
                if self._digest((x, y, z, side), line) == line["sha256"]:
                    self._lines[x, y, z, side] = line

    def put(self, key: Key, window: Window) -> None:
        """Store a window."""
        try:
            self._note(_written(self.folder, key, window))
        except OSError as error:
            raise write_error(self.folder, error) from error

    def take_note(self, line: dict[str, Any]) -> bool:
        """Count a window that another process wrote into the folder (`write_beside`); return
        whether its files are there."""
        size = sum(line["levels"]) + BRICK.itemsize * line["bricks"]
        for name, about in line["attributes"].items():
            value = max(KINDS[name].channels, 1) * np.dtype(about["dtype"]).itemsize
            size += value * (about["values"] + about["leaves"])
            size += BRICK.itemsize * line["bricks"] * about["masked"]
        try:
            paths = _all_paths(self.folder, line["window"], line)
            if sum(path.stat().st_size for path in paths) != size:
                return False
        except OSError:
            return False
        self._note(line)
        return True

    def _note(self, line: dict[str, Any]) -> None:
        self._lines[line["window"]] = line
        self._write(json.dumps(line))

    def get(self, key: Key) -> tuple[tuple[np.ndarray, ...], int]:
        """Return the states of the levels of a window, and the number of its bricks."""
        line = self._lines[key]
        with open(_paths(self.folder, key, 1)[0], "rb") as file:
            levels = tuple(np.frombuffer(file.read(size), np.uint8) for size in line["levels"])
        return levels, line["bricks"]

    def voxels(self, key: Key) -> int:
        """Return the number of voxels of a window."""
        return self._lines[key]["voxels"]

    def known(self, key: Key) -> Any:
        """Return what else is known of a window."""
        return self._lines[key]["known"]

    def bricks(self, key: Key) -> Iterator[np.ndarray]:
        """Yield the bricks of a window in blocks."""
        for path in _paths(self.folder, key, self._lines[key]["files"])[1:]:
            yield np.fromfile(path, BRICK)

    def attribute(self, key: Key, name: str) -> dict[str, Any]:
        """Return of an attribute of a window whether it is masked, the number of values in bricks
        and of leaves, their dtype and, of labels, those that voxels have."""
        return self._lines[key]["attributes"][name]

    def array(self, key: Key, name: str, part: str) -> Iterator[np.ndarray]:
        """Yield an array of an attribute of a window, one of PARTS, in blocks; the bricks as masks
        if it has none."""
        about = self.attribute(key, name)
        if part == "masks" and not about["masked"]:
            yield from self.bricks(key)
            return
        channels = 0 if part == "masks" else KINDS[name].channels
        dtype = BRICK if part == "masks" else np.dtype(about["dtype"])
        row = (channels,) if channels else ()
        with open(_attribute_path(self.folder, key, name, part), "rb") as file:
            while len(block := np.fromfile(file, dtype, VALUES * math.prod(row))):
                yield block.reshape(-1, *row)

    def load(self, key: Key, about: Attribute) -> Attribute:
        """Return an attribute of a window in memory, given one of the same name without values."""
        arrays = [
            np.concatenate([none, *self.array(key, about.name, part)])
            for part, none in (("values", about.values), ("leaves", about.leaves))
        ]
        masks = None
        if self.attribute(key, about.name)["masked"]:
            masks = np.concatenate([np.empty(0, BRICK), *self.array(key, about.name, "masks")])
        return replace(about, values=arrays[0], leaves=arrays[1], masks=masks)

    def mapped(self, name: str, dtype: np.dtype, blocks: Iterable[np.ndarray]) -> np.ndarray:
        """Write an array that comes in blocks beside the windows; return it, mapped into memory."""
        path = self.folder / name
        try:
            with open(path, "wb") as file:
                for block in blocks:
                    file.write(block.data)
            if not path.stat().st_size:
                return np.empty(0, dtype)
            return np.memmap(path, dtype, "r")
        except OSError as error:
            raise write_error(self.folder, error) from error

    def drop(self, key: Key, name: str, part: str) -> None:
        """Remove an array of an attribute of a window from the disk."""
        _attribute_path(self.folder, key, name, part).unlink()

    def take(self, key: Key) -> Iterator[np.ndarray]:
        """Yield the same; each block is then removed from the disk."""
        for path, block in zip(
            _paths(self.folder, key, self._lines[key]["files"])[1:], self.bricks(key), strict=True
        ):
            yield block
            path.unlink()

    def remove(self) -> None:
        """Remove the folder, if it is one of finished windows."""
        if self.folder.exists() and not self._journal.exists() and any(self.folder.iterdir()):
            raise FileError(f"{self.folder} is in the way: rename it")
        shutil.rmtree(self.folder, ignore_errors=True)
        watch.written(self.folder)

    def _write(self, line: str) -> None:
        """Add a line to the journal."""
        with open(self._journal, "a", encoding="utf-8") as file:
            file.write(f"{line}\n")
            file.flush()
            os.fsync(file.fileno())

    def _digest(self, key: Key, line: dict[str, Any]) -> str:
        """Return the SHA-256 of the files of a window."""
        sha = hashlib.sha256()
        for path in _all_paths(self.folder, key, line):
            sha.update(path.read_bytes())
        return sha.hexdigest()


def write_beside(place: tuple[str, str], key: Key, window: Window) -> dict[str, Any] | None:
    """Write a window into the folder of another process, if that is seen here; return what its
    journal says of it, None if the folder is not here.

    Parameters
    ----------
    place : Windows.place of that process.
    """
    folder, head = Path(place[0]), place[1]
    try:
        with open(folder / JOURNAL, encoding="utf-8") as journal:
            if journal.readline() != f"{head}\n":
                return None
        return _written(folder, key, window)
    except OSError:
        return None


def _written(folder: Path, key: Key, window: Window) -> dict[str, Any]:
    """Write the files of a window; return what the journal says of it."""
    files = [window.levels, *([part] for part in _split(window.bricks))]
    for path, arrays in zip(_paths(folder, key, len(files)), files, strict=True):
        with open(path, "wb") as file:
            for array in arrays:
                file.write(array.data)
    attributes = {}
    for one in window.attributes:
        for part, array in zip(PARTS[one.masks is None :], one.arrays, strict=True):
            array.tofile(_attribute_path(folder, key, one.name, part))
        attributes[one.name] = {
            "masked": one.masks is not None,
            "values": len(one.values),
            "leaves": len(one.leaves),
            "dtype": one.values.dtype.str,
        }
        if one.names:
            attributes[one.name]["labels"] = distinct(np.concatenate(one.arrays[-2:])).tolist()
    sizes = {"levels": [array.nbytes for array in window.levels]}
    counts = {"bricks": len(window.bricks), "voxels": window.voxels, "files": len(files)}
    described = {**sizes, **counts, "attributes": attributes, "known": window.known}
    return {"window": key, **described, "sha256": window.sha256}


def _paths(folder: Path, key: Key, count: int) -> list[Path]:
    """Return the files of a window: the states, then blocks of bricks."""
    name = "-".join(map(str, key))
    return [folder / f"{name}.{number}" for number in range(count)]


def _all_paths(folder: Path, key: Key, line: dict[str, Any]) -> list[Path]:
    """Return the files of a window, and those of its attributes, given its line of the journal."""
    attributes = [
        _attribute_path(folder, key, name, part)
        for name, about in line.get("attributes", {}).items()
        for part in PARTS[not about["masked"] :]
    ]
    return [*_paths(folder, key, line["files"]), *attributes]


def _attribute_path(folder: Path, key: Key, name: str, part: str) -> Path:
    """Return the file of an array of an attribute of a window."""
    return folder / f"{'-'.join(map(str, key))}.{name}.{part}"


def _split(bricks: np.ndarray) -> list[np.ndarray]:
    """Return the blocks of bricks that have a file each."""
    return [bricks[start : start + BLOCK] for start in range(0, len(bricks), BLOCK)]
