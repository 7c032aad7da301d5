"""Pages of volumes in a browser, held against `voxtool render` of the same camera."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from golden import picture as golden_picture
from helpers.browser import Viewer, check_same, opened, written
from helpers.cli import run
from PIL import Image

import voxtool
from voxtool.camera import Camera
from voxtool.selftest.reference import segments
from voxtool.tets.pictures.transfer import TransferFunction, default_transfer, named
from voxtool.viewer.job import plan_view

SIZE = (72, 60)
SHARE = 0.999  # of pixels within 2/255
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def volume(models: Path) -> voxtool.TetVolume:
    return voxtool.read_tet(models / "volume.tet.h5")


@pytest.fixture(scope="module")
def viewer(browser, volume: voxtool.TetVolume, tmp_path_factory) -> Iterator[Viewer]:
    with opened(browser, written(volume, tmp_path_factory.mktemp("pages"))) as viewer:
        yield viewer


def setting(transfer: TransferFunction) -> str:
    """Return a transfer function as the page's setting."""
    rows = np.column_stack([transfer.scalars, transfer.colours, transfer.extinctions])
    return ";".join(",".join(map(repr, row)) for row in rows.tolist())


def check_picture(
    viewer: Viewer, volume, camera: Camera, transfer: TransferFunction | None, **surfaces: Any
) -> None:
    """Check a picture through a transfer function, or of isosurfaces alone, whose settings are
    those of `voxtool.render`."""
    settings: dict[str, Any] = {"transfer": setting(transfer)} if transfer else {}
    if surfaces:
        values = ",".join(map(str, surfaces["isovalues"]))
        settings |= {"isovalues": values, "within": "true" if transfer else "false"}
        settings["opacity"] = surfaces.get("opacity", 1)
        if "colour" in surfaces:
            tint = bytes(round(255 * c) for c in surfaces["colour"]).hex()
            settings |= {"tinted": "true", "tint": f"#{tint}"}
    viewer.set(camera, **settings)
    colours, _ = viewer.picture(*SIZE)
    expected = voxtool.render(volume, camera.rays(*SIZE), transfer=transfer, **surfaces)
    assert (expected[..., 3] > 0.05).mean() > 0.1
    check_same(colours, expected, SHARE)


def cameras(volume: voxtool.TetVolume) -> dict[str, Camera]:
    low, high = volume.bounds()
    middle, side = (low + high) / 2, float((high - low).max())
    eye, target = (tuple((middle + s * side).tolist()) for s in (0.1, -1.0))
    within = Camera(eye, target, (0.0, 1.0, 0.0), 90.0)
    return {
        "iso": voxtool.camera_for(volume, "iso"),
        "parallel": voxtool.camera_for(volume, "right", fov=None),
        "within": within,
    }


STEPS = [(0.2, 0.2, 0.5, 0.5, 0.9), [0.0, 2.0, 2.0, 0.0, 30.0]]  # scalars and extinctions


@pytest.mark.parametrize("name", ["iso", "parallel", "within"])
@pytest.mark.parametrize("function", ["default", "steps", "everywhere", "spikes"])
def test_the_picture_is_that_of_render(name: str, function: str, volume, viewer: Viewer) -> None:
    low, high = volume.scalar_range
    transfer = default_transfer(volume)
    if function == "steps":
        colours = np.random.default_rng(4).random((5, 3))
        at = low + (high - low) * np.array(STEPS[0])
        transfer = TransferFunction(at, colours, np.array(STEPS[1]))
    elif function == "spikes":  # the last two are narrower than float32 tells apart
        wide = (high - low) * np.array([1e-3, 1e-9, 1e-14])
        starts = low + (high - low) * np.array([0.1, 0.2, 0.4])
        at = starts[:, None] + wide[:, None] * np.arange(3)
        steep = (high - low) / wide[:, None] * np.array([0.0, 3.0, 0.0])
        colours = np.random.default_rng(4).random((9, 3))
        transfer = TransferFunction(at.ravel(), colours, steep.ravel())
    elif function == "everywhere":
        transfer = named("turbo", low - 1, high + 1, 1.0, (low - 2, high))
    check_picture(viewer, volume, cameras(volume)[name], transfer)


ORANGE = (1.0, 128 / 255, 0.0)


@pytest.mark.parametrize(
    ("name", "shares", "options", "within"),
    [
        ("iso", (0.12,), {"colour": ORANGE}, False),
        ("parallel", (0.5, 0.1, 0.3, 0.1), {"opacity": 0.4}, False),
        ("iso", (0.1, 0.3), {"opacity": 0.5}, True),
        ("parallel", (0.4,), {"colour": ORANGE}, True),
        ("within", (0.2, 0.5, 2.0), {"opacity": 0.7}, True),
    ],
)
def test_isosurfaces_are_those_of_render(
    name: str, shares: tuple[float, ...], options: dict[str, Any], within: bool, volume, viewer
) -> None:
    low, high = volume.scalar_range
    isovalues = [low + (high - low) * share for share in shares]
    transfer = named("turbo", low, high, 2.0, (low, high)) if within else None
    check_picture(viewer, volume, cameras(volume)[name], transfer, isovalues=isovalues, **options)


