"""Pages in Firefox, which draws on the processor by Mesa, as Chromium's tests do by SwiftShader.

Firefox has no WebGL without a display, so Xvfb has one. Marionette is Mozilla's own driver.
"""

from __future__ import annotations

import contextlib
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.browser import NAMES, PATIENCE, check_same, written

import voxtool

SIZE = (72, 60)
FIREFOX = next(filter(None, map(shutil.which, ("firefox-esr", "firefox"))), "")
PICTURE = (
    "const p = window.wrappedJSObject.voxtool.picture(arguments[0], arguments[1]);"
    "return [[...p.colours], [...p.ids]];"
)
SHARES = {"octree": 0.995, "field": 0.995, "volume": 0.999}  # of pixels within 2/255
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def firefox(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A session of Firefox on a display of its own."""
    if not (FIREFOX and shutil.which("Xvfb")):
        pytest.skip("no Firefox, or no display for it: install firefox-esr and xvfb")
    driver = pytest.importorskip("marionette_driver")
    folder = tmp_path_factory.mktemp("firefox")
    screen = ("Xvfb", "-displayfd", "1", "-screen", "0", "640x480x24", "-nolisten", "tcp")
    with (
        subprocess.Popen(screen, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as xvfb,
        contextlib.ExitStack() as last,
    ):
        last.callback(xvfb.terminate)
        assert xvfb.stdout
        patch = last.enter_context(pytest.MonkeyPatch.context())
        patch.setenv("DISPLAY", f":{int(xvfb.stdout.readline())}")
        patch.setenv("LIBGL_ALWAYS_SOFTWARE", "1")
        patch.setenv("HOME", str(folder))
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        client = driver.marionette.Marionette(
            bin=FIREFOX, port=port, prefs={"webgl.force-enabled": True},
            gecko_log=str(folder / "gecko.log"), startup_timeout=2 * PATIENCE,
        )  # fmt: skip
        last.callback(client.cleanup)
        client.start_session()
        yield client


@pytest.mark.parametrize("kind", SHARES)
def test_the_picture_is_that_of_render(kind: str, firefox, models: Path, tmp_path: Path) -> None:
    names = dict(zip(SHARES, NAMES.values(), strict=True))
    read = {"octree": voxtool.read_svo, "field": voxtool.read_adf, "volume": voxtool.read_tet}
    from marionette_driver import Wait

    content = read[kind](models / names[kind])
    firefox.navigate(written(content, tmp_path).as_uri())
    ready = "return document.body.hasAttribute('data-ready')"
    Wait(firefox, PATIENCE).until(lambda tab: tab.execute_script(ready))
    assert firefox.execute_script("return document.getElementById('message').hidden")
    flat = firefox.execute_script(PICTURE, script_args=SIZE)
    colours, ids = (np.array(values).reshape(*SIZE[::-1], 4)[::-1] for values in flat)
    camera = voxtool.camera_for(content)
    check_same(colours, voxtool.render(content, camera.rays(*SIZE)), SHARES[kind])
    assert ((ids[..., 3] > 0) >= (colours[..., 3] > 0)).all()
    assert (colours[..., 3] > 0).mean() > 0.1
