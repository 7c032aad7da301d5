"""Pages in Chromium, which draws on the processor by SwiftShader."""

from __future__ import annotations

import base64
import contextlib
import functools
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest

import voxtool
from voxtool.camera import Camera
from voxtool.viewer.job import plan_view

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
NAMES = {
    voxtool.Octree: "bunny.svo.h5",
    voxtool.DistanceField: "bunny.adf.h5",
    voxtool.TetVolume: "volume.tet.h5",
}
PATIENCE = 60  # seconds; SwiftShader compiles for some
SMALL = (96, 72)  # pixels of a tab: a page draws them all after every change
LARGE = (480, 360)  # there is room for the panel beside the pointer
ARGUMENTS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")

# Arrays come as text: Playwright checks lists one number at a time, in three processes.
PICTURE = """([width, height]) => {
    const text = (array) => {
        const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
        const letters = Array.from(bytes, (byte) => String.fromCharCode(byte));
        return [array.constructor.name, btoa(letters.join(""))];
    };
    const picture = voxtool.picture(width, height);
    return [text(picture.colours), text(picture.ids)];
}"""
TYPES = {"Uint8Array": "u1", "Uint8ClampedArray": "u1", "Uint32Array": "<u4", "Int32Array": "<i4"}


@functools.cache
def chromium() -> str:
    """The path of the browser, or "" where there is none."""
    return next(filter(None, map(shutil.which, CHROMIUM)), "")


@contextlib.contextmanager
def open_browser() -> Iterator[Any]:
    """Yield a browser for the tests of a process."""
    if not chromium():
        pytest.skip("no browser: install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=list(ARGUMENTS))
        yield browser
        browser.close()


class Viewer:
    """A page in a tab, and what it logs: errors and requests of the network."""

    def __init__(
        self, browser: Any, file: Path | str, before: str = "", size: tuple[int, int] = SMALL
    ) -> None:
        self.context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        self.tab = self.context.new_page()
        self.tab.set_default_timeout(1e3 * PATIENCE)
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.tab.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.tab.on("pageerror", lambda error: self.errors.append(str(error)))
        self.tab.on("request", lambda request: self.requests.append(request.url))
        if before:
            self.tab.add_init_script(before)
        self.tab.goto(file if isinstance(file, str) else file.absolute().as_uri())
        self.tab.wait_for_selector("body[data-ready]", state="attached")

    def close(self) -> None:
        self.context.close()

    def resize(self, width: int, height: int) -> None:
        """Give the tab another size; wait until the page is drawn in it."""
        self.tab.set_viewport_size({"width": width, "height": height})
        self.wait(
            f"!voxtool.view.busy && voxtool.view.target.width === {width} &&"
            f" voxtool.view.target.height === {height}"
        )

    def wait(self, condition: str) -> None:
        """Wait until an expression holds; the page's policy forbids Playwright's own way."""
        until = time.monotonic() + PATIENCE
        while not self.tab.evaluate(condition):
            assert time.monotonic() < until, condition
            time.sleep(0.02)

    @property
    def message(self) -> str:
        return self.tab.inner_text("#message")

    def set(self, camera: Camera, **settings: Any) -> None:
        """Set the state by the fragment of the address."""
        words = {n: ",".join(map(repr, getattr(camera, n))) for n in ("eye", "target", "up")}
        lens = {"height": camera.height} if camera.fov is None else {"fov": camera.fov}
        fragment = urlencode({**words, **lens, **settings})
        self.tab.evaluate(
            "fragment => new Promise(done => {"
            "  addEventListener('hashchange', () => setTimeout(done), {once: true});"
            "  location.hash = fragment; })",
            f"{fragment}&call={np.random.default_rng().integers(1 << 40)}",
        )

    def camera(self) -> Camera:
        found = self.tab.evaluate("voxtool.state().camera")
        vectors = (tuple(found[name]) for name in ("eye", "target", "up"))
        return Camera(*vectors, found["fov"], found["height"])

    def picture(self, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """Return colours from 0 to 255, premultiplied, and ids, each (height, width, 4)."""
        found = self.tab.evaluate(PICTURE, [width, height])
        shape = (height, width, 4)
        return tuple(
            np.frombuffer(base64.b64decode(text), TYPES[name]).astype(np.int64).reshape(shape)[::-1]
            for name, text in found
        )


def written(content: Any, folder: Path) -> Path:
    """Return a file with the page of content."""
    file, name = folder / "page.html", NAMES[type(content)]
    file.write_text(plan_view(content, name).run().html, encoding="utf-8")
    return file


@contextlib.contextmanager
def opened(browser: Any, file: Path) -> Iterator[Viewer]:
    """Yield the page of a file, which must log no error and ask no network."""
    viewer = Viewer(browser, file)
    assert viewer.message == ""
    yield viewer
    assert viewer.errors == []
    assert {url.partition(":")[0] for url in viewer.requests} <= {"file", "blob"}
    viewer.close()


def nearer(camera: Camera, share: float) -> Camera:
    """Return a camera whose eye has this share of the distance from its target."""
    ends = zip(camera.eye, camera.target, strict=True)
    return replace(camera, eye=tuple(t + share * (e - t) for e, t in ends))


def beside(mask: np.ndarray) -> np.ndarray:
    """Return the pixels that are or touch one of a mask, (H, W) bool."""
    padded = np.pad(mask, 1)
    height, width = mask.shape
    near = [padded[i : i + height, j : j + width] for i in range(3) for j in range(3)]
    return np.logical_or.reduce(near)


def jumps(picture: np.ndarray) -> np.ndarray:
    """Return the pixels within one of a discontinuity of a picture, 255 to a colour: where
    neighbours differ by more than 2."""
    found = np.zeros(picture.shape[:2], bool)
    down = (np.abs(np.diff(picture, axis=0)) > 2).any(axis=2)
    right = (np.abs(np.diff(picture, axis=1)) > 2).any(axis=2)
    found[1:] |= down
    found[:, 1:] |= right
    return beside(found)


def check_same(found: np.ndarray, expected: np.ndarray, share: float = 0.995) -> None:
    """Check that this share of pixels is within 2/255, and the others at discontinuities."""
    expected = 255.0 * expected
    far = (np.abs(found - expected) > 2).any(axis=2)
    assert far.mean() <= 1 - share, far.mean()
    assert not (far & ~jumps(expected)).any()