@pytest.mark.parametrize("name", ["iso", "parallel", "within"])
def test_ids_are_the_cells_that_rays_enter_first(name: str, volume, viewer: Viewer) -> None:
    camera = cameras(volume)[name]
    if name == "parallel":
        camera = camera.turned(7)  # no ray meets a diagonal, which two cells share
    viewer.set(camera)
    _, ids = viewer.picture(*SIZE)
    rows, columns = np.indices(SIZE[::-1]).reshape(2, -1)
    rays, scalars = camera.rays(*SIZE), volume.vertices[:, 3]
    pixels = np.stack([columns, rows], axis=1)
    (found,) = segments(volume.points(), volume.cells, scalars, rays, pixels, most=1 << 30)
    passed = found.length > 1e-6
    seen, first = np.unique(found.pixel[passed], return_index=True)  # they are sorted by depth
    expected = np.full(len(pixels), -1)
    expected[seen] = found.cell[passed][first]
    entered = np.where(ids[..., 3] > 0, ids[..., 0], -1).ravel()
    assert (expected >= 0).mean() > 0.3
    assert (entered == expected).mean() >= 0.995


@pytest.mark.parametrize("name", ["holes", "hexahedra"])
def test_other_volumes(name: str, browser, tmp_path: Path) -> None:
    volume = golden_picture.own_volume(name)
    low, high = volume.bounds()
    transfer = named("viridis", *volume.scalar_range, float((high - low).max()) / 8)
    with opened(browser, written(volume, tmp_path)) as viewer:
        check_picture(viewer, volume, cameras(volume)["iso"], transfer)
        shown = viewer.tab.locator("#setting-isovalues").count()
        assert shown == (not volume.constant)
        if shown:
            camera, isovalues = cameras(volume)["iso"], np.quantile(volume.scalar_range, (0.3, 0.7))
            check_picture(viewer, volume, camera, None, isovalues=isovalues.tolist(), opacity=0.6)


def test_the_histogram_is_of_volume() -> None:
    volume = golden_picture.own_volume("holes")
    bars, scalars = np.zeros(64), volume.vertices[:, 3]
    for cell in volume.cells:
        a, *others = volume.vertices[cell, :3].astype(float)
        size = abs(np.linalg.det(np.array(others) - a))
        for scalar in scalars[cell]:
            bars[min(int(64 * scalar), 63)] += size
    found = plan_view(volume, "a").plan.content.facts["histogram"]
    assert np.allclose(found, bars / bars.max(), atol=1e-3)


def test_table_4_becomes_table_5(browser, tmp_path: Path, here: Path) -> None:
    run("tet-build volume.vtu --scalar density --layout projection -o p.tet.h5 -q")
    volume = voxtool.read_tet("p.tet.h5")
    with opened(browser, written(volume, tmp_path)) as viewer:
        check_picture(viewer, volume, cameras(volume)["iso"], default_transfer(volume))


@pytest.mark.usefixtures("large")
def test_the_editor_of_the_transfer_function(volume, viewer: Viewer, tmp_path: Path) -> None:
    transfer = default_transfer(volume)
    viewer.set(cameras(volume)["iso"], transfer=setting(transfer))
    viewer.tab.evaluate("document.getElementById('message').hidden = true")

    def points() -> list[dict]:
        return voxtool_points(viewer.tab.evaluate("voxtool.state().settings.transfer"))

    before, drawn = points(), viewer.picture(*SIZE)[0]
    assert [p["scalar"] for p in before] == transfer.scalars.tolist()
    editor = viewer.tab.locator("canvas[role=application]")
    editor.focus()
    viewer.tab.keyboard.press("n")  # the second point
    for _ in range(3):
        viewer.tab.keyboard.press("ArrowUp")
    moved = points()
    assert moved[1]["extinction"] > 0
    assert moved[0] == before[0]
    assert (viewer.picture(*SIZE)[0] != drawn).any()  # in the next frame
    editor.dblclick(position={"x": 150, "y": 30})
    added = points()
    assert len(added) == len(before) + 1
    viewer.tab.keyboard.press("Delete")
    assert points() == moved
    box = editor.bounding_box()
    viewer.tab.mouse.move(box["x"] + box["width"] - 5, box["y"] + 30)
    editor.hover(position={"x": 3, "y": box["height"] - 4})
    viewer.tab.mouse.down()
    viewer.tab.mouse.move(box["x"] + 3, box["y"] + 20)
    viewer.tab.mouse.up()
    assert points()[0]["extinction"] > 0
    viewer.tab.fill("input[type=color]", "#ff0000")
    assert points()[0]["color"] == [1, 0, 0]
    with viewer.tab.expect_download() as download:
        viewer.tab.click("#transfer-save")
    download.value.save_as(tmp_path / "saved.json")
    saved = voxtool.read_transfer(tmp_path / "saved.json")
    assert json.loads(saved.to_json())["points"] == points()
    file = tmp_path / "other.json"
    file.write_text(named("gray", *volume.scalar_range, 0.5).to_json())
    before = viewer.tab.evaluate("voxtool.state().settings.transfer")
    viewer.tab.set_input_files("#transfer-load", file)
    viewer.wait(f"voxtool.state().settings.transfer !== {before!r}")
    assert points() == json.loads(file.read_text())["points"]
    file.write_text('{"points": [{"scalar": 1}]}')
    viewer.tab.set_input_files("#transfer-load", file)
    viewer.wait("!document.getElementById('message').hidden")
    assert "needs 1 to 255 points" in viewer.message


