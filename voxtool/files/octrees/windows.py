"""The windows of an octree that are finished, in a folder beside the file that they become.

`NAME.windows` belongs to one run at a time (claims.py), which has a folder of its own in it, named
by the digest of its request and a number at random. There `windows.jsonl` is: a line that says of
which request, then one for each finished window; and the files of each, the states of its nodes,
blocks of its bricks, and the arrays of its attributes as they are in memory. Processes of a cluster
that see the folder write their windows into it. A killed run leaves the folder, and the next one
renames it, so that nobody else writes there, and takes what is whole. Whatever is read has the size
and the SHA-256 that its line says, or the run ends.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from voxtool import watch
from voxtool.claims import OWNER, Claim
from voxtool.errors import FileError, human
from voxtool.files.storage.atomic import write_error
from voxtool.files.storage.streams import folder_size
from voxtool.morton import distinct
from voxtool.svo.octree.attributes import KINDS, Attribute
from voxtool.svo.octree.layout import BRICK

BLOCK = 1 << 22  # bricks in a file
VALUES = 1 << 20  # values of an attribute that are read at once
PARTS = ("masks", "values", "leaves")  # of an attribute
JOURNAL = "windows.jsonl"
VERSION = 2
Key = tuple[int, int, int, int]  # the window's low corner and its side, in voxels


@dataclass(frozen=True)
class Window:
    """The content of a window: the states of its nodes by level, from the root down, its bricks,
    the number of its voxels, and their attributes; `known` is what else its job has to know of it,
    in JSON types."""

    levels: Sequence[np.ndarray]
    bricks: np.ndarray
    voxels: int
    attributes: Sequence[Attribute] = ()
    known: Any = None


class Store:
    """Finished windows in a folder, which one run writes.

    Parameters
    ----------
    folder : holds the windows of an earlier run if it exists.
    request : what is made, in JSON types.
    """

    def __init__(self, folder: Path, request: dict[str, Any]) -> None:
        self.folder, self._request = folder, request
        self._journal = folder / JOURNAL
        self._lines: dict[Key, dict[str, Any]] = {}
        self.place = str(folder.absolute()), _head_of(request)
        try:
            if self._journal.exists():
                self._read()
            else:
                folder.mkdir(exist_ok=True)
                self._write(self.place[1])
        except OSError as error:
            raise self._error(error) from error

    def beside(self, name: str) -> Store:
        """Return other windows of the same request, which wait in this folder, too."""
        return Store(self.folder / name, {**self._request, "beside": name})

    def __contains__(self, key: Key) -> bool:
        return key in self._lines

    def __len__(self) -> int:
        return len(self._lines)

    def _read(self) -> None:
        """Take the windows that an earlier run finished, and that are whole."""
        for line in _lines_of(self._journal)[1:]:
            with suppress(OSError, KeyError, TypeError, ValueError):
                x, y, z, side = map(int, line["window"])
                key = x, y, z, side
                if all(_is_whole(self._path(key, name), *of) for name, of in line["files"].items()):
                    self._lines[key] = line

    def put(self, key: Key, window: Window) -> None:
        """Store a window."""
        try:
            self._note(_written(self.folder, key, window))
        except OSError as error:
            raise self._error(error) from error

    def take_note(self, line: dict[str, Any]) -> bool:
        """Count a window that another process wrote into the folder (`write_beside`); return
        whether its files are there."""
        try:
            for name, (size, _) in line["files"].items():
                if self._path(line["window"], name).stat().st_size != size:
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
        states = self._checked(key, "0", np.dtype(np.uint8))
        return tuple(np.split(states, np.cumsum(line["levels"])[:-1])), line["bricks"]

    def voxels(self, key: Key) -> int:
        """Return the number of voxels of a window."""
        return self._lines[key]["voxels"]

    def known(self, key: Key) -> Any:
        """Return what else is known of a window."""
        return self._lines[key]["known"]

    def bricks(self, key: Key) -> Iterator[np.ndarray]:
        """Yield the bricks of a window in blocks."""
        for name in self._blocks(key):
            yield self._checked(key, name, BRICK)

    def take(self, key: Key) -> Iterator[np.ndarray]:
        """Yield the bricks of a window in blocks, and remove each block from the disk after it."""
        for name in self._blocks(key):
            yield self._checked(key, name, BRICK)
            self._path(key, name).unlink(missing_ok=True)

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
        row = np.dtype((dtype, (channels,))) if channels else dtype
        yield from self._streamed(key, f"{name}.{part}", row, VALUES)

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
        self._path(key, f"{name}.{part}").unlink(missing_ok=True)

    def _blocks(self, key: Key) -> list[str]:
        """Return the names of the files of a window's bricks."""
        return [name for name in self._lines[key]["files"] if name.isdecimal() and name != "0"]

    def _path(self, key: Key, name: str) -> Path:
        return _path_in(self.folder, key, name)

    def _checked(self, key: Key, name: str, dtype: np.dtype) -> np.ndarray:
        """Return a file of a window."""
        none = np.empty(0, dtype)
        return np.concatenate([none, *self._streamed(key, name, dtype, -1)])

    def _streamed(self, key: Key, name: str, dtype: np.dtype, most: int) -> Iterator[np.ndarray]:
        """Yield a file of a window in blocks of `most` items; FileError, after the last one at the
        latest, if it is not what was written."""
        path, (size, sha256) = self._path(key, name), self._lines[key]["files"][name]
        sha, left = hashlib.sha256(), size
        try:
            with open(path, "rb") as file:
                same = os.fstat(file.fileno()).st_size == size
                while same and left > 0 and len(block := np.fromfile(file, dtype, most)):
                    sha.update(block.data)
                    left -= block.nbytes
                    yield block
        except OSError as error:
            raise self._error(error) from error
        if left or sha.hexdigest() != sha256:
            raise FileError(
                f"{path} is not what this run wrote: another program or the disk changed it: run "
                "the command again"
            )

    def _write(self, line: str) -> None:
        """Add a line to the journal."""
        with open(self._journal, "a", encoding="utf-8") as file:
            file.write(f"{line}\n")
            file.flush()
            os.fsync(file.fileno())

    def _error(self, error: OSError) -> FileError:
        """Return the error of reading or writing a file of the folder."""
        if isinstance(error, FileNotFoundError):
            return FileError(
                f"{self.folder} is gone: another run or program has taken or removed it: run the "
                "command again"
            )
        return write_error(self.folder, error)


