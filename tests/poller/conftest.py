"""A poller for tests that give it devices."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast.appliance import running
from support.native_poller import ReportingPoller

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def poller() -> Iterator[ReportingPoller]:
    made = ReportingPoller()
    yield made
    made.stop()


@pytest.fixture
def health_is_checked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """`Appliance.log_events` logs each change of a device, not only once a second."""
    monkeypatch.setattr(running, "HEALTH_CHECK_INTERVAL", 0.0)
