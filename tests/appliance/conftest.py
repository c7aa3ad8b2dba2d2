"""What the tests of appliances share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast import logs
from support import web

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def log() -> Iterator[web.Records]:
    """All that the project logs, from level info."""
    records = web.Records()
    level = logs.LOGGER.level
    logs.LOGGER.addHandler(records)
    logs.LOGGER.setLevel("INFO")
    yield records
    logs.LOGGER.removeHandler(records)
    logs.LOGGER.setLevel(level)
