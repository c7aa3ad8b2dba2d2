"""The log of a gateway, and pages of a browser."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast import logs
from support import web
from support.gateway_pages import Pages, browsing

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="module")
def pages() -> Iterator[Pages]:
    # Not longer: while Playwright runs, a test in the same thread can't run an event loop.
    with browsing() as browser:
        yield Pages(browser)


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> Iterator[web.Records]:
    """All that the project logs, nothing held back."""
    monkeypatch.setattr(logs, "_REFUSALS", logs.Throttle(burst=10**6))
    records = web.Records()
    level = logs.LOGGER.level
    logs.LOGGER.addHandler(records)
    logs.LOGGER.setLevel("DEBUG")
    yield records
    logs.LOGGER.removeHandler(records)
    logs.LOGGER.setLevel(level)
