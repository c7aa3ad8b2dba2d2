"""The log of a gateway, and pages of a browser."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast.events import log_lines
from holdfast.events.throttle import Throttle
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
    monkeypatch.setattr(log_lines, "_REFUSALS", Throttle(burst=10**6))
    records = web.Records()
    level = log_lines.LOGGER.level
    log_lines.LOGGER.addHandler(records)
    log_lines.LOGGER.setLevel("DEBUG")
    yield records
    log_lines.LOGGER.removeHandler(records)
    log_lines.LOGGER.setLevel(level)
