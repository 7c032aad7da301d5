"""Pictures of distance fields against dense marching in numpy, with analytic shapes, and
invariants."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers import meshes
from helpers.field import cells_of, plain_field, point, sphere
from helpers.files import with_w

from voxtool.adf.construction.build import build_adf
from voxtool.adf.field.field import DistanceField
from voxtool.adf.pictures.raycast import COLOUR, least_shown, refined_children
from voxtool.adf.pictures.scene import FieldScene
from voxtool.adf.queries import textures
from voxtool.camera import Camera, Rays
from voxtool.choices import SEARCHES
from voxtool.errors import VoxtoolError
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.opencl import Device

ORIGIN, SIDE = (-3.7, 0.1, 12.0), 2.3
AMBIENT = 0.08
SAMPLES = 300  # of the oracle, along a ray's way through the cube
WHITE = (1.0, 1.0, 1.0)


def cast(field: DistanceField, rays: Rays, *, device: Device, **options: Any) -> np.ndarray:
    return FieldScene(field, **options).draw(rays, device)


# ---- the oracle


def lines_of(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 3) origins and unit directions of the rays, row by row."""
    width, height = rays.size
    y, x = np.indices((height, width)).reshape(2, -1, 1) + 0.5
    aside = (x - width / 2) * rays.right + (y - height / 2) * rays.down
    origin = np.broadcast_to(rays.origin, aside.shape) + (0 if rays.perspective else aside)
    way = np.broadcast_to(rays.direction, aside.shape) + (aside if rays.perspective else 0)
    return origin, way / np.sqrt((way**2).sum(axis=1, keepdims=True))


def marched(
    field: DistanceField, origin: np.ndarray, way: np.ndarray, offset: float, samples: int
) -> np.ndarray:
    """Return how far along each of N lines dense marching finds the offset first, or infinity."""
    low, high = np.array(field.origin), np.array(field.origin) + field.side
    with np.errstate(divide="ignore"):
        ends = np.stack([low - origin, high - origin]) / way
    begin = np.fmax(ends.min(axis=0).max(axis=1), 0)
    end = ends.max(axis=0).min(axis=1)
    meets = begin < end
    begin, end = np.where(meets, begin, 0), np.where(meets, end, 0)
    step = (end - begin) / samples

    def height(k: np.ndarray) -> np.ndarray:
        places = origin[:, None] + (begin[:, None] + k * step[:, None])[..., None] * way[:, None]
        return field.distance(places.reshape(-1, 3)).reshape(places.shape[:2]) - offset

    sampled = height(np.arange(samples)[None] + 1e-9)
    side = np.where(sampled[:, :1] >= 0, 1, -1)
    crossed = meets[:, None] & (side * sampled <= 0)
    first = crossed.argmax(axis=1)[:, None]
    before, after = np.maximum(first - 1, 0) + 1e-9, first + 1e-9
    for _ in range(40):
        middle = (before + after) / 2
        passed = side * height(middle) <= 0
        before, after = np.where(passed, before, middle), np.where(passed, middle, after)
    return np.where(crossed.any(axis=1), begin + after[:, 0] * step, np.inf)


def brightness(normal: np.ndarray, rays: Rays) -> np.ndarray:
    return AMBIENT + (1 - AMBIENT) * (0.5 + 0.5 * (normal * rays.light()).sum(axis=-1)) ** 2


def agrees(picture: np.ndarray, field: DistanceField, rays: Rays, offset: float = 0.0) -> None:
    """Check a white picture against dense marching; where they differ, against denser marching.

    The gradient is another one on each side of a leaf's face: any of them is right.
    """
    origin, way = lines_of(rays)
    bright, shown = picture[..., 0].ravel(), shown_by(picture)
    assert not picture.reshape(-1, 4)[~shown].any()
    depth = np.full(len(origin), np.inf)
    doubtful = np.arange(len(origin))
    for samples in (SAMPLES, 50 * SAMPLES):
        depth[doubtful] = marched(field, origin[doubtful], way[doubtful], offset, samples)
        found = np.isfinite(depth)
        right = found == shown
        hit = np.flatnonzero(found & shown)
        place = origin[hit] + depth[hit, None] * way[hit]
        differs = np.full(len(hit), np.inf)
        for aside in np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * 1e-6 * field.side:
            gradient = field.gradient(place + aside).astype(float)
            towards = -np.where((gradient * way[hit]).sum(axis=1) > 0, 1, -1)
            normal = gradient * (towards / np.sqrt((gradient**2).sum(axis=1)))[:, None]
            differs = np.minimum(differs, np.abs(brightness(normal, rays) - bright[hit]))
        right[hit] &= differs < 1e-3
        doubtful = np.flatnonzero(~right)
    assert len(hit) > 20
    assert len(doubtful) == 0


