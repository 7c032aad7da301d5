"""Pages of octrees in a browser, held against `voxtool render` of the same camera."""

from __future__ import annotations

import io
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import model
from helpers.browser import LARGE, Viewer, check_same, nearer, opened, written
from helpers.cli import run
from PIL import Image

import voxtool
from voxtool.camera import Camera
from voxtool.svo.pictures.raycast import depths

SIZE = (96, 80)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def octree(models: Path) -> voxtool.Octree:
    return voxtool.read_svo(models / "bunny.svo.h5")


@pytest.fixture(scope="module")
def page(octree: voxtool.Octree, tmp_path_factory) -> Path:
    return written(octree, tmp_path_factory.mktemp("pages"))


@pytest.fixture(scope="module")
def viewer(browser, page: Path) -> Iterator[Viewer]:
    with opened(browser, page) as viewer:
        yield viewer


def hits(octree: voxtool.Octree, camera: Camera, level: int | str = "voxel") -> np.ndarray:
    """Return the voxel that each ray meets, (H, W, 3); -1 for none."""
    rays = camera.rays(*SIZE)
    t = depths(octree, rays, level=level)[..., None]
    x, y = (np.arange(n) + 0.5 - n / 2 for n in SIZE)
    aside = x[None, :, None] * rays.right + y[:, None, None] * rays.down
    way = rays.direction + aside * rays.perspective
    start = rays.origin + aside * (not rays.perspective)
    grid = octree.grid
    seen = np.isfinite(t)
    place = start + (np.where(seen, t, 0) + 1e-5 * grid.pitch[0]) * way
    found = np.floor((place - grid.origin) / grid.pitch).astype(int)
    return np.where(seen, found, -1)


def check_ids(ids: np.ndarray, expected: np.ndarray) -> None:
    """Check that 99.5 % of the pixels name the node that holds the voxel."""
    side = 1 << np.maximum(ids[..., 3:] - 1, 0)
    within = ((ids[..., :3] <= expected) & (expected < ids[..., :3] + side)).all(axis=2)
    same = np.where(ids[..., 3] > 0, within, expected[..., 0] < 0)
    assert (ids[..., 3] > 0).mean() > 0.1
    assert same.mean() >= 0.995


CAMERAS = {
    "iso": ("iso", 30.0, 1.0),
    "front, parallel": ("front", None, 1.0),
    "near": ("left", 60.0, 0.35),
}


@pytest.mark.parametrize("level", ["voxel", 0, 1, 3])
@pytest.mark.parametrize("name", CAMERAS)
def test_the_picture_is_that_of_render(name: str, level, octree, viewer: Viewer) -> None:
    view, fov, share = CAMERAS[name]
    camera = nearer(voxtool.camera_for(octree, view, fov=fov), share)
    viewer.set(camera, level=level)
    colours, ids = viewer.picture(*SIZE)
    check_same(colours, voxtool.render(octree, camera.rays(*SIZE), level=level))
    check_ids(ids, hits(octree, camera, level))


def check_levels(octree: voxtool.Octree, levels, name: str, browser, folder: Path) -> None:
    """Check the pictures of some levels, from one page."""
    view, fov, share = CAMERAS[name]
    camera = nearer(voxtool.camera_for(octree, view, fov=fov), share)
    with opened(browser, written(octree, folder)) as viewer:
        for level in levels:
            viewer.set(camera, level=level)
            colours, ids = viewer.picture(*SIZE)
            check_same(colours, voxtool.render(octree, camera.rays(*SIZE), level=level))
            check_ids(ids, hits(octree, camera, level))


def test_cubes_reach_beyond_the_grid(browser, tmp_path: Path) -> None:
    """More than 1,024 voxels along one side: the page has several tables."""
    x, y, z = np.ogrid[:1100, :330, :8]
    plate = z < (x + y) % 100 / 10
    octree = voxtool.Octree.from_dense(plate)
    check_levels(octree, (5, 8), "iso", browser, tmp_path)


