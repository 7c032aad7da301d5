"""Meshes in other units, and the part of a mesh beyond a grid, against rational numbers."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
from helpers import meshes

import voxtool
from voxtool.choices import LENGTH_UNITS
from voxtool.grid import Grid
from voxtool.mesh.lengths import in_units, share_beyond
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.units import difference, factor

SHAPE = (8, 9, 10)
GRID = Grid(SHAPE, (0, 0, 0), (1, 1, 1))


def share_within(corners: list[list[Fraction]]) -> Fraction:
    """The share of a triangle in the box of GRID, exactly: the polygon of the points (u, v) of the
    plane, a + u (b - a) + v (c - a), that satisfy nine inequalities; its corners are those points
    where two of them are equalities and all others hold."""
    a, b, c = corners
    planes = [(Fraction(1), Fraction(0), Fraction(0)), (Fraction(0), Fraction(1), Fraction(0))]
    planes.append((Fraction(-1), Fraction(-1), Fraction(1)))  # p u + q v + r >= 0
    for axis, end in enumerate(SHAPE):
        p, q, r = b[axis] - a[axis], c[axis] - a[axis], a[axis]
        planes += [(p, q, r), (-p, -q, end - r)]
    points = set()
    for (p, q, r), (s, t, w) in combinations(planes, 2):
        if (full := p * t - q * s) != 0:
            u, v = (q * w - r * t) / full, (r * s - p * w) / full
            if all(x * u + y * v + z >= 0 for x, y, z in planes):
                points.add((u, v))
    if len(points) < 3:
        return Fraction(0)
    mu, mv = (sum(x) / len(points) for x in zip(*points, strict=True))
    around = sorted(points, key=lambda x: float(np.arctan2(float(x[1] - mv), float(x[0] - mu))))
    turned = around[1:] + around[:1]
    return abs(sum(u * y - v * x for (u, v), (x, y) in zip(around, turned, strict=True)))


@pytest.mark.parametrize("seed", range(6))
def test_the_share_beyond_is_that_of_rational_numbers(seed: int) -> None:
    random = np.random.default_rng(seed)
    pitch = random.choice([0.25, 1.0, 4.0], 3)
    grid = Grid(SHAPE, (1.0, -2.0, 0.5), pitch)
    # of few places, so that corners and edges lie on the planes of the box, and beyond it
    corners = random.integers(-3, 14, (40, 3, 3)) / random.choice([1, 2])
    mesh = Mesh(
        (corners * pitch + grid.origin).reshape(-1, 3),
        np.arange(120, dtype=np.int32).reshape(-1, 3),
    )
    a, b, c = np.moveaxis(corners * pitch, 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    shares = [share_within([[Fraction(x) for x in p] for p in t.tolist()]) for t in corners]
    expected = 1 - np.dot(areas, np.array(shares, float)) / areas.sum()
    assert 0.1 < expected < 0.95
    assert abs(share_beyond(mesh, grid) - expected) < 1e-14


def box(low, high) -> Mesh:
    return mesh_from_arrays(*meshes.box(low, high))


@pytest.mark.parametrize(
    ("mesh", "share"),
    [
        (box((0, 0, 0), SHAPE), 0.0),  # its faces are those of the grid
        (box((0, 0, 0), (8.001, 9, 10)), 0.0),  # by less than 1/512 voxel
        (box((1, 1, 1), (16, 9, 10)), None),
        (box((8, 0, 0), (16, 9, 10)), None),  # touches it
        (box((20, 20, 20), (30, 30, 30)), 1.0),
        (box((-1e300, 0, 0), (-1e299, 1e299, 1e299)), 1.0),
        (box((-10, -10, -10), (20, 20, 20)), 1.0),  # around it
        (
            mesh_from_arrays(
                [(0, 0, 0), (4, 4, 4), (30, 0, 0), (40, 0, 0)], [(0, 1, 1), (2, 3, 3)]
            ),
            0.5,
        ),
    ],
)
def test_some_shares_beyond(mesh: Mesh, share: float | None) -> None:
    if share is None:
        (x, y, z), (u, v, w) = mesh.bounds
        sides = [(u - x, v - y, w - z), (8 - x, v - y, w - z)]
        whole, within = (a * b + b * c + c * a for a, b, c in sides)
        share = 1 - (2 * within - sides[1][1] * sides[1][2]) / (2 * whole)
    assert share_beyond(mesh, GRID) == pytest.approx(share, abs=1e-15)
    assert voxtool.share_beyond(mesh, GRID) == share_beyond(mesh, GRID)


def test_units() -> None:
    """Each in each other, there and back; and the names of other programs."""
    metres = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "ft": 0.3048}
    assert set(metres) == set(LENGTH_UNITS)
    for one in metres:
        for other in metres:
            assert float(factor(one, other)) == pytest.approx(
                metres[one] / metres[other], rel=1e-15
            )
            assert factor(one, other) * factor(other, one) == 1
            assert factor(one, "") == factor("", other) == 1
    assert factor("inches", "mm") == Fraction(254, 10)
    assert factor("nm", "um") == Fraction(1, 1000)
    assert factor("pixel", "mm") == factor("mm", "pixel") == 1  # nothing is known
    assert difference("mm", "millimeters", "") == difference("mm", "", "") == ""
    assert difference("cm", "inch", "scale") == "in cm and in inch: 1 inch is 2.54 cm: scale"
    assert difference("mm", "pixel", "scale") == "in mm and in pixel: scale"


def test_a_mesh_in_another_unit() -> None:
    mesh = Mesh(*(getattr(box((0, 0, 0), (1, 2, 3)), n) for n in ("vertices", "faces")), units="m")
    scaled = in_units(mesh, "mm")
    assert (scaled.units, scaled.bounds[1].tolist()) == ("mm", [1000.0, 2000.0, 3000.0])
    assert in_units(scaled, "m") == mesh
    assert in_units(mesh, "m") is in_units(mesh, "") is mesh
    plain = box((0, 0, 0), (1, 2, 3))
    assert in_units(plain, "mm") is plain
    assert in_units(mesh, "pixel") is mesh
