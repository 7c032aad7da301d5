"""Tables for the kernels: the points at which a cell is sampled, and interpolation weights there.

Kernels read points in vectors of eight, so rows are padded with their last number.
"""

from __future__ import annotations

import math

import numpy as np

from voxtool.opencl import program

POINTS = 32  # in a row: 27, and the last one again
MIDDLE = 13  # of the vertices of a block
BLOCK = np.indices((3, 3, 3)).reshape(3, 27)[::-1]  # x, y, z of its vertices
OCTANTS = np.indices((2, 2, 2)).reshape(3, 8)[::-1]
# of a cell, in quarters: the middles of itself, its faces and its edges, and of its octants
_CENTRAL = (BLOCK == 1).sum(axis=0)  # 3 for the cell's, 2 for a face's, 1 for an edge's
SAMPLES = np.concatenate(
    [*(2 * BLOCK[:, central == _CENTRAL] for central in (3, 2, 1)), 2 * OCTANTS + 1], axis=1
)
# No point of a cell is further from a corner or sample than this, in edges: together they are a
# body-centred cubic lattice of half an edge.
SAMPLE_GAP = math.sqrt(5) / 8 * (1 + 2.0**-50)
HALF_DIAGONAL = math.sqrt(3) / 2 * (1 + 2.0**-50)


def _table(name: str, rows: np.ndarray, kind: str = "double", width: int = POINTS) -> str:
    """A constant table."""
    rows = np.pad(rows, ((0, 0), (0, width - rows.shape[1])), mode="edge")
    values = ", ".join(f"{value:g}" for value in rows.ravel().tolist())
    return f"__constant {kind} {name}[] = {{{values}}};"


def _weights() -> np.ndarray:
    """Return the weight of each corner at each sample in trilinear interpolation, (8, 27)."""
    near = np.where(OCTANTS.T[:, :, None] == 1, SAMPLES / 4, 1 - SAMPLES / 4)
    return near.prod(axis=1)


def _corners() -> np.ndarray:
    """Return the vertices of the block at the corners of each child, (8, 8)."""
    places = OCTANTS.T[:, None] + OCTANTS.T[None]
    return places[..., 0] + 3 * places[..., 1] + 9 * places[..., 2]


HEADERS = {
    "adf/levels/sample_points.h": "\n".join(
        [
            program.c_constants(POINTS=POINTS, MIDDLE=MIDDLE),
            f"#define HALF_DIAGONAL {HALF_DIAGONAL.hex()}",
            f"#define SAMPLE_GAP {SAMPLE_GAP.hex()}",
            _table("VERTICES", BLOCK),
            _table("MIDDLES", 2 * OCTANTS + 1),
            _table("CELL", OCTANTS),
            _table("SAMPLES", SAMPLES),
            _table("SIGNS", 2 * OCTANTS - 1, width=8),
            _table("WEIGHTS", _weights()),
            _table("CORNERS", _corners(), "uint", width=8),
        ]
    )
}
