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
