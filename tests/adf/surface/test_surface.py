"""Surfaces of fields: closed and manifold for any values, equal to a plain construction, and as far
from analytic shapes as the leaves allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.field import plain_field, point, sphere

import voxtool
from voxtool.adf.field.field import DistanceField
from voxtool.adf.surface.extract import extract_field_surface, plan_field_surface
from voxtool.errors import MemoryLimitError, MeshWarning, VoxtoolError

CORNERS = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
SURE = {"boundary_edges", "nonmanifold_edges", "inconsistent_edges", "nonmanifold_vertices",
        "duplicate_faces", "degenerate_faces"}  # fmt: skip


def check_sound(surface: voxtool.FieldSurface) -> dict[str, object]:
    found = surface.check()
    assert found["closed"]
    assert not {name: found[name] for name in SURE if found[name]}
    return found


def random_field(seed: int, kind: str) -> DistanceField:
    """Return a field whose blocks do not agree: random leaves with random values, values near those
    of a distance, or blocks of one sign."""
    rng = np.random.default_rng(seed)
    middle, noise = rng.random(3), rng.choice([0, 0.02, 0.2])

    def rough(points: np.ndarray) -> np.ndarray:
        return np.sqrt(((points - middle) ** 2).sum(axis=1)) + noise * rng.random(len(points))

    field = plain_field(rough, float(rng.choice([0.01, 0.03, 0.1])), int(rng.integers(2, 5)))
    noise = rng.standard_normal(field.voxels.shape).astype(np.float32)
    values = {
        "any": noise,
        "sparse": noise + 1.5,
        "near": field.voxels - np.float32(0.4 * rng.random()) + np.float32(0.02) * noise,
        "blocks": np.sign(rng.random(len(noise)) - 0.5)[:, None, None, None] + 0 * noise,
    }
    return replace(field, voxels=values[kind].astype(np.float32))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("kind", ["any", "sparse", "near", "blocks"])
def test_any_values_give_a_closed_manifold(kind: str, seed: int) -> None:
    surface = extract_field_surface(random_field(seed, kind))
    if len(surface.faces):
        check_sound(surface)


def plain_crossings(field: DistanceField, offset: float) -> set[tuple[int, ...]]:
    """Return the minimal edges with a change of sign, by dictionaries: low ends and high ends."""
    side, blocks = 1 << field.depth, set(field.blocks.tolist())
    best: dict[tuple[int, ...], tuple[int, int, float]] = {}
    edges: dict[tuple[int, int, int, int], set[int]] = {}  # unit pieces: sizes of edges over them
    whole = set()
    for code, block in zip(field.blocks.tolist(), field.voxels, strict=True):
        level = (code.bit_length() - 1) // 3 + 1
        size = side >> level
        for octant in range(8):
            child = code << 3 | octant
            if child in blocks:
                continue
            bits = [child >> 3 * k & 7 for k in range(level)]
            low = [sum((b >> a & 1) << k for k, b in enumerate(bits)) * size for a in range(3)]
            order = (level, child << 3 * (field.depth - level))
            for corner in CORNERS:
                at = tuple(low[a] + size * corner[a] for a in range(3))
                x, y, z = ((octant >> a & 1) + corner[a] for a in range(3))
                if at not in best or order > best[at][:2]:
                    best[at] = (*order, float(block[z, y, x]))
                for axis in range(3):
                    if not corner[axis]:
                        whole.add((*at, axis, size))
                        for k in range(size):
                            piece = [*at, axis]
                            piece[axis] += k
                            edges.setdefault(tuple(piece), set()).add(size)  # pyright: ignore

    def inside(at: tuple[int, ...]) -> bool:
        return best[at][2] < offset and all(0 < c < side for c in at)

    found = set()
    for *start, axis, size in whole:
        pieces = []
        for k in range(size):
            piece = [*start, axis]
            piece[axis] += k
            pieces.append(edges[tuple(piece)])  # pyright: ignore
        end = list(start)
        end[axis] += size
        smallest = min(min(sizes) for sizes in pieces)
        if smallest == size and inside(tuple(start)) != inside(tuple(end)):
            found.add((*start, *end))
    return found


@pytest.mark.parametrize("kind", ["any", "near"])
def test_crossings_are_those_of_a_plain_construction(kind: str) -> None:
    from voxtool.adf.surface.dual import find_crossings
    from voxtool.adf.surface.leaves import Leaves, vertices_near

    field = random_field(3, kind)
    leaves = Leaves.of(field)
    vertices = vertices_near(field, leaves, np.float32(0))
    crossings = find_crossings(leaves, vertices)
    found = vertices.places[crossings.ends].reshape(-1, 6)
    assert set(map(tuple, found.tolist())) == plain_crossings(field, 0.0)


@pytest.mark.parametrize("offset", [-0.1, 0.0, 0.05])
def test_a_sphere(offset: float) -> None:
    """The error falls with the square of the edge, the genus is 0, the volume that of the ball."""
    errors = []
    for level in (4, 5, 6):
        field = plain_field(sphere, 1e-9, level)
        surface = extract_field_surface(field, offset=offset)
        assert check_sound(surface)["genus"] == 0
        errors.append(np.abs(sphere(surface.vertices) - offset).max())
        assert errors[-1] <= 0.75 / (0.3 + offset) / 4**level  # a trilinear leaf's error
        assert (np.sum(surface.normals * (surface.vertices - 0.5), axis=1) > 0).all()
    assert errors[0] > 6 * errors[2]


def test_a_shell_has_two_surfaces() -> None:
    field = plain_field(sphere, 1e-3, 6)
    surface = extract_field_surface(field, offset=0.05, shell=0.1)
    found = check_sound(surface)
    volume = 4 / 3 * np.pi * (0.35**3 - 0.25**3)
    assert found["shells"] == 2
    assert found["volume"] == pytest.approx(volume, rel=0.02)
    assert surface.digest() != extract_field_surface(field, offset=0.05).digest()


def test_the_surface_is_closed_at_the_cube() -> None:
    edge = 1 / 32
    field = plain_field(lambda p: sphere(p + np.array([0.5, 0, 0])), 1e-9, 5)
    with pytest.warns(MeshWarning, match="leaves the field's cube"):
        surface = extract_field_surface(field)
    volume = check_sound(surface)["volume"]
    assert isinstance(volume, float)
    lost = 2 / 3 * np.pi * 0.3**3 - volume  # the rim of the half ball is cut off within a leaf
    assert 0 < lost < 2 * np.pi * 0.3 * edge**2 + np.pi * 0.3**2 * edge / 256


def test_refusals() -> None:
    field = plain_field(sphere, 1e-2, 4, band=0.02)
    with pytest.raises(VoxtoolError, match=r"distance 0\.03: the field is sampled within a band"):
        plan_field_surface(field, offset=0.03)
    with pytest.raises(VoxtoolError, match="positive distance"):
        plan_field_surface(field, shell=-1.0)
    with pytest.raises(VoxtoolError, match="no signs"):
        plan_field_surface(plain_field(point, 1e-2, 4, sign="none"), offset=-0.1)
    with pytest.raises(MemoryLimitError, match="--max-level"):
        plan_field_surface(field, max_memory=1000).run()
    with pytest.warns(MeshWarning, match="no surface at distance -0.31"):
        assert not len(extract_field_surface(plain_field(sphere, 1e-2, 4), offset=-0.31).faces)
    with pytest.raises(VoxtoolError, match="are of octrees"):
        voxtool.extract(field, merge=True)


def test_one_call() -> None:
    field = plain_field(sphere, 1e-2, 4)
    surface = voxtool.extract(field, offset=0.05)
    assert isinstance(surface, voxtool.FieldSurface)
    assert surface.digest() == extract_field_surface(field, offset=0.05).digest()
    assert "vertices" in repr(surface)
    assert surface.to_trimesh().is_watertight