def apart_from(rays: Rays, point: np.ndarray) -> np.ndarray:
    """Return the distance of each ray's line from a point, (N,)."""
    origin, way = lines_of(rays)
    return np.sqrt((np.cross(origin - point, way) ** 2).sum(axis=1))


def shown_by(picture: np.ndarray) -> np.ndarray:
    return picture[..., 3].ravel() == 1


def check_outline(picture: np.ndarray, apart: np.ndarray, radius: float, error: float) -> None:
    """Check which rays show a ball, given their distances from its centre."""
    assert shown_by(picture)[apart < radius - error].all()
    assert not shown_by(picture)[apart > radius + error].any()


def view(field: DistanceField, name: str = "iso", size: int = 24, **options) -> Rays:
    low = np.array(field.origin)
    return Camera.fit(low, low + field.side, name, **options).rays(size, size + 3)


# ---- fields


def built(vertices, faces, device, **request) -> DistanceField:
    mesh = mesh_from_arrays(np.asarray(vertices, float), faces)
    return build_adf(mesh, device, **{"tolerance": 2e-3, "max_level": 5, **request})


def ball(**head) -> DistanceField:
    return plain_field(sphere, 2e-3, 6, origin=ORIGIN, side=SIDE, **head)


def torus(device, **request) -> DistanceField:
    return built(*meshes.torus(0.3, 2.0, 0.7), device, **request)


def open_box(device, **request) -> DistanceField:
    return built(*meshes.open_box((0, 0, 0), (4, 3, 2)), device, **request)


FIELDS = {
    "cracks": lambda device: (ball(), 0.0),
    "continuous": lambda device: (torus(device), 0.0),
    "band": lambda device: (torus(device, band=0.01), 0.0),
    "inner offset": lambda device: (torus(device), -0.3),
    "unsigned": lambda device: (torus(device, sign="none"), 0.2),
    "jumps": lambda device: (open_box(device), 0.0),
    "jumps and offset": lambda device: (open_box(device), 0.15),
}


@pytest.mark.parametrize("name", FIELDS)
def test_the_surface_is_where_dense_marching_finds_it(device, name) -> None:
    field, offset = FIELDS[name](device)
    for rays in (view(field, "iso"), view(field, "right", fov=None)):
        agrees(cast(field, rays, offset=offset, colour=WHITE, device=device), field, rays, offset)


@pytest.mark.parametrize("fov", [None, 40.0])
@pytest.mark.parametrize("offset", [0.0, 0.1, -0.1])
def test_a_sphere(device, fov, offset) -> None:
    """The outline and the brightness are right within the tolerance of the field."""
    field = ball()
    rays = view(field, fov=fov, size=64)
    picture = cast(field, rays, offset=offset * SIDE, colour=WHITE, device=device)
    centre, radius = np.array(ORIGIN) + SIDE / 2, (0.3 + offset) * SIDE
    # tested between samples, too, the error is more than the tolerance
    check_outline(picture, apart_from(rays, centre), radius, 2 * field.tolerance * SIDE)
    inner = apart_from(rays, centre) < 0.9 * radius
    origin, way = (lines[inner] for lines in lines_of(rays))
    along = -((origin - centre) * way).sum(axis=1)
    depth = along - np.sqrt(radius**2 - apart_from(rays, centre)[inner] ** 2)
    normal = (origin + depth[:, None] * way - centre) / radius
    assert np.abs(picture[..., 0].ravel()[inner] - brightness(normal, rays)).max() < 0.1


def test_a_camera_inside(device) -> None:
    """The camera sees the surface from within, all around, lit as it faces the camera."""
    field = ball()
    centre = np.array(ORIGIN) + SIDE * np.array([0.52, 0.5, 0.47])
    camera = Camera(tuple(centre), tuple(centre + np.array([1, 0.2, 0.1])), fov=120)
    rays = camera.rays(24, 24)
    picture = cast(field, rays, colour=WHITE, device=device)
    assert (picture[..., 3] == 1).all()
    agrees(picture, field, rays)
    outside = replace(camera, eye=tuple(np.array(ORIGIN) + 0.05 * SIDE))  # but within the cube
    rays = replace(outside, target=tuple(centre)).rays(24, 24)
    agrees(cast(field, rays, colour=WHITE, device=device), field, rays)