def voxtool_points(text: str) -> list[dict]:
    """Return the control points of a setting as in JSON."""
    rows = [list(map(float, word.split(","))) for word in text.split(";")]
    return [{"scalar": s, "color": [r, g, b], "extinction": e} for s, r, g, b, e in rows]


@pytest.mark.usefixtures("large")
def test_the_fields_of_isosurfaces(volume, viewer: Viewer) -> None:
    viewer.set(cameras(volume)["iso"])
    before = viewer.picture(*SIZE)[0]
    field = viewer.tab.locator("#setting-isovalues")
    for wrong in ("0.4,x", ",".join(map(str, range(65)))):
        field.fill(wrong)
        field.blur()
        assert viewer.tab.evaluate("voxtool.state().settings.isovalues") == ""
        assert "Write up to 64 numbers" in field.evaluate("f => f.validationMessage")
    field.fill("5, 3,5")
    field.press("Enter")
    viewer.tab.fill("#setting-tint", "#ff0000")
    viewer.tab.check("#setting-tinted")
    lit = viewer.picture(*SIZE)[0][..., :3].any(axis=(0, 1))
    assert lit.tolist() == [True, False, False]
    assert viewer.tab.evaluate("voxtool.command()").endswith(" --isovalue=3,5 --colour '#ff0000'")
    viewer.tab.check("#setting-within")
    assert (viewer.picture(*SIZE)[0][..., 1] > 0).any()
    field.fill("")
    field.blur()
    assert (viewer.picture(*SIZE)[0] == before).all()


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"isovalues": "3,6", "opacity": "0.5", "tinted": "true", "tint": "#ff8000"},
        {"isovalues": "4", "within": "true"},
    ],
)
def test_the_copied_command(settings: dict[str, str], volume, viewer: Viewer, here: Path) -> None:
    viewer.set(cameras(volume)["iso"], **settings)
    words = shlex.split(viewer.tab.evaluate("voxtool.command()"))
    assert words[2] == "volume.tet.h5"
    size = words.index("--size") + 1
    words[size] = f"{SIZE[0]}x{SIZE[1]}"
    run(f"{shlex.join(words[1:])} -q -o drawn.png")
    straight = np.asarray(Image.open("drawn.png")) / 255
    colours, _ = viewer.picture(*SIZE)
    over_white = colours[..., :3] + 255.0 - colours[..., 3:]
    expected = 255 * (straight[..., :3] * straight[..., 3:] + 1 - straight[..., 3:])
    assert (np.abs(over_white - expected) > 2).any(axis=2).mean() <= 1 - SHARE


@pytest.mark.usefixtures("large")
def test_the_copied_command_names_the_saved_file(volume, viewer: Viewer, here: Path) -> None:
    """The line says to save the transfer function first; then the command draws the picture."""
    changed = setting(named("gray", *volume.scalar_range, 1.0))
    viewer.set(cameras(volume)["iso"], transfer=changed)
    viewer.context.grant_permissions(["clipboard-read", "clipboard-write"])
    viewer.tab.click("#copy")
    viewer.wait("document.getElementById('message').textContent.startsWith('Copied')")
    note, _, command = viewer.message.partition(": voxtool ")
    assert note == "Copied (first save its transfer function: Save JSON)"
    assert command.endswith(" --transfer volume.transfer.json")
    with viewer.tab.expect_download() as download:
        viewer.tab.click("#transfer-save")
    download.value.save_as("volume.transfer.json")
    words = shlex.split(command)
    words[words.index("--size") + 1] = f"{SIZE[0]}x{SIZE[1]}"
    place = words.index("--background")
    run(f"{shlex.join(words[:place] + words[place + 2 :])} -q --float -o drawn.npy")
    colours, _ = viewer.picture(*SIZE)
    check_same(colours, np.load("drawn.npy"), SHARE)
    viewer.set(cameras(volume)["iso"])
    viewer.tab.click("#copy")
    viewer.wait("document.getElementById('message').textContent.startsWith('Copied: voxtool')")