@pytest.mark.soak
@pytest.mark.long
@pytest.mark.parametrize("dim", [600, 1500])
@pytest.mark.parametrize("name", CAMERAS)
def test_every_level_of_large_octrees(name: str, dim: int, browser, tmp_path: Path) -> None:
    mesh = voxtool.load_mesh(model("stanford-bunny.obj"))
    octree = voxtool.voxelize(mesh, dim=dim, mode="solid", fill="winding")
    check_levels(octree, ("voxel", *range(octree.depth)), name, browser, tmp_path)


def test_a_page_that_ends_at_a_level(octree, browser, tmp_path: Path) -> None:
    page = tmp_path / "level.html"
    page.write_text(voxtool.plan_view(octree, "bunny.svo.h5", level=1).run().html, "utf-8")
    with opened(browser, page) as viewer:
        camera = voxtool.camera_for(octree, "iso")
        for level in (1, 3):
            viewer.set(camera, level=level)
            assert f"--level {level}" in viewer.tab.evaluate("voxtool.command()")
            colours, ids = viewer.picture(*SIZE)
            check_same(colours, voxtool.render(octree, camera.rays(*SIZE), level=level))
            check_ids(ids, hits(octree, camera, level))
        viewer.set(camera, level=0)  # which it does not have
        assert viewer.tab.input_value("#setting-level") == "1"


def test_nodes_by_coverage(octree, browser, tmp_path: Path) -> None:
    """The page starts with the isovalue, draws what render draws, and copies it; also the root."""
    page = tmp_path / "share.html"
    page.write_text(voxtool.plan_view(octree, "bunny.svo.h5", isovalue=0.6).run().html, "utf-8")
    with opened(browser, page) as viewer:
        camera = voxtool.camera_for(octree, "iso")
        for level, share in ((0, 0.6), (2, 0.6), (1, 0.9), (octree.depth - 1, 0.01)):
            viewer.set(camera, level=level, isovalue=share)
            assert f"--level {level} --isovalue {share}" in viewer.tab.evaluate("voxtool.command()")
            colours, _ = viewer.picture(*SIZE)
            how = {"level": level, "isovalue": share}
            drawn = voxtool.render(octree, camera.rays(*SIZE), **how)
            assert (drawn != voxtool.render(octree, camera.rays(*SIZE), level=level)).any() == (
                share > 0.1
            )
            check_same(colours, drawn)
        viewer.set(camera, level=octree.depth - 1, isovalue=0.99)
        assert not viewer.picture(*SIZE)[0].any()
        viewer.set(camera)
        assert "--isovalue" not in viewer.tab.evaluate("voxtool.command()")


def test_clipping_planes_remove_voxels(octree, viewer: Viewer) -> None:
    camera = voxtool.camera_for(octree, "iso")
    low, high = (50, 3, 0), (110, 60, 64)
    ends = {f"{axis}-from": n for axis, n in zip("xyz", low, strict=True)}
    viewer.set(camera, **ends, **{f"{axis}-to": n for axis, n in zip("xyz", high, strict=True)})
    _, ids = viewer.picture(*SIZE)
    left = np.zeros(octree.grid.shape, bool)
    part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    left[part] = octree.to_dense()[part]
    rest = voxtool.Octree.from_dense(left, octree.grid.origin, octree.grid.pitch)
    check_ids(ids, hits(rest, camera))


def test_colours_by_depth_normal_and_level(octree, viewer: Viewer) -> None:
    camera = voxtool.camera_for(octree, "front", fov=None)
    t = depths(octree, camera.rays(*SIZE))
    seen = np.isfinite(t)
    by = {}
    for paint in ("depth", "normal", "level"):
        viewer.set(camera, paint=paint)
        by[paint], ids = viewer.picture(*SIZE)
        assert ((by[paint][..., 3] == 255) == seen).mean() > 0.995
    assert np.corrcoef(by["depth"][..., 0][seen], t[seen])[0, 1] < -0.99
    towards = by["normal"][..., 2][seen]
    assert (towards >= 126).all()  # the front view looks along -z
    assert len(np.unique(ids[..., 3])) > 1
    lit = by["level"][seen].reshape(-1, 4)
    assert (lit[:, :3].max(axis=1) > lit[:, :3].min(axis=1) + 5).any()