def test_nothing_behind_the_camera(device) -> None:
    field = ball()
    middle, back = np.array(ORIGIN) + SIDE / 2, np.array([0.0, 0.0, 1.0])
    away = Camera(tuple(middle + SIDE * back), tuple(middle + 2 * SIDE * back))
    assert not cast(field, away.rays(16, 16), device=device).any()


SEARCHED = {
    **{f"{search}, {name}": (search, FIELDS[name]) for search in SEARCHES for name in FIELDS},
    "root alone": ("bottom-up", lambda device: (plain_field(sphere, 10.0, 3), 0.0)),
    "all cells of a level": ("linear", lambda device: (plain_field(sphere, 0.0, 3), 0.0)),
    "w": ("coherent", lambda device: (with_w(ball(), 7), 0.0)),
    "wide": ("coherent", lambda device: (plain_field(
        lambda p: np.log2(point(p) + 1e-12), 0.2, 14, continuous=True), -3.0)),
}  # fmt: skip


@pytest.mark.parametrize("name", SEARCHED)
def test_searches_show_the_same(device, name, monkeypatch) -> None:
    """Each leaf by the hash, from the leaf before: the pixels of the walk in the tree. The table of
    coarse cells is small, so that most leaves are searched for."""
    monkeypatch.setattr(textures, "TOP_LEVEL", 1)
    search, field_of = SEARCHED[name]
    field, offset = field_of(device)
    middle = np.array(field.origin) + field.side * np.array([0.45, 0.55, 0.5])
    within = Camera(tuple(middle), tuple(middle + np.array([1.0, 0.2, 0.3]))).rays(21, 17)
    for rays in (view(field), view(field, "front"), view(field, "top", fov=None), within):
        plain = cast(field, rays, offset=offset, device=device)
        found = cast(field, rays, offset=offset, search=search, device=device)
        assert np.array_equal(found, plain)
        assert plain.any() or rays is within


@pytest.mark.parametrize("name", FIELDS)
def test_what_a_ray_meets_does_not_depend_on_its_neighbours(device, name) -> None:
    """One ray at a time, and rays side by side, draw the same; around an axis, too, where the rays
    of a packet are mirrored differently."""
    field, offset = FIELDS[name](device)
    for rays in (view(field), view(field, "front"), view(field, "top", fov=None)):
        alone, together = (
            cast(field, rays, offset=offset, lanes=lanes, device=device) for lanes in (1, 16)
        )
        assert alone.any()
        assert np.array_equal(alone, together)


def test_a_thin_wall(device) -> None:
    """The wall is a thousandth of the side thick; a ball before it has small leaves around it."""

    def wall(p: np.ndarray) -> np.ndarray:
        ball = np.sqrt(((p - (0.3, 0.6, 0.7)) ** 2).sum(axis=1)) - 0.05
        return np.minimum(np.abs(p[:, 2] - 0.5) - 5e-4, ball)

    field = plain_field(wall, 1e-3, 7, continuous=True)
    for name in ("front", "back", "iso"):
        rays = view(field, name, size=70)
        shown = shown_by(cast(field, rays, device=device))
        origin, way = lines_of(rays)
        hit = origin + ((0.5 - origin[:, 2]) / way[:, 2])[:, None] * way
        inside = ((hit > 0.01) & (hit < 0.99))[:, :2].all(axis=1)
        assert inside.sum() > 500
        assert shown[inside].all()


@pytest.mark.parametrize("offset", [1e3, -1e3, 1e38, -1e300])
def test_offsets_beyond_the_field_show_nothing(device, offset) -> None:
    field = ball()
    assert not cast(field, view(field), offset=offset, device=device).any()


