"""Every case of the corpus ends with a result or one clear line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from conftest import opened, usable_devices

from . import corpus, samples
from .worker import Worker

LIMIT = 9.0  # seconds of processor time; most cases take a tenth
pytestmark = pytest.mark.slow


def cases(render: bool) -> list:
    """Return the entries that render, or the others."""
    chosen = (e for e in corpus.entries() if e.command.startswith("render") == render)
    return [pytest.param(entry, id=ascii(entry.name)) for entry in chosen]


@contextmanager
def worker_for(index: int, folder: Path) -> Iterator[Worker]:
    samples.write_all(folder, opened(index))
    worker = Worker(folder, str(index), LIMIT)
    try:
        yield worker
    finally:
        worker.stop()


@pytest.fixture(scope="module")
def one_worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Worker]:
    with worker_for(usable_devices()[0][0], tmp_path_factory.mktemp("one")) as worker:
        yield worker


@pytest.fixture(scope="module")
def worker(device_index: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Worker]:
    with worker_for(device_index, tmp_path_factory.mktemp("each")) as worker:
        yield worker


@pytest.mark.parametrize("entry", cases(render=False))
def test_on_one_driver(entry: corpus.Entry, one_worker: Worker) -> None:
    assert not one_worker.ask(entry.case(one_worker.device))


@pytest.mark.every_driver
@pytest.mark.parametrize("entry", cases(render=True))
def test_on_every_driver(entry: corpus.Entry, worker: Worker) -> None:
    assert not worker.ask(entry.case(worker.device))
