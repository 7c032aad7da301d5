"""Serving a page and its data to browsers of this machine, for data that no page holds.

The server listens on the loopback address alone. Its addresses begin with a random word, and the
name of the host is checked, so that no page of another site reaches the data.
"""

from __future__ import annotations

import secrets
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from voxtool.viewer.page import Page

HOST = "127.0.0.1"
TYPES = {True: "text/html; charset=utf-8", False: "application/octet-stream"}  # the page, or data


class PageServer(ThreadingHTTPServer):
    """A server of one page; `url` is its address. Leaving the context closes it."""

    def __init__(self, page: Page) -> None:
        super().__init__((HOST, 0), _Handler)
        word = secrets.token_urlsafe(16)
        self.address = f"{HOST}:{self.server_port}"
        self.start = f"/{word}/"
        self.url = f"http://{self.address}{self.start}"
        data = {f"{self.start}data/{name}": block for name, block in page.blocks.items()}
        self.contents = {self.start: page.html.encode(), **data}


class _Handler(BaseHTTPRequestHandler):
    server: PageServer

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
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: stderr is the command's."""
