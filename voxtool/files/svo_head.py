"""What an octree file says besides its arrays: the same for HDF5 and XML, checked in one place."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from voxtool.choices import MODES
from voxtool.errors import FileError
from voxtool.files.head import (
    FLOAT,
    INT,
    JSON_LIMIT,
    TEXT,
    VERSION_LIMIT,
    Layout,
    check_source,
    check_texts,
    check_version,
    expect,
    json_text,
    parse_json,
)
from voxtool.grid import Grid
from voxtool.svo.octree import Octree
from voxtool.version import __version__

if TYPE_CHECKING:
    import numpy as np

FORMAT = "voxtool-svo"
FORMAT_VERSION = "1.0"
OCTREE_MODES = (*MODES, "solid+surface26")

LAYOUT: Layout = {
    "format_version": (TEXT, VERSION_LIMIT),
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
    "plan": (TEXT, JSON_LIMIT),
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
        "plan": json_text("plan", octree.plan),
    }
    check_texts(head, LAYOUT)
    return head


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
    check_version(head["format_version"], FORMAT_VERSION)
    check_texts(head, LAYOUT)
    grid = Grid(head["shape"], head["origin"], head["pitch"])
    expect("dim", head["dim"], (grid.dim,))
    expect("depth", head["depth"], ((grid.side // 4).bit_length(),))
    expect("mode", head["mode"], OCTREE_MODES)
    if not re.fullmatch(r"[a-z][a-z0-9+-]*", head["fill"]):  # a name: it changes nothing here
        raise FileError(f"attribute fill is {head['fill']!r}, which names no rule")
    check_source(head["source_sha256"])
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
        plan=parse_json("plan", head["plan"]),
        source_sha256=head["source_sha256"],
        units=head["units"],
    )
    octree.validate()
    return octree
