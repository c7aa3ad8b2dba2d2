"""A poller for tests that give it devices."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

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
    monkeypatch.setattr("holdfast.appliance.appliance.CHECK_INTERVAL_S", 0.0)
