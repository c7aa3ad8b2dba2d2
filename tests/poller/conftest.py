"""A poller for tests that give it devices."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast._core import Poller

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def poller() -> Iterator[Poller]:
    made = Poller([])
    yield made
    made.stop()