@pytest.mark.usefixtures("large")
def test_keys_step_through_levels(octree, viewer: Viewer) -> None:
    viewer.set(voxtool.camera_for(octree))
    viewer.tab.focus("#picture")
    seen = []
    for key in ("-", "-", "+", "-", "+", "+", "+"):
        viewer.tab.keyboard.press(key)
        seen.append(viewer.tab.input_value("#setting-level"))
    assert seen == ["0", "1", "0", "1", "0", "voxel", "voxel"]


@pytest.mark.usefixtures("large")
def test_pointer_and_keys_move_the_camera(octree, viewer: Viewer) -> None:
    start = voxtool.camera_for(octree, "front")
    viewer.set(start)

    def distance(camera: Camera) -> float:
        return float(np.linalg.norm(np.subtract(camera.eye, camera.target)))

    tab = viewer.tab
    tab.mouse.move(100, 100)
    tab.mouse.down()
    tab.mouse.move(160, 130)
    tab.mouse.up()
    turned = viewer.camera()
    assert turned.target == start.target
    assert distance(turned) == pytest.approx(distance(start))
    assert turned.eye != start.eye
    tab.mouse.wheel(0, 300)
    viewer.wait(f"voxtool.state().camera.eye[0] !== {turned.eye[0]!r}")
    further = viewer.camera()
    assert distance(further) == pytest.approx(distance(turned) * np.exp(0.3))
    tab.mouse.down(button="right")
    tab.mouse.move(170, 130)
    tab.mouse.up(button="right")
    moved = viewer.camera()
    shift = np.subtract(moved.target, further.target)
    assert np.allclose(np.subtract(moved.eye, further.eye), shift)
    pixel = distance(further) * 2 * np.tan(np.radians(15)) / 360
    assert np.linalg.norm(shift) == pytest.approx(10 * pixel)
    tab.keyboard.down("w")
    viewer.wait(f"voxtool.state().camera.target[2] !== {moved.target[2]!r}")
    tab.keyboard.up("w")
    flown = np.subtract(viewer.camera().target, moved.target)
    way = np.subtract(moved.target, moved.eye)
    assert np.allclose(np.cross(flown, way), 0, atol=1e-9)
    assert np.dot(flown, way) > 0


@pytest.mark.usefixtures("large")
def test_two_fingers_zoom_and_move(octree, viewer: Viewer) -> None:
    start = voxtool.camera_for(octree, "front")
    viewer.set(start)
    fingers = viewer.context.new_cdp_session(viewer.tab)

    def touch(kind: str, *places: tuple[int, int]) -> Camera:
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
        before = json.dumps(viewer.tab.evaluate("JSON.stringify(voxtool.state().camera)"))
        fingers.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})
        if kind == "Move":  # the browser hands it out with its next frame
            viewer.wait(f"JSON.stringify(voxtool.state().camera) !== {before}")
        return viewer.camera()

    def distance(camera: Camera) -> float:
        return float(np.linalg.norm(np.subtract(camera.eye, camera.target)))

    assert touch("Start", (50, 100)) == touch("Start", (50, 100), (100, 100)) == start

    def under(camera: Camera, x: float, y: float) -> np.ndarray:
        """The point under a pixel, in the plane of the target; the view is along -z."""
        pixel = distance(camera) * 2 * np.tan(np.radians(15)) / 360
        return np.add(camera.target, [pixel * (x - 240), pixel * (180 - y), 0])

    nearer = touch("Move", (50, 100), (150, 100))
    assert distance(nearer) == pytest.approx(distance(start) / 2)
    assert under(nearer, 100, 100) == pytest.approx(under(start, 75, 100))
    aside = touch("Move", (50, 120), (150, 120))
    assert under(aside, 100, 120) == pytest.approx(under(start, 75, 100))
    moved = touch("Move", (80, 120), (180, 120))  # along the line of the fingers
    touch("End")
    assert distance(moved) == pytest.approx(distance(nearer))
    assert under(moved, 130, 120) == pytest.approx(under(start, 75, 100))
    assert np.subtract(moved.target, moved.eye) == pytest.approx([0, 0, -distance(moved)])
    turned = touch("Start", (50, 100))
    turned = touch("Move", (90, 100))
    touch("End")
    assert turned.target == moved.target
    assert turned.eye != moved.eye


