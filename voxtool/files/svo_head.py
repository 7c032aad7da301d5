"""What an octree file says besides its arrays: the same for HDF5 and XML, checked in one place."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any, NoReturn

from voxtool.errors import FileError
from voxtool.grid import Grid
from voxtool.svo.octree import Octree
from voxtool.version import __version__

if TYPE_CHECKING:
    import numpy as np

FORMAT = "voxtool-svo"
FORMAT_VERSION = "1.0"
MODES = ("surface26", "surface6", "solid", "solid+surface26")

# What each attribute is: a kind, and how many numbers or at most how many bytes of text.
INT, FLOAT, TEXT = int, float, str
LAYOUT: dict[str, tuple[type, int]] = {
    "format_version": (TEXT, 16),
    "creator": (TEXT, 128),
    "dim": (INT, 1),
    "depth": (INT, 1),
    "shape": (INT, 3),
    "mode": (TEXT, 32),
    "fill": (TEXT, 32),
    "origin": (FLOAT, 3),
    "pitch": (FLOAT, 3),
    "units": (TEXT, 64),
    "source_sha256": (TEXT, 64),
    "plan": (TEXT, 60_000),  # HDF5 ends attributes at 64 KiB
}


def head_of(octree: Octree) -> dict[str, Any]:
    """The attributes of an octree, in the order of LAYOUT: int, float or str, or tuples of 3.

    Raises
    ------
    FileError : the plan or a text does not fit in a file.
    """
    head = {
        "format_version": FORMAT_VERSION,
        "creator": f"voxtool {__version__}",
        "dim": octree.grid.dim,
        "depth": octree.depth,
        "shape": octree.grid.shape,
        "mode": octree.mode,
        "fill": octree.fill,
        "origin": octree.grid.origin,
        "pitch": octree.grid.pitch,
        "units": octree.units,
        "source_sha256": octree.source_sha256,
        "plan": json.dumps(octree.plan, separators=(",", ":"), allow_nan=False),
    }
    for name, (kind, limit) in LAYOUT.items():
        if kind is TEXT:
            _check_text(name, head[name], limit)
    return head


def check_version(version: str) -> None:
    """Take this major version, also with a newer minor one.

    Raises
    ------
    FileError : another major version, or none.
    """
    found = re.fullmatch(r"([0-9]{1,4})\.([0-9]{1,4})", version)
    if found is None:
        raise FileError(f"format_version {version[:16]!r} is no version such as {FORMAT_VERSION}")
    major = int(FORMAT_VERSION.split(".")[0])
    if int(found[1]) > major:
        raise FileError(
            f"written in format {version}, newer than the {FORMAT_VERSION} that voxtool "
            f"{__version__} reads: update voxtool"
        )
    if int(found[1]) < major:
        raise FileError(
            f"written in format {version}, older than the {FORMAT_VERSION} that voxtool "
            f"{__version__} reads: write it anew"
        )


def is_newer(version: str) -> bool:
    """Whether a checked version has a minor number beyond ours: it may say more than we know."""
    return int(version.split(".")[1]) > int(FORMAT_VERSION.split(".")[1])


def check_head(head: dict[str, Any]) -> Grid:
    """Check every attribute and their agreement; the grid they place.

    Parameters
    ----------
    head : all of LAYOUT, already of the right types and counts.

    Raises
    ------
    FileError : names the attribute. GridError : shape, origin or pitch out of range.
    """
    check_version(head["format_version"])
    for name, (kind, limit) in LAYOUT.items():
        if kind is TEXT:
            _check_text(name, head[name], limit)
    grid = Grid(head["shape"], head["origin"], head["pitch"])
    _expect("dim", head["dim"], (grid.dim,))
    _expect("depth", head["depth"], ((grid.side // 4).bit_length(),))
    _expect("mode", head["mode"], MODES)
    if not re.fullmatch(r"[a-z][a-z0-9+-]*", head["fill"]):  # a name: it changes nothing here
        raise FileError(f"attribute fill is {head['fill']!r}, which names no rule")
    if not re.fullmatch(r"([0-9a-f]{64})?", head["source_sha256"]):
        raise FileError("attribute source_sha256 is not 64 hexadecimal digits")
    return grid


def build(
    grid: Grid, head: dict[str, Any], offsets: np.ndarray, nodes: np.ndarray, bricks: np.ndarray
) -> Octree:
    """The octree of a checked head and its arrays, fully validated.

    Raises
    ------
    FileError : the plan is not JSON, or an invariant of the octree fails.
    """
    octree = Octree(
        grid,
        head["mode"],
        head["fill"],
        offsets,
        nodes,
        bricks,
        plan=parse_plan(head["plan"]),
        source_sha256=head["source_sha256"],
        units=head["units"],
    )
    octree.validate()
    return octree


def parse_plan(text: str) -> dict[str, Any]:
    """A JSON object as a dict; only what JSON allows, finite numbers and real characters.

    Raises
    ------
    FileError : anything else.
    """

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no JSON number")

    try:
        plan = json.loads(text, parse_constant=refuse)
        json.dumps(plan, ensure_ascii=False, allow_nan=False).encode()
    except (ValueError, RecursionError) as error:
        raise FileError(f"attribute plan is not JSON: {str(error)[:80]}") from None
    if not isinstance(plan, dict):
        raise FileError("attribute plan is not a JSON object")
    return plan


def _check_text(name: str, text: str, limit: int) -> None:
    try:
        size = len(text.encode())
    except UnicodeEncodeError:
        raise FileError(f"attribute {name} is not Unicode text") from None
    if size > limit:
        raise FileError(f"attribute {name} has {size} bytes: at most {limit} fit")
    if name != "plan" and not text.isprintable():
        raise FileError(f"attribute {name} has characters that cannot be printed")


def _expect(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    if value not in allowed:
        wanted = " or ".join(map(str, allowed))
        raise FileError(f"attribute {name} is {str(value)[:40]!r} where {wanted} is expected")
