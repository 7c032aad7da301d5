"""Fields of thin scenes at random, against exact signed distances: wedges, plates, rods, shells,
needles and sheets that nearly coincide, turned, scaled and moved."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.construction.build import build_adf
from voxtool.adf.queries.query import query_adf
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.vector import cross

if TYPE_CHECKING:
    from voxtool.adf.field.field import DistanceField
    from voxtool.opencl import Device

KINDS = ("wedge", "plate", "rod", "shell", "needle", "sheets")
PAIRS = 1 << 16  # of a point and a triangle that are tested at once, in memory that fits caches
DECADES = 3.0  # of size, either way
EXACT = 1e-12  # sides: more than the rounding of coordinates and of these distances
ROUNDS = 4  # of points near the worst ones


@dataclass(frozen=True)
class Thin:
    """A closed mesh of convex pieces, each of which lies apart from the others or within one.

    pieces : the outward triangles of each, (n, 3, 3).
    """

    kind: str
    mesh: Mesh
    pieces: list[np.ndarray]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances, (N,), of (N, 3) points, in numpy: least distances to all
        triangles, negative within an odd number of pieces."""
        triangles, found = np.concatenate(self.pieces), np.empty(len(points))
        step = max(PAIRS // len(triangles), 1)
        for first in range(0, len(points), step):
            some = points[first : first + step]
            inside = np.zeros(len(some), bool)
            for piece in self.pieces:
                inside ^= _within(some, piece)
            squares = _squares(some, triangles)
            found[first : first + step] = np.where(inside, -1, 1) * np.sqrt(squares)
        return found

    def points(self, random: np.random.Generator, count: int) -> np.ndarray:
        """Return (count, 3) points at 1e-6 to 0.1 extents from triangles."""
        extent, triangles = (
            float(np.ptp(self.mesh.bounds, axis=0).max()),
            np.concatenate(self.pieces),
        )
        weights = random.dirichlet([0.5] * 3, count)[..., None]
        on = (weights * triangles[random.integers(0, len(triangles), count)]).sum(axis=1)
        off = random.normal(size=(count, 3)) * 10.0 ** -random.uniform(1, 6, (count, 1))
        return on + extent * off


def _within(points: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """Return whether each point is within a convex piece, (N,)."""
    normals = cross(piece[:, 1] - piece[:, 0], piece[:, 2] - piece[:, 0])
    heights = points @ normals.T - (normals * piece[:, 0]).sum(axis=1)
    return (heights < 0).all(axis=1)


def _squares(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the squared distances, (N,), of points to the nearest of (F, 3, 3) triangles: to the
    plane where the foot is over the triangle, and to the edges."""
    best = np.full(len(points), np.inf)
    for a, b, c in triangles:
        n = np.cross(b - a, c - a)
        least, over = np.full(len(points), np.inf), np.ones(len(points), bool)
        for p, q in ((a, b), (b, c), (c, a)):
            way, along = points - p, q - p
            t = np.clip(way @ along / (along @ along), 0, 1)
            off = way - t[:, None] * along
            least = np.minimum(least, (off * off).sum(axis=1))
            over &= way @ np.cross(n, along) >= 0
        height = (points - a) @ n
        best = np.minimum(best, np.where(over, height * height / (n @ n), least))
    return best


def prism(outline: np.ndarray, height: float) -> shapes.Shape:
    """Return the outward triangles between a convex (n, 2) outline, counter-clockwise, at z = 0 and
    another at z = height."""
    n = len(outline)
    ends = [np.column_stack([outline, np.full(n, z)]) for z in (0.0, height)]
    first = np.arange(n)
    after = (first + 1) % n
    lids = [(0, i + 1, i) for i in range(1, n - 1)] + [
        (n, n + i, n + i + 1) for i in range(1, n - 1)
    ]
    walls = np.concatenate(
        [np.stack([first, after, after + n], 1), np.stack([first, after + n, first + n], 1)]
    )
    return np.concatenate(ends), np.concatenate([lids, walls])


def turn(random: np.random.Generator) -> np.ndarray:
    """Return a rotation at random, (3, 3)."""
    q = random.normal(size=4)
    w, x, y, z = q / np.sqrt((q * q).sum())
    return np.array(
        [
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ]
    )


def _shape(kind: str, random: np.random.Generator) -> list[shapes.Shape]:
    """Return the outward pieces of a scene about one unit long."""

    def thin(low: float, high: float) -> float:
        return 10.0 ** -random.uniform(low, high)

    if kind == "wedge":
        slope = math.tan(math.radians(0.1 * 200.0 ** random.uniform()))
        return [prism(np.array([(0, 0), (1, 0), (1, slope)]), random.uniform(0.2, 1))]
    if kind == "plate":
        return [shapes.box(np.zeros(3), np.array([1, random.uniform(0.3, 1), thin(1.5, 5)]))]
    if kind == "rod":
        angles = np.arange(n := random.integers(3, 9)) * (2 * np.pi / n)
        radius = thin(1.5, 4)
        return [prism(radius * np.stack([np.cos(angles), np.sin(angles)], 1), 1.0)]
    if kind == "shell":
        vertices, faces = shapes.ball(1)
        wall = thin(1.5, 5)
        return [(vertices / 2, faces), ((1 - wall) * vertices / 2, faces)]
    if kind == "needle":
        corners = np.array([(0, 0, 0), (1, 0, 0), (0.5, thin(1, 4), 0), (0.3, 0, thin(1, 4))])
        return [(corners, shapes.TETRAHEDRON_FACES)]
    gap, size = thin(2, 6), np.array([1.0, random.uniform(0.3, 1), thin(1, 3)])
    vertices, faces = shapes.box(np.zeros(3), size)
    other = vertices * np.array([1, 1, -1]) - np.array([0, 0, gap])
    other[:, 2] -= thin(2, 6) * vertices[:, 0]  # tilted away
    return [(vertices, faces), (other, faces[:, ::-1])]


def scene(random: np.random.Generator, kind: str = "") -> Thin:
    """Return a thin scene of a kind, at random."""
    kind = kind or KINDS[random.integers(len(KINDS))]
    size, turned = 10.0 ** random.uniform(-DECADES, DECADES), turn(random)
    offset, pieces, outward = size * random.normal(size=3), [], []
    for number, (vertices, faces) in enumerate(_shape(kind, random)):
        placed = size * vertices @ turned.T + offset
        outward.append(placed[faces])
        cavity = kind == "shell" and number == 1
        pieces.append((placed, faces[:, ::-1] if cavity else faces))
    return Thin(kind, mesh_from_arrays(*shapes.join(*pieces)), outward)


def build(random: np.random.Generator, thin: Thin, device: Device, **request: Any) -> DistanceField:
    """Return a field of a scene, whose tolerance is of the size of its smallest leaves."""
    level = int(random.integers(5, 9))
    tolerance = 2.0**-level * 10 ** random.uniform(-0.3, 0.7)
    wanted = {"tolerance": tolerance, "max_level": level, "measure": False, **request}
    return build_adf(thin.mesh, device, **wanted)


def over_bound(
    random: np.random.Generator, field: DistanceField, thin: Thin, count: int, device: Device
) -> tuple[int, float]:
    """Return the number of points where a field is farther from the distance than the bound of its
    leaf, and the largest error, in bounds: at `count` points in the cube and near triangles, then
    near the worst of these. Leaves without a bound have none to exceed."""
    spread = np.array(field.origin) + field.side * random.random((count // 4, 3))
    points = np.concatenate([spread, thin.points(random, count - len(spread))])
    over, worst = 0, 0.0
    for _ in range(1 + ROUNDS):
        found = query_adf(field, points, bounds=True, cell=True, device=device)
        assert found.bound is not None
        assert found.level is not None
        error = np.abs(found.distance - thin.distance(points)) - EXACT * field.side
        ratio = np.where(found.outside, 0, error / found.bound)
        over, worst = over + int(np.count_nonzero(ratio > 1)), max(worst, float(ratio.max()))
        near = random.choice(np.argsort(-ratio)[: 1 + count // 32], 1 + count // ROUNDS)
        reach = field.side * np.ldexp(1.0, -found.level[near].astype(int))[:, None]
        step = 10.0 ** -random.uniform(0, 2, (len(near), 1))
        points = points[near] + reach * step * random.normal(size=(len(near), 3))
    return over, worst


@case("bounds of fields of thin scenes", "wedges, rods, shells, needles: numpy", "of the bound", 1)
def bounds(device: Device, full: bool) -> float:
    worst = 0.0
    for kind in KINDS:
        for seed in range(20 if full else 2):
            random = np.random.default_rng(seed)
            thin = scene(random, kind)
            field = build(random, thin, device)
            worst = max(worst, over_bound(random, field, thin, 20_000 if full else 2000, device)[1])
    return worst
