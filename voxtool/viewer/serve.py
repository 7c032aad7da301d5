"""Serving a page and its data to browsers of this machine, for data that no page holds.

The server listens on the loopback address alone. Its addresses begin with a random word, and the
name of the host is checked, so that no page of another site reaches the data. A connection that
asks nothing, or takes nothing, is closed after a while; a lost connection is not reported.
"""

from __future__ import annotations

import io
import secrets
import sys
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from socket import socket
    from typing import Any

    from voxtool.viewer.page import Page

HOST = "127.0.0.1"
IDLE = 20.0  # seconds for a request to arrive
STALLED = 120.0  # seconds for a piece of an answer to be taken: pages decompress what they take
PIECE = 1 << 20  # bytes of an answer
LONGEST = 1 << 16  # bytes of a request
PAUSE = 0.2  # seconds to wait for a descriptor or a thread
TYPES = {True: "text/html; charset=utf-8", False: "application/octet-stream"}  # the page, or data


class PageServer(ThreadingHTTPServer):
    """A server of one page; `url` is its address. Leaving the context closes it."""

    request_queue_size = 128  # a browser asks for all data at once

    def __init__(self, page: Page) -> None:
        super().__init__((HOST, 0), _Handler)
        word = secrets.token_urlsafe(16)
        self.address = f"{HOST}:{self.server_port}"
        self.start = f"/{word}/"
        self.url = f"http://{self.address}{self.start}"
        data = {f"{self.start}data/{name}": block for name, block in page.blocks.items()}
        self.contents = {self.start: page.html.encode(), **data}

    def get_request(self) -> tuple[socket, Any]:
        """Return the next connection."""
        try:
            return super().get_request()
        except OSError:  # no descriptor is free: without a pause the server would ask on and on
            time.sleep(PAUSE)
            raise

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a connection that was closed or stands still, or has no thread."""
        if not isinstance(sys.exception(), (OSError, RuntimeError)):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: PageServer

    def setup(self) -> None:
        """Read the request, whose parts may not come one by one for ever."""
        super().setup()
        end, request = time.monotonic() + IDLE, b""
        while b"\r\n\r\n" not in request and len(request) < LONGEST:
            self.connection.settimeout(max(end - time.monotonic(), 0.001))
            part = self.connection.recv(LONGEST)
            if not part:
                break
            request += part
        self.connection.settimeout(STALLED)
        self.rfile = io.BytesIO(request)

    def do_GET(self) -> None:
        content = self.server.contents.get(self.path)
        if self.headers.get("Host") != self.server.address or content is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", TYPES[self.path == self.server.start])
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        for start in range(0, len(content), PIECE):
            self.wfile.write(content[start : start + PIECE])

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: stderr is the command's."""
