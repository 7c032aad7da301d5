"""Pages that are served with their data beside them, to this machine alone."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import socket
import struct
import subprocess
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from helpers.browser import Viewer
from helpers.cli import ENVIRONMENT, MODULE, fail

import voxtool
from voxtool.viewer import serve
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


REQUEST = "GET {start} HTTP/1.1\r\nHost: {address}\r\n\r\n"


@pytest.mark.parametrize("reset", [False, True])
def test_a_connection_may_stop_at_every_point(reset: bool, capfd, monkeypatch) -> None:
    """It ends, after a while at the latest, nothing is printed, and others are answered."""
    monkeypatch.setattr(serve, "IDLE", 0.4)
    monkeypatch.setattr(serve, "STALLED", 0.4)
    octree = voxtool.Octree.from_dense(np.ones((8, 8, 8)))
    with serving(octree) as server:
        server.contents[server.start] = bytes(30 << 20)  # more than buffers take
        request = REQUEST.format(start=server.start, address=server.address).encode()
        before = threading.active_count()
        left = []
        for sent in (0, 1, 20, len(request) - 1, len(request)):
            for taken in (0, 1, 5 << 20) if sent == len(request) else (0,):
                connection = socket.create_connection(server.server_address)
                connection.sendall(request[:sent])
                while taken > 0:
                    taken -= len(connection.recv(min(taken, 1 << 16)))
                if reset:  # as a browser that reloads
                    linger = struct.pack("ii", 1, 0)
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
                    connection.close()
                else:
                    left.append(connection)
        assert answer(server, server.start)[0] == 200
        end = time.monotonic() + 20
        while threading.active_count() > before and time.monotonic() < end:
            time.sleep(0.05)
        assert threading.active_count() == before
        for connection in left:
            connection.close()
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(os.name == "nt", reason="limits of POSIX")
def test_a_server_without_descriptors_waits(capfd, monkeypatch) -> None:
    """It does not spin, and answers once connections end."""
    import resource

    monkeypatch.setattr(serve, "IDLE", 1.0)
    octree = voxtool.Octree.from_dense(np.ones((8, 8, 8)))
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with serving(octree) as server:
        clients = [socket.socket() for _ in range(20)]
        most = max(map(int, os.listdir("/proc/self/fd"))) + 9  # less than clients
        with contextlib.ExitStack() as stack:
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, limits[1]))
            stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, limits)
            for client in clients:
                client.connect(server.server_address)
            before = time.process_time()
            time.sleep(0.6)
            assert time.process_time() - before < 0.3
        time.sleep(0.6)
        assert answer(server, server.start)[0] == 200
        for client in clients:
            client.close()
    assert capfd.readouterr() == ("", "")


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