def test_light_and_dark(viewer: Viewer) -> None:
    def luminance(name: str) -> float:
        colour = viewer.tab.evaluate(f"getComputedStyle(document.body).{name}")
        parts = np.array([int(part) for part in re.findall(r"\d+", colour)[:3]]) / 255
        linear = np.where(parts > 0.04045, ((parts + 0.055) / 1.055) ** 2.4, parts / 12.92)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    papers = []
    for scheme in ("light", "dark"):
        viewer.tab.emulate_media(color_scheme=scheme)
        paper, ink = luminance("backgroundColor"), luminance("color")
        assert (max(paper, ink) + 0.05) / (min(paper, ink) + 0.05) > 7  # WCAG 2, level AAA
        papers.append(paper)
    assert papers[0] > 0.9
    assert papers[1] < 0.1


@pytest.mark.usefixtures("large")
def test_the_copied_command_draws_the_picture(octree, viewer: Viewer, here: Path) -> None:
    viewer.set(voxtool.camera_for(octree, "right", up=(0.0, 0.0, 1.0)), level=1)
    viewer.context.grant_permissions(["clipboard-read", "clipboard-write"])
    viewer.tab.click("#copy")
    viewer.tab.wait_for_selector("#message:not([hidden])")
    command = viewer.message.partition(": ")[2]
    copied = viewer.tab.evaluate("voxtool.command()")
    assert command == copied
    words = shlex.split(command)
    assert words[:3] == ["voxtool", "render", "bunny.svo.h5"]
    run(f"{shlex.join(words[1:])} -q -o drawn.png")
    with viewer.tab.expect_download() as download:
        viewer.tab.click("#save")
    assert download.value.suggested_filename == "bunny.png"
    download.value.save_as("saved.png")
    drawn, saved = (np.asarray(Image.open(f"{name}.png")) for name in ("drawn", "saved"))
    check_same(saved, drawn / 255)
    viewer.set(voxtool.camera_for(octree), edges="true")
    viewer.tab.click("#copy")
    viewer.wait("document.getElementById('message').textContent.includes('no clipping, edges or')")


