"""The browser that all tests of pages share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from helpers_browser import LARGE, SMALL, Viewer, open_browser


@pytest.fixture(scope="session")
def browser() -> Iterator:
    with open_browser() as browser:
        yield browser


@pytest.fixture
def large(viewer: Viewer) -> Iterator[None]:
    """The tab of `viewer` has room for the pointer and the panel."""
    viewer.resize(*LARGE)
    yield
    viewer.resize(*SMALL)
