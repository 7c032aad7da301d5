"""The browser that all tests of pages share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from helpers_browser import open_browser


@pytest.fixture(scope="session")
def browser() -> Iterator:
    with open_browser() as browser:
        yield browser
