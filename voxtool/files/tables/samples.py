"""A tar of samples, as WebDataset and tar itself read it. Each mesh has NAME.ENDING, its output,
and NAME.json, its line of the manifest without what differs from run to run.

WebDataset takes what stands before the first dot of a name for the sample's. The same outputs give
the same tar, byte for byte: there are no times and no users in it.
"""

from __future__ import annotations

import io
import json
import os
import tarfile
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from voxtool.errors import FileError
from voxtool.files.storage.atomic import atomic_path

VARYING = ("output", "stages", "seconds")  # of a manifest's line
LARGEST = 1 << 24  # bytes of a line that is read


@dataclass(frozen=True)
class Sample:
    """The output of a mesh.

    name : without endings; ending : that of the output, without its first dot.
    path : the output; line : the manifest's.
    """

    name: str
    ending: str
    path: str
    line: dict[str, Any]


def write_samples(target: str, samples: Iterable[Sample], clobber: bool = True) -> None:
    """Write a tar of samples, in their order; raise FileError if it cannot be written."""
    with (
        atomic_path(target, clobber) as path,
        tarfile.open(path, "w", format=tarfile.PAX_FORMAT) as tar,
    ):
        for sample in samples:
            with open(sample.path, "rb") as file:
                size = os.fstat(file.fileno()).st_size
                tar.addfile(_member(f"{sample.name}.{sample.ending}", size), file)
            facts = {name: x for name, x in sample.line.items() if name not in VARYING}
            text = json.dumps(facts, sort_keys=True).encode()
            tar.addfile(_member(f"{sample.name}.json", len(text)), io.BytesIO(text))


def read_lines(path: str) -> dict[str, dict[str, Any]]:
    """Return the lines of a tar's samples, by their names; {} if there is no such file.

    Raises
    ------
    FileError
        If the file is no tar of samples.
    """
    found: dict[str, dict[str, Any]] = {}
    try:
        with tarfile.open(path, "r:") as tar:
            for member in tar:
                if member.isfile() and member.name.endswith(".json") and member.size <= LARGEST:
                    file = tar.extractfile(member)
                    line = json.loads(file.read()) if file else None
                    if isinstance(line, dict):
                        found[member.name.removesuffix(".json")] = line
    except FileNotFoundError:
        return {}
    except (OSError, tarfile.TarError, ValueError, RecursionError) as error:
        hint = "remove it, or name another file"
        raise FileError(f"{path}: is no tar of samples ({error}): {hint}") from error
    return found


def _member(name: str, size: int) -> tarfile.TarInfo:
    """Return the header of a file, the same for every time, user and machine."""
    member = tarfile.TarInfo(name)
    member.size, member.mode = size, 0o644
    return member
