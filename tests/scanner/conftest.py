"""Fixtures of the scanner's tests."""

from __future__ import annotations

import pytest

from holdfast import logs


@pytest.fixture(autouse=True)
def _fresh_throttle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets no test use up the log lines of another."""
    monkeypatch.setattr(logs, "_REFUSALS", logs.Throttle())