@pytest.mark.usefixtures("large")
def test_the_picture_is_seen_after_loading_and_in_another_size(octree, viewer: Viewer) -> None:
    viewer.set(voxtool.camera_for(octree))
    viewer.tab.evaluate("document.getElementById('panel').open = false")
    for width, height in (LARGE, LARGE, (300, 240), LARGE):
        viewer.resize(width, height)
        shot = viewer.tab.locator("#picture").screenshot()
        seen = np.asarray(Image.open(io.BytesIO(shot)))[..., :3].astype(int)
        assert np.ptp(seen[height // 2 - 20 : height // 2 + 20, 20 : width // 2 - 20]) > 100


@pytest.mark.usefixtures("large")
def test_the_pointer_names_the_voxel(octree, viewer: Viewer) -> None:
    camera = voxtool.camera_for(octree, "front")
    viewer.set(camera)
    viewer.tab.evaluate("document.getElementById('panel').open = false")
    viewer.tab.focus("#picture")
    viewer.tab.keyboard.press("Escape")  # the message of another test
    viewer.wait("!voxtool.view.busy && voxtool.view.target.width === 480")
    viewer.tab.mouse.move(240, 180)
    viewer.wait("document.getElementById('pointed').textContent")
    said = re.match(r"voxel (\d+), (\d+), (\d+); world", viewer.tab.inner_text("#pointed"))
    assert said
    rays = camera.rays(480, 360)
    grid = octree.grid
    way = rays.direction + 0.5 * rays.right + 0.5 * rays.down
    arm = grid.origin + np.array(grid.pitch) * (np.array([int(n) + 0.5 for n in said.groups()]))
    arm -= rays.origin
    aside = arm - np.dot(arm, way) / np.dot(way, way) * way
    assert np.linalg.norm(aside) < grid.pitch[0]
    assert octree.to_dense()[tuple(map(int, said.groups()))]


def test_the_state_is_in_the_address(octree, browser, page: Path, viewer: Viewer) -> None:
    camera = voxtool.camera_for(octree, "top", fov=None)
    viewer.set(camera, level=2, edges="true")
    viewer.wait("!location.hash.includes('call')")
    fragment = viewer.tab.evaluate("location.hash")
    assert "level=2" in fragment
    assert "paint" not in fragment  # as at the start
    viewer.set(voxtool.camera_for(octree))
    viewer.tab.evaluate("fragment => { location.hash = fragment }", fragment)
    viewer.wait("voxtool.state().settings.level === '2'")
    assert viewer.camera() == camera
    for nonsense in ("#eye=1,2&fov=x&level=9&x-from=1e9", "#eye=0,0,0&target=0,0,0", "#%%%"):
        viewer.tab.evaluate("fragment => { location.hash = fragment }", nonsense)
        viewer.wait("voxtool.state().settings.level === 'voxel'")
        assert viewer.camera().fov == 30.0


def test_a_new_address_outlives_the_late_writing_of_the_state_before(
    octree, viewer: Viewer
) -> None:
    viewer.set(voxtool.camera_for(octree))
    viewer.set(voxtool.camera_for(octree), level=2)
    viewer.tab.evaluate(
        "old => new Promise(done => {"
        "  addEventListener('hashchange', () => setTimeout(done), {once: true});"
        "  location.hash = 'level=1';"
        "  history.replaceState(null, '', old); })",  # as the page does 200 ms after a change
        "#level=2",
    )
    assert viewer.tab.evaluate("voxtool.state().settings.level") == "1"
    viewer.wait("location.hash.includes('level=1')")


# ---- what goes wrong


def test_a_browser_without_webgl(browser, page: Path) -> None:
    viewer = Viewer(browser, page, before="HTMLCanvasElement.prototype.getContext = () => null;")
    assert "no WebGL 2" in viewer.message
    assert "voxtool render bunny.svo.h5" in viewer.message
    viewer.close()


def test_textures_that_are_too_small(browser, page: Path) -> None:
    less = (
        "const get = WebGL2RenderingContext.prototype.getParameter;"
        "WebGL2RenderingContext.prototype.getParameter = function (name) {"
        "  return name === this.MAX_TEXTURE_SIZE ? 16 : get.call(this, name); };"
    )
    viewer = Viewer(browser, page, before=less)
    assert re.match(r"This browser's textures have 16 rows, and the nodes need", viewer.message)
    viewer.close()


def test_a_lost_context(browser, page: Path) -> None:
    viewer = Viewer(browser, page)
    viewer.tab.evaluate("voxtool.view.gl.getExtension('WEBGL_lose_context').loseContext()")
    viewer.tab.wait_for_selector("#message:not([hidden])")
    assert "lost" in viewer.message
    viewer.close()


@pytest.mark.parametrize("shape", [(8, 5, 3), (16, 16, 16)])
def test_small_octrees_and_markup_in_attributes(shape, browser, tmp_path: Path) -> None:
    evil = "</script><script>document.title = 'evil'</script><b>"
    full = voxtool.Octree.from_dense(np.ones(shape, bool), units=evil, pitch=(1.0, 1.5, 0.5))
    viewer = Viewer(browser, written(full, tmp_path), size=LARGE)
    camera = voxtool.camera_for(full)
    colours, ids = viewer.picture(*SIZE)
    check_same(colours, voxtool.render(full, camera.rays(*SIZE)))
    check_ids(ids, hits(full, camera))
    viewer.tab.evaluate("document.getElementById('panel').open = false")
    viewer.wait("!voxtool.view.busy && voxtool.view.target")
    viewer.tab.mouse.move(240, 180)
    viewer.wait("document.getElementById('pointed').textContent")
    assert evil in viewer.tab.text_content("#pointed")
    assert viewer.tab.title() == "octree bunny.svo.h5"
    assert viewer.errors == []
    viewer.close()
