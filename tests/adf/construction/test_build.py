"""Distance fields that are built, against other algorithms, formulas and recounts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import model
from helpers import meshes
from helpers.distance import brute
from helpers.field import HALVES, OCTANTS, cells_of
from helpers.signs import winding
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.adf.construction.build import build_adf, plan_adf
from voxtool.adf.construction.plan import BLOCK_BYTES
from voxtool.adf.construction.stages import BESIDE, CROSSED, SAMPLES
from voxtool.adf.field.cells import JUMP, bound_values
from voxtool.files.meshes.mesh import load_mesh
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.morton import morton_encode
from voxtool.spatial import sides
from voxtool.spatial.sampling import sample_cube
from voxtool.spatial.signed_distance import SignedDistance
from voxtool.spatial.winding_number import WindingNumber

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.adf.field.field import DistanceField
    from voxtool.opencl import Device

EXACT = 2e-15  # error of what is compared with, in sides
SHAPE = (8, 8, 8)
CLEAR = 0.02  # of a winding number from 1/2: beyond it, its sign is certain
HALF_DIAGONAL = math.sqrt(3) / 2


build = partial(build_adf, measure=False)  # it takes longer than what is built here


def mesh_of(vertices, faces=None) -> Mesh:
    vertices = np.ascontiguousarray(vertices, np.float64).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3) if faces is None else faces
    return Mesh(vertices, np.ascontiguousarray(faces, np.int32))


def weights_at(points: np.ndarray) -> np.ndarray:
    """Return the weights of a cell's corners, (..., 8), at (..., 3) points in [0, 1]."""
    near = np.where(OCTANTS == 1, points[..., None, :], 1 - points[..., None, :])
    return near.prod(axis=-1)