class Windows(Store):
    """The finished windows of a file, whose folder this run owns.

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
        If another run is making the file, the folder cannot be written, the disk has too little
        room, or with `resume` the folder is of another request.
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
        self._shared, self.keep = Path(f"{target}.windows"), keep
        self._claim = _claimed(self._shared, target)
        digest = hashlib.sha256(_head_of(request).encode()).hexdigest()
        folder = self._shared / f"{digest[:12]}-{os.urandom(8).hex()}"
        try:
            self._clear(folder, _head_of(request) if resume else None)
            _check_room(target, needed, folder)
            if not keep:
                watch.writing(self._claim.file)
                watch.writing(folder)
            super().__init__(folder, request)
        except OSError as error:
            self._release()
            raise write_error(self._shared, error) from error
        except BaseException:
            self._release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None or not self.keep:
            shutil.rmtree(self.folder, ignore_errors=True)
            watch.written(self.folder)
            self._release()
        else:
            self._claim.release(keep=True)

    def _release(self) -> None:
        """Give the folder back, and remove it unless windows of another request are there."""
        self._claim.release()
        with suppress(OSError):
            self._shared.rmdir()
        watch.written(self._claim.file)

    def _clear(self, folder: Path, head: str | None) -> None:
        """Remove what earlier runs left, but give to `folder` what the one with this head left that
        has the most windows."""
        left = [path for path in self._shared.iterdir() if path.name != OWNER]
        found = {path: _lines_of(path / JOURNAL) for path in left}
        same = [path for path in left if found[path][:1] == [head and json.loads(head)]]
        if head and left:
            if not same:
                raise FileError(
                    f"{self._shared} is of another mesh, grid or options: leave out --resume, "
                    "which removes it"
                )
            best = max(same, key=lambda path: len(found[path]))
            best.rename(folder)
            left.remove(best)
        for path in left:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()


def write_beside(place: tuple[str, str], key: Key, window: Window) -> dict[str, Any] | None:
    """Write a window into the folder of another process, if that is seen here; return what its
    journal says of it, None if the folder is not here.

    Parameters
    ----------
    place : Store.place of that process.
    """
    folder, head = Path(place[0]), place[1]
    try:
        with open(folder / JOURNAL, encoding="utf-8") as journal:
            if journal.readline() != f"{head}\n":
                return None
        return _written(folder, key, window)
    except OSError:
        return None


def _claimed(folder: Path, target: str) -> Claim:
    """Make the folder of windows of a file, and own it."""
    try:
        names = set[str]()
        with suppress(FileNotFoundError):
            names.update(os.listdir(folder))
        own = {OWNER, JOURNAL} & names or any((folder / name / JOURNAL).exists() for name in names)
        if names and not own:
            raise FileError(f"{folder} is in the way: rename it")
        while True:
            with suppress(FileExistsError):
                folder.mkdir()
            with suppress(FileNotFoundError):  # another run has just removed it
                return Claim(folder / OWNER, target)
    except NotADirectoryError:
        raise FileError(f"{folder} is in the way: rename it") from None
    except OSError as error:
        raise write_error(folder, error) from error


def _check_room(target: str, needed: int, folder: Path) -> None:
    """Raise FileError if the disk has too little room for a file and the windows that are not yet
    in the folder."""
    there = folder_size(folder)
    free = shutil.disk_usage(os.path.dirname(os.path.abspath(target))).free
    if needed - there > free:
        raise FileError(
            f"{target} needs about {human(needed - there)} of disk, of {human(free)} free: free "
            "some space, or write to another disk"
        )


def _head_of(request: dict[str, Any]) -> str:
    """Return the first line of a journal."""
    return json.dumps({"voxtool": "windows", "version": VERSION, "request": request})


def _lines_of(journal: Path) -> list[dict[str, Any]]:
    """Return the lines of a journal but those that were cut off; none if there is none."""
    lines = []
    with suppress(OSError), open(journal, encoding="utf-8", errors="replace") as file:
        for text in file:
            with suppress(ValueError):
                lines.append(json.loads(text))
    return lines


def _is_whole(path: Path, size: int, sha256: str) -> bool:
    """Return whether a file has this size and digest."""
    if path.stat().st_size != size:
        return False
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == sha256


def _written(folder: Path, key: Key, window: Window) -> dict[str, Any]:
    """Write the files of a window; return what the journal says of it. Each file appears whole,
    though two workers may make the same window."""
    blocks = [window.levels, *([part] for part in _split(window.bricks))]
    contents = {str(number): arrays for number, arrays in enumerate(blocks)}
    attributes = {}
    for one in window.attributes:
        for part, array in zip(PARTS[one.masks is None :], one.arrays, strict=True):
            contents[f"{one.name}.{part}"] = [array]
        attributes[one.name] = {
            "masked": one.masks is not None,
            "values": len(one.values),
            "leaves": len(one.leaves),
            "dtype": one.values.dtype.str,
        }
        if one.names:
            attributes[one.name]["labels"] = distinct(np.concatenate(one.arrays[-2:])).tolist()
    described = {
        "levels": [array.nbytes for array in window.levels],
        "bricks": len(window.bricks),
        "voxels": window.voxels,
        "attributes": attributes,
        "known": window.known,
    }
    files = {name: _put(_path_in(folder, key, name), each) for name, each in contents.items()}
    return {"window": key, **described, "files": files}


def _put(path: Path, arrays: Iterable[np.ndarray]) -> tuple[int, str]:
    """Write arrays to a file; return its size and SHA-256."""
    beside = path.with_name(f"{path.name}.{os.urandom(8).hex()}")
    sha, size = hashlib.sha256(), 0
    with open(beside, "wb") as file:
        for array in arrays:
            data = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
            file.write(data)
            sha.update(data)
            size += len(data)
    beside.replace(path)
    return size, sha.hexdigest()


def _path_in(folder: Path, key: Key, name: str) -> Path:
    """Return a file of a window: 0, the states; 1 and on, bricks; or an array of an attribute."""
    return folder / f"{'-'.join(map(str, key))}.{name}"


def _split(bricks: np.ndarray) -> list[np.ndarray]:
    """Return the blocks of bricks that have a file each."""
    return [bricks[start : start + BLOCK] for start in range(0, len(bricks), BLOCK)]