def test_an_unsigned_field_shows_its_sheet(device) -> None:
    """The sheet has no holes at the distance that is drawn in place of 0."""
    corners = [(0.0, 0, 0), (4, 1, 0.3), (4.5, 4, 1.7), (0.5, 3, 1.4)]
    faces = [(0, 1, 2), (0, 2, 3)]
    field = built(corners, faces, device, sign="none", max_level=4, tolerance=1e-4)
    rays = view(field, "front", size=80, fov=None)
    shown = shown_by(cast(field, rays, device=device))
    origin, _ = lines_of(rays)
    inside = np.ones(len(origin), bool)
    for (ax, ay, _), (bx, by, _) in zip(corners, [*corners[1:], corners[0]], strict=True):
        across = (bx - ax) * (origin[:, 1] - ay) - (by - ay) * (origin[:, 0] - ax)
        inside &= across > field.side / 16 * math.hypot(bx - ax, by - ay)
    assert inside.sum() > 500
    assert shown[inside].all()
    same = cast(field, rays, offset=least_shown(field), device=device)
    assert np.array_equal(shown_by(same), shown)
    assert least_shown(field) == field.side * max(0.5 ** (field.depth + 1), field.tolerance)


def test_a_larger_world(device) -> None:
    field, low = ball(), np.array(ORIGIN)
    twice = replace(field, origin=tuple(2 * low), side=2 * SIDE)
    one, other = (cast(f, view(f), device=device) for f in (field, twice))
    assert np.array_equal(one, other)


def test_frames(device) -> None:
    """A frame does not depend on the frames before, nor a pixel on other pixels."""
    field = ball()
    rays = view(field, size=33)
    first = cast(field, rays, device=device)
    assert first.shape == (36, 33, 4)
    assert first.dtype == np.float32
    back = cast(field, view(field, "back", size=33), offset=0.1, device=device)
    assert not np.array_equal(back, first)
    assert np.array_equal(cast(field, rays, device=device), first)
    blue = cast(field, rays, colour=(0, 0, 1), device=device)
    assert not blue[..., :2].any()
    shown = first[..., 3] == 1
    assert np.allclose(blue[shown][:, 2] * COLOUR[2], first[shown][:, 2], rtol=1e-6)
    one = replace(rays, size=(1, 1), origin=rays.origin)  # the middle of the picture
    whole = cast(field, replace(rays, size=(33, 35)), device=device)
    assert np.array_equal(cast(field, one, device=device)[0, 0], whole[17, 16])


@pytest.mark.parametrize("max_level", [11, 17])
def test_deep_fields(device, max_level) -> None:
    """The ball has a radius of 2**-9, or 2**-15 in leaves with 64-bit identifiers."""
    field = plain_field(lambda p: np.log2(point(p) + 1e-12), 0.2, max_level, continuous=True)
    assert field.depth == max_level
    assert field.cells.shape[-1] == (3 if max_level > 11 else 2)
    exponent = 2 - max_level
    centre, radius = np.array([0.3, 0.6, 0.7]), 2.0**exponent
    for fov in (None, 30.0):
        rays = Camera.fit(centre - radius, centre + radius, fov=fov).rays(50, 50)
        picture = cast(field, rays, offset=exponent, colour=WHITE, device=device)
        check_outline(picture, apart_from(rays, centre), 1.05 * radius, 0.25 * radius)
        assert picture[picture[..., 3] == 1][:, 0].std() > 0.1


def test_a_root_alone(device) -> None:
    field = plain_field(sphere, 10.0, 3)
    rays = view(field)
    agrees(cast(field, rays, colour=WHITE, device=device), field, rays)


def test_refusals(device) -> None:
    field = ball()
    rays = view(field)
    for offset in (math.nan, math.inf, -math.inf):
        with pytest.raises(VoxtoolError, match=f"an offset of {offset}: give a finite distance"):
            cast(field, rays, offset=offset, device=device)
    for colour in ((1, 1), (0, 0, 2), (0, math.nan, 0)):
        with pytest.raises(VoxtoolError, match="give red, green and blue between 0 and 1"):
            cast(field, rays, colour=colour, device=device)
    with pytest.raises(VoxtoolError, match="search 'fast' is unknown: choose linear, binary"):
        cast(field, rays, search="fast", device=device)


# ---- tables


def test_refined_children() -> None:
    field = plain_field(point, 1e-2, 7)
    levels, cells = cells_of(field)
    refined = refined_children(field)
    for child in range(8):
        octant = np.array([child & 1, child >> 1 & 1, child >> 2])
        there = np.array(
            [field.slots(int(n) + 1, (2 * c + octant)[None])[0] >= 0
             for n, c in zip(levels, cells, strict=True)]
        )  # fmt: skip
        assert np.array_equal(refined >> child & 1, there)
    assert refined.any()