@dataclass
class Tree:
    """The children of a field's blocks, leaves or not, each with its own corners."""

    field: DistanceField

    @cached_property
    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        return cells_of(self.field)

    @cached_property
    def levels(self) -> np.ndarray:
        return np.repeat(self.blocks[0] + 1, 8)

    @cached_property
    def cells(self) -> np.ndarray:
        return (2 * self.blocks[1].astype(np.int64)[:, None] + OCTANTS).reshape(-1, 3)

    @cached_property
    def refined(self) -> np.ndarray:
        own = self.field.blocks.astype(np.uint64)
        return np.isin(own[:, None] << np.uint64(3) | morton_encode(OCTANTS), own).ravel()

    @cached_property
    def corners(self) -> np.ndarray:
        """Return the distances at the corners of each child, (n, 8) float64."""
        v = self.field.voxels
        parts = [v[:, z : z + 2, y : y + 2, x : x + 2].reshape(-1, 8) for x, y, z in OCTANTS]
        return np.stack(parts, axis=1).reshape(-1, 8).astype(np.float64)

    @property
    def codes(self) -> np.ndarray:
        assert self.field.bounds is not None
        return self.field.bounds.ravel()

    def world(self, which: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return points in n children, (n, k, 3) world units, from points of the unit cube."""
        at = (self.cells[which][:, None] + points) * np.exp2(-self.levels[which])[:, None, None]
        return np.array(self.field.origin) + self.field.side * at

    def vertices(self) -> np.ndarray:
        """Return the vertices of all blocks, (27 n, 3), in units of the deepest lattice."""
        levels, ijk = self.blocks
        shift = (self.field.depth - 1 - levels)[:, None, None]
        return ((2 * ijk.astype(np.int64)[:, None] + HALVES) << shift).reshape(-1, 3)

    def vertices_in_world(self) -> np.ndarray:
        unit = 0.5**self.field.depth
        return np.array(self.field.origin) + self.field.side * (self.vertices() * unit)

    def hanging(self) -> np.ndarray:
        """Return which vertices lie on a leaf of the block's own level or coarser, (27 n,)."""
        levels, ijk = self.blocks
        leading = np.uint64(1) << (3 * levels).astype(np.uint64)
        size = (1 << levels.astype(np.int64))[:, None]
        hangs = np.zeros((len(levels), 27), bool)
        for vertex, half in enumerate(HALVES):
            if (half == 1).sum() in (0, 3):
                continue
            for beside in OCTANTS[1:] * (half - 1):
                at = ijk.astype(np.int64) + beside
                inside = ((at >= 0) & (at < size)).all(axis=1)
                codes = morton_encode(at.clip(0)) | leading
                hangs[:, vertex] |= inside & ~np.isin(codes, self.field.blocks.astype(np.uint64))
        places = np.unique(self.vertices(), axis=0, return_inverse=True)[1].ravel()
        return np.bincount(places, hangs.ravel())[places] > 0


def check_voxels(
    field: DistanceField, exact: Callable[[np.ndarray], np.ndarray], error: float = EXACT
) -> Tree:
    """Check that vertices that do not hang have the distance `exact`, rounded to float32."""
    tree = Tree(field)
    field.validate()
    distance = exact(tree.vertices_in_world()) / field.side
    apart = np.abs(field.voxels.ravel().astype(np.float64) - distance)
    wrong = apart > np.spacing(np.abs(distance).astype(np.float32)) + error
    if field.continuous:
        wrong &= ~tree.hanging()
    assert not wrong.any(), (tree.vertices_in_world()[wrong][:3], apart[wrong].max())
    return tree


def check_bounds(
    field: DistanceField,
    exact: Callable[[np.ndarray], np.ndarray],
    unclear: Callable[[np.ndarray], np.ndarray],
    count: int = 24,
    most: int = 4000,
) -> int:
    """Check that no leaf is further from the distance than its bound, at random points and on a
    lattice of sixths, and then near the worst points; return the number of leaves."""
    tree, rng = Tree(field), np.random.default_rng(0)
    leaves = np.flatnonzero(~tree.refined & (tree.codes != JUMP))
    if len(leaves) > most:
        leaves = np.sort(rng.choice(leaves, most, replace=False))
    points = rng.uniform(size=(len(leaves), count, 3))
    points[:, : count // 2] = np.rint(points[:, : count // 2] * 6) / 6
    for _ in range(2):
        stored = (weights_at(points) * tree.corners[leaves][:, None]).sum(axis=-1)
        world = tree.world(leaves, points).reshape(-1, 3)
        error = np.abs(stored - exact(world).reshape(stored.shape) / field.side)
        error[unclear(world).reshape(error.shape)] = 0
        excess = error.max(axis=1) - bound_values()[tree.codes[leaves]]
        at = int(excess.argmax())
        assert excess[at] <= EXACT, (
            f"{np.count_nonzero(excess > EXACT)} of {len(leaves)} leaves; worst: error "
            f"{error[at].max():.3g}, bound {bound_values()[tree.codes[leaves[at]]]:.3g}, level "
            f"{tree.levels[leaves[at]]}, cell {tree.cells[leaves[at]]}"
        )
        worst = points[np.arange(len(leaves)), error.argmax(axis=1)]
        points = (worst[:, None] + 0.1 * rng.normal(size=points.shape)).clip(0, 1)
    return len(leaves)


# ---- shapes


def fan(n: int, height: float, waves: float = 0.0) -> Mesh:
    """Return two cones over a circle, whose edge waves up and down."""
    t = 2 * np.pi * np.arange(n) / n
    rim = np.stack([np.cos(t), np.sin(t), waves * np.cos(t * (n // 2))], axis=1)
    i, j = np.arange(n), (np.arange(n) + 1) % n
    faces = [np.stack([i, j, 0 * i + n], 1), np.stack([j, i, 0 * i + n + 1], 1)]
    return mesh_of([*rim, (0.03, 0.02, height), (0, 0, -1.5)], np.concatenate(faces))


def to_sphere(points: np.ndarray) -> np.ndarray:
    return np.sqrt((points**2).sum(axis=1)) - 1


def to_box(points: np.ndarray) -> np.ndarray:
    beyond = np.maximum(-points, points - (3, 4, 5))
    return np.sqrt((np.maximum(beyond, 0) ** 2).sum(axis=1)) + np.minimum(beyond.max(axis=1), 0)


def dented_octahedron(seed: int) -> Mesh:
    vertices, faces = meshes.octahedron(0, 1)
    return mesh_of(vertices + 0.25 * np.random.default_rng(seed).normal(size=(6, 3)), faces)


CLOSED = {
    "torus": lambda: mesh_of(*meshes.torus(sides=(9, 5))),
    "flat fan": lambda: fan(9, 0.01),
    "fan": lambda: fan(9, 0.6),
    "hollow fan": lambda: fan(12, -0.6),
    "saddle": lambda: fan(8, 0.1, 0.5),
    "thin box": lambda: mesh_of(*meshes.box((0, 0, 0), (1, 1, 1e-3))),
    "two boxes": lambda: mesh_of(
        *meshes.join(meshes.box(0, (1, 1, 0.1)), meshes.box((0.1, 0, 0.101), (1.1, 0.9, 0.2)))
    ),
    "needle": lambda: mesh_of(*meshes.tetrahedron((0, 0, 0), (9, 1, 0), (9, 0, 1), (9, -1, -1))),
    "dented": lambda: dented_octahedron(1),
}
OPEN = {
    "triangle": lambda: mesh_of([(0, 0, 0), (2, 0, 0.5), (0, 2, 0.5)]),
    "sheets": lambda: mesh_of(
        [(0, 0, 0), (1, 0, 0.2), (0, 1, 0.1), (0, 0, 0.01), (1, 0, 0.21), (0, 1, 0.11)]
    ),
    "loose": lambda: mesh_of(*meshes.random_triangles(np.random.default_rng(2), 7, (16,) * 3)),
    "tiny and large": lambda: mesh_of(
        *meshes.join(meshes.icosphere(1, (0.3, 0.2, 0.4), 1e-3), (np.eye(3), np.array([(0, 1, 2)])))
    ),
}
continuity = pytest.mark.parametrize("continuous", [True, False], ids=["continuous", "cracks"])


# ---- the stored distances


@given(meshes.fixed_triangles(SHAPE, max_triangles=6), st.booleans(), st.booleans())
@settings(max_examples=15)
def test_any_triangles(device: Device, triangles, twice: bool, continuous: bool) -> None:
    vertices, faces = triangles
    mesh = mesh_of(vertices / 256, np.concatenate([faces, faces[::-1]]) if twice else faces)
    if not np.ptp(mesh.bounds, axis=0).any():
        return  # a point: no cube is about it
    field = build(mesh, device, tolerance=0.02, max_level=3, sign="none", continuous=continuous)
    corners = mesh.vertices[mesh.faces]
    check_voxels(field, lambda points: brute(points, corners))


@continuity
@pytest.mark.parametrize(
    ("mesh", "formula", "error"),
    [
        (lambda: mesh_of(*meshes.icosphere(4)), to_sphere, 0.0015),
        (lambda: mesh_of(*meshes.box(0, (3, 4, 5))), to_box, 0),
    ],
    ids=["sphere", "box"],
)
def test_formulas(device: Device, mesh, formula, error: float, continuous: bool) -> None:
    mesh = mesh()
    field = build(mesh, device, tolerance=4e-3, max_level=4, continuous=continuous)
    assert field.sign == "pseudonormal"
    check_voxels(field, formula, error / field.side + EXACT)


@pytest.mark.parametrize("name", CLOSED)
@pytest.mark.parametrize("sign", ["pseudonormal", "winding"])
def test_closed_meshes_are_the_signed_distance(device: Device, name: str, sign: str) -> None:
    mesh = CLOSED[name]()
    field = build(mesh, device, tolerance=8e-3, max_level=4, sign=sign, continuous=False)
    check_voxels(field, SignedDistance(mesh, sign, device))


def settled(mesh: Mesh, device: Device, sign: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that finds the points where the winding number does not decide the sign."""
    if sign != "winding":
        return lambda points: np.zeros(len(points), bool)
    number = WindingNumber(mesh, device)
    return lambda points: np.abs(number(points) - 0.5) <= CLEAR


SELF_CROSSING = {
    "crossing boxes": lambda: mesh_of(*meshes.join(meshes.box(0, 4), meshes.box((2, 1, 1), 6))),
    "a face pierced": lambda: mesh_of(
        *meshes.join(meshes.box(0, 16), meshes.box((9, 3, 15), (11, 5, 17)))
    ),
    # which runs from a face of the other through its middle and out beyond the slant
    "a spike through": lambda: mesh_of(
        *meshes.join(
            meshes.tetrahedron((0, 0, 0), (8, 0, 0), (0, 8, 0), (0, 0, 8)),
            meshes.tetrahedron((1.9, 2.1, -6), (2.1, 1.9, -6), (2.3, 2.3, -6), (2, 2, 9)),
        )
    ),
}
CROSSING = {
    "box without lid": lambda: mesh_of(*meshes.open_box(0, (4, 3, 2))),
    # four triangles about nothing, whose diagonals differ
    "no thickness": lambda: mesh_of(
        [(0, 0, 0), (1, 0, 0.3), (1, 1, 0.3), (0, 1, 0)],
        [(0, 1, 2), (0, 2, 3), (0, 3, 1), (1, 3, 2)],
    ),
    **SELF_CROSSING,
}
EVERY = {**CLOSED, **OPEN, **CROSSING}


def check_distances(mesh: Mesh, field: DistanceField, device: Device) -> np.ndarray:
    """Check the distances without their signs; return the points, (27 n, 3)."""
    points = Tree(field).vertices_in_world()
    expected = np.abs(SignedDistance(mesh, "none", device)(points)) / field.side
    apart = np.abs(np.abs(field.voxels.ravel().astype(np.float64)) - expected)
    assert (apart <= np.spacing(expected.astype(np.float32)) + EXACT).all()
    return points


def check_signs(mesh: Mesh, field: DistanceField, device: Device) -> None:
    """Check the distances, and the signs where they are certain."""
    points, stored = check_distances(mesh, field, device), field.voxels.ravel()
    expected = SignedDistance(mesh, field.sign, device)(points) / field.side
    unclear = settled(mesh, device, field.sign)(points)
    wrong = ((stored < 0) != (expected < 0)) & ~unclear & (np.abs(expected) > 1e-12)
    assert not wrong.any(), f"{np.count_nonzero(wrong)} of {len(wrong)}: {points[wrong][:2]}"


@pytest.mark.parametrize("name", CROSSING)
def test_signs_of_meshes_that_are_open_or_cross(device: Device, name: str) -> None:
    """Winding numbers are their default: inside is what is in any part."""
    mesh = CROSSING[name]()
    field = build(mesh, device, tolerance=4e-3, max_level=5, continuous=False)
    assert field.sign == "winding"
    assert not field.plan["closed"]
    assert "search for jumps of the sign" not in field.plan["left_out"]
    check_signs(mesh, field, device)
    if name not in SELF_CROSSING:
        return
    assert 0 < field.plan["crossed_triangles"] < len(mesh.faces)
    assert field.reached["jumps"] == 0
    some = np.random.default_rng(1).choice(27 * len(field.voxels), 500, replace=False)
    inside = winding(Tree(field).vertices_in_world()[some], mesh.vertices[mesh.faces]) > 0.5
    stored = field.voxels.ravel()[some]
    assert ((stored < 0) == inside)[np.abs(stored) > 1e-9].all()
    assert 10 < np.count_nonzero(inside) < 490


@pytest.mark.parametrize("name", SELF_CROSSING)
def test_pseudonormals_where_closed_meshes_pass_through_themselves(
    device: Device, name: str
) -> None:
    """Pseudo-normals give no sides there: distances are right, and some signs jump."""
    mesh = SELF_CROSSING[name]()
    field = build(mesh, device, tolerance=4e-3, max_level=5, sign="pseudonormal", continuous=False)
    assert field.reached["jumps"] > 0
    check_distances(mesh, field, device)


@pytest.mark.parametrize(
    ("name", "sign"),
    [
        ("stanford-bunny", "winding"),
        ("rocker-arm", "pseudonormal"),
        ("suzanne", "none"),
    ],
)
def test_real_models(device: Device, name: str, sign: str) -> None:
    mesh = load_mesh(model(f"{name}.obj"))
    field = build(mesh, device, tolerance=4e-3, max_level=4, sign=sign, continuous=False)
    check_signs(mesh, field, device)


@pytest.mark.parametrize("sign", ["winding", "none"])
def test_many_triangles_of_any_size_and_shape(device: Device, sign: str) -> None:
    """Their lists are long, so that they are searched in bundles; many have no area."""
    triangles = meshes.hard_triangles(3000)
    triangles[::3, 2] = triangles[::3, 1]
    mesh = mesh_of(triangles)
    field = build(mesh, device, tolerance=4e-3, max_level=3, sign=sign, continuous=False)
    check_distances(mesh, field, device)


def sphere_among_segments(missing: int) -> Mesh:
    """Return a sphere of radius 1 without its first faces, and 4,000 segments about its surface."""
    (vertices, faces), rng = meshes.icosphere(4), np.random.default_rng(16)
    ends = rng.normal(size=(4000, 2, 3))
    ends *= rng.uniform(0.7, 1.3, (4000, 2, 1)) / np.linalg.norm(ends, axis=-1, keepdims=True)
    ends[:, 1] = ends[:, 0] + 0.05 * (ends[:, 1] - ends[:, 0])
    return mesh_of(np.concatenate([vertices[faces[missing:]], ends[:, [0, 1, 1]]]))


def test_segments_about_a_sphere_have_no_say_in_its_sides(device: Device) -> None:
    mesh = sphere_among_segments(missing=0)
    field = build(mesh, device, tolerance=4e-3, max_level=4, sign="pseudonormal", continuous=False)
    points = check_distances(mesh, field, device)
    from_middle = np.linalg.norm(points, axis=1)
    clear = (from_middle < 0.99) | (from_middle > 1)
    assert ((field.voxels.ravel() < 0) == (from_middle < 1))[clear].all()


def test_segments_about_a_sphere_with_a_hole(device: Device) -> None:
    mesh = sphere_among_segments(missing=40)
    field = build(mesh, device, tolerance=4e-3, max_level=4, sign="winding", continuous=False)
    points = check_distances(mesh, field, device)
    some = np.random.default_rng(1).choice(len(points), 1500, replace=False)
    number = winding(points[some], mesh.vertices[mesh.faces[: len(mesh.faces) - 4000]])
    clear = np.abs(number - 0.5) > CLEAR
    assert ((field.voxels.ravel()[some] < 0) == (number > 0.5))[clear].all()


# ---- the tree


def examined(
    tree: Tree, exact: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest error of the interpolation of every child at the samples, (n,), and
    whether its signs there or at all corners may be others than the mesh's."""
    points = SAMPLES.T / 4
    everything = np.arange(len(tree.levels))
    world = tree.world(everything, np.broadcast_to(points, (len(everything), *points.shape)))
    distance = exact(world.reshape(-1, 3)).reshape(len(everything), -1) / tree.field.side
    found, inside = tree.corners @ weights_at(points).T, tree.corners < 0
    unlike = ((found < 0) != (distance < 0)).any(axis=1)
    return np.abs(found - distance).max(axis=1), unlike | (inside == inside[:, :1]).all(axis=1)


def check_tree(field: DistanceField, mesh: Mesh, device: Device) -> Tree:
    """Check that each cell is a leaf, or refined, for one of the documented reasons."""
    tree = Tree(field)
    field.validate()
    errors, unlike = examined(tree, SignedDistance(mesh, field.sign, device))
    edge = np.exp2(-tree.levels)
    unsigned = SignedDistance(mesh, "none", device)
    middles = tree.world(np.arange(len(edge)), np.full((len(edge), 1, 3), 0.5))
    middle = unsigned(middles.reshape(-1, 3)) / field.side
    passed = middle <= HALF_DIAGONAL * edge * (1 + 1e-9)
    jumps = tree.codes == JUMP
    beyond = middle - HALF_DIAGONAL * edge > field.band
    over = (errors > field.tolerance * (1 + 1e-6)) & ~beyond & ~jumps
    under = errors < field.tolerance * (1 - 1e-6)
    assert not (over & ~tree.refined & (tree.levels < field.max_level)).any()
    coarse = edge > CROSSED * field.tolerance
    assert not (under & tree.refined & ~(passed & (coarse | unlike))).any()
    assert not (beyond & tree.refined).any()
    assert tree.levels.max() <= field.max_level
    # smaller leaves help where the mesh may pass, and where the error is that of a single point
    half = HALF_DIAGONAL * edge
    least = np.maximum(abs(tree.corners).min(axis=1) - half, 0)
    helped = errors <= np.where(least == 0, np.inf, np.sqrt(least**2 + half**2) - least)
    assert helped[passed & over & ~tree.refined].all() or field.continuous
    missed = over & ~tree.refined & helped
    medial = over & ~tree.refined & ~helped
    found = field.reached.get("medial", {"leaves": 0, "error": 0})
    assert found["leaves"] == np.count_nonzero(medial)
    rounding = 2.0**-19  # of single precision, for the distance to a corner of a triangle
    assert found["error"] == pytest.approx(errors[medial].max(initial=0), rel=0, abs=rounding)
    assert field.reached["missed"] == np.count_nonzero(missed)
    assert field.reached["jumps"] == np.count_nonzero(jumps)
    assert field.reached["leaves"] == np.count_nonzero(~tree.refined)
    if missed.any():
        worst = field.reached["worst"]
        at = int(np.argmax(np.where(missed, errors, 0)))
        assert worst["error"] == pytest.approx(errors[at], rel=1e-6)
        inside = (np.array(worst["where"]) - field.origin) / field.side * 2.0 ** worst["level"]
        same = (tree.levels == worst["level"]) & (tree.cells == np.floor(inside)).all(axis=1)
        assert errors[same].tolist() == pytest.approx([errors[at]], rel=1e-6)
    else:
        assert "worst" not in field.reached
    return tree


@continuity
@pytest.mark.parametrize(
    ("name", "request_"),
    [
        ("torus", {"tolerance": 1e-2}),
        ("torus", {"tolerance": 1e-3, "band": 0.02}),
        ("fan", {"tolerance": 3e-3, "max_level": 5}),
        ("thin box", {"tolerance": 2e-2, "max_level": 3}),
        ("triangle", {"tolerance": 1e-2, "sign": "none"}),
        ("sheets", {"tolerance": 5e-3, "sign": "none"}),
        ("loose", {"tolerance": 2e-2, "sign": "none"}),
    ],
)
def test_leaves_are_leaves_for_a_reason(
    device: Device, name: str, request_: dict[str, Any], continuous: bool
) -> None:
    mesh = EVERY[name]()
    field = build(mesh, device, continuous=continuous, **{"max_level": 4, **request_})
    check_tree(field, mesh, device)


@continuity
@pytest.mark.parametrize("tolerance", [4e-4, 1e-3, 5e-3])
def test_jumps_are_refined_while_they_are_coarse(
    device: Device, tolerance: float, continuous: bool
) -> None:
    """Leaves in which the sign jumps have an edge of CROSSED tolerances at most, or the last level:
    so the sides of a box without lid, where nothing jumps, are separate from the hole."""
    mesh = CROSSING["box without lid"]()
    field = build(mesh, device, tolerance=tolerance, max_level=5, continuous=continuous)
    tree = Tree(field)
    jumps = np.flatnonzero(tree.codes == JUMP)
    assert len(jumps)
    coarse = np.exp2(-tree.levels[jumps]) > CROSSED * tolerance
    assert (tree.levels[jumps][coarse] == 5).all(), np.bincount(tree.levels[jumps])
    assert coarse.any() == (tolerance == 4e-4)


@pytest.mark.parametrize("most", [BLOCK_BYTES, 20 * BLOCK_BYTES, 100 * BLOCK_BYTES + 1])
def test_the_largest_errors_are_refined_first(device: Device, most: int) -> None:
    mesh = CLOSED["fan"]()
    request = {"tolerance": 1e-3, "max_level": 5, "continuous": False}
    field = build(mesh, device, **request, max_bytes=most)
    assert len(field.voxels) == most // BLOCK_BYTES < len(build(mesh, device, **request).voxels)
    tree = Tree(field)
    field.validate()
    errors, _ = examined(tree, SignedDistance(mesh, field.sign, device))
    for level in range(1, field.depth + 1):
        of = tree.levels == level
        if tree.refined[of].any() and not tree.refined[of].all():
            assert errors[of & tree.refined].min() >= errors[of & ~tree.refined].max() - 1e-7
    assert field.reached["missed"] > 0 or not tree.refined.all()


# ---- the bounds


@continuity
@pytest.mark.parametrize(
    ("name", "sign", "tolerance", "max_level"),
    [
        *((name, "pseudonormal", 1e-2, 4) for name in CLOSED),
        *((name, "none", 1e-2, 4) for name in [*OPEN, "torus", "thin box"]),
        *((name, "winding", 5e-3, 5) for name in CROSSING),
    ],
)
def test_bounds(
    device: Device, name: str, sign: str, tolerance: float, max_level: int, continuous: bool
) -> None:
    mesh, request = EVERY[name](), {"tolerance": tolerance, "max_level": max_level, "sign": sign}
    field = build(mesh, device, continuous=continuous, **request)
    exact, unclear = SignedDistance(mesh, sign, device), settled(mesh, device, sign)
    assert check_bounds(field, exact, unclear)


@continuity
@pytest.mark.parametrize("name", SELF_CROSSING)
def test_bounds_of_sizes_by_pseudonormals_that_jump(
    device: Device, name: str, continuous: bool
) -> None:
    """The bounds are of unsigned distances where closed meshes pass through themselves."""
    mesh = SELF_CROSSING[name]()
    request = {"tolerance": 1e-3, "max_level": 4, "sign": "pseudonormal"}
    field = build(mesh, device, continuous=continuous, **request)
    tree, points = Tree(field), np.random.default_rng(2).uniform(size=(12, 3))
    leaves = np.flatnonzero(~tree.refined & (tree.codes != JUMP))
    stored = np.abs(tree.corners[leaves] @ weights_at(points).T)
    world = tree.world(leaves, np.broadcast_to(points, (len(leaves), *points.shape)))
    distance = SignedDistance(mesh, "none", device)(world.reshape(-1, 3)).reshape(stored.shape)
    error = np.abs(stored - distance / field.side).max(axis=1)
    assert (error <= bound_values()[tree.codes[leaves]] + EXACT).all()


# ---- leaves of different level


def leaf_at(tree: Tree, points: np.ndarray, bits: int) -> np.ndarray:
    """Return the child that is the leaf at (N, 3) int64 points, in units of 2**-bits sides."""
    leaves = np.flatnonzero(~tree.refined)
    levels = tree.levels[leaves].astype(np.uint64)
    codes = morton_encode(tree.cells[leaves]) | np.uint64(1) << np.uint64(3) * levels
    order = np.argsort(codes)
    found = np.full(len(points), -1)
    for level in range(1, tree.field.depth + 1):
        wanted = morton_encode(points >> (bits - level)) | np.uint64(1 << 3 * level)
        at = order[np.searchsorted(codes[order], wanted).clip(max=len(order) - 1)]
        found = np.where(codes[at] == wanted, leaves[at], found)
    assert (found >= 0).all()
    return found


def with_other_signs(tree: Tree, bits: int) -> np.ndarray:
    """Return which children have at their boundary a vertex with another sign than their own
    interpolation, and which have one where rounding decides that, (2, 8 n) bool."""
    found, stored = np.zeros((2, len(tree.levels)), bool), tree.field.voxels.ravel()
    places = tree.vertices() << (bits - tree.field.depth)
    for before in np.indices((2, 2, 2)).reshape(3, 8).T:
        beside = places - before
        there = np.flatnonzero(((beside >= 0) & (beside < 1 << bits)).all(axis=1))
        leaves = leaf_at(tree, beside[there], bits)
        scale = np.exp2(tree.levels[leaves] - float(bits))[:, None]
        within = places[there] * scale - tree.cells[leaves]
        value = (weights_at(within) * tree.corners[leaves]).sum(axis=1)
        near = np.abs(value) <= 2 * np.spacing(np.abs(tree.corners[leaves]).max(axis=1))
        other = (value < 0) != (stored[there] < 0)
        found[0, leaves[other & ~near]] = found[1, leaves[other & near]] = True
    return found


@pytest.mark.parametrize(
    ("name", "request_"),
    [
        ("torus", {"tolerance": 1e-3, "band": 0.01}),
        ("torus", {"tolerance": 1e-4, "max_level": 6, "max_bytes": 20_000}),
        ("needle", {"tolerance": 3e-3, "max_level": 6}),
        ("loose", {"tolerance": 1e-2, "sign": "none"}),
        ("box without lid", {"tolerance": 1e-2}),
    ],
)
def test_both_sides_of_a_face_agree(device: Device, name: str, request_: dict[str, Any]) -> None:
    mesh = EVERY[name]()
    field = build(mesh, device, **{"max_level": 5, **request_})
    tree, rng, bits = Tree(field), np.random.default_rng(1), 20
    _, first, copies = np.unique(tree.vertices(), axis=0, return_index=True, return_inverse=True)
    stored = field.voxels.ravel()
    assert np.array_equal(stored, stored[first][copies.ravel()])

    leaves = np.flatnonzero(~tree.refined)
    points = rng.integers(0, 5, (len(leaves), 6, 10, 3)) / 4
    points[:, :, 5:] = rng.integers(0, 1 << 10, (len(leaves), 6, 5, 3)) / (1 << 10)
    for face in range(6):
        points[:, face, :, face // 2] = face % 2
    edge = (1 << (bits - tree.levels[leaves]).astype(np.int64))[:, None, None, None]
    at = np.rint(tree.cells[leaves][:, None, None] * edge + points * edge).astype(np.int64)
    across = at.copy()
    for face in range(6):
        across[:, face, :, face // 2] -= 1 - face % 2
    inside = ((across >= 0) & (across < 1 << bits)).all(axis=-1)
    own = np.broadcast_to(leaves[:, None, None], inside.shape)[inside]
    other = leaf_at(tree, across[inside].clip(0, (1 << bits) - 1), bits)
    finer = tree.levels[own] > tree.levels[other]
    own, other, at = own[finer], other[finer], at[inside][finer]
    assert len(own) > 100
    sides = []
    for which in (own, other):
        within = at * np.exp2(tree.levels[which] - float(bits))[:, None] - tree.cells[which]
        assert (within >= 0).all()
        assert (within <= 1).all()
        sides.append((weights_at(within) * tree.corners[which]).sum(axis=1))
    ulp = np.spacing(np.abs(tree.corners[other]).max(axis=1).astype(np.float32))
    apart = np.abs(sides[0] - sides[1])
    kept, unsure = with_other_signs(tree, bits)[:, other]
    most = np.where(kept | unsure, np.sqrt(3) * np.exp2(-tree.levels[other]), 2 * ulp)
    assert (apart <= most).all()
    assert not kept.all()
    assert kept.any() == (field.reached["kept"] > 0)


@pytest.mark.parametrize("tolerance", [0.05, 1e-3])
def test_sides_that_are_found_when_asked_for_change_nothing(
    device: Device, tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An open mesh that intersects itself: winding numbers in front of the faces that samples ask
    for, and of all faces beforehand."""
    ball = meshes.icosphere(3)
    vertices, faces = meshes.join((ball[0], ball[1][4:]), (0.5 * ball[0] + 0.8, ball[1][:-4]))
    mesh = meshes.mesh_of(vertices, faces)
    monkeypatch.setattr(sides, "MANY", 2)  # never all
    request: Any = {"tolerance": tolerance, "max_level": 5, "measure": False, "device": device}
    some, every = plan_adf(mesh, **request), plan_adf(mesh, **request)
    every._survey.sides.find(np.arange(len(faces)))
    every._survey.sides.write()
    assert some.run().digest() == every.run().digest()
    known = ~np.isinf(some._survey.sides.front)
    assert 0 < np.count_nonzero(known) < len(faces)
    assert some.plan.crossed == np.count_nonzero(some._survey.found == 1) <= every.plan.crossed


# ---- measured errors


def points_of(field: DistanceField) -> int:
    return min(max(1024, 8 * field.reached["leaves"]), 32768)


def test_a_coarse_field_is_measured_at_few_points(device: Device) -> None:
    ball = meshes.mesh_of(*meshes.icosphere(3))
    coarse, fine = (build_adf(ball, device, tolerance=t, max_level=6) for t in (0.1, 5e-4))
    for field in (coarse, fine):
        assert field.reached["errors"]["in the cube"]["points"] == points_of(field)
    assert points_of(coarse) < 8192 < points_of(fine)


@pytest.mark.parametrize("band", [math.inf, 0.05])
@pytest.mark.parametrize("name", ["fan", "box without lid"])
def test_errors(device: Device, name: str, band: float) -> None:
    """Errors are measured within the band, and where the sign does not jump."""
    mesh = EVERY[name]()
    field = build_adf(mesh, device, tolerance=5e-3, max_level=4, band=band)
    measured = field.reached["errors"]
    points = np.array(field.origin) + field.side * sample_cube(points_of(field))
    exact = SignedDistance(mesh, field.sign, device)(points) / field.side
    answer = field.query(points, bounds=True)
    assert answer.bound is not None
    counts = np.isfinite(answer.bound) & (np.abs(exact) <= band)
    assert (counts.sum() < len(points)) == (band < 1 or name == "box without lid")
    errors = np.sort(np.abs(answer.distance / field.side - exact)[counts])
    assert measured["in the cube"] == pytest.approx(
        {
            "points": len(errors),
            "max": errors[-1],
            "rms": np.sqrt(np.mean(errors**2)),
            "p99": errors[math.ceil(0.99 * len(errors)) - 1],
            "within": np.mean(errors <= 5e-3),
        },
        rel=1e-9,
    )
    near = measured["near the surface"]
    assert 0 < near["rms"] <= near["max"] < 0.1
    assert near["p99"] <= near["max"]
    assert points_of(field) / 2 < near["points"] <= points_of(field)
    assert 0.5 < near["within"] <= 1


# ---- what changes nothing


def same_textures(one: DistanceField, other: DistanceField) -> bool:
    same = np.array_equal(one.voxels, other.voxels) and np.array_equal(one.cells, other.cells)
    return same and one.hash == other.hash


@pytest.mark.parametrize("sign", ["pseudonormal", "winding", "none"])
@pytest.mark.parametrize("exponent", [-40, 40])
def test_scale_changes_no_bit(device: Device, sign: str, exponent: int) -> None:
    mesh = mesh_of(*meshes.torus(sides=(11, 7)))
    scaled = replace(mesh, vertices=np.ldexp(mesh.vertices, exponent))
    one, other = (build(m, device, tolerance=1e-2, max_level=4, sign=sign) for m in (mesh, scaled))
    assert same_textures(one, other)
    assert np.array_equal(one.bounds, other.bounds)
    assert other.side == math.ldexp(one.side, exponent)
    assert other.origin == tuple(math.ldexp(x, exponent) for x in one.origin)
    assert one.lipschitz == other.lipschitz


@pytest.mark.parametrize("sign", ["pseudonormal", "winding", "none"])
@pytest.mark.parametrize("name", ["torus", "saddle", "box without lid"])
def test_the_order_of_faces_changes_no_distance(device: Device, name: str, sign: str) -> None:
    """Bounds may differ: of equally good triangles the first serves, of many the first KEPT."""
    mesh = EVERY[name]()
    shuffled = replace(mesh, faces=np.random.default_rng(4).permutation(mesh.faces))
    request = {"tolerance": 1e-2, "max_level": 4, "sign": sign}
    assert same_textures(*(build(m, device, **request) for m in (mesh, shuffled)))


def test_copies_of_faces_change_nothing_and_end(device: Device) -> None:
    """A thousand equally near faces would fill every list."""
    vertices, faces = meshes.box(0, 4)
    request = {"tolerance": 1e-2, "max_level": 5, "sign": "none"}
    copies = (mesh_from_arrays(vertices, np.tile(faces, (count, 1))) for count in (1, 1000))
    assert same_textures(*(build(mesh, device, **request) for mesh in copies))


def test_a_segment_through_the_middles_of_cells(device: Device) -> None:
    """No triangle has a side, and the nearest one is at distance 0 of the middles."""
    mesh = mesh_from_arrays(np.array([(0.0, 0, 0), (1, 1, 1), (1, 1, 1)]), np.array([(0, 1, 2)]))
    field = build_adf(mesh, device, tolerance=1e-3, max_level=3)
    field.validate()
    points = np.random.default_rng(3).uniform(-0.1, 1.1, (100, 3))
    found = field.query(points, bounds=True)
    exact = np.linalg.norm(points - points.mean(axis=1, keepdims=True).clip(0, 1), axis=1)
    assert (np.abs(found.distance - exact) <= found.bound).all()


def test_whole_numbers_are_lengths(device: Device) -> None:
    one, other = (
        build(CLOSED["torus"](), device, tolerance=t, band=b, max_level=2)
        for t, b in ((0, 1), (0.0, 1.0))
    )
    assert one.digest() == other.digest()


def test_the_medial_axis_is_left_where_no_level_reaches_the_tolerance(device: Device) -> None:
    """A box beside a small ball: fewer leaves, as exact near the surface; all with everywhere."""
    parts = meshes.box(0, (1, 0.7, 0.5)), meshes.icosphere(2, (1.2, 0.4, 0.3), 5e-4)
    (vertices, faces), (others, more) = parts
    mesh = mesh_from_arrays(
        np.concatenate([vertices, others]), np.concatenate([faces, more + len(vertices)])
    )
    request = {"tolerance": 1e-4, "max_level": 8, "measure": False}
    left, full = (build_adf(mesh, device, **request, everywhere=every) for every in (False, True))
    assert full.reached["medial"]["left"] == 0
    assert left.reached["missed"] == full.reached["missed"]
    medial = left.reached["medial"]
    assert 0 < medial["left"] < medial["leaves"] < full.reached["medial"]["leaves"]
    assert left.reached["leaves"] < 0.96 * full.reached["leaves"]
    random = np.random.default_rng(8)
    points = np.array(left.origin) + left.side * random.random((40_000, 3))
    distances = SignedDistance(mesh, left.sign, device)(points)
    found = left.query(points, bounds=True)
    assert found.bound is not None
    errors = abs(found.distance - distances) / left.side
    exact = abs(full.distance(points) - distances) / left.side
    assert (errors <= found.bound / left.side + 1e-7).all()
    largest = 2.0**-7  # the edge whose square is within the tolerance
    assert errors.max() < largest / 2
    near = abs(distances) < (BESIDE - 2) * 2.0**-8 * left.side
    assert errors[near].max() <= exact[near].max()
