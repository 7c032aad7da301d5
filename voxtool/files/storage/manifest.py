"""A manifest: what many meshes became, a line of JSON each, in the folder of the outputs.

`manifest.jsonl`, or `manifest.3-of-16.jsonl` of one of several shards. A line is added when a mesh
is done, so that a killed run leaves the lines of the meshes that it did; at the end of a run the
file is replaced by one that has the last line of each output.
"""

from __future__ import annotations

import json
import os
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from voxtool.claims import OWNER, Claim
from voxtool.errors import FileError
from voxtool.files.storage.atomic import alone, atomic_path, remove_with_temporaries, write_error

if TYPE_CHECKING:
    from collections.abc import Iterable


class Manifest:
    """The manifest of a folder, which is made if it does not exist.

    Attributes
    ----------
    path : Path
        The file that this run writes.

    It is owned by this run until the context is left. Another run of the same meshes is refused,
    and one of all meshes beside one of a shard.

    Raises
    ------
    FileError
        If another run makes the folder, or it or the file cannot be written.
    """

    def __init__(self, folder: str, shard: tuple[int, int] | None) -> None:
        name = "manifest.{}-of-{}.jsonl".format(*shard) if shard else "manifest.jsonl"
        self.path = Path(folder, name)
        self._own: dict[str, str] = {}  # lines by output; text takes a third of what a dict does
        self._known: dict[str, dict[str, Any]] = {}
        self._added = False
        self._made = not os.path.isdir(folder)
        make_folder(folder)
        self._owned = ExitStack()
        self._claim = self._owned.enter_context(alone(self.path))
        with self._owned:  # given back if what follows fails
            beside = f"-of-{shard[1]}.jsonl{OWNER}" if shard else self._claim.file.name
            for other in Path(folder).glob(f".manifest*{OWNER}"):
                if not other.name.endswith(beside):
                    Claim(other, folder).release()  # refused if that run is alive
            self._read(folder)
            self._owned = self._owned.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._owned.close()

    def _read(self, folder: str) -> None:
        """Take the lines that earlier runs wrote."""
        for other in sorted(Path(folder).glob("manifest*.jsonl")):
            self._known |= _lines_of(other)
        self._new = not self.path.exists()
        if not self._new:
            own = _lines_of(self.path)
            self._own = {output: json.dumps(line) for output, line in own.items()}

    def line_of(self, output: str) -> dict[str, Any]:
        """Return the last line of an output, of this shard or another; {} if there is none."""
        text = self._own.get(output)
        return json.loads(text) if text else self._known.get(output, {})

    def add(self, line: dict[str, Any]) -> None:
        """Add the line of an output."""
        if not self._claim.holds:
            raise FileError(f"another run has taken {self.path}: run this one again")
        text = self._own[line["output"]] = json.dumps(line)
        try:
            with open(self.path, "a", encoding="utf-8") as file:
                if not self._added and file.tell():
                    file.write("\n")  # ends a line that a killed run left
                file.write(text + "\n")
            self._added = True
        except OSError as error:
            raise write_error(self.path, error) from error

    def discard(self) -> None:
        """Remove the file and the folder, if this run made them and nothing else is there."""
        self._owned.close()
        with suppress(OSError):
            if self._new:
                self.path.unlink(missing_ok=True)
            if self._made:
                self.path.parent.rmdir()

    def remove(self, outputs: Iterable[str]) -> None:
        """Remove outputs, what is left of killed runs of them, the file, and the folders of all as
        far as nothing else is there."""
        top, folders = self.path.parent, set[Path]()
        for output in map(Path, outputs):
            remove_with_temporaries(output)
            folders |= {above for above in output.parents if above.is_relative_to(top)}
        self.path.unlink(missing_ok=True)
        self._owned.close()
        for folder in sorted(folders, reverse=True):  # those within others first
            with suppress(OSError):
                folder.rmdir()

    def finish(self, order: Iterable[str]) -> None:
        """Replace the file by the last line of each output, in this order; others come first."""
        if not self._added:
            return
        given = dict.fromkeys(output for output in order if output in self._own)
        others = [output for output in self._own if output not in given]
        with atomic_path(self.path) as path, open(path, "w", encoding="utf-8") as file:
            file.writelines(f"{self._own[output]}\n" for output in [*others, *given])


def make_folder(folder: str | os.PathLike[str]) -> None:
    """Make a folder, and those above it, unless they exist."""
    try:
        os.makedirs(folder, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise FileError(f"cannot write into {folder}: it is a file, not a folder") from error
    except OSError as error:
        raise write_error(folder, error) from error


def _lines_of(path: Path) -> dict[str, dict[str, Any]]:
    """Return the lines of a manifest by their output; lines that are no JSON are left out."""
    found: dict[str, dict[str, Any]] = {}
    try:
        with open(path, encoding="utf-8") as file:
            for text in file:
                with suppress(ValueError, TypeError, KeyError):
                    line = json.loads(text)
                    found[line["output"]] = line
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path}: is no manifest ({error}): remove it") from error
    return found
