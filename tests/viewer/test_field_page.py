"""Pages of distance fields in a browser, held against `voxtool render` of the same camera."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.browser import Viewer, check_same, nearer, opened, written

import voxtool
from voxtool.camera import Camera
from voxtool.viewer.fields import field_content

SIZE = (72, 60)
ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def field(models: Path) -> voxtool.DistanceField:
    return voxtool.read_adf(models / "bunny.adf.h5")


@pytest.fixture(scope="module")
def viewer(browser, field: voxtool.DistanceField, tmp_path_factory) -> Iterator[Viewer]:
    with opened(browser, written(field, tmp_path_factory.mktemp("pages"))) as viewer:
        yield viewer


def places(camera: Camera, t: np.ndarray) -> np.ndarray:
    """Return the points at depths (H, W) on the rays of pixels, (H, W, 3)."""
    rays = camera.rays(*SIZE)
    x, y = (np.arange(n) + 0.5 - n / 2 for n in SIZE)
    aside = x[None, :, None] * rays.right + y[:, None, None] * rays.down
    return rays.origin + t[..., None] * (rays.direction + aside)


@pytest.mark.parametrize("offset", [0.0, 0.08, -0.05])
@pytest.mark.parametrize(
    ("view", "fov", "share"), [("iso", 30, 1), ("front", None, 1), ("left", 60, 0.1)]
)
def test_the_picture_is_that_of_render(offset, view, fov, share, field, viewer: Viewer) -> None:
    camera = nearer(voxtool.camera_for(field, view, fov=fov), share)
    viewer.set(camera, offset=offset)
    colours, ids = viewer.picture(*SIZE)
    check_same(colours, voxtool.render(field, camera.rays(*SIZE), offset=offset))
    assert ((ids[..., 3] > 0) == (colours[..., 3] > 0)).all()
    options = f" --offset {offset!r}" if offset else " --background none"
    assert viewer.tab.evaluate("voxtool.command()").endswith(options)


def test_pixels_name_the_leaf_of_the_first_root(field, viewer: Viewer) -> None:
    camera = voxtool.camera_for(field, "iso")
    viewer.set(camera)
    _, ids = viewer.picture(*SIZE)
    far = float(np.linalg.norm(np.subtract(camera.eye, camera.target)))
    steps = np.linspace(far - field.side, far + field.side, 800)
    depths = np.broadcast_to(steps[:, None, None], (800, SIZE[1], SIZE[0]))
    points = np.stack([places(camera, t) for t in depths])
    inside = (points > field.origin).all(axis=-1)
    inside &= (points < np.add(field.origin, field.side)).all(axis=-1)
    below = np.zeros(inside.shape, bool)
    below[inside] = voxtool.query_adf(field, points[inside]).distance <= 0
    hit = below.any(axis=0)
    after = np.argmax(below, axis=0)
    low, high = steps[np.maximum(after - 1, 0)], steps[after]
    for _ in range(40):
        middle = (low + high) / 2
        found = voxtool.query_adf(field, places(camera, middle).reshape(-1, 3)).distance
        beyond = found.reshape(middle.shape) <= 0
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    at = voxtool.query_adf(field, places(camera, high).reshape(-1, 3), cell=True)
    level = at.level.reshape(hit.shape).astype(int)
    cell = at.cell.reshape(*hit.shape, 3).astype(int)
    shift = (field.depth - level)[..., None]
    same = (ids[..., :3] == cell << shift).all(axis=2) & (ids[..., 3] == shift[..., 0] + 1)
    assert hit.mean() > 0.1
    assert np.where(hit, same, ids[..., 3] == 0).mean() >= 0.995


def test_the_cutting_plane_shows_distances_bounds_and_leaves(field, viewer: Viewer) -> None:
    camera = voxtool.camera_for(field, "front", fov=None)
    z = field.origin[2] + 0.999 * field.side
    rays = camera.rays(*SIZE)
    x, y = (np.arange(n) + 0.5 - n / 2 for n in SIZE)
    points = rays.origin + x[None, :, None] * rays.right + y[:, None, None] * rays.down
    points[..., 2] = z
    hidden = 0.999 * field.side * float(field.voxels.min())  # a speck within the rabbit
    asked = {
        "offset": hidden,
        "plane": "z",
        "at": 0.999,
        "spacing": field.side * float(np.ptp(field.voxels)) / 12,
    }
    viewer.set(camera, **asked)
    colours, ids = viewer.picture(*SIZE)
    within = ((points > field.origin) & (points < np.add(field.origin, field.side))).all(axis=2)
    assert ((colours[..., 3] > 0) == within).all()
    found = voxtool.query_adf(field, points[within], cell=True, bounds=True)
    shift = field.depth - found.level.astype(int)
    assert (ids[within][:, :3] == found.cell.astype(int) << shift[:, None]).all(
        axis=1
    ).mean() > 0.99
    dark = colours[within][:, 0] < 110  # the isolines
    spacing = asked["spacing"]
    from_line = np.abs(found.distance - spacing * np.rint(found.distance / spacing))
    pixel = float(np.linalg.norm(rays.right))
    assert dark.any()
    assert (from_line[dark] <= 0.8 * pixel).all()
    assert dark[from_line < 0.7 * pixel].all()
    viewer.set(camera, **asked, leaves="true")
    edges = (viewer.picture(*SIZE)[0] != colours).any(axis=2)
    assert edges.any()
    assert edges.mean() < 0.9
    viewer.set(camera, **asked, shows="bound")
    by_bound = viewer.picture(*SIZE)[0][within][:, :3]
    plain = from_line > pixel
    codes = {}
    for bound, colour in zip(found.bound[plain], by_bound[plain], strict=True):
        codes.setdefault(float(bound), set()).add(tuple(colour))
    assert len(codes) > 3
    assert all(len(colours) == 1 for colours in codes.values())


def test_the_plane_cuts_the_surface(field, viewer: Viewer) -> None:
    camera = voxtool.camera_for(field, "front")
    viewer.set(camera, plane="z", at=0.5, spacing=field.side * float(np.ptp(field.voxels)) / 12)
    cut, _ = viewer.picture(*SIZE)
    viewer.set(camera)
    whole, _ = viewer.picture(*SIZE)
    assert (cut[..., 3] >= whole[..., 3]).all()
    blue = (cut[..., 2] > cut[..., 0] + 20) & (whole[..., 3] > 0)
    assert blue.mean() > 0.05  # what is inside


def test_textures_are_those_of_the_file(field, models: Path) -> None:
    content = field_content(field)
    with h5py.File(models / "bunny.adf.h5") as file:
        for name in ("voxels", "cells", "hash", "bounds"):
            assert np.array_equal(content.arrays[name], np.asarray(file[name]))
        assert ("HAS_W" in content.defines) == (file["hash"].shape[-1] == 4)


def test_the_search_is_that_of_the_page_of_formats() -> None:
    text = (ROOT / "docs/formats.md").read_text(encoding="utf-8")
    shown = re.search(r"### A lookup in GLSL.*?```glsl\n(.*?)```", text, re.DOTALL)
    assert shown
    assets = ROOT / "voxtool/viewer/assets"
    assert (assets / "lookup.glsl").read_text(encoding="utf-8") == shown[1]
