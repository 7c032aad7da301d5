"""examples/models.py, by a server on this machine, and the table of docs/models.md."""

from __future__ import annotations

import hashlib
import importlib.util
import re
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from conftest import MODELS, model
from helpers.cli import ROOT

DATA = b"v 0 0 0\n" * 9000


class Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        if self.path == "/moved":
            self.send_response(302)
            self.send_header("Location", "/data")
            self.end_headers()
            return
        sent = {"/data": DATA, "/other": DATA[::-1], "/cut": DATA[:-1], "/long": DATA + b"#"}
        self.send_response(200 if self.path in sent else 404)
        self.end_headers()
        self.wfile.write(sent.get(self.path, b""))

    def log_message(self, format: str, *args: Any) -> None: ...


@pytest.fixture(scope="module")
def example() -> Any:
    spec = importlib.util.spec_from_file_location("models", ROOT / "examples/models.py")
    assert spec
    assert spec.loader
    found = sys.modules["models"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as served:
        threading.Thread(target=served.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{served.server_port}"
        served.shutdown()


@pytest.fixture
def local(example: Any, server: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The script, with models of this server, which its opener reaches by http."""

    def opener() -> urllib.request.OpenerDirector:
        return urllib.request.build_opener(urllib.request.ProxyHandler({}))

    monkeypatch.setattr(example, "opener", opener)
    monkeypatch.setattr(example, "COLLECTION", server)
    sha256 = hashlib.sha256(DATA).hexdigest()
    places = ("data", "moved", "other", "cut", "long", "absent", "")
    models = {f"{place or 'unknown'}.obj": (len(DATA), sha256, place) for place in places}
    monkeypatch.setattr(example, "MODELS", {n: example.Model(*m) for n, m in models.items()})
    return example


def test_models_are_fetched_and_left_where_they_are(local: Any, tmp_path: Path, capsys) -> None:
    words = ["-o", str(tmp_path / "models"), "data.obj", "moved.obj"]
    for said in (f"{len(DATA):,} bytes", "is there"):
        assert local.main(words) == 0
        assert capsys.readouterr().out.count(said) == 2
    found = sorted((tmp_path / "models").iterdir())
    assert [path.name for path in found] == ["data.obj", "moved.obj"]
    assert {path.read_bytes() for path in found} == {DATA}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("other.obj", "has SHA-256"),
        ("cut.obj", "has SHA-256"),
        ("long.obj", "is longer than 72,000 bytes"),
        ("absent.obj", "HTTP Error 404"),
        ("unknown.obj", "no address is known"),
    ],
)
def test_refusals_take_one_line_and_write_nothing(
    name: str, said: str, local: Any, tmp_path: Path, capsys
) -> None:
    (tmp_path / name).write_text("mine")
    assert local.main(["-o", str(tmp_path), name]) == 1
    message = capsys.readouterr().err
    assert said in message
    assert message.count("\n") == 1
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_only_https(example: Any, server: str, tmp_path: Path) -> None:
    model = example.Model(len(DATA), hashlib.sha256(DATA).hexdigest(), "")
    assert example.COLLECTION.startswith("https://")
    for url in (f"{server}/data", (ROOT / "README.md").as_uri()):
        with pytest.raises(urllib.error.URLError, match="unknown url type"):
            example.fetch(url, model, tmp_path / "a.obj", example.opener())
    assert not list(tmp_path.iterdir())


def test_unknown_names(example: Any, capsys) -> None:
    with pytest.raises(SystemExit):
        example.main(["cow.obj"])
    assert "no model cow.obj: choose from armadillo.obj" in capsys.readouterr().err


def test_the_page_has_the_same_sums(example: Any) -> None:
    page = (ROOT / "docs/models.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\S+)` \| ([\d,]+) \| `(\w{64})` \|$", page, re.M)
    sums = {name: (f"{m.size:,}", m.sha256) for name, m in example.MODELS.items()}
    assert {name: row for name, *row in rows} == {n: list(s) for n, s in sums.items()}
    assert all(page.count(f"| `{name}` |") == 2 for name in sums)


def test_the_models_of_tests_have_these_sums(example: Any) -> None:
    here = [name for name in example.MODELS if (MODELS / name).exists()]
    if not here:
        model(next(iter(example.MODELS)))  # skips, and names it
    assert all(example.is_there(MODELS / name, example.MODELS[name]) for name in here)
