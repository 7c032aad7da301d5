"""Pages that are served with their data beside them, to this machine alone."""

from __future__ import annotations

import contextlib
import http.client
import json
import signal
import subprocess
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from helpers_browser import Viewer
from helpers_cli import ENVIRONMENT, MODULE, fail

import voxtool
from voxtool.viewer.job import plan_view
from voxtool.viewer.serve import PageServer


@contextlib.contextmanager
def serving(octree: voxtool.Octree) -> Iterator[PageServer]:
    """Yield a server that runs in a thread."""
    with PageServer(plan_view(octree, "a", served=True).run()) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def answer(server: PageServer, path: str, host: str = "") -> tuple[int, bytes]:
    """Return the status and the body of a request."""
    connection = http.client.HTTPConnection(server.address, timeout=10)
    connection.request("GET", path, headers={"Host": host} if host else {})
    response = connection.getresponse()
    found = response.status, response.read()
    connection.close()
    return found


def test_the_data_are_beside_the_page() -> None:
    octree = voxtool.Octree.from_dense(np.random.default_rng(1).random((20, 9, 12)) < 0.3)
    inside = plan_view(octree, "a").run()
    with serving(octree) as server:
        assert server.server_address[0] == "127.0.0.1"
        status, text = answer(server, server.start)
        assert status == 200
        assert b"data-bricks" not in text
        assert b"connect-src 'self'" in text
        assert "connect-src" not in inside.html
        for name, array in inside.content.arrays.items():
            status, block = answer(server, f"{server.start}data/{name}")
            assert (status, len(zlib.decompress(block))) == (200, array.nbytes)


def test_nothing_else_is_answered() -> None:
    octree = voxtool.Octree.from_dense(np.ones((8, 8, 8)))
    with serving(octree) as server:
        for path in ("/", "/data/bricks", f"{server.start}../etc/passwd", f"{server.start}data/x"):
            assert answer(server, path)[0] == 404
        assert answer(server, server.start, host="evil.example")[0] == 404


@pytest.mark.slow
def test_a_browser_draws_a_served_page(browser) -> None:
    octree = voxtool.Octree.from_dense(np.random.default_rng(1).random((20, 9, 12)) < 0.3)
    with serving(octree) as server:
        viewer = Viewer(browser, server.url)
        colours, _ = viewer.picture(48, 40)
        expected = voxtool.render(octree, voxtool.camera_for(octree).rays(48, 40))
        assert np.mean(np.abs(colours - 255 * expected) <= 2) > 0.995
        assert {urlsplit(url).netloc for url in viewer.requests} == {server.address}
        assert viewer.errors == []
        viewer.close()


def test_the_command_serves_until_it_is_interrupted(here: Path) -> None:
    words = [*MODULE, "view", "bunny.svo.h5", "--serve", "--no-open", "--json"]
    with subprocess.Popen(words, env=ENVIRONMENT, stdout=subprocess.PIPE) as child:
        assert child.stdout
        lines = []
        while not lines or lines[-1] != b"}\n":
            lines.append(child.stdout.readline())
        found = urlsplit(json.loads(b"".join(lines))["url"])
        connection = http.client.HTTPConnection(found.netloc, timeout=10)
        connection.request("GET", found.path)
        assert connection.getresponse().status == 200
        connection.close()
        child.send_signal(signal.SIGINT)
        assert child.wait(20) == 130
    assert not Path("bunny.html").exists()
    assert "--serve writes no page" in fail("view bunny.svo.h5 --serve -o a.html", 2)
