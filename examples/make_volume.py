"""Make an example volume: an arch in which two strands of plasma coil about each other.

    python examples/make_volume.py [-o volume.vtu] [--cells N]

One leg is of hexahedra, the crown of tetrahedra, the other leg of wedges: 49,920 cells, which
become twice as many tetrahedra when all are split. `density` and `momentum` are at points, `leg` is
at cells. The arch stands on y = 0, its middle line is a half circle of radius 1. Needs meshio, of
the extra `tets`.

Only + - * / decide what is in the arrays, so they are the same on every machine.
"""

import argparse
from pathlib import Path

import numpy as np

WIDE = 0.4  # half of the arch's width and depth
APART = 0.18  # of a strand from the middle line
THICK = 0.13  # of a strand, where its density has fallen to a quarter
LENGTH = 4  # of the arch, in widths

# Corners of a lattice cell, as bits x + 2 y + 4 z, in VTK's order. Every quadrilateral is cut from
# its least corner to its greatest, as `voxtool tet-build` cuts those of hexahedra and wedges.
HEXAHEDRA = [(0, 1, 3, 2, 4, 5, 7, 6)]
WEDGES = [(0, 1, 3, 4, 5, 7), (0, 3, 2, 4, 7, 6)]
TETRAHEDRA = [(0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7)]
LEGS = [("hexahedron", HEXAHEDRA), ("tetra", TETRAHEDRA), ("wedge", WEDGES)]


def quarter_turn(t):
    """Cosine and sine of about t right angles, for t in [-1, 1]; at the ends just so."""
    tangent = t * (0.785 + 0.215 * t * t)  # of half the angle
    square = tangent * tangent
    return (1 - square) / (1 + square), 2 * tangent / (1 + square)


def double(turn):
    """Twice the angle."""
    c, s = turn
    return c * c - s * s, 2 * c * s


def density(across, deep, turn):
    """Return the density of two strands, thinner and brighter towards the crown."""
    c, s = double(double(turn))
    thick = THICK * (1.25 - 0.25 * turn[0])
    total = 0.0
    for side in (APART, -APART):
        x, y = (across - side * c) / thick, (deep - side * s) / thick
        near = 1 / (1 + x * x + y * y)
        total = total + near * near
    return total * (0.6 + 0.4 * turn[0])


def make_volume(cells=50_000):
    """Points (N, 3), cells by kind, arrays at points, and arrays at the cells of each kind."""
    side = 4
    while 3 * LENGTH * (side + 1) ** 3 <= cells:
        side += 1
    shape = side, side, LENGTH * side
    i, j, k = np.indices([n + 1 for n in shape])
    across, deep = WIDE * (2 * i / side - 1), WIDE * (2 * j / side - 1)
    up, along = turn = quarter_turn(2 * k / shape[2] - 1)
    points = [(1 + across) * along, (1 + across) * up, deep]
    dense = density(across, deep, turn)
    # along the arch, and around its middle line
    swirl = 6 * deep
    momentum = [dense * (up - swirl * along), dense * (-along - swirl * up), dense * 6 * across]

    number = np.arange(dense.size).reshape(dense.shape)
    corner = [number[b & 1, b >> 1 & 1, b >> 2] for b in range(8)]
    ends = [round(shape[2] * leg / len(LEGS)) for leg in range(len(LEGS) + 1)]
    blocks = []
    for (kind, pieces), first, last in zip(LEGS, ends, ends[1:], strict=False):
        low = number[:-1, :-1, first:last].reshape(-1, 1, 1)
        offsets = np.array([[corner[b] for b in piece] for piece in pieces])
        blocks.append((kind, (low + offsets).reshape(-1, offsets.shape[1])))
    at_points = {
        "density": dense.ravel(),
        "momentum": np.stack([m.ravel() for m in momentum], axis=1),
    }
    at_cells = {"leg": [np.full(len(block), n) for n, (_, block) in enumerate(blocks)]}
    return np.stack([p.ravel() for p in points], axis=1), blocks, at_points, at_cells


def main():
    parser = argparse.ArgumentParser(description="Make an example volume: an arch of plasma.")
    parser.add_argument("-o", "--output", type=Path, default=Path("volume.vtu"))
    parser.add_argument("--cells", type=int, default=50_000, help="at most this many (50000)")
    arguments = parser.parse_args()
    if not 1_000 <= arguments.cells <= 2_000_000:
        parser.error(f"--cells {arguments.cells}: choose from 1000 to 2000000")
    import meshio

    points, blocks, at_points, at_cells = make_volume(arguments.cells)
    mesh = meshio.Mesh(points, blocks, at_points, at_cells)  # pyright: ignore[reportArgumentType]
    meshio.write(arguments.output, mesh, file_format="vtu")
    counts = ", ".join(f"{len(block):,} {kind}" for kind, block in blocks)
    print(f"{arguments.output}: {len(points):,} points, {counts}")


if __name__ == "__main__":
    main()
