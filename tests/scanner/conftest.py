"""Fixtures of the scanner's tests."""

from __future__ import annotations

import pytest

from holdfast.events import log_lines
from holdfast.events.throttle import Throttle


@pytest.fixture(autouse=True)
def _fresh_throttle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets no test use up the log lines of another."""
    monkeypatch.setattr(log_lines, "_REFUSALS", Throttle())
